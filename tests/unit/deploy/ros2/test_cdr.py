"""CDR bytes of ROS 2 messages.

Another reader decodes them correctly, the decoder reads them back, and random bytes are rejected.
"""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sextant.deploy.ros2 import cdr
from sextant.deploy.ros2.cdr import CdrError
from sextant.deploy.ros2.definitions import DEFINITIONS
from sextant.deploy.ros2.interface import fields

PEER = get_typestore(Stores.ROS2_JAZZY)
for grid_map_type in ("grid_map_msgs/msg/GridMapInfo", "grid_map_msgs/msg/GridMap"):
    PEER.register(get_types_from_msg(DEFINITIONS[grid_map_type], grid_map_type))
NAMES = sorted(DEFINITIONS)
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=6)


def numbers(base: str) -> st.SearchStrategy[Any]:
    if base == "bool":
        return st.booleans()
    if base.startswith("float"):
        return st.floats(width=int(base[5:]))  # type: ignore[arg-type]
    bits = int(base.lstrip("uint"))
    return st.integers(0, 2**bits - 1) if base[0] == "u" else st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def values(name: str) -> st.SearchStrategy[dict[str, Any]]:
    """Return a strategy for messages of a type."""
    return st.fixed_dictionaries({field.name: _of(field) for field in fields(name)})


def _of(field: Any) -> st.SearchStrategy[Any]:
    one = TEXTS if field.base == "string" else values(field.base) if field.nested else numbers(field.base)
    if not field.array:
        return one
    least, most = (field.length, field.length) if field.array == "fixed" else (0, 3)
    found = st.lists(one, min_size=least, max_size=most)
    if field.nested or field.base == "string":
        return found
    dtype = {"bool": "?"}.get(field.base, field.base)
    return found.map(lambda numbers: np.array(numbers, dtype=dtype))


def alike(a: Any, b: Any) -> bool:
    """Return whether two messages are equal, as mappings or as the peer's objects.

    NaN equals NaN.
    """
    if isinstance(a, dict):
        other = b if isinstance(b, dict) else {f.name: getattr(b, f.name) for f in dataclasses.fields(b)}
        other = {name: value for name, value in other.items() if name in a}
        return a.keys() == other.keys() and all(alike(a[name], other[name]) for name in a)
    if isinstance(a, str):
        return bool(a == b)
    if isinstance(a, list):
        return len(a) == len(b) and all(alike(one, other) for one, other in zip(a, b, strict=True))
    return bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True))


def for_peer(name: str, value: dict[str, Any]) -> Any:
    """Return the peer's object of a message."""
    made = {}
    for field in fields(name):
        found = value[field.name]
        if field.nested:
            found = [for_peer(field.base, one) for one in found] if field.array else for_peer(field.base, found)
        made[field.name] = found
    return PEER.types[name](**made)


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
@settings(max_examples=12, deadline=None)
def test_cdr_round_trips_with_independent_implementation(name: str, data: st.DataObject) -> None:
    value = data.draw(values(name))
    frame = cdr.encode(name, value)
    assert alike(value, PEER.deserialize_cdr(frame, name))
    assert frame == bytes(PEER.serialize_cdr(for_peer(name, value), name, little_endian=True))
    assert alike(value, cdr.decode(name, frame))
    big = bytes(PEER.serialize_cdr(for_peer(name, value), name, little_endian=False))
    assert alike(value, cdr.decode(name, big))
    assert alike(value, cdr.decode(name, frame + bytes(data.draw(st.integers(0, 3))))), (
        "padding to a multiple of four may follow"
    )


def test_encoding_matches_known_bytes() -> None:
    assert cdr.encode("std_msgs/msg/String", {"data": "hello"}).hex() == "000100000600000068656c6c6f00"
    head = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "base"}
    joints = {"header": head, "name": ["j1", "j2"], "position": [0.5, -1.0], "velocity": [], "effort": []}
    assert cdr.encode("sensor_msgs/msg/JointState", joints).hex() == (
        "00010000010000000200000005000000626173650000000002000000030000006a310000030000006a32000002000000"
        "00000000000000000000e03f000000000000f0bf0000000000000000"
    )


@given(st.sampled_from(NAMES), st.binary(max_size=200))
@settings(max_examples=150, deadline=None)
def test_random_bytes_decode_or_raise_cdr_error(name: str, data: bytes) -> None:
    for head in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        try:
            found = cdr.decode(name, head + data)
        except CdrError as error:
            assert str(error).startswith(f"{name}: ")  # noqa: PT017
        else:
            assert found.keys() == {field.name for field in fields(name)}


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_truncated_or_overlong_message_is_refused(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(NAMES))
    frame = cdr.encode(name, data.draw(values(name)))
    for short in {0, 1, 3, 4, len(frame) - 1} - {len(frame)}:
        with pytest.raises(CdrError, match="expected"):
            cdr.decode(name, frame[:short])
    with pytest.raises(CdrError, match=f"{len(frame)} bytes expected, found {len(frame) + 4}"):
        cdr.decode(name, frame + bytes(4))


def test_excessive_sequence_length_is_refused() -> None:
    many = b"\0\1\0\0" + b"\xff\xff\xff\xff"
    for name in ("tf2_msgs/msg/TFMessage", "std_msgs/msg/String"):
        with pytest.raises(CdrError, match=r"do not fit|at least \d+ bytes expected"):
            cdr.decode(name, many)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("std_msgs/msg/String", {}, "fields data expected"),
        ("std_msgs/msg/String", {"data": "x", "more": 1}, "fields data expected"),
        ("builtin_interfaces/msg/Time", {"sec": 2**40, "nanosec": 0}, r"Time\.sec: a int32 expected"),
        ("builtin_interfaces/msg/Time", {"sec": 0, "nanosec": -1}, r"Time\.nanosec: a uint32 expected"),
        ("builtin_interfaces/msg/Time", {"sec": 0.5, "nanosec": 0}, r"Time\.sec: a int32 expected"),
    ],
)
def test_value_of_wrong_type_is_refused(name: str, value: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        cdr.encode(name, value)


def test_fixed_array_of_wrong_length_is_refused() -> None:
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    pose = {"position": zero, "orientation": {**zero, "w": 1.0}}
    with pytest.raises(ValueError, match="36 values expected, found 35"):
        cdr.encode("geometry_msgs/msg/PoseWithCovariance", {"pose": pose, "covariance": np.zeros(35)})
