"""Operator requests: priority, age, speed, and what counts as a new course."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.planner.operator_request import current_request, is_new_course, is_still
from sextant.shared.wire.messages import Goal, PostureCommand, VelocityCommand

S = 1_000_000_000
NOW_NS = 100 * S
COMMAND = VelocityCommand(NOW_NS, np.array([0.06, 0.0]), 0.2, 0.11, 0.04)
POSTURE = PostureCommand(NOW_NS, np.zeros(3), np.array([0.0, 0.1, 0.0]))
GOAL = Goal(NOW_NS, np.array([[1.0, 0.0]]), 0.03, 0.10, 0.11, 0.04)


def test_velocity_command_has_priority_over_goal() -> None:
    request = current_request(COMMAND, None, GOAL, NOW_NS, 1.0)
    assert request.command is COMMAND
    assert request.goal is None
    assert request.untimely_reason == ""


def test_posture_is_between_velocity_command_and_goal() -> None:
    both = current_request(COMMAND, POSTURE, GOAL, NOW_NS, 1.0)
    assert (both.command, both.posture, both.goal) == (COMMAND, None, None)
    held = current_request(None, POSTURE, GOAL, NOW_NS, 1.0)
    assert (held.command, held.posture, held.goal) == (None, POSTURE, None)


def test_goal_holds_if_the_velocity_command_is_stale() -> None:
    request = current_request(replace(COMMAND, stamp_ns=NOW_NS - 3 * S), None, GOAL, NOW_NS, 1.0)
    assert request.command is None
    assert request.goal is not None


@pytest.mark.parametrize(("age_s", "words"), [(60, "60.0 s old"), (-3, "stamped 3.0 s ahead")])
def test_stale_or_future_request_is_ignored_with_reason(age_s: int, words: str) -> None:
    stamp_ns = NOW_NS - age_s * S
    for what, velocity, posture, goal in (
        ("velocity command", replace(COMMAND, stamp_ns=stamp_ns), None, None),
        ("posture command", None, replace(POSTURE, stamp_ns=stamp_ns), None),
        ("goal", None, None, replace(GOAL, stamp_ns=stamp_ns)),
    ):
        request = current_request(velocity, posture, goal, NOW_NS, 1.0)
        assert request.command is None
        assert request.posture is None
        assert request.goal is None
        assert request.untimely_reason.startswith(f"the {what} is {words} by the robot's clock")


def test_speed_scale_slows_velocity_turn_and_goal() -> None:
    by_velocity, by_goal = current_request(COMMAND, None, None, NOW_NS, 0.5), current_request(None, None, GOAL, NOW_NS, 0.5)
    assert by_velocity.command is not None
    np.testing.assert_allclose(by_velocity.command.velocity, 0.5 * COMMAND.velocity)
    assert by_velocity.command.yaw_rate == pytest.approx(0.5 * COMMAND.yaw_rate)
    assert by_goal.goal is not None
    assert by_goal.goal.speed == pytest.approx(0.5 * GOAL.speed)


def test_turn_on_the_spot_is_not_still() -> None:
    still = replace(COMMAND, velocity=np.zeros(2), yaw_rate=0.0)
    assert is_still(still)
    assert not is_still(replace(still, yaw_rate=0.1))
    assert not is_still(replace(still, velocity=np.array([0.0, -0.01])))


@pytest.mark.parametrize(
    ("change", "new"),
    [
        ({"velocity": np.array([0.07, 0.01])}, False),
        ({"velocity": np.array([0.09, 0.0])}, True),
        ({"yaw_rate": -0.2}, True),
        ({"body_height": 0.12}, True),
        ({"lift": 0.05}, True),
        ({"gait": "wave"}, True),
    ],
)
def test_new_course_is_a_change_that_asks_for_another_step(change: dict[str, Any], new: bool) -> None:
    assert is_new_course(replace(COMMAND, **change), COMMAND) is new
    assert is_new_course(COMMAND, None)
