"""CDR bytes of every published message type equal recorded ones."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sextant.deploy.ros2 import converted
from sextant.deploy.ros2.bridge import LATCHED, PICTURES, PUBLISHED
from sextant.deploy.ros2.message_types import String, encode
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import UNKNOWN, BodyPose, Odometry, TerrainMap
from tests.support.states import actuator_state

S = 1_000_000_000
AT_NS = 1_700_000_000 * S + 250_000_000
# The bytes were recorded from an independent encoder, hexadecimal.
RECORDED: dict[str, str] = json.loads((Path(__file__).parent / "encoded_bytes.json").read_text())


def terrain(nx: int, ny: int) -> TerrainMap:
    """Return a map with an unknown cell, heights and scores that differ everywhere."""
    height = (np.arange(nx)[:, None] * 0.5 - 0.125 * np.arange(ny)).astype(np.float32)
    height[0, ny - 1] = np.nan
    evaluation = np.full((nx, ny), -3, np.int8)
    evaluation[0, ny - 1] = UNKNOWN
    return TerrainMap(
        0, 0.25, np.array([1.0, -2.0]), height, height * height, height * 2, np.zeros((nx, ny), dtype=bool), evaluation
    )


def examples(nx: int = 3, ny: int = 2) -> Iterator[tuple[str, Any]]:
    """Yield a message of each published type, by name."""
    before = Odometry(5 * S, from_xyz_rpy((0.5, -0.25, 0.125), (0.0, 0.0, 0.0)), 0.0, 0.0, np.ones(6, dtype=bool), True)
    newest = Odometry(
        5 * S + S // 2, from_xyz_rpy((0.75, -0.25, 0.125), (0.0, 0.0, 0.0)), 0.0, 0.0, np.ones(6, dtype=bool), True
    )
    covariance = np.arange(36.0).reshape(6, 6) / 4
    T = np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about z
    T[:3, 3] = (1.0, 2.0, -3.5)
    pose = BodyPose(0, T, np.eye(4), covariance, 1.0, True, "", np.zeros((0, 6)))
    q = np.arange(18.0).reshape(6, 3) / 8
    yield "nav_msgs/msg/Odometry", converted.odometry(newest, before, AT_NS)
    yield "geometry_msgs/msg/PoseWithCovarianceStamped", converted.pose(pose, AT_NS)
    yield "tf2_msgs/msg/TFMessage", converted.transforms(AT_NS, ("map", "odom", T), ("odom", "base_link", np.eye(4)))
    yield "std_msgs/msg/String", String("<robot/>")
    state = actuator_state(load_profile("phantomx_mk2"), stamp_ns=0, q=q, load_nm=-q)
    yield "sensor_msgs/msg/JointState", converted.joint_state(state, AT_NS)
    yield "grid_map_msgs/msg/GridMap", converted.grid_map(terrain(nx, ny), AT_NS)
    yield "sensor_msgs/msg/PointCloud2", converted.points(terrain(nx, ny), AT_NS)
    yield "sensor_msgs/msg/CompressedImage", converted.jpeg(np.frombuffer(b"\xff\xd8jpeg\xff\xd9!", np.uint8), AT_NS)


def test_every_published_type_has_recorded_bytes() -> None:
    assert {kind for _, kind, _ in (*PUBLISHED, *LATCHED, *PICTURES)} == set(RECORDED) == {kind for kind, _ in examples()}


@pytest.mark.parametrize(("kind", "message"), list(examples()), ids=[kind for kind, _ in examples()])
def test_encoded_bytes_equal_recorded(kind: str, message: Any) -> None:
    assert encode(kind, message).hex() == RECORDED[kind]
