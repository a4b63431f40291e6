"""Numbers to plot over a walk, in the schema `sextant.Walk`.

It is the only schema here that is not one of Foxglove's.
"""

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
    "pace",  # [1] share of normal speed that the servos can sustain
    "phase",  # [1] progress of the step
    "slip",  # [m] largest displacement of a stance foot relative to the others
    "voltage",  # [V] lowest of all servos
    "temperature",  # [deg C] highest of all servos
    "torque",  # [N m] largest absolute value of all joints
)


def walk(state: ActuatorState, T_world_body: Array) -> Message:
    """Return the main numbers of a walk."""
    roll, pitch, _ = rpy_from_rotation(T_world_body[:3, :3]).tolist()
    seconds, nanos = divmod(state.stamp_ns, 1_000_000_000)
    return _WALK(
        timestamp={"seconds": seconds, "nanos": nanos},
        height=float(T_world_body[2, 3]),
        roll=roll,
        pitch=pitch,
        pace=state.speed_scale,
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
