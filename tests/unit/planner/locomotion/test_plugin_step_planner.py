"""A step planner of another package: what it is told, and what becomes of its steps."""

import numpy as np
import pytest

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.plan_tracking import PlanTracker
from sextant.services.planner.locomotion.plugin_step_planner import PluginStepPlanner
from sextant.services.planner.locomotion.replan_attempts import RefusedSteps
from sextant.services.planner.locomotion.step_planner import NoStep, PlannedStep, StepStart
from sextant.services.planner.locomotion.step_selection import StepSelector
from sextant.services.planner.robot_estimate import RobotEstimate
from sextant.services.planner.terrain import flat_terrain
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.plugins.loading import PluginError
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Stages
from sextant.shared.wire.messages import BodyPose, VelocityCommand
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.11
BODY = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
FEET = PROFILE.rest_feet(HEIGHT) + BODY[:3, 3]
FLAT = flat_terrain(0, np.zeros(2), 0.0)
AHEAD = VelocityCommand(0, np.array([0.06, 0.0]), 0.01, HEIGHT, 0.04, gait="ripple")
GROUPS = [np.arange(6) % 3 == k for k in range(3)]
STARTS = [StepStart(BODY, FEET, swing, AHEAD, number=7) for swing in GROUPS]


def settings(name: str) -> Settings:
    return Settings(step_planner=f"tests.support.plugins:{name}")


@pytest.fixture
def refusals() -> RefusedSteps:
    return RefusedSteps()


def test_request_tells_robot_motion_and_due_legs(refusals):
    planner = PluginStepPlanner(PROFILE, settings("StandStill"), refusals)
    planner.choose(STARTS, FLAT)
    (request,) = planner._plugin._target.requests
    assert (request.T_world_body == BODY).all()
    assert (request.feet == FEET).all()
    assert [due.tolist() for due in request.due] == [group.tolist() for group in GROUPS]
    assert (request.velocity == AHEAD.velocity).all()
    assert (request.yaw_rate, request.body_height, request.lift) == (0.01, HEIGHT, 0.04)
    assert (request.stances, request.refused, request.refusal) == (2, 0, "")
    assert request.map is FLAT.map
    assert request.step == 7


def test_step_of_the_plugin_is_taken(refusals):
    found, attempt = PluginStepPlanner(PROFILE, settings("StandStill"), refusals).choose(STARTS, FLAT)
    assert isinstance(found, PlannedStep)
    assert found.swing.tolist() == [False, False, True, False, False, False]
    assert (found.touchdown == FEET).all(), "the feet of standing legs are filled in"
    assert (found.duration, attempt) == (1.0, 0)


def test_refusals_are_told_and_end_the_attempts(refusals):
    planner = PluginStepPlanner(PROFILE, settings("StandStill"), refusals)
    seen = []
    for _ in range(12):
        found, attempt = planner.choose(STARTS, FLAT, refusals.of(0))
        if isinstance(found, NoStep):
            break
        seen.append(planner._plugin._target.requests[-1].refused)
        refusals.add((0, attempt), "a foot is out of reach")
    assert isinstance(found, NoStep)
    assert found.reason == "the actuator refuses the steps of the plug-in: a foot is out of reach"
    assert seen == list(range(9))
    assert planner._plugin._target.requests[-1].refusal == "a foot is out of reach"
    refusals.give_up()
    planner.choose(STARTS, FLAT, refusals.of(0))
    assert planner._plugin._target.requests[-1].refused == 0, "it is bounded"


def test_reason_of_the_plugin_reaches_the_operator(refusals):
    found, _ = PluginStepPlanner(PROFILE, settings("Idle"), refusals).choose(STARTS, FLAT)
    assert found == NoStep("plug-in: right rear leg: it rests on Sundays", 3)


def test_running_step_is_not_revised(refusals):
    planner = PluginStepPlanner(PROFILE, settings("StandStill"), refusals)
    found, _ = planner.choose(STARTS, FLAT)
    assert isinstance(found, PlannedStep)
    assert planner.retarget(found, flat_terrain(1, np.zeros(2), 0.05)) is found


def test_selector_uses_the_plugin_of_the_settings():
    steps = StepSelector(PROFILE, settings("Idle"), PlanTracker(PROFILE.foot.radius), Stages())
    state = actuator_state(PROFILE, stamp_ns=10**9, feet=PROFILE.rest_feet(HEIGHT), T_odom_body=BODY, body_ref=BODY)
    robot = RobotEstimate(state, BodyPose(0, BODY, np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6))))
    decision = steps.select((AHEAD,), robot, FLAT)
    assert (decision.state, decision.step, decision.blocked_leg) == ("blocked", None, 3)
    assert decision.reason == "plug-in: right rear leg: it rests on Sundays"


def test_unknown_plugin_ends_the_start():
    with pytest.raises(PluginError, match="did you mean 'Idle'"):
        StepSelector(PROFILE, settings("Idl"), PlanTracker(PROFILE.foot.radius), Stages())
