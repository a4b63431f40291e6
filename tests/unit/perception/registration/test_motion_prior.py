"""Motion prior: the legs' estimate of the motion between frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.perception.registration.motion_prior import OdometryHistory, VelocityPrior
from sextant.shared.geometry import Array, exp_se3, from_xyz_rpy
from sextant.shared.wire.messages import Odometry

MS = 1_000_000
PERIOD = 20 * MS
TWIST = np.array([0.1, 0.02, 0.0, 0.0, 0.0, 0.3])  # [m/s] and [rad/s] {body}


def pose_at(ns: int) -> Array:
    """Return the pose (4, 4) of a body in steady screw motion."""
    return exp_se3(TWIST * ns * 1e-9)


def message(ns: int, reliable: bool = True, travelled: float | None = None, T: Array | None = None) -> Odometry:
    far = 0.1 * ns * 1e-9 if travelled is None else travelled
    return Odometry(ns, pose_at(ns) if T is None else T, far, 0.3 * ns * 1e-9, np.ones(6, dtype=bool), reliable)


def odometry_history(count: int = 50) -> OdometryHistory:
    history = OdometryHistory()
    for k in range(count):
        history.add(message(k * PERIOD))
    return history


def test_empty_history_has_no_motion() -> None:
    assert OdometryHistory().motion_at(0) is None


def test_no_motion_before_first_message() -> None:
    history = OdometryHistory()
    history.add(message(5 * PERIOD))
    assert history.motion_at(4 * PERIOD) is None
    assert history.motion_at(5 * PERIOD) is not None


@given(st.integers(0, 49 * PERIOD))
def test_motion_is_interpolated_between_messages(ns: int) -> None:
    motion = odometry_history().motion_at(ns)
    assert motion is not None
    np.testing.assert_allclose(motion.T_odom_body, pose_at(ns), atol=1e-5)
    assert motion.travelled == pytest.approx(0.1 * ns * 1e-9)
    assert motion.turned == pytest.approx(0.3 * ns * 1e-9)


@pytest.mark.parametrize("index", [0, 7, 49])
def test_motion_at_message_stamp_equals_message(index: int) -> None:
    motion = odometry_history().motion_at(index * PERIOD)
    assert motion is not None
    np.testing.assert_allclose(motion.T_odom_body, pose_at(index * PERIOD), atol=1e-12)


def test_motion_is_extrapolated_shortly_after_newest_message() -> None:
    motion = odometry_history().motion_at(49 * PERIOD + 15 * MS)
    assert motion is not None
    np.testing.assert_allclose(motion.T_odom_body, pose_at(49 * PERIOD + 15 * MS), atol=1e-4)
    assert motion.reliable


def test_long_after_newest_message_motion_stops_and_is_unreliable() -> None:
    history = odometry_history()
    far, farther = history.motion_at(49 * PERIOD + 10_000 * MS), history.motion_at(49 * PERIOD + 20_000 * MS)
    assert far is not None
    assert farther is not None
    np.testing.assert_array_equal(far.T_odom_body, farther.T_odom_body)
    assert np.linalg.norm(far.T_odom_body[:3, 3] - pose_at(49 * PERIOD)[:3, 3]) < 0.02
    assert not far.reliable
    alone = OdometryHistory()
    alone.add(message(0))
    late = alone.motion_at(10_000 * MS)
    assert late is not None
    assert not late.reliable


def test_unreliable_adjacent_message_makes_motion_unreliable() -> None:
    history = OdometryHistory()
    for k in range(6):
        history.add(message(k * PERIOD, reliable=k != 3))
    doubts = [not history.motion_at(k * PERIOD // 2).reliable for k in range(11)]  # type: ignore[union-attr]
    assert doubts == [False] * 4 + [True] * 4 + [False] * 3  # an instant at a message also depends on the next message


def test_odometry_restart_is_counted_and_clears_history() -> None:
    history = odometry_history()
    history.add(message(50 * PERIOD, travelled=0.0, T=np.eye(4)))
    assert history.restarts == 1
    assert history.motion_at(49 * PERIOD) is None
    motion = history.motion_at(50 * PERIOD)
    assert motion is not None
    np.testing.assert_array_equal(motion.T_odom_body, np.eye(4))


@pytest.mark.parametrize("away_ns", [3600_000_000_000, -3600_000_000_000])
def test_clock_jump_is_odometry_restart(away_ns: int) -> None:
    history = odometry_history()
    history.add(message(50 * PERIOD + away_ns, travelled=1.0))
    for k in range(51, 60):
        history.add(message(k * PERIOD, travelled=1.0 + 0.001 * k))
    motion = history.motion_at(59 * PERIOD)
    assert motion is not None
    assert motion.reliable
    np.testing.assert_allclose(motion.T_odom_body, pose_at(59 * PERIOD), atol=1e-9)
    assert history.restarts >= 1


def test_motion_within_long_silence_is_unreliable() -> None:
    history = odometry_history(10)
    history.add(message(9 * PERIOD + 2_000 * MS))
    within, beyond = history.motion_at(9 * PERIOD + 1_000 * MS), history.motion_at(9 * PERIOD + 3_500 * MS)
    assert within is not None
    assert beyond is not None
    assert not within.reliable
    assert beyond.silence_s == pytest.approx(1.5)


def test_standing_still_is_not_odometry_restart() -> None:
    history = OdometryHistory()
    for k in range(10):
        history.add(message(k * PERIOD, travelled=0.25))
    assert history.restarts == 0


def test_out_of_order_message_is_ignored() -> None:
    history = odometry_history(10)
    history.add(message(5 * PERIOD, travelled=0.0, T=from_xyz_rpy((9, 9, 9), np.zeros(3))))
    assert history.restarts == 0
    motion = history.motion_at(5 * PERIOD)
    assert motion is not None
    np.testing.assert_allclose(motion.T_odom_body, pose_at(5 * PERIOD), atol=1e-12)


@pytest.mark.parametrize(("way", "turn"), [(0.3, 0.0), (0.0, 1.0)])
def test_impossible_pose_jump_is_odometry_restart(way: float, turn: float) -> None:
    history = odometry_history()
    history.add(message(50 * PERIOD, T=pose_at(50 * PERIOD) @ from_xyz_rpy([way, 0.0, 0.0], [0.0, 0.0, turn])))
    assert history.restarts == 1
    history.add(message(51 * PERIOD))  # back to the previous place
    assert history.restarts == 2
    motion = history.motion_at(51 * PERIOD)
    assert motion is not None
    np.testing.assert_allclose(motion.T_odom_body, pose_at(51 * PERIOD))


def test_pose_jump_after_silence_is_not_odometry_restart() -> None:
    history = odometry_history()
    history.add(message(100 * PERIOD, T=pose_at(50 * PERIOD) @ from_xyz_rpy([0.3, 0.0, 0.0], [0.0, 0.0, 0.5])))
    assert history.restarts == 0


def test_history_keeps_only_recent_messages() -> None:
    history = odometry_history(500)
    assert history.motion_at(0) is None
    assert history.motion_at(499 * PERIOD - 1_000 * MS) is not None


FRAME = 33 * MS


def follow(prior: VelocityPrior, poses: list[np.ndarray], registered: bool = True, twists: np.ndarray | None = None) -> None:
    """Update a prior with frames at the given poses, one period apart."""
    for k, T in enumerate(poses):
        prior.update(k * FRAME, T, registered, np.zeros((0, 6)) if twists is None else twists)


@given(st.integers(1, 100))
def test_observed_motion_is_predicted_along_its_screw(span_ms: int) -> None:
    prior = VelocityPrior(0.15)
    step = exp_se3(np.array([0.001, -0.0005, 0.0, 0.001, 0.0, 0.002]) * span_ms)
    before = from_xyz_rpy((0.3, 0.1, 0.2), np.array([0.1, -0.2, 0.7]))
    for k in range(3):
        prior.update(k * span_ms * MS, before @ np.linalg.matrix_power(step, k), True, np.zeros((0, 6)))
    assert prior.measured
    np.testing.assert_allclose(prior.predict(span_ms * 1e-3), before @ np.linalg.matrix_power(step, 3), atol=1e-9)


def test_prior_starts_at_rest_with_unmeasured_velocity() -> None:
    prior = VelocityPrior(0.15)
    with pytest.raises(ValueError, match="at least one frame"):
        prior.predict(0.033)
    prior.update(0, pose_at(0), True, np.eye(6))
    assert not prior.measured
    np.testing.assert_allclose(prior.predict(1.0), pose_at(0), atol=1e-12)


def test_predicted_velocity_of_lost_camera_decays_to_zero() -> None:
    """Check that the predicted travel ends at the speed times the time constant."""
    prior = VelocityPrior(0.15)
    follow(prior, [from_xyz_rpy((0.02 * k, 0.0, 0.0), np.zeros(3)) for k in range(10)])
    speed = 0.02 / (FRAME * 1e-9)
    stamp_ns = 9 * FRAME
    for _ in range(100):
        T = prior.predict(FRAME * 1e-9)
        stamp_ns += FRAME
        prior.update(stamp_ns, T, False, np.eye(6))
    assert not prior.measured
    assert 0.18 < T[0, 3] < 0.18 + speed * (0.15 + FRAME * 1e-9)
    np.testing.assert_allclose(prior.predict(FRAME * 1e-9), T, atol=1e-6)


def test_only_unobservable_velocity_components_decay() -> None:
    prior = VelocityPrior(0.15)
    follow(prior, [from_xyz_rpy((0.01 * k, 0.01 * k, 0.0), np.zeros(3)) for k in range(10)])
    T, stamp_ns = from_xyz_rpy((0.09, 0.09, 0.0), np.zeros(3)), 9 * FRAME
    for _ in range(60):  # y is observed and continues; x is left to the prior
        T = from_xyz_rpy((prior.predict(FRAME * 1e-9)[0, 3], T[1, 3] + 0.01, 0.0), np.zeros(3))
        stamp_ns += FRAME
        prior.update(stamp_ns, T, True, np.eye(6)[:1])
    step = prior.predict(FRAME * 1e-9)[:2, 3] - T[:2, 3]
    assert abs(step[0]) < 1e-5
    assert step[1] == pytest.approx(0.01, rel=1e-6)


def test_relocalization_jump_gives_no_velocity() -> None:
    prior = VelocityPrior(0.15)
    follow(prior, [from_xyz_rpy((0.01 * k, 0.0, 0.0), np.zeros(3)) for k in range(5)])
    prior.update(5 * FRAME, from_xyz_rpy((0.5, 0.0, 0.0), np.zeros(3)), True, np.zeros((0, 6)))
    assert not prior.measured
    assert prior.predict(FRAME * 1e-9)[0, 3] == pytest.approx(0.5)
    with pytest.raises(ValueError, match="positive time of decay"):
        VelocityPrior(0.0)
