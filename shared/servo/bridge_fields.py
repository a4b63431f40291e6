"""Kinds of fields of a message on a wire of plain msgpack values: what each may be, and how it is written."""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class Kind:
    """How one field looks on the wire, and what it may be."""

    def to_wire(self, value: Any) -> Any:
        """The plain value of a field; ValueError when the field may not be so."""
        raise NotImplementedError

    def from_wire(self, plain: Any) -> Any:
        """The field of a plain value, to be checked by `to_wire`; ValueError when it is of another type."""
        return plain


@dataclass(frozen=True)
class Whole(Kind):
    """A whole number within bounds."""

    low: int
    high: int

    def to_wire(self, value: Any) -> int:
        """The number itself."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise ValueError(f"a whole number from {self.low} to {self.high} expected, found {value!r:.40}")
        return value


@dataclass(frozen=True)
class Choice(Kind):
    """A member of an enumeration, by its number."""

    of: type[IntEnum]

    def to_wire(self, value: Any) -> int:
        """Its number."""
        if type(value) is not self.of:
            raise ValueError(f"a {self.of.__name__} expected, found {value!r:.40}")
        return int(value)

    def from_wire(self, plain: Any) -> IntEnum:
        """The member of a number."""
        if type(plain) is not int or plain not in [member.value for member in self.of]:
            raise ValueError(f"a {self.of.__name__} expected, found {plain!r:.40}")
        return self.of(plain)


@dataclass(frozen=True)
class Text(Kind):
    """Printable ASCII."""

    most: int

    def to_wire(self, value: Any) -> str:
        """The text itself."""
        if type(value) is not str or len(value) > self.most or not (value.isascii() and value.isprintable()):
            raise ValueError(f"a text of at most {self.most} plain characters expected, found {value!r:.40}")
        return value


@dataclass(frozen=True)
class Octets(Kind):
    """Bytes, one a value."""

    most: int
    high: int = 0xFF

    def to_wire(self, value: Any) -> bytes:
        """The bytes themselves."""
        if type(value) is not bytes or len(value) > self.most or max(value, default=0) > self.high:
            raise ValueError(f"at most {self.most} bytes of 0 to {self.high} expected, found {value!r:.40}")
        return value


@dataclass(frozen=True)
class Words(Kind):
    """Numbers of two bytes, little-endian, as raw bytes on the wire."""

    high: int
    most: int

    def to_wire(self, value: Any) -> bytes:
        """Two bytes a number."""
        whole = type(value) is tuple and len(value) <= self.most and all(type(v) is int for v in value)
        if not whole or (value and not 0 <= min(value) <= max(value) <= self.high):
            raise ValueError(f"at most {self.most} whole numbers from 0 to {self.high} expected, found {value!r:.40}")
        return struct.pack(f"<{len(value)}H", *value)

    def from_wire(self, plain: Any) -> tuple[int, ...]:
        """The numbers of their bytes."""
        if type(plain) is not bytes or len(plain) % 2:
            raise ValueError(f"bytes of two-byte numbers expected, found {plain!r:.40}")
        return struct.unpack(f"<{len(plain) // 2}H", plain)
