"""Plan tracking: which of the sent plans runs, was refused, or stays unanswered."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.planner.locomotion.plan_tracking import NumberedStep, PlanTracker
from sextant.services.planner.locomotion.step_planner import PlannedStep
from sextant.services.planner.robot_estimate import RobotEstimate
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode, StepPlan
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
FEET = PROFILE.rest_feet()
TRIPOD = np.isin(np.arange(6), (0, 2, 4))
MS = 1_000_000
SHIFT = from_xyz_rpy((0.01, -0.02, 0.003), (0.0, 0.0, 0.05))


def numbered(number: int = 1, swing: Array = TRIPOD, variant: tuple[int, int] = (0, 0), stop: bool = False) -> NumberedStep:
    """Return a step of 5 cm ahead."""
    touchdown = FEET + np.where(swing[:, None], [0.05, 0.0, 0.0], 0.0)
    goal = from_xyz_rpy((0.025, 0.0, 0.0), np.zeros(3))
    planned = PlannedStep(swing, touchdown, touchdown[:, :2], np.full(6, 0.04), goal, goal, FEET, 0, 1.0, 1.0, 2.0)
    return NumberedStep(planned, number, variant, np.eye(4), stop)


def state(now_ms: int = 0, **changes: Any) -> ActuatorState:
    return actuator_state(PROFILE, stamp_ns=now_ms * MS, **changes)


def during(plan: StepPlan, now_ms: int, phase: float = 0.2, **changes: Any) -> ActuatorState:
    """Return a state in which the actuator executes a plan."""
    walking = {"mode": Mode.WALK, "step": plan.step, "phase": phase, "swing": plan.swing, "plan_ns": plan.stamp_ns}
    return state(now_ms, **(walking | changes))


def pose(T_world_odom: Array) -> BodyPose:
    return BodyPose(0, np.eye(4), T_world_odom, np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))


@pytest.fixture
def plans() -> PlanTracker:
    return PlanTracker(PROFILE.foot.radius)


def test_revisions_of_a_step_increase(plans: PlanTracker) -> None:
    sent = [plans.send(state(now_ms), numbered(number)) for now_ms, number in ((0, 1), (100, 1), (200, 2), (300, 1))]
    assert [(plan.step, plan.revision) for plan in sent] == [(1, 1), (1, 2), (2, 1), (1, 3)]


def test_new_step_is_reported_once(plans: PlanTracker) -> None:
    first = plans.send(state(), numbered())
    assert not plans.update(state(20))
    assert plans.update(during(first, 40))
    assert not plans.update(during(first, 60))
    revision = plans.send(during(first, 80), numbered())
    assert not plans.update(during(revision, 100)), "a revision is not a new step"
    assert plans.running is not None
    assert plans.running.plan is revision


def test_plan_of_another_planner_is_unknown(plans: PlanTracker) -> None:
    plans.send(state(), numbered())
    running = replace(plans.send(state(20), numbered()), stamp_ns=7)
    plans.update(during(running, 40))
    assert plans.running is None
    assert plans.stance_after(RobotEstimate(during(running, 40), pose(np.eye(4)))) is None


def test_refusal_of_next_step_excludes_its_way(plans: PlanTracker) -> None:
    for now_ms in (0, 100):
        plan = plans.send(state(now_ms), numbered(variant=(0, 3)))
        plans.update(state(now_ms + 50, refused_plan_ns=plan.stamp_ns, plan_refusal="out of reach"))
    assert plans.refusals.count == 2
    assert plans.refusals.of(0) == {3}
    assert plans.refusals.reason == "out of reach"


def test_refused_revision_does_not_replace_running_plan(plans: PlanTracker) -> None:
    first = plans.send(state(), numbered())
    plans.update(during(first, 20))
    second, third = plans.send(during(first, 40), numbered(2)), plans.send(during(first, 240), numbered(2))
    plans.update(during(first, 260, plan_refusal="out of reach", refused_plan_ns=third.stamp_ns))
    assert plans.refusals.count == 0, "the accepted plan waits for the end of the running step"
    plans.update(during(second, 280))
    assert plans.running is not None
    assert plans.running.plan is second


def test_started_step_resets_refusals(plans: PlanTracker) -> None:
    plan = plans.send(state(), numbered())
    plans.update(state(20, refused_plan_ns=plan.stamp_ns, plan_refusal="out of reach"))
    plans.update(during(plans.send(state(40), numbered()), 60))
    assert plans.refusals.count == 0


def test_legs_of_a_reversed_step_are_kept_until_they_step_again(plans: PlanTracker) -> None:
    first = plans.send(state(), numbered())
    plans.update(during(first, 20))
    plans.update(during(first, 40, plan_ns=-1))
    np.testing.assert_array_equal(plans.reversed_legs, TRIPOD)
    plans.update(during(plans.send(state(60, step=1), numbered(2, TRIPOD)), 80))
    np.testing.assert_array_equal(plans.reversed_legs, TRIPOD)
    plans.update(during(plans.send(state(100, step=2), numbered(3, ~TRIPOD)), 120))
    assert not plans.reversed_legs.any()


def test_plan_without_answer_from_resting_legs_is_unanswered(plans: PlanTracker) -> None:
    plan = plans.send(state(), numbered())
    assert not plans.is_unanswered(state(300))
    assert plans.is_unanswered(state(320))
    assert not plans.is_unanswered(during(plan, 320, step=0)), "the legs are busy"
    plans.update(state(340, refused_plan_ns=plan.stamp_ns, plan_refusal="out of reach"))
    plans.send(state(360), numbered())
    assert not plans.is_unanswered(state(800)), "a refusal is an answer"


def test_plan_of_the_next_step_is_settled_shortly_before_the_step(plans: PlanTracker) -> None:
    running = plans.send(state(), numbered())  # of 1 s
    plans.update(during(running, 20))
    assert not plans.is_settled(during(running, 900, phase=0.9)), "there is no next step"
    queued = plans.send(during(running, 900), numbered(2, ~TRIPOD))
    assert not plans.is_settled(during(running, 800, phase=0.8))
    assert plans.is_settled(during(running, 900, phase=0.9))
    assert not plans.is_settled(during(running, 1020, phase=1.0)), "the legs rest"
    plans.update(during(running, 920, refused_plan_ns=queued.stamp_ns))
    assert not plans.is_settled(during(running, 920, phase=0.92)), "another way is needed"


def test_feet_are_measured_after_a_rest(plans: PlanTracker) -> None:
    plan = plans.send(state(), numbered())
    plans.update(during(plan, 1_000))
    plans.update(state(1_020))
    assert not plans.feet_are_measured(1_200 * MS)
    assert plans.feet_are_measured(1_300 * MS)


def test_stance_of_resting_robot_is_measured(plans: PlanTracker) -> None:
    stance = plans.stance_after(RobotEstimate(state(body_ref=np.eye(4)), pose(SHIFT)))
    assert stance is not None
    np.testing.assert_allclose(stance.feet, apply(SHIFT, FEET))
    np.testing.assert_allclose(stance.body, SHIFT)


def test_stance_after_running_step_is_planned_and_fixed_in_odom(plans: PlanTracker) -> None:
    plan = plans.send(state(), numbered())
    running = during(plan, 20)
    plans.update(running)
    stance = plans.stance_after(RobotEstimate(running, pose(SHIFT)))
    assert stance is not None
    np.testing.assert_allclose(apply(inverse(SHIFT), stance.feet), plan.touchdown, atol=1e-12)
    np.testing.assert_allclose(inverse(SHIFT) @ stance.body, plan.body_goal, atol=1e-12)


def test_foot_that_met_ground_early_counts_where_it_stands(plans: PlanTracker) -> None:
    plan = plans.send(state(), numbered())
    running = during(plan, 20)
    plans.update(running)
    touch, legs = np.zeros((6, 3)), np.arange(6) == 2
    touch[2] = (0.2, -0.1, 0.03)
    met = replace(running, touchdown_point=touch, touchdown_ns=np.where(legs, 30 * MS, -1), touchdown_contact=legs)
    stance = plans.stance_after(RobotEstimate(met, pose(np.eye(4))))
    assert stance is not None
    np.testing.assert_allclose(stance.feet[2], (0.2, -0.1, 0.03 + PROFILE.foot.radius))
    np.testing.assert_allclose(stance.feet[~legs], plan.touchdown[~legs])


def test_swinging_legs_land_at_the_height_of_their_own_measure(plans: PlanTracker) -> None:
    heights = np.array([-0.01, 0.02, 0.005, 0.0, -0.003, 0.0])
    step = replace(numbered(), leg_heights=heights)
    plan = plans.send(state(), step)
    np.testing.assert_allclose(plan.touchdown[:, 2] - step.planned.touchdown[:, 2], np.where(TRIPOD, heights, 0.0))
    np.testing.assert_array_equal(plan.touchdown[:, :2], step.planned.touchdown[:, :2])
    plans.update(during(plan, 20))
    renewed = plans.renew(during(plan, 200), pose(np.eye(4)))
    assert renewed is not None
    np.testing.assert_allclose(renewed.touchdown, plan.touchdown)


def test_running_step_is_renewed_in_newest_world(plans: PlanTracker) -> None:
    plan = plans.send(state(), numbered(stop=True))
    assert plans.renew(state(100), None) is None, "it has not begun"
    plans.update(during(plan, 20))
    assert plans.renew(during(plan, 30), None) is None, "it was sent lately"
    renewed = plans.renew(during(plan, 40), pose(SHIFT))
    assert renewed is not None
    assert (renewed.step, renewed.revision, renewed.stop) == (1, 2, True)
    np.testing.assert_allclose(apply(inverse(renewed.T_world_odom), renewed.touchdown), plan.touchdown, atol=1e-12)
    assert plans.renew(during(plan, 60), None) is None
    assert plans.renew(during(plan, 200, phase=1.0), None) is None, "it is over"


def moved_step(x_m: float) -> NumberedStep:
    """Return the step of `numbered` with touchdowns further ahead, by a newer map."""
    step = numbered()
    planned = replace(step.planned, touchdown=step.planned.touchdown + np.where(TRIPOD[:, None], [x_m, 0.0, 0.0], 0.0))
    return replace(step, planned=planned, map_ns=7)


def test_revision_on_its_way_is_renewed_in_place_of_the_running_plan(plans: PlanTracker) -> None:
    first = plans.send(state(), numbered())
    plans.update(during(first, 20))
    revision = plans.send(during(first, 40), moved_step(0.01))
    renewed = plans.renew(during(first, 80), None)
    assert renewed is not None
    assert renewed.map_ns == revision.map_ns == 7
    np.testing.assert_allclose(renewed.touchdown, revision.touchdown)
    lost = plans.renew(during(first, 160), None)
    assert lost is not None
    assert lost.map_ns == -1
    np.testing.assert_allclose(lost.touchdown, first.touchdown, err_msg="without an answer the revision counts as lost")


def test_newest_map_of_executed_plans_is_kept(plans: PlanTracker) -> None:
    first = plans.send(state(), numbered())
    plans.update(during(first, 20))
    assert plans.executed_map_ns == first.map_ns == -1
    revision = plans.send(during(first, 40), moved_step(0.01))
    assert plans.executed_map_ns == -1, "it is on its way"
    plans.update(during(revision, 60))
    assert plans.executed_map_ns == 7
    plans.update(during(first, 80))
    assert plans.executed_map_ns == 7, "an older one does not replace it"


def test_refused_revision_is_followed_by_the_running_plan_at_once(plans: PlanTracker) -> None:
    first = plans.send(state(), numbered())
    plans.update(during(first, 20))
    revision = plans.send(during(first, 40), moved_step(0.01))
    refusal = during(first, 60, plan_refusal="too fast", refused_plan_ns=revision.stamp_ns)
    plans.update(refusal)
    renewed = plans.renew(refusal, None)
    assert renewed is not None
    np.testing.assert_allclose(renewed.touchdown, first.touchdown)


def test_plans_of_one_state_have_different_stamps(plans: PlanTracker) -> None:
    sent = [plans.send(state(20), numbered()) for _ in range(3)]
    assert [plan.stamp_ns - 20 * MS for plan in sent] == [0, 1, 2], "the actuator names a plan by its stamp"
