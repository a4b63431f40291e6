"""CDR codec for ROS 2 messages: plain CDR of XCDR version 1.

rmw_zenoh and the DDS implementations use this format. A message is a mapping from field names to values: numbers, strings,
mappings, lists, and NumPy arrays for arrays of numbers. A header of four bytes states the encoding. Each value is aligned to
its own size, counted from the end of the header.

Source: OMG DDS-XTypes 1.3, 7.4.1 (plain CDR) and 7.6.3.1.2 (encapsulation).
"""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from sextant.deploy.ros2.interface import Field, fields

Value = Mapping[str, Any]

# Type codes of plain numbers for struct and NumPy, without the byte order.
_NUMBERS = {
    "bool": "?",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_LITTLE, _BIG = b"\x00\x01", b"\x00\x00"
_HEAD = 4  # bytes
_PADDING = 3  # bytes that may follow the last field, up to a multiple of four


class CdrError(ValueError):
    """Bytes are not the expected message; the text states why."""


def encode(name: str, value: Value) -> bytes:
    """Encode a message, little-endian.

    Args:
        name: Of the message, e.g. "geometry_msgs/msg/Twist".
        value: Exactly the fields of the message.

    Raises:
        ValueError: A field is missing or unknown, or an array does not have the defined length.
    """
    out = bytearray(_LITTLE + b"\0\0")
    _write(out, name, value)
    return bytes(out)


def decode(name: str, data: bytes) -> dict[str, Any]:
    """Decode a message of either byte order; arrays of numbers are NumPy arrays.

    Raises:
        CdrError: The bytes are not exactly such a message.
    """
    if len(data) < _HEAD or data[:2] not in (_LITTLE, _BIG):
        raise CdrError(f"{name}: plain CDR expected, which begins with 00 01 or 00 00, found {data[:4].hex(' ') or 'nothing'}")
    reader = _Reader(data, "<" if data[:2] == _LITTLE else ">", name)
    value = reader.message(name)
    if len(data) - reader.at > _PADDING:
        raise CdrError(f"{name}: {reader.at} bytes expected, found {len(data)}")
    return value


def _align(out: bytearray, size: int) -> None:
    out += bytes(-(len(out) - _HEAD) % size)


def _write(out: bytearray, name: str, value: Value) -> None:
    known = fields(name)
    if value.keys() != {field.name for field in known}:
        raise ValueError(f"{name}: fields {', '.join(field.name for field in known)} expected, found {', '.join(value)}")
    for field in known:
        where = f"{name}.{field.name}"
        if field.array:
            _write_array(out, field, value[field.name], where)
        else:
            _write_one(out, field.base, value[field.name], where)


def _write_array(out: bytearray, field: Field, values: Any, where: str) -> None:
    count = len(values)
    if (field.array == "fixed" and count != field.length) or (field.array == "bounded" and count > field.length):
        raise ValueError(f"{where}: {field.length} values expected, found {count}")
    if field.array != "fixed":
        _write_one(out, "uint32", count, where)
    if field.base in _NUMBERS:
        dtype = np.dtype(f"<{_NUMBERS[field.base]}")
        if count:
            _align(out, dtype.itemsize)
            out += np.ascontiguousarray(values, dtype=dtype).tobytes()
        return
    for one in values:
        _write_one(out, field.base, one, where)


def _write_one(out: bytearray, base: str, value: Any, where: str) -> None:
    if base in _NUMBERS:
        code = f"<{_NUMBERS[base]}"
        _align(out, struct.calcsize(code))
        try:
            out += struct.pack(code, value)
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{where}: a {base} expected, found {value!r:.40}: {error}") from None
    elif base == "string":
        text = value.encode()
        _write_one(out, "uint32", len(text) + 1, where)
        out += text + b"\0"
    else:
        _write(out, base, value)


class _Reader:
    """Reads bytes once, from the front."""

    def __init__(self, data: bytes, order: str, name: str):
        self.at = _HEAD
        self._data, self._order, self._name = data, order, name

    def message(self, name: str) -> dict[str, Any]:
        return {field.name: self._array(field) if field.array else self._one(field.base) for field in fields(name)}

    def _array(self, field: Field) -> Any:
        count = field.length if field.array == "fixed" else self._number("uint32")
        if field.array == "bounded" and count > field.length:
            raise CdrError(f"{self._name}: at most {field.length} values of {field.name} expected, found {count}")
        if field.base in _NUMBERS:
            return self._numbers(field.base, count)
        if count > len(self._data) - self.at:  # each of them takes at least a byte
            raise CdrError(f"{self._name}: {count} values of {field.name} do not fit its {len(self._data)} bytes")
        return [self._one(field.base) for _ in range(count)]

    def _one(self, base: str) -> Any:
        if base in _NUMBERS:
            return self._number(base)
        return self._text() if base == "string" else self.message(base)

    def _number(self, base: str) -> Any:
        return self._numbers(base, 1)[0].item()

    def _numbers(self, base: str, count: int) -> Any:
        dtype = np.dtype(f"{self._order}{_NUMBERS[base]}")
        if count:
            self.at += -(self.at - _HEAD) % dtype.itemsize
        taken = self._take(count * dtype.itemsize)
        if base == "bool" and taken.strip(b"\0\1"):
            raise CdrError(f"{self._name}: booleans of 0 or 1 expected, found {taken.hex(' '):.20}")
        return np.frombuffer(taken, dtype).astype(dtype.newbyteorder("="), copy=False)

    def _text(self) -> str:
        data = self._take(self._number("uint32"))
        if not data.endswith(b"\0"):
            raise CdrError(f"{self._name}: a text that ends with a zero byte expected")
        try:
            return data[:-1].decode()
        except UnicodeDecodeError:
            raise CdrError(f"{self._name}: a text in UTF-8 expected") from None

    def _take(self, size: int) -> bytes:
        begin, self.at = self.at, self.at + size
        if self.at > len(self._data):
            raise CdrError(f"{self._name}: at least {self.at} bytes expected, found {len(self._data)}")
        return self._data[begin : self.at]
