"""Observations for the choice of gait and speed: failures and loads of the last seconds."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.auto_gait import AutoGait
from sextant.services.planner.robot_estimate import RobotEstimate
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, BodyPose, VelocityCommand
from tests.support.states import actuator_state
from tests.unit.planner.conftest import terrain_of

PROFILE = load_profile("phantomx_mk2")
PARAMS = Settings().gait_choice
BODY = from_xyz_rpy((0.0, 0.0, 0.11), np.zeros(3))
AUTO = VelocityCommand(0, np.array([0.12, 0.0]), 0.0, 0.11, 0.025, "auto", auto_speed=True)
SECOND_NS = 1_000_000_000


def state(seconds: float, load: float = 0.0, slip: float = 0.0) -> ActuatorState:
    at = actuator_state(PROFILE, stamp_ns=round(seconds * 1e9), feet=PROFILE.rest_feet(0.11), T_odom_body=BODY, body_ref=BODY)
    return replace(at, load_nm=np.full((6, 3), load * PROFILE.servo.stall_torque), slip=slip, temperature=30.0)


def chosen(
    auto: AutoGait, seconds: float, command: VelocityCommand = AUTO, pose_fault: str = ""
) -> tuple[VelocityCommand, str]:
    """Return the command that the choice makes of one, and the reason."""
    pose = BodyPose(0, BODY, np.eye(4), np.eye(6) * 1e-6, 1.0, not pose_fault, pose_fault, np.zeros((0, 6)))
    (resolved,) = auto.resolve((command,), RobotEstimate(state(seconds), pose), terrain_of(), BODY)
    return resolved, "" if auto.choice is None else auto.choice.reason


def test_request_that_leaves_nothing_to_the_planner_stays_as_it_is() -> None:
    auto, command = AutoGait(PROFILE, Settings()), replace(AUTO, gait="ripple", auto_speed=False)
    assert chosen(auto, 0.0, command)[0] is command
    assert (auto.choice, auto.pace) == (None, None)


def test_even_ground_is_walked_on_faster_with_lower_feet() -> None:
    auto = AutoGait(PROFILE, Settings())
    command, reason = chosen(auto, 0.0)
    assert (command.gait, command.lift, command.auto_speed) == ("tripod", PARAMS.even_lift_m, False)
    assert command.velocity[0] > PROFILE.stance.max_speed
    assert reason == "even ground: 100% of its cells carry a foot"
    assert auto.pace is not None
    auto.forget_choice()
    assert (auto.choice, auto.pace) == (None, None)


def test_failures_count_once_in_a_while_and_are_forgotten() -> None:
    auto = AutoGait(PROFILE, Settings())
    for k in range(10):
        auto.note_failure(k * 1000, "there was no step")
    assert chosen(auto, 0.1)[1] == "doubtful ground: there was no step"
    for k in range(1, PARAMS.difficult_failures):
        auto.note_failure(k * SECOND_NS, "there was no step")
    command, reason = chosen(auto, PARAMS.difficult_failures)
    assert command.gait == "ripple"
    assert reason == "difficult ground: 3 failures in 10 s, the last: there was no step"
    later = PARAMS.difficult_failures + PARAMS.memory_s + PARAMS.calm_s
    assert chosen(auto, later)[1].startswith("even ground")


def test_slips_and_missing_ground_are_failures() -> None:
    auto = AutoGait(PROFILE, Settings())
    auto.update(state(1.0, slip=0.02), 0)
    assert chosen(auto, 1.0)[1] == "doubtful ground: a foot slipped"
    auto.update(state(2.0), 1)
    assert chosen(auto, 2.0)[1] == "doubtful ground: a foot found no ground"
    auto.update(state(3.0), 1)
    assert chosen(auto, 3.0 + PARAMS.memory_s + PARAMS.calm_s)[1].startswith("even ground")


def test_uncertain_pose_is_doubtful() -> None:
    assert chosen(AutoGait(PROFILE, Settings()), 0.0, pose_fault="overlap 12%")[1] == (
        "doubtful ground: the pose is uncertain: overlap 12%"
    )


@pytest.mark.parametrize("gap_s", [0.02, 0.5])
def test_lasting_load_slows_the_walk_and_a_short_one_does_not(gap_s: float) -> None:
    auto = AutoGait(PROFILE, Settings())
    auto.update(state(0.0), 0)
    fast = chosen(auto, 0.0)[0].velocity[0]
    auto.update(state(gap_s, load=0.9), 0)
    assert chosen(auto, gap_s)[0].velocity[0] == fast
    for k in range(2, round(60.0 / gap_s)):
        auto.update(state(k * gap_s, load=0.45), 0)
    assert chosen(auto, 60.0)[0].velocity[0] < fast
