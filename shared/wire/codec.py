"""Codec between messages and frames (bytes); the only file that uses msgpack.

A frame is a msgpack header, followed by the raw bytes of the arrays, 8-byte aligned:

    uint32 little-endian header length | header | padding | array | padding | array ...

    header = [schema, began_ns, sent_ns, [field, ...]]   an array field is [dtype, [length, ...], offset into the arrays]

Encoding copies each array once, into the frame. Decoding does not copy: arrays are read-only views of the frame. Packed arrays
are the exception. Their field [dtype, [length, ...], offset, bytes] refers to a Zstandard frame of the differences along the
first axis, zigzag coded, with low bytes before high ones; unpacking creates a new array. Floats and truth values are packed as
the integers with the same bits: nothing is rounded, and each NaN keeps its bits. A sender whose readers run on the same machine
sends packed arrays like others. `schema` is a hash of the message's declaration, so two versions with different
declarations refuse each other's messages instead of misreading them.

Frames are not trusted. Besides the checks of the message class, decoding refuses poses that are not rigid or lie more than
1000 km away, and numbers so large that computing with them may overflow.
"""

import hashlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from math import prod
from typing import Any, Literal, TypeAlias, TypeVar

import msgpack
import numpy as np
import zstandard
from numpy.typing import NDArray

from sextant.shared.wire.messages import MAX_ITEMS, MAX_LENGTH, MAX_TEXT, Message, schema

M = TypeVar("M", bound=Message)

_PREFIX = struct.Struct("<I")
_ALIGNMENT = 8
_MAX_HEADER = 1 << 20  # [bytes]
_INTEGER = frozenset([int])  # excludes bool
_HEADER = [str, int, int, list]
_FEW = 256  # [bytes] up to which testing the bytes is faster than making an array
_TRUTH_VALUES = b"\0\1"
_MAX_UNPACKED = 1 << 24  # [bytes] of a packed array
MAX_NUMBER = 1e12  # largest absolute value of a finite number in a frame; products of such numbers are finite too
MAX_DISTANCE = 1e6  # [m] of a pose from the origin of its frame
_RIGID = 1e-4  # tolerance of the rotation matrix of a received pose
_compress, _decompress = zstandard.ZstdCompressor(level=1).compress, zstandard.ZstdDecompressor().decompress


class DecodeError(ValueError):
    """The frame does not match its topic's declaration; the text gives the reason."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Start of the sender's step and time of sending [ns, sender's clock]."""

    began_ns: int
    sent_ns: int


@dataclass(frozen=True, slots=True)
class Label:
    """Header of a frame, readable for every version of Sextant."""

    schema_id: str
    stamp_ns: int  # [ns] of the message; -1 without one
    timing: Timing


def schema_id(kind: type[Message]) -> str:
    """Return the name and hash of a message's declaration."""
    return _layout(kind).schema_id


def encode(message: Message, timing: Timing = Timing(0, 0), packs: bool = True) -> bytes:
    """Encode a message as one frame; without `packs` no array is packed, for readers on the same machine."""
    layout = _layout(type(message))
    fields: list[Any] = []
    buffers: list[Any] = []
    size = 0
    for field in layout.fields:
        value = getattr(message, field.name)
        if field.dtype:
            if field.packed and packs:
                buffer: Any = _packed(value)
                length = len(buffer)
                fields.append((field.dtype, value.shape, size, length))
            else:
                array = np.ascontiguousarray(value)
                buffer, length = array.data, array.nbytes
                fields.append((field.dtype, array.shape, size))
            buffers.append(buffer)
            gap = -length % _ALIGNMENT
            if gap:
                buffers.append(bytes(gap))
            size += length + gap
        else:
            fields.append(str(value) if isinstance(value, StrEnum) else value)
    header = msgpack.packb((layout.schema_id, timing.began_ns, timing.sent_ns, fields), use_bin_type=True)
    gap = -(_PREFIX.size + len(header)) % _ALIGNMENT
    return b"".join((_PREFIX.pack(len(header)), header, bytes(gap), *buffers))


