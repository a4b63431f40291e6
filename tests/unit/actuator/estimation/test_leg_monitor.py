"""Findings about legs: what stops the robot, what makes it slower, what does neither, and how exactly they name."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.estimation.leg_monitor import LegMonitor
from sextant.services.actuator.estimation.stance_fit import measure_stance
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile

# Feet without a radius do not roll, so their centres are fixed to the ground.
PROFILE = replace(load_profile("phantomx_mk2"), foot=replace(load_profile("phantomx_mk2").foot, radius=1e-6))
SWINGS = [[False, True] * 3, [True, False] * 3]
CYCLES = 40
COXA_OF_LEFT_FRONT, TIBIA_OF_RIGHT_MIDDLE = 0, 8


def angles(x: float) -> Array:
    return body_inverse(PROFILE, apply(inverse(from_xyz_rpy((x, 0.0, 0.0), np.zeros(3))), PROFILE.rest_feet()))


def step(monitor: LegMonitor, number: int, slip: Array | None = None, since: int = -1, stride: float = 0.09) -> int | None:
    """Let a monitor watch a step, in which encoders are behind their links by `slip` (18,) [rad] from a cycle on.

    Return the cycle at which it stops the robot.
    """
    swing, stops = SWINGS[number % 2], None
    for k in range(CYCLES):
        q = angles(stride * (k / CYCLES - 0.5))
        if slip is not None and k >= since:
            q -= slip.reshape(6, 3)
        monitor.check_goals()
        monitor.watch(number, swing, swing, k == CYCLES - 1, q)
        stops = k if monitor.stop and stops is None else stops
    monitor.watch(number, swing, [False] * 6, True, q)
    return stops


def walked(steps: int = 8, horns: Array | None = None) -> LegMonitor:
    monitor = LegMonitor(PROFILE)
    for number in range(steps):
        assert step(monitor, number, horns) is None
    assert (monitor.stop, monitor.warning, monitor.pace) == ("", "", 1.0)
    return monitor


def one(joint: int, degrees: float) -> Array:
    offset = np.zeros(18)
    offset[joint] = np.radians(degrees)
    return offset


@pytest.mark.parametrize("seed", range(5))
def test_robot_whose_horns_are_off_all_the_time_is_not_suspected(seed: int) -> None:
    walked(20, np.radians(np.random.default_rng(seed).uniform(-4.0, 4.0, 18)))


@pytest.mark.parametrize("degrees", [-20.0, 20.0])
@pytest.mark.parametrize("joint", range(18))
def test_slip_in_the_air_stops_the_robot_within_four_steps_and_no_other_leg_is_named_alone(joint: int, degrees: float) -> None:
    monitor = walked()
    for number in (8, 9, 10, 11):
        step(monitor, number, one(joint, degrees))
    assert "has slipped by about" in monitor.stop
    assert LEGS[joint // 3] in monitor.stop
    monitor.forget()  # torque is off
    assert (monitor.stop, monitor.warning) == ("", "")
    for number in (12, 13, 14, 15):
        step(monitor, number, one(joint, degrees))
    assert "has slipped by about" in monitor.stop


def test_large_slip_in_the_first_steps_may_also_be_a_servo_with_a_wrong_sign_or_another_id() -> None:
    """Check the advice: the fit blames a horn, and perhaps of a healthy leg, if a servo has never been where it should be."""
    fresh = LegMonitor(PROFILE)
    for number in range(4):
        step(fresh, number, one(TIBIA_OF_RIGHT_MIDDLE, -20.0), since=CYCLES // 2)
    assert "a servo of any leg turns the wrong way or has another one's id: run `sextant servos test`" in fresh.warning
    later = walked(32)
    step(later, 32, one(TIBIA_OF_RIGHT_MIDDLE, -20.0), since=CYCLES // 2)
    assert "has slipped by about" in later.warning
    assert "servos test" not in later.warning


def test_horn_that_is_off_from_the_start_is_named_without_slowing_the_robot() -> None:
    assert walked(20).deviation == ""
    ahead = walked(20, one(COXA_OF_LEFT_FRONT, 4.0)).deviation
    servo = PROFILE.servo_ids[0, 0]
    assert ahead.startswith(f"the coxa servo of the left front leg (id {servo}): its horn is off by about 4 deg")
    assert "`sextant camera calibrate`" in ahead
    assert walked(20, one(TIBIA_OF_RIGHT_MIDDLE, -4.0)).deviation.startswith("right middle leg: a horn is off by about")


@pytest.mark.parametrize("seed", range(4))
def test_robot_with_many_horns_off_says_that_its_legs_differ(seed: int) -> None:
    horns = np.radians(np.random.default_rng(seed).uniform(-4.0, 4.0, 18))
    said = walked(20, horns).deviation
    assert said.startswith("horns or links of several legs differ from the profile: compare the lengths in [links]")
    assert said.endswith("run `sextant camera calibrate`, which measures all horns")


@pytest.mark.parametrize(("moved", "is_said"), [(2.5, False), (3.5, True)])
def test_feet_that_creep_as_on_a_slope_are_not_horns(moved: float, is_said: bool) -> None:
    """Check the limit, in variances of a robot that matches its profile: on a slope of 10 deg such robots had 2.3 at most."""
    horns = np.radians(np.random.default_rng(0).uniform(-4.0, 4.0, 18))
    all_of_them = walked(20, horns).offsets
    some = horns * np.sqrt(moved / (all_of_them.moved / all_of_them.pairs))
    assert bool(walked(20, some).deviation) is is_said


@pytest.mark.parametrize("seed", range(4))
def test_sure_offsets_explain_the_stances_and_are_closer_to_the_true_ones_than_the_profile(seed: int) -> None:
    """Straight steps on level ground show 6 of 18 combinations of offsets: three distances of either three legs."""
    horns = np.radians(np.random.default_rng(seed).uniform(-4.0, 4.0, 18))
    assert walked(4, horns).sure_offsets is None, "too few stances"
    found = walked(20, horns).sure_offsets
    assert found is not None
    assert np.linalg.norm(found - horns) < np.linalg.norm(horns)
    before, after = (angles(x) - horns.reshape(6, 3) for x in (-0.04, 0.04))
    legs = ((0, 2, 4), (1, 3, 5))
    shown = np.concatenate([measure_stance(PROFILE, before, after, three).constant for three in legs])
    assert np.linalg.matrix_rank(shown) == 6
    assert np.linalg.norm(shown @ (found - horns)) < 0.3 * np.linalg.norm(shown @ horns)


def test_offsets_are_not_sure_without_errors_nor_while_a_slip_may_explain_a_stance() -> None:
    rng = np.random.default_rng(0)
    noisy = LegMonitor(PROFILE)
    for number in range(40):
        step(noisy, number, rng.normal(0.0, np.radians(0.1), 18), since=CYCLES // 2)  # play and resolution of the encoders
        assert noisy.sure_offsets is None
    horns = np.radians(rng.uniform(-3.0, 3.0, 18))
    monitor = walked(20, horns)
    assert monitor.sure_offsets is not None
    step(monitor, 20, horns + one(TIBIA_OF_RIGHT_MIDDLE, -20.0), since=CYCLES // 2)
    for number in range(21, 26):
        assert monitor.sure_offsets is None
        step(monitor, number, horns)
    step(monitor, 26, horns)
    assert monitor.sure_offsets is not None
    step(monitor, 27, horns + one(COXA_OF_LEFT_FRONT, 9.0))
    step(monitor, 28, horns + one(COXA_OF_LEFT_FRONT, 9.0))
    assert monitor.sure_offsets is None, "it is too small to stop the robot"


def test_large_slip_makes_the_robot_slower_at_once_and_stops_it_when_the_same_legs_stand_again() -> None:
    monitor = walked()
    step(monitor, 8, one(TIBIA_OF_RIGHT_MIDDLE, -20.0), since=CYCLES // 2)
    assert monitor.stop == ""
    assert monitor.pace < 1.0
    assert monitor.warning.startswith("right middle leg: a horn has slipped by about")
    step(monitor, 9, one(TIBIA_OF_RIGHT_MIDDLE, -20.0))
    assert monitor.stop == ""
    step(monitor, 10, one(TIBIA_OF_RIGHT_MIDDLE, -20.0))
    assert "right middle leg" in monitor.stop


def test_foot_that_slides_once_makes_the_robot_slower_for_six_stances() -> None:
    monitor = walked()
    step(monitor, 8, one(TIBIA_OF_RIGHT_MIDDLE, -20.0), since=CYCLES // 2)
    assert "or the foot slides" in monitor.warning
    for number in range(9, 14):
        step(monitor, number)
    assert monitor.warning != ""
    step(monitor, 14)
    assert (monitor.stop, monitor.warning, monitor.pace) == ("", "", 1.0)


def test_warning_follows_the_foot_that_slid_last() -> None:
    monitor = walked()
    step(monitor, 8, one(TIBIA_OF_RIGHT_MIDDLE, -20.0), since=CYCLES // 2)
    assert monitor.warning.startswith("right middle leg")
    step(monitor, 9, one(COXA_OF_LEFT_FRONT, 20.0), since=CYCLES // 2)
    assert "left front" not in monitor.warning, "that leg swings"
    step(monitor, 10, one(COXA_OF_LEFT_FRONT, 20.0), since=CYCLES // 2)
    assert "left front" in monitor.warning


def test_small_slip_makes_the_robot_slower_after_two_stances() -> None:
    monitor = walked()
    step(monitor, 8, one(COXA_OF_LEFT_FRONT, 9.0))
    assert (monitor.warning, monitor.pace) == ("", 1.0)
    step(monitor, 9)
    step(monitor, 10, one(COXA_OF_LEFT_FRONT, 9.0))
    assert "left front" in monitor.warning
    assert "has slipped by about 9 deg" in monitor.warning
    assert monitor.stop == ""
    assert monitor.pace < 1.0


def test_nothing_is_learned_from_an_unusual_stance() -> None:
    """A slip of 9 deg that is there in one stance of four does not become usual."""
    monitor = walked()
    for number in range(8, 40):
        step(monitor, number, one(COXA_OF_LEFT_FRONT, 9.0) if number % 8 == 0 else None)
    assert (monitor.stop, monitor.warning) == ("", "")
    step(monitor, 40, one(COXA_OF_LEFT_FRONT, 9.0))
    step(monitor, 42, one(COXA_OF_LEFT_FRONT, 9.0))
    assert "left front" in monitor.warning


def push(monitor: LegMonitor, index: int) -> None:
    """Let a servo show its full torque for ten readings, 0.3 rad behind its goal."""
    monitor.goals.note_goals([0.3] * 18)
    for _ in range(10):
        monitor.goals.add_reading(index, 0.0, PROFILE.servo.stall_torque)
    monitor.goals.add_reading(index, 0.3, 0.0)
    monitor.check_goals()


def test_weak_servo_makes_the_robot_slower_and_the_second_time_stops_it() -> None:
    monitor = walked()
    push(monitor, 10)
    assert f"(id {PROFILE.servo_ids.ravel()[10]}) shows its full torque" in monitor.warning
    assert monitor.pace < 1.0
    push(monitor, 10)  # the same step: something holds it
    assert monitor.stop == ""
    step(monitor, 8, one(COXA_OF_LEFT_FRONT, 20.0))  # its leg hangs and pushes the others
    step(monitor, 9)
    step(monitor, 10, one(COXA_OF_LEFT_FRONT, 20.0))
    assert monitor.stop == ""
    push(monitor, 10)
    assert f"(id {PROFILE.servo_ids.ravel()[10]}) shows its full torque" in monitor.stop


def test_joint_that_was_held_once_is_forgotten() -> None:
    monitor = walked()
    push(monitor, 10)
    for number in range(8, 16):
        step(monitor, number)
    assert (monitor.stop, monitor.warning, monitor.pace) == ("", "", 1.0)


def lie(monitor: LegMonitor) -> None:
    """Let a servo read 17 deg off its goal without load, and then follow it."""
    monitor.goals.note_goals([0.3] * 18)
    for off in (*[0.3] * 3, *[0.0] * 30):
        monitor.goals.add_reading(10, 0.3 - off, 0.0)
        monitor.check_goals()
        if off and monitor.stop:
            assert f"(id {PROFILE.servo_ids.ravel()[10]}) is 17 deg off its goal" in monitor.stop


def test_lie_of_a_register_stops_the_robot_as_long_as_it_lasts_and_soon_again_until_torque_is_off() -> None:
    monitor = walked()
    lie(monitor)
    assert monitor.stop == ""
    for number in range(8, 16):
        step(monitor, number)
    lie(monitor)  # after a while, it may be another cause
    assert monitor.stop == ""
    step(monitor, 16)
    lie(monitor)
    assert "is 17 deg off its goal" in monitor.stop
