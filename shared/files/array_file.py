"""Reader of untrusted .npy files with numbers.

The size in the header is checked before any allocation.
"""

import re
from pathlib import Path

import numpy as np

from sextant.shared.files.input_file import FileError, read_bytes
from sextant.shared.geometry import Array

_MAX_CELLS = 1 << 24
_MAGIC = b"\x93NUMPY"
_HEADER = re.compile(
    rb"\s*\{\s*'descr':\s*'(?P<type>[<>|=]?[biuf][1248])',"
    rb"\s*'fortran_order':\s*(?P<fortran>True|False),\s*'shape':\s*\((?P<shape>[0-9, ]*)\),?\s*\}\s*"
)
_OTHER_TYPE = re.compile(rb"'descr':\s*('[^']{1,20}'|\[)")


def read_numbers(path: Path) -> Array:
    """Read the array of a .npy file as floats.

    Pickled objects, records and complex numbers are refused.

    Raises:
        FileError: The file cannot be read, is truncated, or contains something else.
    """
    data = read_bytes(path, 8 * _MAX_CELLS + 65536)
    if len(data) < 10 or not data.startswith(_MAGIC):
        raise FileError(path, "a .npy array expected, found something else")
    size = 2 if data[6] == 1 else 4  # [bytes] of the header length field
    begin = 8 + size + int.from_bytes(data[8 : 8 + size], "little")
    header = _HEADER.fullmatch(data[8 + size : begin])
    if header is None:
        other = _OTHER_TYPE.search(data[8 + size : begin])
        found = "a damaged header" if other is None else _type_name(other[1])
        raise FileError(path, f"a .npy array of numbers expected, found {found}")
    digits = [int(n[:20]) for n in header["shape"].decode().replace(" ", "").split(",") if n]
    return _filled(path, data[begin:], header["type"].decode(), digits, header["fortran"] == b"True")


def _filled(path: Path, data: bytes, descr: str, shape: list[int], fortran: bool) -> Array:
    """Return the array that a header describes, from the bytes after it."""
    count, kind = 1, np.dtype(descr)
    for length in shape:
        count *= length
    found = "x".join(map(str, shape)) or "a single value"
    if not 0 < count <= _MAX_CELLS or len(shape) > 8:
        raise FileError(path, f"an array of 1 to {_MAX_CELLS} numbers expected, found {found:.80}")
    if len(data) != count * kind.itemsize:
        raise FileError(path, f"{count * kind.itemsize} bytes for {found:.80} numbers expected, found {len(data)}")
    values = np.frombuffer(data, dtype=kind).reshape(shape, order="F" if fortran else "C")
    return np.ascontiguousarray(values, dtype=np.float64)


def _type_name(descr: bytes) -> str:
    if descr == b"[":
        return "records"
    return "pickled objects" if b"O" in descr else f"type {descr[1:-1].decode('latin-1')!r}"
