"""Message <-> bytes; the only file that knows msgpack.

A frame is a msgpack header and behind it the raw bytes of the arrays, 8-byte aligned:

    uint32 little-endian header length | header | padding | array | padding | array ...

    header = [schema, began_ns, sent_ns, [field, ...]]   an array field is [dtype, [length, ...], offset into the arrays]

Sending copies an array once, into the frame; receiving does not copy: arrays are read-only views of the frame. `schema` is a
hash of the message's declaration, so two versions that disagree refuse each other by name instead of misreading.
"""

import hashlib
import struct
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, TypeVar, cast

import msgpack
import numpy as np

from shared.messages import MAX_ITEMS, MAX_LENGTH, MAX_TEXT, Message, schema

M = TypeVar("M", bound=Message)

_PREFIX = struct.Struct("<I")
_ALIGNMENT = 8
_MAX_HEADER = 1 << 20  # [bytes]


class DecodeError(ValueError):
    """A frame that is not what its topic says, with the reason in words."""


@dataclass(frozen=True, slots=True)
class Timing:
    """When the sender began the step that made a message, and when it sent it [ns, sender's clock]."""

    began_ns: int
    sent_ns: int


_SCHEMA_IDS: dict[type[Message], str] = {}


def schema_id(kind: type[Message]) -> str:
    """Name and hash of a message's declaration."""
    known = _SCHEMA_IDS.get(kind)
    if known is None:
        known = _SCHEMA_IDS[kind] = _schema_id(kind)
    return known


def _schema_id(kind: type[Message]) -> str:
    declaration = repr([(name, str(base), str(detail)) for name, base, detail in schema(kind)])
    return f"{kind.__name__}:{hashlib.blake2s(declaration.encode(), digest_size=4).hexdigest()}"


def encode(message: Message, timing: Timing = Timing(0, 0)) -> bytes:
    """Encode a message as one frame."""
    fields: list[Any] = []
    buffers: list[memoryview | bytes] = []
    size = 0
    for name, kind, _ in schema(type(message)):
        value = getattr(message, name)
        if kind is np.ndarray:
            array = np.ascontiguousarray(value)
            fields.append([array.dtype.str, list(array.shape), size])
            buffers.append(array.reshape(-1).view(np.uint8).data)
            buffers.append(bytes(-array.nbytes % _ALIGNMENT))
            size += array.nbytes + len(buffers[-1])
        else:
            fields.append(str(value) if isinstance(value, StrEnum) else value)
    header = msgpack.packb([schema_id(type(message)), timing.began_ns, timing.sent_ns, fields], use_bin_type=True)
    gap = bytes(-(_PREFIX.size + len(header)) % _ALIGNMENT)
    return b"".join([_PREFIX.pack(len(header)), header, gap, *buffers])


def decode(frame: bytes, kind: type[M], max_bytes: int = 1 << 26) -> tuple[M, Timing]:
    """Decode a frame as a message of one type; arrays are read-only views of it.

    Raises:
        DecodeError: Anything at all is not as declared; nothing is repaired.
    """
    if len(frame) > max_bytes:
        raise DecodeError(f"{kind.__name__}: frame of at most {max_bytes} bytes expected, found {len(frame)}")
    if len(frame) < _PREFIX.size:
        raise DecodeError(f"{kind.__name__}: frame of {len(frame)} bytes is shorter than its prefix")
    (length,) = _PREFIX.unpack_from(frame)
    if length > min(_MAX_HEADER, len(frame) - _PREFIX.size):
        raise DecodeError(f"{kind.__name__}: header of {length} bytes does not fit the frame of {len(frame)}")
    found, began_ns, sent_ns, values = _unpack_header(frame[_PREFIX.size : _PREFIX.size + length], kind)
    if found != schema_id(kind):
        raise DecodeError(f"schema {schema_id(kind)} expected, found {found}: sender and receiver are different versions")
    fields = schema(kind)
    if len(values) != len(fields):
        raise DecodeError(f"{kind.__name__}: {len(fields)} fields expected, found {len(values)}")
    start = _PREFIX.size + length
    arrays = start + (-start % _ALIGNMENT)
    decoded: dict[str, Any] = {}
    for (name, base, detail), value in zip(fields, values, strict=True):
        decoded[name] = _decode_field(frame, arrays, f"{kind.__name__}.{name}", base, detail, value)
    try:
        return kind(**decoded), Timing(began_ns, sent_ns)
    except ValueError as error:
        raise DecodeError(str(error)) from None


def _unpack_header(header: bytes, kind: type[Message]) -> tuple[str, int, int, list[Any]]:
    try:
        unpacked = msgpack.unpackb(
            header,
            raw=False,
            strict_map_key=True,
            max_str_len=4 * MAX_TEXT,
            max_array_len=MAX_ITEMS,
            max_bin_len=0,
            max_map_len=0,
            max_ext_len=0,
        )
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise DecodeError(f"{kind.__name__}: header is not msgpack: {type(error).__name__}") from None
    match unpacked:
        case [str(found), int(began_ns), int(sent_ns), list(values)] if bool not in (type(began_ns), type(sent_ns)):
            return found, began_ns, sent_ns, values
        case _:
            raise DecodeError(f"{kind.__name__}: header of schema, two times and fields expected")


def _decode_field(frame: bytes, arrays: int, where: str, base: Any, detail: Any, value: Any) -> Any:
    if base is np.ndarray:
        return _decode_array(frame, arrays, where, detail[0], len(detail[1].shape), value)
    if base is tuple:
        return tuple(value) if isinstance(value, list) else value
    if isinstance(value, list | dict):  # perhaps so deeply nested that not even its repr could be had
        raise DecodeError(f"{where}: a single value expected, found a {type(value).__name__}")
    if base is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if base is not Literal and isinstance(base, type) and issubclass(base, StrEnum):
        try:
            return base(value)
        except ValueError:
            raise DecodeError(f"{where}: one of {[str(b) for b in base]} expected, found {value!r:.40}") from None
    return value


def _decode_array(frame: bytes, arrays: int, where: str, dtype: np.dtype[Any], ndim: int, value: Any) -> Any:
    match value:
        case [str(found), list(shape), int(offset)] if all(type(n) is int and 0 <= n <= MAX_LENGTH for n in shape):
            pass
        case _:
            raise DecodeError(f"{where}: an array's dtype, shape and offset expected")
    if found != dtype.str:
        raise DecodeError(f"{where}: an array of {dtype.str} expected, found {found[:10]!r}")
    if len(shape) != ndim:
        raise DecodeError(f"{where}: an array of {ndim} dimensions expected, found {len(shape)}")
    count = 1
    for n in shape:  # Python integers do not overflow
        count *= n
    begin = arrays + offset
    if offset < 0 or offset % _ALIGNMENT or begin + count * dtype.itemsize > len(frame):
        raise DecodeError(f"{where}: {count} values of {dtype.str} at offset {offset} do not fit the frame")
    if dtype.kind == "b" and np.frombuffer(frame, np.uint8, count, begin).max(initial=0) > 1:
        raise DecodeError(f"{where}: truth values of 0 or 1 expected")
    return cast(Any, np.frombuffer(frame, dtype, count, begin)).reshape(shape)
