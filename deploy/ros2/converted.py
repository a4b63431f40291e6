"""Conversion of Sextant's messages to ROS 2 messages; pure functions.

Frames follow REP 105: {world} is `map`, {odom} is `odom`, {body} is `base_link`. Axes and units already follow REP 103: x
forward, y left, z up, metres and radians. The camera frame is an optical frame: z forward, x right, y down.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sextant.deploy.ros2 import message_types as ros
from sextant.shared.geometry import Array, inverse, log_se3, quaternion_from_rotation
from sextant.shared.robot.links import BASE, CAMERA, JOINT_NAMES, fixed_joints, hinges, posed
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import UNKNOWN, ActuatorState, BodyPose, Odometry, TerrainMap

MAP, ODOM = "map", "odom"
_NOT_KNOWN = np.zeros(36)
_LONG_NS = 500_000_000  # [ns] between two odometry messages, above which the velocity is zero


def header(at_ns: int, frame: str) -> ros.Header:
    """Make a std_msgs/msg/Header of a time [ns]."""
    return ros.Header(ros.Time(at_ns // 1_000_000_000, at_ns % 1_000_000_000), frame)


def _quaternion(R: Array) -> ros.Quaternion:
    w, x, y, z = quaternion_from_rotation(R).tolist()
    return ros.Quaternion(x, y, z, w)


def _pose(T: Array) -> ros.Pose:
    return ros.Pose(ros.Point(*T[:3, 3].tolist()), _quaternion(T[:3, :3]))


def transforms(at_ns: int, *found: tuple[str, str, Array]) -> ros.TFMessage:
    """Make a tf2_msgs/msg/TFMessage of (frame, child frame, transform).

    The transform takes coordinates of the child frame to the frame.
    """
    return ros.TFMessage(
        [
            ros.TransformStamped(
                header(at_ns, frame), child, ros.Transform(ros.Vector3(*T[:3, 3].tolist()), _quaternion(T[:3, :3]))
            )
            for frame, child, T in found
        ]
    )


def fixed_transforms(profile: RobotProfile, at_ns: int) -> ros.TFMessage:
    """Make the tf2_msgs/msg/TFMessage of the robot's fixed frames: its camera, and the centres of its feet."""
    return transforms(at_ns, *((joint.parent, joint.child, joint.T_parent_child) for joint in fixed_joints(profile)))


def leg_transforms(profile: RobotProfile, q: Array, at_ns: int) -> ros.TFMessage:
    """Make the tf2_msgs/msg/TFMessage of the links of the legs, at joint angles (6, 3) [rad]."""
    angles = zip(hinges(profile), q.ravel().tolist(), strict=True)
    return transforms(at_ns, *((joint.parent, joint.child, posed(joint, angle)) for joint, angle in angles))


def joint_state(state: ActuatorState, at_ns: int) -> ros.JointState:
    """Make a sensor_msgs/msg/JointState: measured angles [rad] and torques [N m].

    Velocities are not measured.
    """
    return ros.JointState(
        header(at_ns, ""),
        name=list(JOINT_NAMES),
        position=state.q.ravel(),
        velocity=np.zeros(0),
        effort=state.load_nm.ravel(),
    )


def odometry(newest: Odometry, before: Odometry | None, at_ns: int) -> ros.Odometry:
    """Make a nav_msgs/msg/Odometry: pose in `odom`, twist in `base_link`.

    The twist is the motion since the message before. Covariances are zero, which means unknown.
    """
    return ros.Odometry(
        header(at_ns, ODOM),
        child_frame_id=BASE,
        pose=ros.PoseWithCovariance(_pose(newest.T_odom_body), _NOT_KNOWN),
        twist=ros.TwistWithCovariance(twist(newest, before), _NOT_KNOWN),
    )


def twist(newest: Odometry, before: Odometry | None) -> ros.Twist:
    """Make a geometry_msgs/msg/Twist {body} between two odometry messages.

    It is zero if there is no message before, or only an old one.
    """
    moved = np.zeros(6)
    if before is not None and 0 < newest.stamp_ns - before.stamp_ns <= _LONG_NS:
        moved = log_se3(inverse(before.T_odom_body) @ newest.T_odom_body) / ((newest.stamp_ns - before.stamp_ns) * 1e-9)
    return ros.Twist(ros.Vector3(*moved[:3].tolist()), ros.Vector3(*moved[3:].tolist()))


