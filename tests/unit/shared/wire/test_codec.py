"""Frames: each message survives a round trip, and all other data is rejected.

A rejection states its reason.
"""

import dataclasses
import struct
import tracemalloc
from enum import StrEnum
from typing import Annotated, Any

import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.wire import codec, topics
from sextant.shared.wire import messages as m
from sextant.shared.wire.messages import Message

KINDS = list(topics.OF_TYPE)
int64 = st.integers(-(1 << 63) + 1, (1 << 63) - 1)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)


def field_values(base: Any, detail: Any, lengths: dict[str, int]) -> st.SearchStrategy[Any]:
    if base is np.ndarray:
        dtype, dims = detail
        shape = tuple(n if isinstance(n, int) else lengths[n] for n in dims.shape)
        elements = None if dims.most is None else st.integers(0, dims.most)
        if dims.shape == (4, 4):
            return hnp.arrays(np.float64, 3, elements=st.floats(-codec.MAX_DISTANCE, codec.MAX_DISTANCE)).map(
                lambda xyz: from_xyz_rpy(tuple(xyz), np.array([0.1, -0.2, 3.0]))
            )
        if dtype.kind == "f" and dims.finite:
            elements = (
                st.floats(-1e12, 1e12, width=8 * dtype.itemsize) if dtype.itemsize == 8 else st.floats(-1.0, 1.0, width=32)
            )
        elif dtype.kind == "f":
            elements = st.floats(width=8 * dtype.itemsize, allow_nan=True, allow_infinity=True)
        return hnp.arrays(dtype, shape, elements=elements, fill=None if elements is None else st.just(dtype.type(0)))
    if base is tuple:
        return st.lists(texts, max_size=4).map(tuple)
    if isinstance(base, type) and issubclass(base, StrEnum):
        return st.sampled_from(list(base))
    if isinstance(detail, tuple):
        return st.sampled_from(detail)
    plain: dict[Any, st.SearchStrategy[Any]] = {
        int: int64,
        float: st.floats(-codec.MAX_NUMBER, codec.MAX_NUMBER),
        bool: st.booleans(),
        str: texts,
    }
    return plain[base]


@st.composite
def messages(draw: st.DrawFn, kind: type[Message]) -> Message:
    """Draw a message of a type from its declaration."""
    fields = m.schema(kind)
    arrays = [detail[1] for _, base, detail in fields if base is np.ndarray]
    names = {n: dims.lengths or (0, 5) for dims in arrays for n in dims.shape if isinstance(n, str)}
    lengths = {n: draw(st.integers(least, min(most, 5)), label=n) for n, (least, most) in sorted(names.items())}
    values = {name: draw(field_values(base, detail, lengths)) for name, base, detail in fields}
    if kind is m.Health:  # one name for each number
        values["stages"] = tuple(map(str, range(lengths["stage"])))
        values["inputs"] = tuple(map(str, range(lengths["input"])))
    return kind(**values)


def example(kind: type[Message]) -> Message:
    values: dict[str, Any] = {}
    for name, base, detail in m.schema(kind):
        if base is np.ndarray:
            free = 1 if kind is m.Health else min(3, (detail[1].lengths or (0, 3))[1])
            ones = np.ones([n if isinstance(n, int) else free for n in detail[1].shape], detail[0])
            values[name] = np.eye(4) if detail[1].shape == (4, 4) else ones
        elif base is tuple:
            values[name] = ("text",)
        elif isinstance(base, type) and issubclass(base, StrEnum):
            values[name] = next(iter(base))
        elif isinstance(detail, tuple):
            values[name] = detail[0]
        else:
            values[name] = base(1)
    return kind(**values)


def assert_equal(found: Message, expected: Message) -> None:
    assert type(found) is type(expected)
    for name, base, _ in m.schema(type(expected)):
        a, b = getattr(found, name), getattr(expected, name)
        assert type(a) is type(b)
        if base is np.ndarray:
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        else:
            assert a == b


def framed(kind: type[Message], fields: Any, data: bytes = b"", *, timing: Any = (0, 0), name: str | None = None) -> bytes:
    """Return a frame with a given header."""
    header = fields if isinstance(fields, bytes) else msgpack.packb([name or codec.schema_id(kind), *timing, fields])
    start = struct.pack("<I", len(header)) + header
    return start + bytes(-len(start) % 8) + data


