"""Constructors of the parts of Foxglove messages."""

from collections.abc import Sequence
from functools import cache

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from sextant.shared.geometry import Array, quaternion_of_rows

Rgba = tuple[float, float, float, float]

_ORIGIN = (0.0, 0.0, 0.0)
_UPRIGHT = Quaternion(w=1.0)


def time(stamp_ns: int) -> Timestamp:
    """Return the Timestamp of a stamp [ns]."""
    seconds, nanos = divmod(stamp_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def pose(T: Array) -> Pose:
    """Return the Pose of a rigid transform (4, 4)."""
    rows = T[:3].tolist()
    w, x, y, z = quaternion_of_rows(rows)
    return Pose(position=Vector3(x=rows[0][3], y=rows[1][3], z=rows[2][3]), orientation=Quaternion(x=x, y=y, z=z, w=w))


def place(p: Sequence[float] | Array) -> Pose:
    """Return the Pose of a point (3,), without rotation."""
    return Pose(position=vector(p), orientation=_UPRIGHT)


def vector(v: Sequence[float] | Array) -> Vector3:
    """Return the Vector3 of three numbers."""
    return Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


@cache
def color(rgba: Rgba) -> Color:
    """Return the Color of red, green, blue and opacity within 0..1; it is shared, as messages copy their parts."""
    return Color(r=rgba[0], g=rgba[1], b=rgba[2], a=rgba[3])


def lines(kind: LinePrimitive.Type.ValueType, corners: Array, rgba: Rgba, width: float) -> LinePrimitive:
    """Return lines with a width [m] through points (n, 3)."""
    drawn = LinePrimitive(type=kind, pose=place(_ORIGIN), thickness=width, color=color(rgba))
    for x, y, z in corners.tolist():
        drawn.points.add(x=x, y=y, z=z)
    return drawn
