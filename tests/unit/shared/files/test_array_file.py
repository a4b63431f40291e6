"""Arrays in .npy files: only numbers are read.

Nothing is allocated for the size that a header claims.
"""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.files.array_file import read_numbers
from sextant.shared.files.input_file import FileError


def header(text: str, major: int = 1) -> bytes:
    data = text.encode()
    return b"\x93NUMPY" + bytes([major, 0]) + len(data).to_bytes(2 if major == 1 else 4, "little") + data


def saved(folder: Path, array: object) -> Path:
    np.save(folder / "array.npy", np.asarray(array))
    return folder / "array.npy"


@pytest.mark.parametrize("dtype", ["<f8", ">f4", "<f2", "|u1", "<i8", ">u2", "|b1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_numpy_are_read(tmp_path: Path, dtype: str, order: str) -> None:
    array = np.array([[0, 1, 2], [3, 4, 100]]).astype(dtype, order=order)  # type: ignore[call-overload]
    found = read_numbers(saved(tmp_path, array))
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, array)


def test_newer_header_and_nan_are_read(tmp_path: Path) -> None:
    with (tmp_path / "two.npy").open("wb") as file:
        np.lib.format.write_array(file, np.array([np.nan, 1.0]), version=(2, 0))
    np.testing.assert_array_equal(read_numbers(tmp_path / "two.npy"), [np.nan, 1.0])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"0.1 0.2\n", "a .npy array expected, found something else"),
        (b"", "a .npy array expected"),
        (b"\x93NUMPY\x01", "a .npy array expected"),
        (header("{'descr': '|O', 'fortran_order': False, 'shape': (2,), }"), "of numbers expected, found pickled objects"),
        (header("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (2,), }"), "found records"),
        (header("{'descr': '<c16', 'fortran_order': False, 'shape': (2,), }"), "found type '<c16'"),
        (header("[" * 60_000), "found a damaged header"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }"), "16777216 numbers expected, found"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 5000 + ",), }"), "16777216 numbers expected"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (0, 5), }"), "found 0x5"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (4, 4), }") + bytes(8), "128 bytes for 4x4 .* found 8"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }") + bytes(16), "8 bytes for 1 .* found 16"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1," * 40 + "), }") + bytes(8), "found 1x1x"),
    ],
)
def test_invalid_file_is_refused_with_little_memory(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "bad.npy"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(FileError, match=message) as caught:
            read_numbers(path)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value)) < 400


@settings(max_examples=200)
@given(st.integers(0, 200), st.integers(0, 255), st.integers(0, 400))
def test_file_with_any_changed_byte_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, at: int, value: int, cut: int
) -> None:
    path = saved(tmp_path_factory.mktemp("npy"), np.eye(5))
    data = bytearray(path.read_bytes())[: cut if cut > 8 else None]
    data[at : at + 1] = bytes([value])
    path.write_bytes(data)
    try:
        assert read_numbers(path).dtype == np.float64
    except FileError as error:
        assert error.cause  # noqa: PT017 - either is right
