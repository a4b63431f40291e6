"""Pose tracking: prediction by odometry, correction by registration."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.motion_prior import Motion
from sextant.services.perception.registration.pose_tracking import PoseTracker
from sextant.shared.geometry import Array, from_xyz_rpy, inverse, is_rigid, rpy_from_rotation, yaw_of

S = 1_000_000_000
SETTINGS = Settings()


def pose(x: float, roll: float = 0.0, yaw: float = 0.0) -> Array:
    return from_xyz_rpy((x, 0.0, 0.1), (roll, 0.0, yaw))


def motion(x: float, reliable: bool = True) -> Motion:
    return Motion(pose(x), x, 0.0, reliable)


@pytest.fixture
def tracker() -> PoseTracker:
    tracker = PoseTracker(SETTINGS)
    tracker.correct(0, pose(0.0), motion(0.0), registered=True)
    return tracker


def test_prediction_follows_odometry_and_its_spread_grows(tracker: PoseTracker) -> None:
    near, far = (tracker.predict(motion(x), 0) for x in (0.1, 0.5))
    np.testing.assert_allclose(far[0], pose(0.5))
    assert np.sqrt(near[1][0, 0]) == pytest.approx(0.1 * SETTINGS.odometry_drift + SETTINGS.odometry_floor)
    assert far[1][0, 0] > near[1][0, 0]
    assert far[1][2, 2] == near[1][2, 2], "any floor constrains height"


def test_unreliable_odometry_has_a_larger_spread(tracker: PoseTracker) -> None:
    (_, sure), (_, unsure) = (tracker.predict(motion(0.1, reliable), 0) for reliable in (True, False))
    assert (np.diag(unsure) > np.diag(sure)).all()


def test_failed_frame_leaves_the_spread_growing(tracker: PoseTracker) -> None:
    tracker.correct(S, pose(0.2), motion(0.2), registered=False)
    _, covariance = tracker.predict(motion(0.3), 0)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.3 * SETTINGS.odometry_drift + SETTINGS.odometry_floor)


def test_spread_is_bounded_for_any_travelled_distance(tracker: PoseTracker) -> None:
    _, covariance = tracker.predict(replace(motion(0.1), travelled=1e12, turned=1e12), 0)
    assert np.sqrt(np.diag(covariance)).max() <= 10.0


def test_registration_moves_odom_in_world(tracker: PoseTracker) -> None:
    tracker.correct(S, pose(0.25, yaw=0.1), motion(0.2), registered=True)
    np.testing.assert_allclose(tracker.T_world_odom @ pose(0.2), pose(0.25, yaw=0.1), atol=1e-12)
    np.testing.assert_allclose(tracker.predict(motion(0.2), 0)[0], pose(0.25, yaw=0.1), atol=1e-12)


def test_restarted_odometry_keeps_the_body_pose(tracker: PoseTracker) -> None:
    tracker.correct(S, pose(0.5), motion(0.5), registered=True)
    elsewhere = replace(motion(0.0), T_odom_body=from_xyz_rpy((-0.7, 0.3, 0.1), (0.0, 0.0, 1.0)))
    np.testing.assert_allclose(tracker.predict(elsewhere, 1)[0], pose(0.5), atol=1e-12)


def test_nearly_rigid_pose_becomes_rigid(tracker: PoseTracker) -> None:
    scaled = pose(0.1)
    scaled[:3, :3] *= 1.0 + 4e-5
    tracker.correct(S, scaled, motion(0.1), registered=True)
    assert is_rigid(tracker.T_world_body, 1e-9)
    assert is_rigid(tracker.T_world_odom, 1e-9)


def test_steady_correction_averages_tilt_and_is_exact_at_the_body(tracker: PoseTracker) -> None:
    tracker.correct(S // 10, pose(0.1, roll=0.02, yaw=0.1), motion(0.1), registered=True)
    steady = tracker.steady_T_world_odom(pose(0.1))
    assert 0.0 < rpy_from_rotation(steady[:3, :3])[0] < 0.002
    assert yaw_of(steady) == pytest.approx(yaw_of(tracker.T_world_odom))
    np.testing.assert_allclose((steady @ pose(0.1))[:3, 3], tracker.T_world_body[:3, 3], atol=1e-12)


def test_restarted_tilt_is_the_next_one(tracker: PoseTracker) -> None:
    tracker.restart_tilt()
    tracker.correct(S // 10, pose(0.1, roll=0.02), motion(0.1), registered=True)
    steady = tracker.steady_T_world_odom(pose(0.1))
    np.testing.assert_allclose(steady, pose(0.1, roll=0.02) @ inverse(pose(0.1)), atol=1e-9)


def lose(tracker: PoseTracker, from_s: int, until_s: int) -> None:
    for k in range(from_s, until_s):
        tracker.correct(k * S, pose(0.0), motion(0.0), registered=False)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (pose(0.0, roll=0.08), "images tilt the body by 5 deg against its feet"),
        (from_xyz_rpy((0.0, 0.0, 0.14), np.zeros(3)), "images lift the body by +4 cm off its feet"),
    ],
)
def test_pose_that_contradicts_feet_is_refused_after_long_time_without_registration(
    tracker: PoseTracker, wrong: Array, words: str
) -> None:
    assert not tracker.contradiction(S, wrong, motion(0.0)), "the ground may sink under the feet"
    lose(tracker, 1, 5)
    right = pose(0.1, roll=0.02)
    assert not tracker.contradiction(5 * S, right, motion(0.1))
    tracker.correct(5 * S, right, motion(0.1), registered=True)
    assert tracker.contradiction(6 * S, wrong, motion(0.0)) == words, "a pose that is wrong by and by"
    for begin_s, for_s in ((6, 2), (20, 4), (40, 8)):
        tracker.distrust(begin_s * S, words)
        np.testing.assert_allclose(tracker.T_world_odom, np.eye(4), atol=1e-12)
        refused = [tracker.distrusted((begin_s + k) * S) for k in (0, for_s - 1, for_s)]
        assert refused == [words, words, ""], "longer each time"
        lose(tracker, begin_s, begin_s + 10)
        assert tracker.contradiction((begin_s + 10) * S, wrong, motion(0.0)) == words


def test_doubt_ends_after_a_while(tracker: PoseTracker) -> None:
    lose(tracker, 1, 5)
    assert not tracker.contradiction(5 * S, pose(0.0), motion(0.0))
    tracker.correct(5 * S, pose(0.0), motion(0.0), registered=True)
    assert not tracker.contradiction(7 * S, pose(0.0, roll=0.08), motion(0.0))
