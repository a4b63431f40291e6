"""Frames on a serial line: consistent overhead byte stuffing between zeros, closed by a CRC.

    00 | COBS( payload | CRC-32, little-endian ) | 00

A zero byte stands nowhere but around a frame, so a receiver that has lost its place finds it at the next one, and any one
broken byte spoils at most one frame. CRC-32 (zlib's) lets one broken frame in four thousand million through. Bytes in, bytes
out; no port, no clock.
"""

import struct
import zlib
from collections import Counter
from enum import StrEnum

MAX_PAYLOAD = 400  # [bytes] with the CRC
MAX_FRAME = MAX_PAYLOAD + MAX_PAYLOAD // 254 + 1  # [bytes] between the zeros

_CRC = struct.Struct("<I")
_ZERO = b"\0"
_BLOCK = 254  # most bytes behind one code


class Broken(StrEnum):
    """Why what stood between two zeros is no frame."""

    LONG = "frame too long"
    STUFFING = "frame cut or broken"
    CRC = "frame with a wrong CRC"


def frame(payload: bytes) -> bytes:
    """A payload with its CRC, stuffed, between zeros.

    Raises:
        ValueError: It is too long.
    """
    if len(payload) + _CRC.size > MAX_PAYLOAD:
        raise ValueError(f"at most {MAX_PAYLOAD - _CRC.size} bytes of payload expected, found {len(payload)}")
    return _ZERO + stuffed(payload + _CRC.pack(zlib.crc32(payload))) + _ZERO


def stuffed(data: bytes) -> bytes:
    """Consistent overhead byte stuffing: the same bytes without a zero, a code byte before each run of others."""
    out = bytearray()
    block = b""
    for run in data.split(_ZERO):
        block = run
        while len(block) >= _BLOCK:
            out.append(0xFF)
            out += block[:_BLOCK]
            block = block[_BLOCK:]
        out.append(len(block) + 1)
        out += block
    if not block and run:  # the last run ends with a full block, behind which no zero is meant
        out.pop()
    return bytes(out)


def unstuffed(data: bytes) -> bytes | None:
    """The inverse of `stuffed`; None where it is cut. Zeros must not be in it."""
    out = bytearray()
    at = 0
    while at < len(data):
        code = data[at]
        end = at + code
        if end > len(data):
            return None
        out += data[at + 1 : end]
        if code <= _BLOCK and end < len(data):
            out.append(0)
        at = end
    return bytes(out)


class Deframer:
    """Payloads out of a byte stream that may hold anything. It keeps at most one frame's bytes."""

    def __init__(self) -> None:
        """Begin between two frames."""
        self.broken: Counter[str] = Counter()  # frames, by `Broken`
        self._buffer = bytearray()
        self._overlong = False

    @property
    def pending(self) -> int:
        """Bytes kept of a frame that has not ended."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """Take the next bytes of the stream and return the payloads that they complete."""
        payloads: list[bytes] = []
        start = 0
        while (end := data.find(0, start)) >= 0:
            self._keep(data[start:end])
            payload = self._complete()
            if payload is not None:
                payloads.append(payload)
            start = end + 1
        self._keep(data[start:])
        return payloads

    def _keep(self, data: bytes) -> None:
        self._overlong |= len(self._buffer) + len(data) > MAX_FRAME
        if self._overlong:
            self._buffer.clear()
        else:
            self._buffer += data

    def _complete(self) -> bytes | None:
        """The payload of the frame that has just ended, or None, counted where there was something."""
        stuffing, overlong = bytes(self._buffer), self._overlong
        self._buffer.clear()
        self._overlong = False
        if not (stuffing or overlong):
            return None
        data = None if overlong else unstuffed(stuffing)
        if data is None or len(data) < _CRC.size:
            self.broken[Broken.LONG if overlong else Broken.STUFFING] += 1
            return None
        payload = data[: -_CRC.size]
        if zlib.crc32(payload) != _CRC.unpack(data[-_CRC.size :])[0]:
            self.broken[Broken.CRC] += 1
            return None
        return payload
