"""Search for packets in a byte stream with noise and broken or truncated packets, for any protocol with a fixed header."""

from abc import ABC, abstractmethod
from collections import Counter
from enum import StrEnum

from sextant.shared.servo.servo_model import Packet


class Dropped(StrEnum):
    """Reason for which a parser dropped bytes."""

    NOISE = "noise"  # counts bytes outside packets, not packets
    LENGTH = "bad length"
    CHECKSUM = "bad checksum"
    TRUNCATED = "truncated"
    DIRECTION = "wrong direction"  # an instruction among responses, as from an adapter that echoes, or the reverse


class StreamParser(ABC):
    """Parser that finds packets by their header, length and checksum.

    After a broken packet the search continues right after its first byte, so an intact packet inside it is found. Any split of
    a stream gives the same packets.
    """

    header: bytes
    head_size: int  # [bytes] of a packet from its header to its length

    def __init__(self, max_length: int, *, keep_broken: bool = False, instructions: bool = False) -> None:
        """Start at stream offset 0.

        Args:
            max_length: Largest accepted length; a lower value recovers sooner on a bus with short packets.
            keep_broken: Also return packets with a wrong checksum, with `intact` False.
            instructions: Return the packets from the host to the servos; otherwise, the responses of the servos.
        """
        self.dropped: Counter[str] = Counter()  # by `Dropped`; bytes for NOISE, else packets
        self._max_length = max_length
        self._keep_broken = keep_broken
        self._instructions = instructions
        self._buffer = bytearray()
        self._offset = 0  # stream offset of the buffer's first byte

    @property
    def pending(self) -> int:
        """Number of buffered bytes of an incomplete packet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """Add the next bytes of the stream, and return the completed packets."""
        self._buffer += data
        return self._parse()

    def flush(self) -> list[Packet]:
        """Give up an incomplete packet, and return the intact packets inside it."""
        found: list[Packet] = []
        while self._buffer:
            self._reject(Dropped.NOISE if len(self._buffer) < self.head_size else Dropped.TRUNCATED)
            found += self._parse()
        return found

    @abstractmethod
    def _size(self) -> int | Dropped | None:
        """Return the size of the packet that starts the buffer.

        It is a reason when there is no such packet, and None when the next bytes decide.
        """

    @abstractmethod
    def _is_intact(self, raw: bytes) -> bool:
        """Return whether the checksum of a whole packet is right."""

    @abstractmethod
    def _is_instruction(self, raw: bytes) -> bool:
        """Return whether the host sends this whole packet."""

    @abstractmethod
    def _decode(self, raw: bytes, end: int, *, intact: bool) -> Packet:
        """Return a whole packet, with its stream offset and whether its checksum is right."""

    def _parse(self) -> list[Packet]:
        found: list[Packet] = []
        while self._find_header():
            size = self._size()
            if isinstance(size, Dropped):
                self._reject(size)
                continue
            if size is None or len(self._buffer) < size:
                break
            raw = bytes(self._buffer[:size])
            intact, wanted = self._is_intact(raw), self._is_instruction(raw) == self._instructions
            if wanted and (intact or self._keep_broken):
                found.append(self._decode(raw, self._offset + size, intact=intact))
            if not intact:
                self._reject(Dropped.CHECKSUM)
                continue
            if not wanted:
                self.dropped[Dropped.DIRECTION] += 1
            self._drop(size)
        return found

    def _find_header(self) -> bool:
        """Drop the bytes before the next header; return whether there is one."""
        start = self._buffer.find(self.header)
        noise = start
        if start < 0:  # the last bytes may be the first ones of a header
            head = next((n for n in range(len(self.header) - 1, 0, -1) if self._buffer.endswith(self.header[:n])), 0)
            noise = len(self._buffer) - head
        if noise:
            self.dropped[Dropped.NOISE] += noise
            self._drop(noise)
        return start >= 0

    def _reject(self, reason: Dropped) -> None:
        """Count what starts the buffer, and continue after its first byte."""
        self.dropped[reason] += 1
        self._drop(1)

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._offset += count
