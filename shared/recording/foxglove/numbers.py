"""Numbers to plot over a walk: the one schema that Foxglove does not have, `sextant.Walk`."""

from collections.abc import Callable

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp

from sextant.shared.geometry import Array, rpy_from_rotation
from sextant.shared.wire.messages import ActuatorState

_NUMBERS = (
    "height",  # [m] of the body in the world
    "roll",  # [rad]
    "pitch",  # [rad]
    "pace",  # [1] share of the usual speed that the servos can bear for long
    "phase",  # [1] through the step
    "slip",  # [m] of the standing feet against each other
    "voltage",  # [V] lowest seen
    "temperature",  # [deg C] highest seen
    "torque",  # [N m] of the joint that bears most
)


def walk(state: ActuatorState, T_world_body: Array) -> Message:
    """What a walk is judged by, as numbers."""
    roll, pitch, _ = rpy_from_rotation(T_world_body[:3, :3]).tolist()
    seconds, nanos = divmod(state.stamp_ns, 1_000_000_000)
    return _WALK(
        timestamp={"seconds": seconds, "nanos": nanos},
        height=float(T_world_body[2, 3]),
        roll=roll,
        pitch=pitch,
        pace=state.pace,
        phase=state.phase,
        slip=state.slip,
        voltage=state.voltage,
        temperature=state.temperature,
        torque=float(np.abs(state.load_nm).max()),
        step=state.step,
        mode=str(state.mode),
    )


def _walk_type() -> Callable[..., Message]:
    file = FileDescriptorProto(name="sextant/Walk.proto", package="sextant", syntax="proto3")
    file.dependency.append(Timestamp.DESCRIPTOR.file.name)
    message, field = file.message_type.add(name="Walk"), FieldDescriptorProto
    message.field.add(name="timestamp", number=1, type=field.TYPE_MESSAGE, type_name=".google.protobuf.Timestamp")
    for name in _NUMBERS:
        message.field.add(name=name, number=len(message.field) + 1, type=field.TYPE_DOUBLE)
    message.field.add(name="step", number=len(message.field) + 1, type=field.TYPE_INT64)
    message.field.add(name="mode", number=len(message.field) + 1, type=field.TYPE_STRING)
    for one in message.field:
        one.label = field.LABEL_OPTIONAL
    times = FileDescriptorProto()
    Timestamp.DESCRIPTOR.file.CopyToProto(times)
    pool = DescriptorPool()
    pool.Add(times)
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("sextant.Walk"))


_WALK = _walk_type()
