"""Joint goals: finite, within joint limits, bounded in speed and acceleration.

Speed and acceleration stay within what the servos can do. Selected joints move at a reduced (gentle) speed.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sextant.services.actuator.locomotion.joint_rate_limits import FETCHED, GENTLE, LOWERED, JointRateLimits
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
LIMITS = PROFILE.joint_limits
REST = body_inverse(PROFILE, PROFILE.rest_feet())
FASTEST = PROFILE.servo.no_load_speed
DT = 0.02
anything = st.floats(allow_nan=True, allow_infinity=True)


@pytest.mark.slow
@given(
    st.lists(hnp.arrays(np.float64, (6, 3), elements=anything), min_size=1, max_size=4),
    st.integers(0, 2**32 - 1),
    st.floats(0, 0.1),
)
@settings(max_examples=200)
def test_goals_are_finite_within_joint_limits_and_servo_speed(wanted: list[Array], seed: int, dt: float) -> None:
    limits = JointRateLimits(PROFILE)
    last = np.random.default_rng(seed).uniform(LIMITS[..., 0], LIMITS[..., 1])
    for q in wanted:
        with np.errstate(all="ignore"):
            goal, warning = limits.safe(q, last, dt)
        assert np.isfinite(goal).all()
        assert within_limits(PROFILE, goal).all()
        assert np.abs(goal - last).max() <= FASTEST * dt + 1e-12
        lost = ~np.isfinite(q).all(axis=1)
        np.testing.assert_array_equal(goal[lost], last[lost])
        assert bool(warning) == bool(lost.any())
        last = goal


def test_warning_names_legs_out_of_reach() -> None:
    q = REST.copy()
    q[2, 1] = np.nan
    goal, warning = JointRateLimits(PROFILE).safe(q, REST, DT)
    assert warning == "foot out of reach, leg held in place: right middle"
    np.testing.assert_array_equal(goal, REST)
    q[4, 0] = np.inf
    _, warning = JointRateLimits(PROFILE).safe(q, REST, DT)
    assert warning == "foot out of reach, leg held in place: right middle, left rear"


def test_goals_in_reach_pass_unchanged() -> None:
    goal, warning = JointRateLimits(PROFILE).safe(REST + 0.01, REST, DT)
    np.testing.assert_allclose(goal, REST + 0.01)
    assert warning == ""


def test_acceleration_is_limited_but_deceleration_is_not() -> None:
    limits, last, far = JointRateLimits(PROFILE), REST, np.clip(REST + 0.5, LIMITS[..., 0], LIMITS[..., 1])
    steps = list[float]()
    for _ in range(4):
        goal, _ = limits.safe(far, last, DT)
        steps.append(float(np.abs(goal - last).max()))
        last = goal
    np.testing.assert_allclose(steps[:3], FASTEST * DT * np.array([0.5, 1.0, 1.0]))
    goal, _ = limits.safe(last, last, DT)
    np.testing.assert_array_equal(goal, last)
    slow, _ = limits.safe(last - 0.01, last, DT)
    fast, _ = limits.safe(REST, slow, DT)
    np.testing.assert_allclose(np.abs(fast - slow).max(), 0.01 + 0.5 * FASTEST * DT)


def test_limited_joint_moves_gently_until_it_has_caught_up() -> None:
    limits, wanted = JointRateLimits(PROFILE), REST + 0.1
    limits.limit_joint(3, 1)
    last, slow, others = REST, 0, True
    for _ in range(40):
        goal, _ = limits.safe(wanted, last, DT)
        assert abs(goal[3, 1] - last[3, 1]) <= GENTLE * DT + 1e-12
        slow += abs(goal[3, 1] - wanted[3, 1]) > 1e-9
        others = others and np.abs(np.delete((goal - last).ravel(), 10)).max() > GENTLE * DT
        last = goal
    assert slow == round(0.1 / (GENTLE * DT) - 0.5)
    np.testing.assert_allclose(last, wanted)
    goal, _ = limits.safe(wanted + 0.04, last, DT)
    np.testing.assert_allclose(goal, wanted + 0.04)  # it has caught up and is as fast as the others again


def test_limited_joint_is_behind_while_over_5_deg_from_its_goal() -> None:
    limits, last = JointRateLimits(PROFILE), REST
    wanted = REST.copy()
    wanted[3, 1] += 0.2
    wanted[2, 0] += 0.2
    limits.limit_joint(3, 1)
    for _ in range(40):
        last, _ = limits.safe(wanted, last, DT)
        far = wanted[3, 1] - last[3, 1] > np.radians(5.0)
        assert np.argwhere(limits.behind).tolist() == ([[3, 1]] if far else [])
    assert not limits.behind.any()


def test_all_joints_of_leg_stay_gentle_while_one_is_behind() -> None:
    limits, wanted, last = JointRateLimits(PROFILE), REST.copy(), REST
    wanted[3, 1] += 0.3
    limits.limit_joint(3, 1)
    while limits.behind.any():
        last, _ = limits.safe(wanted, last, DT)
        wanted[3, 2] = last[3, 2] + (0.1 if limits.behind.any() else 0.0)  # a leg that hung begins to stand
        goal, _ = limits.safe(wanted, last, DT)
        assert abs(goal[3, 2] - last[3, 2]) <= GENTLE * DT + 1e-12
        last = goal


def test_is_limiting_until_the_last_joint_reaches_its_goal() -> None:
    limits, wanted, last = JointRateLimits(PROFILE), REST + 0.05, REST
    assert not limits.is_limiting
    limits.limit_joint(3, 1)
    while limits.is_limiting:
        last, _ = limits.safe(wanted, last, DT)
        assert limits.is_limiting == (np.abs(wanted - last)[3].max() > 1e-9)
    np.testing.assert_allclose(last[3], wanted[3])
    limits.limit_joint(0, 0)
    limits.forget()
    assert not limits.is_limiting


def test_forget_clears_joint_limits_with_torque_off() -> None:
    limits = JointRateLimits(PROFILE)
    limits.limit_joint(3, 1)
    assert limits.behind.any()
    limits.forget()
    assert not limits.behind.any()
    goal, _ = limits.safe(REST + 0.1, REST, DT)
    assert (goal - REST)[3, 1] > GENTLE * DT


def test_reversed_goal_accelerates_from_zero_speed() -> None:
    limits, fastest = JointRateLimits(PROFILE), PROFILE.servo.no_load_speed
    last, rates = REST.copy(), []
    for way in (1.0,) * 5 + (-1.0,) * 5:
        goal, _ = limits.safe(last + way * np.radians(30.0), last, DT / 2)
        rates.append((goal - last)[3, 0] / (DT / 2) / fastest)
        last = goal
    np.testing.assert_allclose(rates, [0.25, 0.5, 0.75, 1.0, 1.0, -0.25, -0.5, -0.75, -1.0, -1.0], atol=1e-9)


def test_gentle_speeds_match_documentation() -> None:
    np.testing.assert_allclose(np.degrees([GENTLE, LOWERED, FETCHED]), [25.0, 35.0, 95.0])


@pytest.mark.parametrize(("short_deg", "pace"), [(0.0, 1.0), (1.5, 0.5), (3.0, 0.0), (9.0, 0.0)])
def test_pace_falls_to_zero_at_3_deg_behind_the_goal(short_deg: float, pace: float) -> None:
    limits, wanted = JointRateLimits(PROFILE), REST.copy()
    wanted[3, 1] += GENTLE * DT + np.radians(short_deg)
    limits.limit_joint(3, 1)
    limits.safe(wanted, REST, DT)
    assert limits.pace == pytest.approx(pace)


def test_speed_limit_can_be_set_per_leg() -> None:
    limits = JointRateLimits(PROFILE)
    limits.limit_joint(2, 0)
    limits.limit_joint(3, 1, LOWERED)
    steps = np.abs(limits.safe(REST + 0.1, REST, DT)[0] - REST)
    np.testing.assert_allclose(steps[2], GENTLE * DT)
    np.testing.assert_allclose(steps[3], LOWERED * DT)
    limits.limit_joint(3, 1)
    last, _ = limits.safe(REST + 0.1, REST, DT)
    np.testing.assert_allclose(np.abs(last - REST)[3], GENTLE * DT)


def test_pace_keeps_motion_within_3_deg_of_limited_joints() -> None:
    """Check that `pace` slows a motion until the joints' goals keep up with it.

    The motion may ask for any speed.
    """
    limits, last, share, cycles = JointRateLimits(PROFILE), REST, 0.0, 0
    assert limits.pace == 1.0
    while share < 1.0 and cycles < 1000:
        share = min(share + limits.pace * DT, 1.0)  # one radian per second
        limits.limit_joint(3, 1)
        wanted = REST.copy()
        wanted[3, 1] += share
        last, _ = limits.safe(wanted, last, DT)
        assert abs(wanted - last).max() < np.radians(3.0)
        assert 0.0 <= limits.pace <= 1.0
        cycles += 1
    assert cycles * DT == pytest.approx(1.0 / GENTLE, abs=0.2)
    limits.forget()
    assert limits.pace == 1.0
    limits.safe(REST - 0.2, last, DT)
    assert limits.pace == 1.0, "joints without a limit keep no step waiting"
