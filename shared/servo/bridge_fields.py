"""Field types of the bridge messages: allowed values and msgpack representation."""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class Kind:
    """Base class of the field types."""

    def to_wire(self, value: Any) -> Any:
        """Return the plain value of a field; raises ValueError for an invalid field."""
        raise NotImplementedError

    def from_wire(self, plain: Any) -> Any:
        """Return the field of a plain value; raises ValueError for a wrong type.

        `to_wire` checks the value.
        """
        return plain


@dataclass(frozen=True)
class Whole(Kind):
    """Integer within bounds."""

    low: int
    high: int

    def to_wire(self, value: Any) -> int:
        """Return the number, checked."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise ValueError(f"a whole number from {self.low} to {self.high} expected, found {value!r:.40}")
        return value


@dataclass(frozen=True)
class Choice(Kind):
    """Member of an enumeration, sent as its number."""

    of: type[IntEnum]

    def to_wire(self, value: Any) -> int:
        """Return the number of a member."""
        if type(value) is not self.of:
            raise ValueError(f"a {self.of.__name__} expected, found {value!r:.40}")
        return int(value)

    def from_wire(self, plain: Any) -> IntEnum:
        """Return the member with a number."""
        if type(plain) is not int or plain not in [member.value for member in self.of]:
            raise ValueError(f"a {self.of.__name__} expected, found {plain!r:.40}")
        return self.of(plain)


@dataclass(frozen=True)
class Text(Kind):
    """Text of printable ASCII characters."""

    most: int

    def to_wire(self, value: Any) -> str:
        """Return the text, checked."""
        if type(value) is not str or len(value) > self.most or not (value.isascii() and value.isprintable()):
            raise ValueError(f"a text of at most {self.most} plain characters expected, found {value!r:.40}")
        return value


@dataclass(frozen=True)
class Octets(Kind):
    """Values of one byte each."""

    most: int
    high: int = 0xFF

    def to_wire(self, value: Any) -> bytes:
        """Return the bytes, checked."""
        if type(value) is not bytes or len(value) > self.most or max(value, default=0) > self.high:
            raise ValueError(f"at most {self.most} bytes of 0 to {self.high} expected, found {value!r:.40}")
        return value


@dataclass(frozen=True)
class Words(Kind):
    """Integers of two bytes each, little-endian, sent as raw bytes; in two's complement if some are negative."""

    low: int
    high: int
    most: int

    def to_wire(self, value: Any) -> bytes:
        """Return the numbers as bytes, two per number."""
        whole = type(value) is tuple and len(value) <= self.most and all(type(v) is int for v in value)
        if not whole or (value and not self.low <= min(value) <= max(value) <= self.high):
            raise ValueError(f"at most {self.most} whole numbers from {self.low} to {self.high} expected, found {value!r:.40}")
        return struct.pack(f"<{len(value)}{self._code}", *value)

    def from_wire(self, plain: Any) -> tuple[int, ...]:
        """Return the numbers encoded in bytes."""
        if type(plain) is not bytes or len(plain) % 2:
            raise ValueError(f"bytes of two-byte numbers expected, found {plain!r:.40}")
        return struct.unpack(f"<{len(plain) // 2}{self._code}", plain)

    @property
    def _code(self) -> str:
        return "h" if self.low < 0 else "H"