def with_field(kind: type[Message], name: str, value: object) -> bytes:
    """Return the frame of the example message with one field of its header replaced."""
    frame = codec.encode(example(kind))
    (length,) = struct.unpack_from("<I", frame)
    header = msgpack.unpackb(frame[4 : 4 + length])
    header[3][[n for n, _, _ in m.schema(kind)].index(name)] = value
    return framed(kind, header[3], frame[4 + length + -(4 + length) % 8 :])


def refusal(frame: bytes, kind: type[Message], max_bytes: int = 1 << 26) -> str:
    with pytest.raises(codec.DecodeError) as caught:
        codec.decode(frame, kind, max_bytes)
    return str(caught.value)


def decoded_or_refused(frame: bytes, kind: type[Message]) -> Message | None:
    """Decode as every receiver does.

    Any exception other than DecodeError fails the test.
    """
    try:
        return codec.decode(frame, kind)[0]
    except codec.DecodeError:
        return None


# ------------------------------------------------------------------------------------------------- round trips


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=20)
@given(data=st.data())
def test_every_message_survives_round_trip(kind: type[Message], data: st.DataObject) -> None:
    message = data.draw(messages(kind))
    timing = codec.Timing(*data.draw(st.tuples(int64, int64)))
    frame = codec.encode(message, timing)
    found, found_timing = codec.decode(frame, kind)
    assert_equal(found, message)
    assert found_timing == timing
    assert codec.encode(found, timing) == frame  # the same message has the same bytes


@pytest.mark.parametrize("kind", KINDS)
def test_decoded_arrays_are_read_only_views_of_frame(kind: type[Message]) -> None:
    frame = codec.encode(example(kind))
    found, _ = codec.decode(frame, kind)
    whole = np.frombuffer(frame, np.uint8)
    for name, base, detail in m.schema(kind):
        if base is np.ndarray:
            array = getattr(found, name)
            assert np.shares_memory(array, whole) != detail[1].packed
            assert not array.flags.writeable
            assert array.flags.c_contiguous
            with pytest.raises(ValueError, match="read-only"):
                array.flat[0] = 0


@pytest.mark.parametrize("kind", KINDS)
def test_copy_equals_decoded_message(kind: type[Message]) -> None:
    message = example(kind)
    copy, decoded = codec.as_received(message), codec.decode(codec.encode(message), kind)[0]
    assert_equal(copy, decoded)
    for name, _, _ in m.schema(kind):
        value = getattr(copy, name)
        assert type(value) is type(getattr(decoded, name)), name
        if isinstance(value, np.ndarray):
            assert not np.shares_memory(value, getattr(message, name))
            assert not value.flags.writeable
            assert value.flags.c_contiguous


def test_copy_has_plain_values() -> None:
    message = dataclasses.replace(example(m.Odometry), path_length=np.float64(0.5))  # type: ignore[call-arg]
    assert type(codec.as_received(message).path_length) is float  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "array", [np.arange(12, dtype=np.uint16).reshape(3, 4).T, np.arange(24, dtype=np.uint16).reshape(4, 6)[::2, ::-2]]
)
def test_arrays_of_any_memory_layout_are_encoded(array: Any) -> None:
    found, _ = codec.decode(codec.encode(m.DepthImage(1, array)), m.DepthImage)
    np.testing.assert_array_equal(found.depth, array)


@dataclasses.dataclass(frozen=True, slots=True)
class Packed(Message):
    """One packed array of each kind."""

    small: Annotated[NDArray[np.uint8], m.Dims("n", packed=True)]
    wide: Annotated[NDArray[np.int64], m.Dims("n", 2, 3, packed=True)]


@given(data=st.data(), n=st.integers(0, 40))
def test_packed_arrays_survive_round_trip(data: st.DataObject, n: int) -> None:
    message = Packed(1, data.draw(hnp.arrays(np.uint8, (n,))), data.draw(hnp.arrays(np.int64, (n, 2, 3))))
    assert_equal(codec.decode(codec.encode(message), Packed)[0], message)
    unpacked = codec.decode(codec.encode(message, packs=False), Packed)[0]
    assert_equal(unpacked, message)
    assert not unpacked.wide.flags.writeable  # type: ignore[attr-defined]
    timing = codec.Timing(3, 4)
    assert codec.packed(codec.encode(message, timing, packs=False), Packed) == codec.encode(message, timing)
    assert codec.packed(b"no frame", Packed) == b"no frame"


