"""Mount of an IMU that is found from gravity in postures."""

import numpy as np
import pytest

from sextant.services.perception.calibration import imu_mount
from sextant.services.perception.calibration.imu_mount import ImuTrack
from sextant.services.perception.calibration.kinematic_calibration import BodyPoses
from sextant.services.perception.calibration.survey import postures
from sextant.shared.geometry import Array, exp_so3, from_xyz_rpy
from sextant.shared.robot.profile import GRAVITY
from sextant.shared.robot.profiles import load_profile

MS = 1_000_000
TURN = np.radians([2.0, -3.0, 4.0])
ATTITUDES = np.array([from_xyz_rpy(p[:3], p[3:])[:3, :3] for p in postures(load_profile("phantomx_mk2"))])


def shown_up(R_floor_body: Array, turn: Array, slope: Array) -> Array:
    """Return the direction of up (3,) that an IMU shows in {body} whose mount is turned against its profile."""
    up_floor = np.array([*-slope, 1.0]) / np.linalg.norm([*slope, 1.0])
    return np.asarray(exp_so3(turn).T @ R_floor_body.T @ up_floor)


def measured(turn: Array = TURN, slope: Array | None = None, gyro: float = 0.0) -> tuple[ImuTrack, BodyPoses]:
    """Return the readings of a robot that takes all postures, four images in each, and its poses."""
    slope = np.zeros(2) if slope is None else slope
    poses, posture = np.tile(np.eye(4), (4 * len(ATTITUDES), 1, 1)), np.repeat(np.arange(len(ATTITUDES)), 4)
    poses[:, :3, :3] = ATTITUDES[posture]
    stamps = 100 * MS * np.arange(1, len(posture) + 1)
    readings = 10 * MS * np.arange(1, 10 * len(posture) + 11)
    now = np.minimum(np.searchsorted(stamps, readings), len(posture) - 1)  # image that follows a reading
    force = GRAVITY * np.array([shown_up(poses[k, :3, :3], turn, slope) for k in now])
    track = ImuTrack(readings, np.full_like(force, gyro), force)
    return track, BodyPoses(stamps.astype(float), posture, poses)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.08, -0.05)])
def test_mount_is_found_on_a_level_and_on_a_sloping_floor(slope: tuple[float, float]) -> None:
    found = imu_mount.estimate(*measured(slope=np.array(slope)))
    assert found is not None
    assert found.turn == pytest.approx(TURN, abs=np.radians(0.02))
    assert found.slope == pytest.approx(slope, abs=5e-4)


def test_interval_holds_the_truth() -> None:
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        up = np.array([shown_up(R, TURN, np.array([0.01, 0.02])) for R in ATTITUDES])
        noisy = ATTITUDES @ exp_so3(rng.normal(0.0, np.radians(0.2), (len(ATTITUDES), 3)))
        found = imu_mount.fit(noisy, up)
        inside.append(np.abs(found.turn - TURN) < 2.0 * found.sigma)
    assert 0.93 < np.mean(inside) < 1.0


def test_slope_and_mount_cannot_be_told_apart_by_a_body_that_never_turns() -> None:
    """Then the uncertainty is that of the slope."""
    straight = np.array([from_xyz_rpy(p[:3], [0.0, 0.0, 0.0])[:3, :3] for p in postures(load_profile("phantomx_mk2"))])
    up = np.array([shown_up(R, TURN, np.zeros(2)) for R in straight])
    assert np.degrees(imu_mount.fit(straight, up).sigma).min() > 3.0


def test_body_that_never_rests_and_a_silent_imu_give_no_mount() -> None:
    track, poses = measured()
    assert imu_mount.estimate(measured(gyro=0.2)[0], poses) is None
    few = ImuTrack(track.stamp_ns[::20], track.gyro[::20], track.specific_force[::20])
    assert imu_mount.estimate(few, poses) is None
    assert imu_mount.estimate(track, poses) is not None
