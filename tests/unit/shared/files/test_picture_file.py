"""Pictures: the type is read from the header before a picture is decoded."""

import struct
import zlib
from pathlib import Path
from random import Random

import cv2
import numpy as np
import pytest

from sextant.shared.files.input_file import FileError
from sextant.shared.files.picture_file import read_color, read_grey

GREY = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000


def encoded(picture: np.ndarray, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, picture)[1].tobytes()


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width: int, height: int, bits: int, kind: int, *more: bytes) -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(more) + chunk(b"IEND", b"")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "picture.png"


def test_grey_image_is_read_as_stored(path: Path) -> None:
    path.write_bytes(encoded(GREY))
    np.testing.assert_array_equal(read_grey(path, bits=(16,), size=(4, 3)), GREY)
    path.write_bytes(encoded(GREY.astype(np.uint8)))
    np.testing.assert_array_equal(read_grey(path, bits=(8, 16)), GREY.astype(np.uint8))


def test_color_image_is_read_as_rgb(path: Path) -> None:
    picture = np.zeros((3, 4, 3), dtype=np.uint8)
    picture[:, :, 2] = 200  # of OpenCV's blue, green, red
    path.write_bytes(encoded(picture))
    np.testing.assert_array_equal(read_color(path, (4, 3))[0, 0], (200, 0, 0))
    path.write_bytes(encoded(picture, ".jpg"))
    np.testing.assert_allclose(read_color(path, (4, 3))[0, 0], (200, 0, 0), atol=3)


COLOUR = np.zeros((3, 4, 3), dtype=np.uint8)
DATA = chunk(b"IDAT", zlib.compress(bytes(1000)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"no picture", "a PNG picture expected, found something else"),
        (b"", "a PNG picture expected, found something else"),
        (encoded(COLOUR), "a grey PNG of 16 bits expected, found colour of 8 bits"),
        (encoded(GREY.astype(np.uint8)), "a grey PNG of 16 bits expected, found grey of 8 bits"),
        (encoded(GREY.T), "a picture of 4x3 pixels expected, found 3x4"),
        (encoded(GREY)[:-20], "found one that is cut off after"),
        (encoded(GREY)[:20], "found one that is cut off after 20 bytes"),
        (encoded(GREY).replace(b"IDAT", b"IDAX"), "found one that is damaged at byte 33"),
        (png(100_000, 100_000, 16, 0, DATA), "a picture of 4x3 pixels expected, found 100000x100000"),
        (png(4, 3, 16, 0, chunk(b"IDAT", b"nonsense")), "a whole picture expected, found damaged data"),
        (png(4, 3, 16, 0), "a whole picture expected, found damaged data"),
        (png(4, 3, 16, 9, DATA), "found an unknown kind of 16 bits"),
        (b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b""), "without its header"),
    ],
)
def test_unexpected_or_damaged_image_is_refused(path: Path, data: bytes, message: str) -> None:
    path.write_bytes(data)
    with pytest.raises(FileError, match=message):
        read_grey(path, bits=(16,), size=(4, 3))


def test_image_size_is_limited_without_expected_size(path: Path) -> None:
    path.write_bytes(png(100_000, 100_000, 8, 0, DATA))
    with pytest.raises(FileError, match="1 to 16777216 pixels expected, found 100000x100000"):
        read_grey(path, bits=(8,))


def test_text_chunks_of_png_are_not_unpacked(path: Path) -> None:
    bomb = chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(50 << 20)))
    data = encoded(GREY)
    path.write_bytes(data[:33] + bomb + data[33:])
    np.testing.assert_array_equal(read_grey(path, bits=(16,)), GREY)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_any_damaged_image_is_read_or_refused(path: Path, suffix: str) -> None:
    rng, good = Random(3), encoded(COLOUR, suffix)
    for _ in range(300):
        data = bytearray(good)
        data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data[: rng.choice((len(data), rng.randrange(len(data))))])
        try:
            assert read_color(path, (4, 3)).shape == (3, 4, 3)
        except FileError as error:
            assert error.cause  # noqa: PT017 - either is right
