import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.motion_prior import Motion
from sextant.services.perception.registration.pose_tracking import PoseTracker
from sextant.services.perception.registration.rest_gravity import RestGravity, levelling
from sextant.shared.geometry import rotation_from_rpy, transform
from sextant.shared.robot.profile import GRAVITY
from sextant.shared.wire.messages import Imu

MS = 1_000_000
LEANING = rotation_from_rpy((np.radians(5.0), np.radians(-8.0), 0.0))  # of the body {level}


def rested(count: int = 50, gyro: float = 0.0, force: float = GRAVITY, noise: float = 0.1) -> RestGravity:
    found, rng = RestGravity(), np.random.default_rng(3)
    for k in range(count):
        pull = force * LEANING[2] + rng.normal(0.0, noise, 3)
        found.add(Imu(10 * k * MS, np.full(3, gyro), pull))
    return found


def test_up_of_a_resting_body_is_the_mean_force() -> None:
    up = rested().up()
    assert up is not None
    assert np.degrees(np.arccos(up @ LEANING[2])) < 0.3
    assert not rested().begins


@pytest.mark.parametrize("moving", [{"gyro": 0.3}, {"force": GRAVITY + 2.0}, {"force": 0.0}, {"count": 0}])
def test_moving_or_missing_sensor_gives_no_direction(moving: dict[str, float]) -> None:
    assert rested(**moving).up() is None  # type: ignore[arg-type]


def test_first_readings_are_waited_for_and_older_ones_are_forgotten() -> None:
    few = rested(count=5)
    assert few.begins
    assert few.up() is None
    late = rested()
    late.add(Imu(9_000 * MS, np.zeros(3), np.array([GRAVITY, 0.0, 0.0])))
    assert late.begins


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
def test_levelling_makes_up_vertical_without_a_turn_about_it(roll: float, pitch: float) -> None:
    up = rotation_from_rpy((roll, pitch, 0.0))[2]
    R = levelling(up)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.degrees(np.arccos(min((R @ up)[2], 1.0))) <= 1.0 + 1e-6
    assert abs(R[1, 0] - R[0, 1]) < 1e-9


def test_new_world_is_level_and_that_of_a_robot_that_walked_before_is_kept() -> None:
    tracker = PoseTracker(Settings())
    motion = Motion(transform(np.eye(3), np.array([0.0, 0.0, 0.1])), 0.0, 0.0, True, 0.0)
    tracker.begin(np.eye(4), motion, LEANING[2])
    T_world_body, _ = tracker.predict(motion, 0)
    np.testing.assert_allclose(T_world_body[2, :3], LEANING[2], atol=1e-9)
    np.testing.assert_allclose(tracker.T_world_odom[:3, 3], 0.0)
    walked = transform(rotation_from_rpy((0.01, 0.0, 0.4)), np.array([1.0, 0.0, 0.0]))
    for T, up in ((walked, LEANING[2]), (np.eye(4), None)):
        tracker.begin(T, motion, up)
        np.testing.assert_array_equal(tracker.T_world_odom, T)
