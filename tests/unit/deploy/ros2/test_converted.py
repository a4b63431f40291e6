"""Conversions to ROS: poses, twists, joints, and maps cell by cell.

The frames are those of REP 105.
"""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.deploy.ros2 import converted
from sextant.deploy.ros2.message_types import Vector3, decode, encode
from sextant.shared.geometry import exp_se3, from_xyz_rpy, rotation_from_quaternion
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import UNKNOWN, BodyPose, Odometry, TerrainMap
from tests.support.states import actuator_state

S = 1_000_000_000
AT = 1_700_000_000 * S + 250_000_000
PROFILE = load_profile("phantomx_mk2")
TWISTS = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6).map(np.array)


def matrix(position: Any, orientation: Any) -> NDArray[np.float64]:
    """Return the (4, 4) matrix of the parts of a pose or transform."""
    T = np.eye(4)
    q = orientation
    T[:3, :3], T[:3, 3] = rotation_from_quaternion([q.w, q.x, q.y, q.z]), [position.x, position.y, position.z]
    return T


def odometry(stamp_ns: int, T: NDArray[np.float64]) -> Odometry:
    return Odometry(stamp_ns, T, 0.0, 0.0, np.ones(6, dtype=bool), True)


@given(TWISTS, TWISTS)
def test_odometry_has_pose_and_twist_between_messages(start: NDArray[np.float64], moved: NDArray[np.float64]) -> None:
    before = odometry(5 * S, exp_se3(start))
    newest = odometry(5 * S + S // 50, before.T_odom_body @ exp_se3(moved * 0.02))
    value = converted.odometry(newest, before, AT)
    assert encode("nav_msgs/msg/Odometry", value)
    assert (value.header.frame_id, value.child_frame_id) == ("odom", "base_link")
    assert (value.header.stamp.sec, value.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert np.allclose(matrix(value.pose.pose.position, value.pose.pose.orientation), newest.T_odom_body, atol=1e-9)
    twist = value.twist.twist
    found = [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]
    assert np.allclose(found, moved, atol=1e-6)


@pytest.mark.parametrize("gap_ns", [0, -S, 2 * S])
def test_twist_is_zero_across_gap(gap_ns: int) -> None:
    before, newest = odometry(5 * S, np.eye(4)), odometry(5 * S + gap_ns, from_xyz_rpy((1.0, 0.0, 0.0), (0, 0, 0)))
    for found in (converted.twist(newest, before), converted.twist(newest, None)):
        assert found.linear == found.angular == Vector3(0.0, 0.0, 0.0)


@given(TWISTS, TWISTS)
def test_transforms_chain_from_map_to_base_link(correction: NDArray[np.float64], way: NDArray[np.float64]) -> None:
    chain = (("map", "odom", exp_se3(correction)), ("odom", "base_link", exp_se3(way)))
    value = converted.transforms(AT, *chain)
    assert encode("tf2_msgs/msg/TFMessage", value)
    found = value.transforms
    assert [(one.header.frame_id, one.child_frame_id) for one in found] == [("map", "odom"), ("odom", "base_link")]
    T = np.linalg.multi_dot([matrix(one.transform.translation, one.transform.rotation) for one in found])
    assert np.allclose(T, exp_se3(correction) @ exp_se3(way), atol=1e-9)


def test_pose_covariance_is_row_major() -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    found = BodyPose(0, from_xyz_rpy((1.0, 2.0, 3.0), (0.1, 0.2, 0.3)), np.eye(4), covariance, 1.0, True, "", np.zeros((0, 6)))
    value = converted.pose(found, AT)
    assert encode("geometry_msgs/msg/PoseWithCovarianceStamped", value)
    assert value.header.frame_id == "map"
    assert np.allclose(matrix(value.pose.pose.position, value.pose.pose.orientation), found.T_world_body)
    assert value.pose.covariance.tolist() == list(range(36))


def test_joint_names_follow_leg_and_link_order() -> None:
    state = actuator_state(PROFILE, stamp_ns=0, q=np.arange(18.0).reshape(6, 3), load_nm=-np.arange(18.0).reshape(6, 3))
    value = converted.joint_state(state, AT)
    assert encode("sensor_msgs/msg/JointState", value)
    joints = dict(zip(value.name, zip(value.position, value.effort, strict=True), strict=True))
    assert len(joints) == 18
    assert joints["left_front_coxa"] == (0.0, 0.0)
    assert joints["right_middle_femur"] == (7.0, -7.0)
    assert len(value.velocity) == 0


def terrain(nx: int = 5, ny: int = 3) -> TerrainMap:
    height = (np.arange(nx)[:, None] + 0.1 * np.arange(ny)).astype(np.float32)
    height[1, 2] = np.nan
    evaluation = np.full((nx, ny), -3, np.int8)
    evaluation[1, 2] = UNKNOWN
    origin = np.array([1.0, -2.0])
    return TerrainMap(0, 0.25, origin, height, height, height * 2, np.zeros((nx, ny), dtype=bool), evaluation)


def at_position(grid: Any, layer: str, xy: NDArray[np.float64]) -> float:
    """Return a grid map's value at a position.

    The layout follows grid_map's documentation. Index 0 is at the largest x and y. Rows run along x, and the matrix is stored
    column by column.
    """
    info, data = grid.info, grid.data[grid.layers.index(layer)]
    columns, rows = data.layout.dim
    assert (columns.label, rows.label) == ("column_index", "row_index")
    assert columns.stride == rows.size * columns.size == len(data.data)
    corner = [info.pose.position.x + 0.5 * info.length_x, info.pose.position.y + 0.5 * info.length_y]
    row, column = np.floor((corner - xy) / info.resolution).astype(int)
    return float(data.data[column * rows.size + row])


def test_grid_map_cells_match_terrain_positions() -> None:
    map_ = terrain()
    grid = converted.grid_map(map_, AT)
    assert encode("grid_map_msgs/msg/GridMap", grid)
    assert grid.header.frame_id == "map"
    for (i, j), height in np.ndenumerate(map_.elevation):
        xy = map_.origin + map_.resolution * np.array([i, j])
        assert at_position(grid, "elevation", xy) == pytest.approx(height, nan_ok=True)
        assert at_position(grid, "score", xy) == pytest.approx(2 * height, nan_ok=True)
        assert at_position(grid, "evaluation", xy) == pytest.approx(np.nan if (i, j) == (1, 2) else -3, nan_ok=True)


def test_point_cloud_contains_known_cells() -> None:
    map_ = terrain()
    value = converted.points(map_, AT)
    assert encode("sensor_msgs/msg/PointCloud2", value)
    assert [field.name for field in value.fields] == ["x", "y", "z", "score"]
    assert [field.offset for field in value.fields] == [0, 4, 8, 12]
    assert value.row_step == value.width * value.point_step == len(value.data)
    cloud = value.data.view("<f4").reshape(-1, 4)
    assert len(cloud) == np.isfinite(map_.elevation).sum() == value.width
    for x, y, z, score in cloud.tolist():
        i, j = np.round((np.array([x, y]) - map_.origin) / map_.resolution).astype(int)
        assert (z, score) == pytest.approx((map_.elevation[i, j], map_.score[i, j]))
    assert value.is_dense


def test_unknown_map_gives_empty_point_cloud() -> None:
    height = np.full((4, 4), np.nan, np.float32)
    none = np.zeros((4, 4), dtype=bool)
    value = converted.points(TerrainMap(0, 0.01, np.zeros(2), height, height, height, none, none.astype(np.int8)), AT)
    assert (value.width, len(value.data)) == (0, 0)
    assert decode("sensor_msgs/msg/PointCloud2", encode("sensor_msgs/msg/PointCloud2", value)).width == 0