def test_packing_compresses_similar_neighbours() -> None:
    slow = np.cumsum(np.random.default_rng(0).integers(-2, 3, (10_000, 2, 3)), axis=0)
    message = Packed(1, np.zeros(10_000, np.uint8), slow)
    assert len(codec.encode(message)) < slow.nbytes / 10


@dataclasses.dataclass(frozen=True, slots=True)
class PackedBits(Message):
    """Packed arrays of floats and truth values."""

    heights: Annotated[NDArray[np.float32], m.Dims("n", "k", finite=False, packed=True)]
    exact: Annotated[NDArray[np.float64], m.Dims("n", finite=False, packed=True)]
    flags: Annotated[NDArray[np.bool_], m.Dims("n", "k", packed=True)]


@given(data=st.data(), n=st.integers(0, 12), k=st.integers(0, 12))
def test_packed_floats_and_truth_values_keep_every_bit(data: st.DataObject, n: int, k: int) -> None:
    """Each bit survives, also of NaN, infinities and negative zero."""
    heights = data.draw(hnp.arrays(np.uint32, (n, k))).view(np.float32)
    exact = data.draw(hnp.arrays(np.uint64, (n,))).view(np.float64)
    flags = data.draw(hnp.arrays(np.bool_, (n, k)))
    found = codec.decode(codec.encode(PackedBits(1, heights, exact, flags)), PackedBits)[0]
    assert found.heights.tobytes() == heights.tobytes()
    assert found.exact.tobytes() == exact.tobytes()
    assert found.flags.tobytes() == flags.tobytes()
    assert (found.heights.dtype, found.flags.dtype) == (np.float32, np.bool_)
    assert not found.heights.flags.writeable


def test_packed_truth_values_other_than_0_and_1_are_refused() -> None:
    flags = np.full((3, 3), 2, np.uint8).view(np.bool_)
    frame = codec.encode(PackedBits(1, np.zeros((3, 3), np.float32), np.zeros(3), flags))
    with pytest.raises(codec.DecodeError, match="truth values of 0 or 1 expected"):
        codec.decode(frame, PackedBits)


def test_packed_map_is_a_quarter_of_a_raw_one_and_equal_to_it() -> None:
    """A map with noisy heights where it has been seen, and NaN elsewhere."""
    rng = np.random.default_rng(0)
    seen = np.hypot(*np.meshgrid(np.arange(256) - 128, np.arange(256) - 128)) < 70
    layers = [np.where(seen, rng.normal(0.02, s, seen.shape), np.nan).astype(np.float32) for s in (0.003, 1e-6, 0.1)]
    made = m.TerrainMap(1, 0.01, np.zeros(2), *layers, ~seen, np.where(seen, -1, 127).astype(np.int8))
    raw, packed = codec.encode(made, packs=False), codec.encode(made)
    assert len(packed) < len(raw) / 4
    assert_equal(codec.decode(packed, m.TerrainMap)[0], codec.decode(raw, m.TerrainMap)[0])


def test_packed_array_of_another_kind_cannot_be_declared() -> None:
    @dataclasses.dataclass(frozen=True, slots=True)
    class Broken(Message):
        """A packed array of complex numbers."""

        values: Annotated[NDArray[np.complex64], m.Dims("n", packed=True)]

    with pytest.raises(TypeError, match="numbers or truth values expected"):
        codec.schema_id(Broken)


def test_longest_texts_are_encoded() -> None:
    status = m.PlannerStatus(0, "waiting", "\U0001f9ed" * m.MAX_TEXT, 0, 0, -1)
    assert_equal(codec.decode(codec.encode(status), m.PlannerStatus)[0], status)
    state = dataclasses.replace(example(m.ActuatorState), warnings=("w" * 100,) * m.MAX_ITEMS)  # type: ignore[call-arg]
    assert_equal(codec.decode(codec.encode(state), m.ActuatorState)[0], state)