def decode(frame: bytes, kind: type[M], max_bytes: int = 1 << 26) -> tuple[M, Timing]:
    """Decode a frame as a message of one type; arrays are read-only views of it.

    Raises:
        DecodeError: The frame differs from the declaration; nothing is repaired.
    """
    if len(frame) > max_bytes:
        raise DecodeError(f"{kind.__name__}: frame of at most {max_bytes} bytes expected, found {len(frame)}")
    start, found, began_ns, sent_ns, values = _header(frame, kind.__name__)
    layout = _layout(kind)
    if found != layout.schema_id:
        of_other_type = found.partition(":")[0] != kind.__name__
        why = (
            "the sender publishes another type under this key"
            if of_other_type
            else "sender and receiver need the same version of Sextant"
        )
        raise DecodeError(f"schema {layout.schema_id} expected, found {found}: {why}")
    if len(values) != len(layout.fields):
        raise DecodeError(f"{kind.__name__}: {len(layout.fields)} fields expected, found {len(values)}")
    arrays = start + (-start % _ALIGNMENT)
    decoded = [field.decode(frame, arrays, value) for field, value in zip(layout.fields, values, strict=True)]
    try:
        message = kind(*decoded)
    except ValueError as error:
        raise DecodeError(str(error)) from None
    check_received(message)
    return message, Timing(began_ns, sent_ns)


def as_received(message: M) -> M:
    """Return a copy of a message, as `decode` returns it: with plain values, and read-only arrays of its own.

    `check_received` checks its values.
    """
    kind = type(message)
    made = object.__new__(kind)
    for field in _layout(kind).fields:
        value = getattr(message, field.name)
        if field.dtype:
            value = value.copy()
            value.setflags(write=False)
        elif field.plain is not None:
            value = field.plain(value)
        object.__setattr__(made, field.name, value)
    return made


def check_received(message: Message) -> None:
    """Check what a message's constructor does not check.

    Raises:
        DecodeError: Fields contradict each other, a pose is not rigid, or a number is too large.
    """
    if problem := message.contradiction():
        raise DecodeError(f"{type(message).__name__}: {problem}")
    for where, check, name in _layout(type(message)).claims:
        if problem := check(getattr(message, name)):
            raise DecodeError(f"{where}: {problem}")


def packed(frame: bytes, kind: type[Message]) -> bytes:
    """Return a frame with its arrays packed; unchanged if it has none to pack, or does not decode."""
    if not any(field.packed for field in _layout(kind).fields):
        return frame
    try:
        return encode(*decode(frame, kind))
    except DecodeError:
        return frame


def label(frame: bytes) -> Label:
    """Decode the header of a frame, without its arrays.

    Raises:
        DecodeError: The frame has no valid header.
    """
    _, found, began_ns, sent_ns, values = _header(frame, "a frame")
    stamp_ns = values[0] if values and type(values[0]) is int else -1
    return Label(found, stamp_ns, Timing(began_ns, sent_ns))


_FieldDecoder: TypeAlias = Callable[[bytes, int, Any], Any]  # frame, offset of its arrays, value in the header


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    dtype: str  # of an array, in the notation of NumPy's array interface; empty for other fields
    decode: _FieldDecoder
    packed: bool = False
    plain: Callable[[Any], Any] | None = None  # makes a plain value as decoding does; None if it leaves the value as it is


@dataclass(frozen=True, slots=True)
class _Layout:
    """Frame layout of one message type.

    It is computed once, because a frame arrives every millisecond.
    """

    schema_id: str
    fields: tuple[_Field, ...]
    claims: tuple[tuple[str, Callable[[Any], str], str], ...]  # full name of a field, check of its value, its name


_LAYOUTS: dict[type[Message], _Layout] = {}


def _layout(kind: type[Message]) -> _Layout:
    known = _LAYOUTS.get(kind)
    if known is None:
        fields = schema(kind)
        declaration = repr([(name, str(base), str(detail)) for name, base, detail in fields])
        hashed = f"{kind.__name__}:{hashlib.blake2s(declaration.encode(), digest_size=4).hexdigest()}"
        checks = [(f"{kind.__name__}.{field[0]}", _claim_check(*field[1:]), field[0]) for field in fields]
        claims = tuple((where, check, name) for where, check, name in checks if check is not None)
        known = _LAYOUTS[kind] = _Layout(hashed, tuple(_field(kind, *field) for field in fields), claims)
    return known


