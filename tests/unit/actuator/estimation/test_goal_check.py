"""Check of goals: honest servos never contradict themselves, and each lie is named by its kind and size."""

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.estimation.goal_check import GoalCheck
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
SERVO = PROFILE.servo
INDEX = 10


def spring(goal: float, angle: float) -> float:
    """Return the load [N m] that a servo shows."""
    return min(max(SERVO.stiffness * (goal - angle), -SERVO.stall_torque), SERVO.stall_torque)


def read(check: GoalCheck, goal: float, angle: float, load: float) -> None:
    check.note_goals([goal] * 18)
    check.add_reading(INDEX, angle, load)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 10_000))
def test_honest_servo_contradicts_itself_never(seed: int) -> None:
    """Move and load the joint at random, with play and stiffness of a real servo and goals that are a cycle late."""
    rng, check = np.random.default_rng(seed), GoalCheck(PROFILE)
    goal, stiffness = 0.0, rng.uniform(0.9, 1.1)
    for _ in range(30):
        before, goal = goal, goal + rng.uniform(-0.12, 0.12)
        followed = goal if rng.random() < 0.8 else before
        angle = followed - rng.uniform(-0.13, 0.13)
        play = math.radians(rng.uniform(-0.25, 0.25))
        read(check, goal, angle, stiffness * spring(followed + play, angle))
        assert check.found is None


@pytest.mark.parametrize("off_deg", [-19.0, -5.0, 5.0, 19.0])
def test_stuck_goal_bit_is_named_by_its_size_at_the_third_reading(off_deg: float) -> None:
    check, off = GoalCheck(PROFILE), math.radians(off_deg)
    for k in range(3):
        assert check.found is None
        goal = 0.001 * k
        read(check, goal, goal - off - 0.02, spring(goal - off, goal - off - 0.02))
    assert check.found is not None
    index, words = check.found
    size = re.match(r"is (\d+) deg off its goal", words)
    assert index == INDEX
    assert size is not None
    assert float(size[1]) == pytest.approx(abs(off_deg), abs=1.0)


@pytest.mark.parametrize("sag", [-0.08, 0.08])
def test_load_with_wrong_sign_is_named(sag: float) -> None:
    check = GoalCheck(PROFILE)
    for _ in range(3):
        read(check, 0.3, 0.3 - sag, -spring(0.3, 0.3 - sag))
    assert check.found == (INDEX, "reports its load with the wrong sign")
    for _ in range(100):
        read(check, 0.3, 0.3, 0.0)  # without load the sign does not show
    assert check.found is not None
    for _ in range(30):
        read(check, 0.3, 0.3 - sag, spring(0.3, 0.3 - sag))
    assert check.found is None


def test_jammed_or_excused_servo_is_not_named() -> None:
    check = GoalCheck(PROFILE)
    for _ in range(5):
        read(check, 0.5, 0.0, SERVO.stall_torque)
    assert check.found is None
    for _ in range(5):
        read(check, 0.5, 0.0, 0.0)
        check.skip(INDEX)
    assert check.found is None


@pytest.mark.parametrize(
    ("load", "ahead", "weak"), [(1.0, 0.25, True), (-1.0, -0.25, True), (1.0, 0.17, False), (1.0, -0.25, False)]
)
def test_servo_is_weak_if_it_shows_its_full_torque_far_behind_its_goal(load: float, ahead: float, weak: bool) -> None:
    check = GoalCheck(PROFILE)
    for _ in range(5):
        assert check.take_weak() == []
        read(check, ahead, 0.0, load * SERVO.stall_torque)
    assert check.take_weak() == ([INDEX] if weak else [])
    assert check.take_weak() == []