def test_decoding_depth_frame_needs_little_memory() -> None:
    frame = codec.encode(m.DepthImage(1, np.ones((480, 640), np.uint16)))
    codec.decode(frame, m.DepthImage)
    assert _peak(lambda: codec.decode(frame, m.DepthImage)) < 20_000  # of 614 kB


def pose_of(change: Any) -> Any:
    """Return a changed pose."""
    T = np.eye(4)
    change(T)
    return T


@pytest.mark.parametrize(
    "change",
    [
        lambda T: T.fill(0.0),
        lambda T: T.__setitem__((0, 0), -1.0),  # a mirror
        lambda T: T.__setitem__((slice(3), slice(3)), 1.001 * np.eye(3)),
        lambda T: T.__setitem__((3, 0), 1e-3),
        lambda T: T.__setitem__((0, 1), 0.01),
        lambda T: T.fill(1.7e308),
    ],
)
def test_invalid_pose_is_refused(change: Any) -> None:
    frame = codec.encode(dataclasses.replace(example(m.Odometry), T_odom_body=pose_of(change)))  # type: ignore[call-arg]
    assert refusal(frame, m.Odometry).startswith("Odometry.T_odom_body: a pose expected")


def test_pose_far_from_origin_is_refused() -> None:
    far = pose_of(lambda T: T.__setitem__((0, 3), -1.1e6))
    frame = codec.encode(dataclasses.replace(example(m.Odometry), T_odom_body=far))  # type: ignore[call-arg]
    assert "T_odom_body: a pose within 1e+06 m of its frame's origin expected, found 1.1e+06 m" in refusal(frame, m.Odometry)


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        (m.Odometry, {"path_length": 1.1e12}),
        (m.BodyPose, {"covariance": np.full((6, 6), 1e300)}),
        (m.PassagePlan, {"tree_edges": np.full((1, 2, 3), 1e30, np.float32)}),
    ],
)
def test_too_large_number_is_refused(kind: type[Message], changes: dict[str, Any]) -> None:
    message = dataclasses.replace(example(kind), **changes)
    assert f"at most {codec.MAX_NUMBER:g} expected" in refusal(codec.encode(message), kind)
    with pytest.raises(codec.DecodeError, match="at most"):
        codec.check_received(codec.as_received(message))
    codec.decode(codec.encode(dataclasses.replace(example(m.BodyPose), covariance=np.full((6, 6), 1e12))), m.BodyPose)  # type: ignore[call-arg]


@pytest.mark.parametrize("name", ["stages", "inputs"])
def test_frame_with_more_names_than_values_is_refused(name: str) -> None:
    health = dataclasses.replace(example(m.Health), **{name: ("one", "two")})  # type: ignore[arg-type]
    assert "values for the named stages and inputs" in refusal(codec.encode(health), m.Health)


@pytest.mark.parametrize("name", ["reason", "warnings"])
def test_frame_with_too_long_text_is_refused(name: str) -> None:
    message = example(m.ActuatorState)
    long = "x" * (m.MAX_TEXT + 1)
    object.__setattr__(message, name, (long,) if name == "warnings" else long)
    with pytest.raises(codec.DecodeError, match=f"{name}: a text of at most {m.MAX_TEXT} characters expected, found 2001"):
        codec.decode(codec.encode(message), m.ActuatorState)


def test_schema_names_are_unique() -> None:
    assert len({codec.schema_id(kind) for kind in KINDS}) == len(KINDS)


# --------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=20)
@given(garbage=st.binary(max_size=200))
def test_random_bytes_are_refused(kind: type[Message], garbage: bytes) -> None:
    refusal(garbage, kind)


