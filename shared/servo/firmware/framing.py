"""Frames on a serial line: byte stuffing (COBS) between zeros, with a CRC.

    00 | COBS( payload | CRC-32, little-endian ) | 00

Zero bytes occur only around frames. A receiver that is out of sync recovers at the next zero, and one broken byte damages at
most one frame. CRC-32 (zlib's) misses one broken frame in four thousand million. The module has no port and no clock.
"""

import binascii

MAX_PAYLOAD = 400  # [bytes] including the CRC
MAX_FRAME = MAX_PAYLOAD + MAX_PAYLOAD // 254 + 1  # [bytes] between the zeros

_CRC_SIZE = 4  # [bytes]
_ZERO = b"\0"
_BLOCK = 254  # maximum bytes after one code byte


class Broken:
    """Reasons for which the bytes between two zeros are not a frame."""

    LONG = "frame too long"
    STUFFING = "frame cut or broken"
    CRC = "frame with a wrong CRC"


def frame(payload: bytes) -> bytes:
    """Return the frame of a payload: with its CRC, stuffed, between zeros.

    Raises:
        ValueError: The payload is too long.
    """
    if len(payload) + _CRC_SIZE > MAX_PAYLOAD:
        raise ValueError(f"at most {MAX_PAYLOAD - _CRC_SIZE} bytes of payload expected, found {len(payload)}")
    return _ZERO + stuffed(payload + _crc(payload)) + _ZERO


def stuffed(data: bytes) -> bytes:
    """Encode bytes without zeros, by consistent overhead byte stuffing (COBS).

    A code byte precedes each run of other bytes.
    """
    out = bytearray()
    run = block = b""
    for run in data.split(_ZERO):
        block = run
        if len(run) < _BLOCK:  # the usual case
            out.append(len(run) + 1)
            out += run
            continue
        while len(block) >= _BLOCK:
            out.append(0xFF)
            out += block[:_BLOCK]
            block = block[_BLOCK:]
        out.append(len(block) + 1)
        out += block
    if not block and run:  # the last run ends with a full block, which implies no zero
        return bytes(out[:-1])
    return bytes(out)


def unstuffed(data: bytes) -> bytes | None:
    """Decode `stuffed` bytes without zeros; None if they are truncated."""
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


def _crc(payload: bytes) -> bytes:
    return binascii.crc32(payload).to_bytes(_CRC_SIZE, "little")


class Deframer:
    """Decoder of payloads in an arbitrary byte stream; it buffers at most one frame."""

    def __init__(self) -> None:
        """Start between two frames."""
        self.broken: dict[str, int] = {}  # number of broken frames, by `Broken`
        self._buffer = b""
        self._overlong = False

    @property
    def pending(self) -> int:
        """Number of buffered bytes of an incomplete frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """Add the next bytes of the stream, and return the completed payloads."""
        payloads: list[bytes] = []
        start = 0
        end = data.find(_ZERO)
        while end >= 0:
            self._keep(data[start:end])
            payload = self._complete()
            if payload is not None:
                payloads.append(payload)
            start = end + 1
            end = data.find(_ZERO, start)
        self._keep(data[start:])
        return payloads

    def _keep(self, data: bytes) -> None:
        if len(self._buffer) + len(data) > MAX_FRAME:
            self._overlong = True
        self._buffer = b"" if self._overlong else self._buffer + data

    def _complete(self) -> bytes | None:
        """Return the payload of the frame that just ended, or None.

        Broken frames are counted.
        """
        stuffing, overlong = self._buffer, self._overlong
        self._buffer = b""
        self._overlong = False
        if not (stuffing or overlong):
            return None
        data = None if overlong else unstuffed(stuffing)
        if data is None or len(data) < _CRC_SIZE:
            self._count(Broken.LONG if overlong else Broken.STUFFING)
            return None
        payload = data[:-_CRC_SIZE]
        if _crc(payload) != data[-_CRC_SIZE:]:
            self._count(Broken.CRC)
            return None
        return payload

    def _count(self, reason: str) -> None:
        self.broken[reason] = self.broken.get(reason, 0) + 1