def _claim_check(base: Any, detail: Any) -> Callable[[Any], str] | None:
    """Return the additional check of a received value, or None without one.

    The message's constructor makes the other checks.
    """
    if base is float:
        return lambda value: "" if abs(value) <= MAX_NUMBER else f"a number of at most {MAX_NUMBER:g} expected, found {value:g}"
    if base is np.ndarray and detail[0].kind == "f" and detail[1].finite:
        return _pose_problem if detail[1].shape == (4, 4) else _size_problem
    return None


def _size_problem(value: NDArray[Any]) -> str:
    # A small sum of squares proves that all values are small, at a third of the cost. A large sum needs the full test.
    if np.vdot(value, value) <= MAX_NUMBER**2 or not (largest := float(np.abs(value).max(initial=0.0))) > MAX_NUMBER:
        return ""
    return f"numbers of at most {MAX_NUMBER:g} expected, found {largest:g}"


def _pose_problem(value: NDArray[Any]) -> str:
    """Return the error in a pose, or an empty text.

    It uses plain floats, because poses arrive every few milliseconds.
    """
    x, y, z, last = value.tolist()
    (a, b, c, _), (d, e, f, _), (g, h, i, _) = x, y, z
    off = (a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0)
    skew = (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if not (max(map(abs, off + skew)) <= _RIGID and det > 0.0 and last == [0.0, 0.0, 0.0, 1.0]):
        return "a pose expected, a rotation and a translation (4, 4)"
    far = max(abs(x[3]), abs(y[3]), abs(z[3]))
    return f"a pose within {MAX_DISTANCE:g} m of its frame's origin expected, found {far:g} m" if far > MAX_DISTANCE else ""


def _field(kind: type[Message], name: str, base: Any, detail: Any) -> _Field:
    where = f"{kind.__name__}.{name}"
    if base is np.ndarray:
        dtype, dims = detail
        if dims.packed:
            return _Field(name, dtype.str, _packed_decoder(where, dtype, len(dims.shape)), packed=True)
        return _Field(name, dtype.str, _array_decoder(where, dtype, len(dims.shape)))
    return _Field(name, "", _value_decoder(where, base), plain=_plain(base))


def _plain(base: Any) -> Callable[[Any], Any] | None:
    """Return the function that converts a value to the type that decoding gives it, or None."""
    if base is bool:
        return None
    if base is tuple:
        return lambda value: tuple(map(str, value))
    return base if isinstance(base, type) else str  # a number, a text or an enumeration; a choice is a text


def pack_values(values: list[Any]) -> bytes:
    """Encode plain values (integers, texts, bytes) as a msgpack array.

    This is for protocols without frames.
    """
    return bytes(msgpack.packb(values, use_bin_type=True))


def unpack_values(data: bytes, max_bytes: int = 0) -> Any:
    """Decode msgpack data with bounded arrays, texts and bytes.

    Maps and extensions are refused.

    Args:
        data: One msgpack value.
        max_bytes: Maximum length of raw bytes in it.

    Raises:
        DecodeError: The data is not msgpack, or exceeds a bound.
    """
    try:
        return msgpack.unpackb(
            data,
            raw=False,
            strict_map_key=True,
            max_str_len=4 * MAX_TEXT,
            max_array_len=MAX_ITEMS,
            max_bin_len=max_bytes,
            max_map_len=0,
            max_ext_len=0,
        )
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise DecodeError(f"not msgpack: {type(error).__name__}") from None


def _header(frame: bytes, name: str) -> tuple[int, str, int, int, list[Any]]:
    """Decode a frame's header: return its end, the schema, two times and the fields."""
    if len(frame) < _PREFIX.size:
        raise DecodeError(f"{name}: frame of {len(frame)} bytes is shorter than its prefix")
    (length,) = _PREFIX.unpack_from(frame)
    if length > min(_MAX_HEADER, len(frame) - _PREFIX.size):
        raise DecodeError(f"{name}: header of {length} bytes does not fit the frame of {len(frame)}")
    end = _PREFIX.size + length
    try:
        unpacked = unpack_values(frame[_PREFIX.size : end])
    except DecodeError as error:
        raise DecodeError(f"{name}: header is {error}") from None
    if type(unpacked) is not list or [*map(type, unpacked)] != _HEADER:  # a match statement takes as long as unpacking
        raise DecodeError(f"{name}: header of schema, two times and fields expected")
    found, began_ns, sent_ns, values = unpacked
    return end, found, began_ns, sent_ns, values


def _value_decoder(where: str, base: Any) -> _FieldDecoder:
    """Return the decoder of a plain value.

    The message's constructor checks the value afterwards.
    """
    enum = base if base is not Literal and isinstance(base, type) and issubclass(base, StrEnum) else None

    def decode_value(_frame: bytes, _arrays: int, value: Any) -> Any:
        if isinstance(value, list | dict):  # may be nested so deeply that even its repr fails
            raise DecodeError(f"{where}: a single value expected, found a {type(value).__name__}")
        if enum is not None:
            try:
                return enum(value)
            except ValueError:
                raise DecodeError(f"{where}: one of {[str(b) for b in enum]} expected, found {value!r:.40}") from None
        if base is float and type(value) is int:
            return float(value)
        if isinstance(value, str):
            _check_length(where, value)
        return value

    def decode_texts(_frame: bytes, _arrays: int, value: Any) -> Any:
        for text in value if isinstance(value, list) else ():
            if isinstance(text, str):
                _check_length(where, text)
        return tuple(value) if isinstance(value, list) else value

    return decode_texts if base is tuple else decode_value


def _check_length(where: str, text: str) -> None:
    """Refuse a text that is too long; a Sextant sender would have truncated it."""
    if len(text) > MAX_TEXT:
        raise DecodeError(f"{where}: a text of at most {MAX_TEXT} characters expected, found {len(text)}")


def _array_decoder(where: str, dtype: np.dtype[Any], ndim: int) -> _FieldDecoder:
    """Return the decoder of an array, which makes a view of the frame."""
    code, itemsize, truth = dtype.str, dtype.itemsize, dtype.kind == "b"

    def decode_array(frame: bytes, arrays: int, value: Any) -> Any:
        if type(value) is not list or len(value) != 3 or [*map(type, value)] != [str, list, int]:
            raise DecodeError(f"{where}: an array's dtype, shape and offset expected")
        found, shape, offset = value
        count = _count(where, code, ndim, found, shape)
        begin, end = arrays + offset, arrays + offset + count * itemsize
        if offset < 0 or offset % _ALIGNMENT or end > len(frame):
            raise DecodeError(f"{where}: {count} values of {code} at offset {offset} do not fit the frame")
        if truth and not _truth_values(frame, begin, count):
            raise DecodeError(f"{where}: truth values of 0 or 1 expected")
        return np.ndarray(shape, dtype, frame, begin)

    return decode_array


def _packed_decoder(where: str, dtype: np.dtype[Any], ndim: int) -> _FieldDecoder:
    """Return the decoder of a packed array."""
    code, itemsize, truth = dtype.str, dtype.itemsize, dtype.kind == "b"
    if dtype.kind not in "iufb":
        raise TypeError(f"{where}: a packed array of numbers or truth values expected, found {code}")
    same_bits = _same_bits(dtype)
    decode_array = _array_decoder(where, dtype, ndim)

    def decode_packed(frame: bytes, arrays: int, value: Any) -> Any:
        if type(value) is list and len(value) == 3:  # sent without packing
            return decode_array(frame, arrays, value)
        if type(value) is not list or len(value) != 4 or [*map(type, value)] != [str, list, int, int]:
            raise DecodeError(f"{where}: a packed array's dtype, shape, offset and bytes expected")
        found, shape, offset, length = value
        size = _count(where, code, ndim, found, shape) * itemsize
        begin, end = arrays + offset, arrays + offset + length
        if min(offset, length) < 0 or offset % _ALIGNMENT or end > len(frame):
            raise DecodeError(f"{where}: {length} packed bytes at offset {offset} do not fit the frame")
        if size > _MAX_UNPACKED:
            raise DecodeError(f"{where}: an array of at most {_MAX_UNPACKED} bytes expected, found {size}")
        unpacked = _unpacked(where, frame[begin:end], tuple(shape), same_bits, size)
        if truth and unpacked.max(initial=0) > 1:
            raise DecodeError(f"{where}: truth values of 0 or 1 expected")
        return unpacked.view(dtype)

    return decode_packed


def _count(where: str, code: str, ndim: int, found: str, shape: list[Any]) -> int:
    """Return the number of values of an array.

    Its dtype and shape in the header are checked first.
    """
    if found != code:
        raise DecodeError(f"{where}: an array of {code} expected, found {found[:10]!r}")
    if len(shape) != ndim:
        raise DecodeError(f"{where}: an array of {ndim} dimensions expected, found {len(shape)}")
    # Check the types first, because a received list may be nested so deeply that even its repr fails.
    if not _INTEGER.issuperset(map(type, shape)) or min(shape) < 0 or max(shape) > MAX_LENGTH:
        raise DecodeError(f"{where}: whole numbers from 0 to {MAX_LENGTH} expected as lengths")
    return prod(shape)  # Python integers do not overflow


def _packed(array: NDArray[Any]) -> bytes:
    """Compress an array as zigzag-coded differences along its first axis."""
    array = np.ascontiguousarray(array).view(_same_bits(array.dtype))
    steps = np.empty((prod(array.shape[1:]), len(array)), dtype=array.dtype)  # values of one column are similar
    steps.T[:] = array.reshape(steps.shape[::-1])
    steps[:, 1:] -= steps[:, :-1].copy()  # integers wrap around here, and back when unpacked
    signed = steps.view(f"i{array.itemsize}")
    numbers = (signed + signed) ^ (signed >> (8 * array.itemsize - 1))  # 0, -1, 1, -2, 2 ... become 0, 1, 2, 3, 4
    return _compress(numbers.view(np.uint8).reshape(numbers.size, array.itemsize).T.tobytes())


def _same_bits(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of integers with the size of a type; integers keep their own."""
    return dtype if dtype.kind in "iu" else np.dtype(f"{dtype.str[0]}u{dtype.itemsize}")


def _unpacked(where: str, data: bytes, shape: tuple[int, ...], dtype: np.dtype[Any], size: int) -> NDArray[Any]:
    try:
        if zstandard.frame_content_size(data) != size:  # check before unpacking: the data may claim any size
            raise DecodeError(f"{where}: {size} bytes expected when unpacked, found another number")
        planes = np.frombuffer(_decompress(data), np.uint8)
    except zstandard.ZstdError:
        raise DecodeError(f"{where}: not a packed array") from None
    if len(planes) != size:
        raise DecodeError(f"{where}: {size} bytes expected when unpacked, found {len(planes)}")
    lowest, *others = planes.reshape(dtype.itemsize, size // dtype.itemsize)
    numbers = lowest.astype(f"u{dtype.itemsize}")
    for k, plane in enumerate(others, 1):
        numbers |= plane.astype(numbers.dtype) << (8 * k)
    steps = ((numbers >> 1) ^ -(numbers & 1)).view(dtype).reshape(prod(shape[1:]), shape[0])
    out: NDArray[Any] = np.empty((shape[0], len(steps)), dtype=dtype)
    for column, values in enumerate(np.cumsum(steps, axis=1, dtype=dtype)):  # several times faster than transposing
        out[:, column] = values
    out = out.reshape(shape)
    out.flags.writeable = False
    return out


def _truth_values(frame: bytes, begin: int, count: int) -> bool:
    """Return whether all of these bytes of a frame are 0 or 1."""
    if count <= _FEW:
        return not frame[begin : begin + count].strip(_TRUTH_VALUES)
    return bool(np.frombuffer(frame, np.uint8, count, begin).max() <= 1)