@pytest.mark.parametrize("kind", KINDS)
def test_truncated_frame_is_refused(kind: type[Message]) -> None:
    frame = codec.encode(example(kind))
    message = codec.decode(frame, kind)[0]
    for length in range(len(frame)):
        cut = decoded_or_refused(frame[:length], kind)
        if cut is not None:  # only padding was cut off
            assert_equal(cut, message)
            assert length > len(frame) - 8


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=40)
@given(data=st.data())
def test_flipped_bits_are_refused_or_give_valid_message(kind: type[Message], data: st.DataObject) -> None:
    frame = bytearray(codec.encode(example(kind)))
    for bit in data.draw(st.lists(st.integers(0, min(8 * len(frame), 8 * 400) - 1), min_size=1, max_size=4)):
        frame[bit // 8] ^= 1 << bit % 8
    found = decoded_or_refused(bytes(frame), kind)
    assert found is None or type(found) is kind


objects = st.recursive(
    st.none() | st.booleans() | int64 | st.floats() | texts | st.binary(max_size=9) | st.sampled_from(["<f8", "|u1", "|b1"]),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=12,
)
shapes = st.lists(st.sampled_from([0, 1, 2, 3, 6, 2**31, 2**62, 2**63, 2**64 - 1, -1, True, 1.0]), max_size=70)
array_fields = st.tuples(
    st.sampled_from(["<f8", "<f4", "|u1", "|b1", "<u2", "<i2", "|O", ">f8", ""]), shapes, st.integers(-9, 99)
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=40)
@given(data=st.data())
def test_arbitrary_fields_are_refused_or_valid(kind: type[Message], data: st.DataObject) -> None:
    names = [name for name, _, _ in m.schema(kind)]
    frame = with_field(kind, data.draw(st.sampled_from(names)), data.draw(objects | array_fields))
    found = decoded_or_refused(frame, kind)
    assert found is None or type(found) is kind


@pytest.mark.parametrize("header", [[], [1, 2, 3], None, {}, "text", [None, 0, 0, []], ["x", 0, 0, {}], ["x", 0.0, 0, []]])
def test_malformed_header_is_refused(header: object) -> None:
    assert "expected" in refusal(framed(m.Imu, msgpack.packb(header)), m.Imu) or header == {}


@pytest.mark.parametrize("timing", [(True, 0), (0, False), (0.0, 0), ("0", 0), (None, None)])
def test_non_integer_times_are_refused(timing: Any) -> None:
    assert "two times" in refusal(framed(m.ModeCommand, [0, "off", 1], timing=timing), m.ModeCommand)


def test_other_message_type_or_version_is_named() -> None:
    words = refusal(codec.encode(example(m.Imu)), m.Odometry)
    assert codec.schema_id(m.Imu) in words
    assert codec.schema_id(m.Odometry) in words
    assert "another type" in words
    assert "the same version" in refusal(framed(m.ModeCommand, [0, "off", 1], name="ModeCommand:00000000"), m.ModeCommand)


@pytest.mark.parametrize("fields", [[], [0], [0, "off", 1], [0, "off", 1, "me", False, 1]])
def test_wrong_number_of_fields_is_refused(fields: list[Any]) -> None:
    assert refusal(framed(m.ModeCommand, fields), m.ModeCommand) == f"ModeCommand: 5 fields expected, found {len(fields)}"


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (["<f4", [3], 0], "an array of <f8 expected, found '<f4'"),
        (["|O", [3], 0], "an array of <f8 expected"),
        (["<f8", [4], 0], "found (4,)"),
        (["<f8", [3, 1], 0], "1 dimensions expected, found 2"),
        (["<f8", [], 0], "1 dimensions expected, found 0"),
        (["<f8", [1] * 65, 0], "1 dimensions expected, found 65"),
        (["<f8", [-1], 0], "from 0 to 4000000 expected as lengths"),
        (["<f8", [True], 0], "from 0 to 4000000 expected as lengths"),
        (["<f8", [2**63], 0], "from 0 to 4000000 expected as lengths"),
        (["<f8", [3_999_999], 0], "do not fit the frame"),
        (["<f8", [3], 4], "do not fit the frame"),
        (["<f8", [3], -8], "do not fit the frame"),
        (["<f8", [3], 2**60], "do not fit the frame"),
        (["<f8", [3]], "dtype, shape and offset expected"),
        ("text", "dtype, shape and offset expected"),
        (None, "dtype, shape and offset expected"),
    ],
)
def test_arrays_that_differ_from_declaration_are_refused(value: object, words: str) -> None:
    found = refusal(with_field(m.Imu, "gyro", value), m.Imu)
    assert found.startswith("Imu.gyro: ")
    assert words in found


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (["|u1", [3]], "dtype, shape, offset and bytes expected"),
        (["|u1", [3], 0, 10.0], "dtype, shape, offset and bytes expected"),
        (["<i2", [3], 0, 10], "an array of |u1 expected"),
        (["|u1", [3], 0, -1], "do not fit the frame"),
        (["|u1", [3], 4, 10], "do not fit the frame"),
        (["|u1", [3], 0, 2**40], "do not fit the frame"),
        (["|u1", [3], 0, 3], "not a packed array"),
        (["|u1", [3], 0, 0], "not a packed array"),
        (["|u1", [4_000_001], 0, 10], "from 0 to 4000000 expected as lengths"),
    ],
)
def test_packed_arrays_that_differ_from_declaration_are_refused(value: object, words: str) -> None:
    found = refusal(with_field(m.Scan, "pixel_count", value), m.Scan)
    assert found.startswith("Scan.pixel_count: ")
    assert words in found