def pose(found: BodyPose, at_ns: int) -> ros.PoseWithCovarianceStamped:
    """Make a geometry_msgs/msg/PoseWithCovarianceStamped in `map`."""
    return ros.PoseWithCovarianceStamped(
        header(at_ns, MAP), ros.PoseWithCovariance(_pose(found.T_world_body), found.covariance.ravel())
    )


def grid_map(terrain: TerrainMap, at_ns: int) -> ros.GridMap:
    """Make a grid_map_msgs/msg/GridMap in `map`; NaN is unknown.

    Layers: `elevation` [m], `variance` [m^2], `score` (0 best, above 1 no foothold) and `evaluation` (Masri's function [cells],
    negative where a foot may stand). In a GridMap cell (0, 0) lies at the largest x and y, rows go along x, columns along y.
    """
    layers = {
        "elevation": terrain.elevation,
        "variance": terrain.variance,
        "score": terrain.score,
        "evaluation": np.where(terrain.evaluation == UNKNOWN, np.nan, terrain.evaluation),
    }
    return grid_map_of(layers, terrain.origin, terrain.resolution, at_ns)


def grid_map_of(layers: Mapping[str, NDArray[np.floating]], origin: Array, edge: float, at_ns: int) -> ros.GridMap:
    """Make a grid_map_msgs/msg/GridMap in `map` of layers (nx, ny), `elevation` among them.

    Cell (0, 0) of a layer is centred at an origin (2,) [m], and cells have an edge [m].
    """
    nx, ny = layers["elevation"].shape
    middle = origin + 0.5 * edge * (np.array([nx, ny]) - 1)
    return ros.GridMap(
        header=header(at_ns, MAP),
        info=ros.GridMapInfo(
            resolution=edge,
            length_x=nx * edge,
            length_y=ny * edge,
            pose=ros.Pose(ros.Point(middle[0], middle[1], 0.0), _quaternion(np.eye(3))),
        ),
        layers=list(layers),
        basic_layers=["elevation"],
        data=[_float_array(layer) for layer in layers.values()],
        outer_start_index=0,
        inner_start_index=0,
    )


def _float_array(layer: NDArray[np.floating]) -> ros.Float32MultiArray:
    """Make a std_msgs/msg/Float32MultiArray of cells (nx, ny).

    The order is column by column, from the largest x and y on.
    """
    rows, columns = layer.shape
    dims = [
        ros.MultiArrayDimension("column_index", size=columns, stride=rows * columns),
        ros.MultiArrayDimension("row_index", size=rows, stride=rows),
    ]
    return ros.Float32MultiArray(
        ros.MultiArrayLayout(dims, data_offset=0), layer[::-1, ::-1].astype(np.float32).ravel(order="F")
    )


def points(terrain: TerrainMap, at_ns: int) -> ros.PointCloud2:
    """Make a sensor_msgs/msg/PointCloud2 in `map`.

    Each cell of known height gives a point at its centre, with its score.
    """
    i, j = np.nonzero(np.isfinite(terrain.elevation))
    xy = terrain.origin + terrain.resolution * np.column_stack([i, j])
    cloud = np.column_stack([xy, terrain.elevation[i, j], terrain.score[i, j]]).astype("<f4")
    step = cloud.itemsize * cloud.shape[1]
    names = ("x", "y", "z", "score")
    return ros.PointCloud2(
        header(at_ns, MAP),
        height=1,
        width=len(cloud),
        fields=[
            ros.PointField(name, offset=cloud.itemsize * k, datatype=ros.PointField.FLOAT32, count=1)
            for k, name in enumerate(names)
        ],
        is_bigendian=False,
        point_step=step,
        row_step=step * len(cloud),
        data=np.frombuffer(cloud.tobytes(), np.uint8),
        is_dense=bool(np.isfinite(cloud).all()),
    )


def jpeg(data: NDArray[np.uint8], at_ns: int) -> ros.CompressedImage:
    """Make a sensor_msgs/msg/CompressedImage of a JPEG."""
    return ros.CompressedImage(header(at_ns, CAMERA), format="jpeg", data=data)
