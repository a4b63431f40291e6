"""ROS 2 message types, their CDR encoding and their type hashes, by rosbags.

The definitions are those of ROS 2 Jazzy, which later releases have not changed. Those of grid_map_msgs are from
ANYbotics/grid_map (branch rolling). Tests compare the type hashes with published ones.
"""

import functools
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.stores import ros2_jazzy as jazzy

_GRID_MAP = {
    "grid_map_msgs/msg/GridMapInfo": """
        float64 resolution
        float64 length_x
        float64 length_y
        geometry_msgs/Pose pose
    """,
    "grid_map_msgs/msg/GridMap": """
        std_msgs/Header header
        GridMapInfo info
        string[] layers
        string[] basic_layers
        std_msgs/Float32MultiArray[] data
        uint16 outer_start_index
        uint16 inner_start_index
    """,
}
_STORE = get_typestore(Stores.ROS2_JAZZY)
for _name, _definition in _GRID_MAP.items():
    _STORE.register(get_types_from_msg(_definition, _name))

Time = jazzy.builtin_interfaces__msg__Time
Header = jazzy.std_msgs__msg__Header
MultiArrayDimension = jazzy.std_msgs__msg__MultiArrayDimension
MultiArrayLayout = jazzy.std_msgs__msg__MultiArrayLayout
Float32MultiArray = jazzy.std_msgs__msg__Float32MultiArray
String = jazzy.std_msgs__msg__String
Vector3 = jazzy.geometry_msgs__msg__Vector3
Point = jazzy.geometry_msgs__msg__Point
Quaternion = jazzy.geometry_msgs__msg__Quaternion
Pose = jazzy.geometry_msgs__msg__Pose
PoseWithCovariance = jazzy.geometry_msgs__msg__PoseWithCovariance
PoseWithCovarianceStamped = jazzy.geometry_msgs__msg__PoseWithCovarianceStamped
Transform = jazzy.geometry_msgs__msg__Transform
TransformStamped = jazzy.geometry_msgs__msg__TransformStamped
Twist = jazzy.geometry_msgs__msg__Twist
TwistStamped = jazzy.geometry_msgs__msg__TwistStamped
TwistWithCovariance = jazzy.geometry_msgs__msg__TwistWithCovariance
Odometry = jazzy.nav_msgs__msg__Odometry
JointState = jazzy.sensor_msgs__msg__JointState
PointField = jazzy.sensor_msgs__msg__PointField
PointCloud2 = jazzy.sensor_msgs__msg__PointCloud2
CompressedImage = jazzy.sensor_msgs__msg__CompressedImage
Image = jazzy.sensor_msgs__msg__Image
CameraInfo = jazzy.sensor_msgs__msg__CameraInfo
RegionOfInterest = jazzy.sensor_msgs__msg__RegionOfInterest
TFMessage = jazzy.tf2_msgs__msg__TFMessage
GridMapInfo: Any = _STORE.types["grid_map_msgs/msg/GridMapInfo"]
GridMap: Any = _STORE.types["grid_map_msgs/msg/GridMap"]


def definition(kind: str) -> str:
    """Return the definition of a type with all that it contains, as recordings store it."""
    text, _ = _STORE.generate_msgdef(kind, ros_version=2)
    return str(text)


class CdrError(ValueError):
    """Bytes are not the expected message; the text states why."""


def encode(kind: str, message: object) -> bytes:
    """Encode a message of a type, e.g. "geometry_msgs/msg/Twist", in little-endian CDR."""
    return bytes(_STORE.serialize_cdr(message, kind, little_endian=True))


def decode(kind: str, data: bytes) -> Any:
    """Decode a message of a type from CDR of either byte order.

    Raises:
        CdrError: The bytes are not exactly such a message.
    """
    try:
        return _STORE.deserialize_cdr(data, kind)
    except SerdeError as error:
        raise CdrError(f"{kind}: a message in plain CDR expected, found {_found(data)}: {error}") from None


def _found(data: bytes) -> str:
    return f"{len(data)} bytes that begin with {data[:4].hex(' ')}" if data else "nothing"


@functools.cache
def type_hash(kind: str) -> str:
    """Return RIHS01 of a message type (REP 2016), e.g. of "geometry_msgs/msg/Twist"."""
    return _STORE.hash_rihs01(kind)