def test_packed_array_of_wrong_size_is_refused_before_unpacking() -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 24))
    good = codec.encode(Packed(1, np.zeros(3, np.uint8), np.zeros((3, 2, 3), np.int64)))
    (length,) = struct.unpack_from("<I", good)
    header = msgpack.unpackb(good[4 : 4 + length])
    for claim in ([3, 1 << 24], [4_000_000]):
        header[3][1] = ["|u1", claim[:1], 0, len(bomb)]
        frame = framed(Packed, header[3], bomb)
        assert _peak(lambda frame=frame: refusal(frame, Packed)) < 200_000
    header[3][2] = ["<i8", [4_000_000, 2, 3], 0, len(bomb)]
    header[3][1] = ["|u1", [1 << 21], 0, len(bomb)]
    assert "expected when unpacked" in refusal(framed(Packed, header[3], bomb), Packed)
    unsized = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(3))
    header[3][1] = ["|u1", [3], 0, len(unsized)]
    assert "expected when unpacked" in refusal(framed(Packed, header[3], unsized), Packed)


@pytest.mark.parametrize("shape", [[0, 2**62, 3], [0, 2**63, 3], [0, 2**64 - 1, 3], [1] * 65, [0] * 200])
def test_empty_array_with_invalid_shape_is_refused(shape: list[int]) -> None:
    assert refusal(with_field(m.ColorImage, "rgb", ["|u1", shape, 0]), m.ColorImage).startswith("ColorImage.rgb: ")


@pytest.mark.parametrize(
    ("kind", "name", "value", "words"),
    [
        (m.ModeCommand, "mode", "run", "one of ('off', 'stop', 'ready', 'stand', 'walk', 'sit') expected"),
        (m.ModeCommand, "mode", ["off"], "expected, found a list"),
        (m.ModeCommand, "sequence", 1.0, "whole number expected"),
        (m.ModeCommand, "sequence", 2**63, "whole number expected"),
        (m.ModeCommand, "stamp_ns", True, "whole number expected"),
        (m.ActuatorState, "mode", "run", "one of ['off'"),
        (m.ActuatorState, "mode", 3, "one of ['off'"),
        (m.ActuatorState, "reason", 3, "a text of at most"),
        (m.ActuatorState, "reason", "x" * 2001, "a text of at most"),
        (m.ActuatorState, "phase", float("nan"), "a finite number expected, found nan"),
        (m.ActuatorState, "phase", float("inf"), "a finite number expected, found inf"),
        (m.ActuatorState, "warnings", "text", "a tuple of at most 256 texts expected"),
        (m.ActuatorState, "warnings", [1], "texts"),
        (m.BodyPose, "ok", 1, "true or false expected, found 1"),
    ],
)
def test_values_that_differ_from_declaration_are_refused(kind: type[Message], name: str, value: object, words: str) -> None:
    found = refusal(with_field(kind, name, value), kind)
    assert found.startswith(f"{kind.__name__}.{name}: ")
    assert words in found


@pytest.mark.parametrize("kind", [k for k in KINDS if any(b is np.ndarray and d[0].kind == "f" for _, b, d in m.schema(k))])
def test_nan_in_finite_array_is_refused(kind: type[Message]) -> None:
    for name, base, detail in m.schema(kind):
        if base is np.ndarray and detail[0].kind == "f" and detail[1].finite:
            message = example(kind)
            before = codec.encode(message)
            getattr(message, name).flat[-1] = np.nan  # after the message's own check, so only the receiver can find it
            frame = codec.encode(message)
            assert len(frame) == len(before)
            assert "NaN or infinity" in refusal(frame, kind)


