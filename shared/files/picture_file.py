"""Reader of untrusted PNG and JPEG images.

Size and format are checked before decoding.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.files.input_file import FileError, read_bytes

_MAX_FILE_BYTES = 256_000_000
_MAX_PIXELS = 1 << 24
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_KINDS = {0: "grey", 2: "colour", 3: "palette", 4: "grey with alpha", 6: "colour with alpha"}
_PNG_DECODED = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")  # other chunks are texts, profiles and additional images
_JPEG = b"\xff\xd8\xff"
_JPEG_NO_FRAMES = (0xC4, 0xC8, 0xCC)  # markers from 0xC0 to 0xCF that do not start a frame


@dataclass(frozen=True, slots=True)
class _Header:
    """Header of an image."""

    width: int  # [px]
    height: int  # [px]
    bits: int  # per channel
    kind: str


def read_grey(path: Path, bits: tuple[int, ...], size: tuple[int, int] | None = None) -> NDArray[np.uint8 | np.uint16]:
    """Read a grey PNG image (h, w) with its stored values.

    Args:
        path: The file.
        bits: Accepted bits per pixel: 8, 16 or both.
        size: Expected width and height [px]; None for any size up to 16 million pixels.

    Raises:
        FileError: The file cannot be read, is truncated or damaged, or has another format.
    """
    data = read_bytes(path, _MAX_FILE_BYTES)
    if not data.startswith(_PNG):
        raise FileError(path, "a PNG picture expected, found something else")
    header, data = _png(path, data)
    if header.kind != "grey" or header.bits not in bits:
        wanted = " or ".join(map(str, bits))
        raise FileError(path, f"a grey PNG of {wanted} bits expected, found {header.kind} of {header.bits} bits")
    _check_size(path, header, size)
    return _decoded(path, data, cv2.IMREAD_UNCHANGED, (header.height, header.width))


def read_color(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read a PNG or JPEG image as R, G, B (h, w, 3).

    Args:
        path: The file.
        size: Expected width and height [px].

    Raises:
        FileError: As in `read_grey`.
    """
    data = read_bytes(path, _MAX_FILE_BYTES)
    if data.startswith(_PNG):
        header, data = _png(path, data)
    elif data.startswith(_JPEG):
        header = _jpeg_header(path, data)
    else:
        raise FileError(path, "a PNG or JPEG picture expected, found something else")
    _check_size(path, header, size)
    bgr = _decoded(path, data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, (header.height, header.width, 3))
    return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)


def _check_size(path: Path, header: _Header, size: tuple[int, int] | None) -> None:
    found = f"{header.width}x{header.height}"
    if size is not None and (header.width, header.height) != size:
        raise FileError(path, f"a picture of {size[0]}x{size[1]} pixels expected, found {found}")
    if not 0 < header.width * header.height <= _MAX_PIXELS:
        raise FileError(path, f"a picture of 1 to {_MAX_PIXELS} pixels expected, found {found}")


def _decoded(path: Path, data: bytes, flags: int, shape: tuple[int, ...]) -> NDArray[np.uint8 | np.uint16]:
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        picture = None
    if picture is None or picture.shape != shape:
        raise FileError(path, "a whole picture expected, found damaged data")
    return np.asarray(picture)


def _png(path: Path, data: bytes) -> tuple[_Header, bytes]:
    """Return the header of a PNG, and its bytes without unused chunks."""
    chunks = list(_png_chunks(path, data))
    if len(chunks[0]) != len(b"IHDR") + 13 or not chunks[0].startswith(b"IHDR"):
        raise FileError(path, "a PNG picture expected, found one without its header")
    width, height, bits, kind = struct.unpack_from(">IIBB", chunks[0], len(b"IHDR"))
    kept = [chunk for chunk in chunks if chunk[:4] in _PNG_DECODED]
    whole = (struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in kept)
    return _Header(width, height, bits, _PNG_KINDS.get(kind, "an unknown kind")), _PNG + b"".join(whole)


def _png_chunks(path: Path, data: bytes) -> Iterator[bytes]:
    """Yield name and contents of each chunk, up to IEND."""
    at, name = len(_PNG), b""
    while name != b"IEND":
        length = int.from_bytes(data[at : at + 4], "big")
        chunk, checksum = data[at + 4 : at + 8 + length], data[at + 8 + length : at + 12 + length]
        if len(checksum) < 4:
            raise FileError(path, f"a whole PNG picture expected, found one that is cut off after {len(data)} bytes")
        if zlib.crc32(chunk) != int.from_bytes(checksum, "big"):
            raise FileError(path, f"a whole PNG picture expected, found one that is damaged at byte {at}")
        at, name = at + 12 + length, chunk[:4]
        yield chunk


def _jpeg_header(path: Path, data: bytes) -> _Header:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in _JPEG_NO_FRAMES:
            bits, height, width = struct.unpack_from(">BHH", data, at + 4)
            return _Header(width, height, bits, "colour")
        at += 1 if marker == 0xFF else 2 + max(length, 2)
    raise FileError(path, "a JPEG picture expected, found one without its header")
