"""Step selection: the first feasible command, and revisions of the running step."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.plan_tracking import PlanTracker
from sextant.services.planner.locomotion.step_planner import StepPlanner
from sextant.services.planner.locomotion.step_selection import StepSelector
from sextant.services.planner.robot_estimate import RobotEstimate
from sextant.services.planner.terrain import Terrain, flat_terrain
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Stages
from sextant.shared.wire.messages import BodyPose, Mode, VelocityCommand
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.11
BODY = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
FLAT = flat_terrain(0, np.zeros(2), 0.0)
AHEAD = VelocityCommand(0, np.array([0.06, 0.0]), 0.0, HEIGHT, 0.04)
TOO_HIGH = replace(AHEAD, body_height=0.25)
Maker = Callable[..., Terrain]


def robot() -> RobotEstimate:
    """Return a robot that stands on level ground before its first step."""
    state = actuator_state(PROFILE, stamp_ns=10**9, feet=PROFILE.rest_feet(HEIGHT), T_odom_body=BODY, body_ref=BODY)
    return RobotEstimate(state, BodyPose(0, BODY, np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6))))


@pytest.fixture
def plans() -> PlanTracker:
    return PlanTracker(PROFILE.foot.radius)


@pytest.fixture
def steps(plans: PlanTracker) -> StepSelector:
    return StepSelector(PROFILE, Settings(), plans, Stages())


def test_first_feasible_command_gives_the_step(steps: StepSelector) -> None:
    decision = steps.select((TOO_HIGH, AHEAD), robot(), FLAT)
    assert decision.state == "stepping"
    assert decision.step is not None
    assert decision.step.number == 1
    assert decision.step.variant[0] == 1, "the index of the second command"


def test_reason_is_that_of_the_last_command(steps: StepSelector) -> None:
    decision = steps.select((AHEAD, TOO_HIGH), robot(), flat_terrain(0, np.full(2, 9.0), 0.0))
    assert decision.state == "blocked"
    assert decision.step is None
    assert "body height" in decision.reason
    assert decision.retry_s == Settings().revision.interval_s, "the search for the first command takes time"


def test_reason_is_that_of_the_ground_if_the_actuator_excludes_no_way(steps: StepSelector, plans: PlanTracker) -> None:
    """Check a step that is refused once, after which the map shows that there is none."""
    plans.refusals.add((0, 0), "too fast")
    nowhere = flat_terrain(0, np.full(2, 9.0), 0.0)
    decision = steps.select((AHEAD,), robot(), nowhere)  # the first command with this course
    plans.refusals.add((0, 0), "too fast")
    again = steps.select((AHEAD,), robot(), nowhere)
    assert decision.reason == again.reason
    assert "not seen" in again.reason
    plans.refusals.add((0, 0), "too fast")
    assert "the actuator refuses every feasible step: too fast" in steps.select((AHEAD,), robot(), nowhere).reason


def test_advice_to_turn_is_for_a_steering_operator_alone(steps: StepSelector, make_terrain: Maker) -> None:
    aside = replace(AHEAD, velocity=np.array([0.0, 0.06]))
    unseen = make_terrain(lambda x, y: np.full_like(x, np.nan), lambda x, y: np.full_like(x, np.nan))
    by_goal, steered = (steps.select((aside,), robot(), unseen, steered=steered) for steered in (False, True))
    assert steered.reason == f"{by_goal.reason}; the ground there is unseen: turn left first to see it"


def test_running_step_is_retargeted_once_per_map(
    steps: StepSelector, plans: PlanTracker, make_terrain: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_rest = robot()
    decision = steps.select((AHEAD,), at_rest, FLAT)
    assert decision.step is not None
    plan = plans.send(at_rest.state, decision.step)
    swinging = {"mode": Mode.WALK, "step": 1, "phase": 0.2, "swing": plan.swing, "plan_ns": plan.stamp_ns}
    running = RobotEstimate(replace(at_rest.state, **swinging), at_rest.pose)
    plans.update(running.state)
    searches: list[object] = []
    retarget = StepPlanner.retarget
    monkeypatch.setattr(StepPlanner, "retarget", lambda *args: (searches.append(args), retarget(*args))[1])
    for number in (1, 2):
        terrain = make_terrain()
        terrain = replace(terrain, map=replace(terrain.map, stamp_ns=number))
        confirmed = steps.retarget(running, terrain)
        assert confirmed is not None
        assert confirmed.map_ns == number
        np.testing.assert_array_equal(confirmed.planned.touchdown, plan.touchdown, "all places are equal")
        assert all(steps.retarget(running, terrain) is None for _ in range(4))
        assert len(searches) == number


@pytest.mark.parametrize("stop", [True, False])
def test_revision_changes_only_the_touchdowns(stop: bool, steps: StepSelector, plans: PlanTracker, make_terrain: Maker) -> None:
    """Check that a step by touch still ends at rest after its touchdowns have been moved."""
    at_rest = robot()
    decision = steps.select((AHEAD,), at_rest, FLAT)
    assert decision.step is not None
    plan = plans.send(at_rest.state, replace(decision.step, stop=stop))
    swinging = {"mode": Mode.WALK, "step": 1, "phase": 0.2, "swing": plan.swing, "plan_ns": plan.stamp_ns}
    running = RobotEstimate(replace(at_rest.state, **swinging), at_rest.pose)
    plans.update(running.state)
    x, y, _ = plan.touchdown[int(np.flatnonzero(plan.swing)[0])]
    revised = steps.retarget(
        running, make_terrain(score=lambda at_x, at_y: np.where(np.hypot(at_x - x, at_y - y) < 0.015, 9.0, 0.0))
    )
    assert revised is not None
    assert not np.allclose(revised.planned.touchdown, plan.touchdown)
    assert (revised.number, revised.variant, revised.stop) == (plan.step, decision.step.variant, stop)


def test_choice_of_gait_is_in_the_reason_and_a_faster_pace_in_the_step(steps: StepSelector, make_terrain: Maker) -> None:
    command = replace(AHEAD, velocity=np.array([PROFILE.stance.max_speed, 0.0]), lift=0.025)
    explicit = steps.select((command,), robot(), make_terrain())
    auto = steps.select((replace(command, gait="auto", auto_speed=True),), robot(), make_terrain())
    assert explicit.step is not None
    assert auto.step is not None
    assert auto.reason.startswith("tripod at ")
    assert "even ground: 100% of its cells carry a foot; 0 of 3 footholds moved" in auto.reason
    assert auto.step.planned.duration < 0.85 * explicit.step.planned.duration
    assert auto.step.planned.clearance.max() < explicit.step.planned.clearance.max()
    assert steps.select((command,), robot(), make_terrain()).reason == explicit.reason, "an explicit request is as before"


def test_robot_that_finds_no_step_tries_another_gait(steps: StepSelector, make_terrain: Maker) -> None:
    nothing = make_terrain(score=lambda x, y: 0.0 * x + 5.0)
    auto = replace(AHEAD, gait="auto", auto_speed=True)
    gaits = []
    for second in range(5):
        at = robot()
        at = RobotEstimate(replace(at.state, stamp_ns=(second + 1) * 10**9), at.pose)
        assert steps.select((auto,), at, nothing).state == "blocked"
        assert steps.auto_gait.choice is not None
        gaits.append(steps.auto_gait.choice.walk.gait)
    assert gaits == ["tripod", "tripod", "tripod", "ripple", "ripple"]