def test_boolean_value_of_two_is_refused() -> None:
    message = example(m.Odometry)
    frame = bytearray(codec.encode(message))
    frame[-8] = 2  # stance is the last array
    assert "truth values of 0 or 1" in refusal(bytes(frame), m.Odometry)


@pytest.mark.parametrize("where", [0, 70_000, -1])
def test_boolean_value_of_two_in_large_array_is_refused(where: int) -> None:
    n = 300
    layer = np.zeros((n, n), dtype=np.float32)
    flags = np.zeros((n, n), dtype=np.bool_)
    cells = np.zeros((n, n), dtype=np.int8)
    frame = bytearray(codec.encode(m.TerrainMap(0, 0.01, np.zeros(2), layer, layer, layer, flags, cells), packs=False))
    assert codec.decode(bytes(frame), m.TerrainMap)
    begin = len(frame) - 2 * n * n - 6 * 8  # the cells and the legs' heights follow the flags without a gap
    frame[begin + where % (n * n)] = 2
    assert "truth values of 0 or 1" in refusal(bytes(frame), m.TerrainMap)


def test_oversized_frame_is_refused_undecoded() -> None:
    frame = codec.encode(example(m.ColorImage))
    assert f"at most {len(frame) - 1} bytes expected, found {len(frame)}" in refusal(frame, m.ColorImage, len(frame) - 1)


@pytest.mark.parametrize("depth", [1, 100, 500, 900, 1000, 1020, 5000, 200_000])
@pytest.mark.parametrize(("kind", "position"), [(m.ModeCommand, 1), (m.ActuatorState, 1), (m.PlannerStatus, 3), (m.Imu, 1)])
def test_deep_nesting_is_refused(depth: int, kind: type[Message], position: int) -> None:
    n = len(m.schema(kind))
    nested = b"\x91" * depth + b"\x01"
    fields = b"".join(nested if i == position else b"\x00" for i in range(n))
    header = b"\x94" + msgpack.packb(codec.schema_id(kind)) + b"\x00\x00" + b"\xdc" + struct.pack(">H", n) + fields
    assert refusal(framed(kind, header), kind)
    assert refusal(framed(kind, nested), kind)


@pytest.mark.parametrize("depth", [1, 500, 900, 980, 990, 1000, 1010, 1020, 5000])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_deep_nesting_in_array_is_refused(depth: int, place: int) -> None:
    nested = b"\x91" * depth + b"\x01"
    parts = [msgpack.packb("<f8"), b"\x91\x03", b"\x00"]
    parts[place] = b"\x91" + nested if place == 1 else nested
    array = b"\x93" + b"".join(parts)
    header = b"\x94" + msgpack.packb(codec.schema_id(m.Imu)) + b"\x00\x00" + b"\x93\x00" + array + array
    assert refusal(framed(m.Imu, header), m.Imu)


HUGE_CLAIMS = {
    "array": b"\xdd\xff\xff\xff\xff",
    "map": b"\xdf\xff\xff\xff\xff",
    "text": b"\xdb\xff\xff\xff\xff",
    "bytes": b"\xc6\xff\xff\xff\xff",
    "extension": b"\xc9\xff\xff\xff\xff\x01",
    "timestamp": b"\xd6\xff\x00\x00\x00\x00",
}


@pytest.mark.parametrize("claim", HUGE_CLAIMS.values(), ids=HUGE_CLAIMS)
def test_huge_claimed_size_allocates_nothing(claim: bytes) -> None:
    frames = [
        framed(m.Imu, claim),
        framed(m.Imu, b"\x94" + claim + b"\x00" * 50),
        framed(m.Imu, b"\x94" + msgpack.packb(codec.schema_id(m.Imu)) + b"\x00\x00" + claim + b"\x00" * 50),
        struct.pack("<I", 0xFFFFFFFF) + claim,
    ]
    for frame in frames:
        assert _peak(lambda frame=frame: refusal(frame, m.Imu)) < 200_000


def test_huge_claimed_array_allocates_nothing() -> None:
    frame = with_field(m.DepthImage, "depth", ["<u2", [4_000_000, 4_000_000], 0])
    assert _peak(lambda: refusal(frame, m.DepthImage)) < 200_000


def _peak(act: Any) -> int:
    """Return the peak of the memory that an action holds [bytes]."""
    tracemalloc.start()
    try:
        act()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
