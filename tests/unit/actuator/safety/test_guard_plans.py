"""Guard and plans: acceptance, the deadline, faults and unsustainable conditions."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.actuator.safety.command_arbiter import LEASE_NS
from sextant.services.actuator.safety.guard import DEADLINE_NS, PLAN_REFUSAL_NS, Act
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.geometry import apply, from_xyz_rpy
from sextant.shared.wire.messages import Mode, ModeCommand, StepPlan
from tests.support.guarded import BAD, BROKEN, CYCLE, EPOCH, FEET, PROFILE, SPENT, in_mode, rested

POWERED = [mode for mode in Mode if mode is not Mode.OFF]

# ---------------------------------------------------------------------------------------------------------------- plans


def test_finished_plan_is_followed_by_hold() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    assert robot.accept_plan(robot.plan())
    assert (robot.mode, robot.guard.reason, robot.guard.refused) == (Mode.WALK, "walking", "")
    robot.cycle()
    robot.cycle(ends=True)
    assert robot.mode is Mode.HOLD
    assert robot.guard.reason == "the last accepted step is finished; no new plan received"


@pytest.mark.parametrize("bad", BAD)
def test_invalid_plan_is_refused_with_reason_and_keeps_deadline(bad: str) -> None:
    robot = in_mode(Mode.WALK)
    make, words = BAD[bad]
    plan = make(robot)
    assert not robot.accept_plan(plan)
    assert words in robot.guard.refused
    judged = bad in ("out of reach", "without end", "no pose")
    assert robot.guard.refused_ns == (plan.stamp_ns if judged else -1)
    assert robot.mode is Mode.WALK
    robot.now += DEADLINE_NS - CYCLE
    assert robot.cycle(0) == ()
    assert robot.cycle(1) == (Act.SET_DOWN,), "it has not moved the deadline"


@pytest.mark.parametrize("nonsense", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["touchdown", "body_goal", "T_world_odom", "clearance", "duration"])
def test_plan_with_nan_or_infinite_values_raises_value_error(field: str, nonsense: float) -> None:
    robot = in_mode(Mode.HOLD)
    with pytest.raises(ValueError, match=rf"StepPlan\.{field}"):
        robot.plan(**{field: np.asarray(getattr(robot.plan(), field)) * 0 + nonsense if field != "duration" else nonsense})


def test_revision_is_checked_from_current_pose_next_step_from_end_pose() -> None:
    robot = in_mode(Mode.WALK)
    away = from_xyz_rpy((1.0, 0.0, PROFILE.stance.body_height), np.zeros(3))
    there = FEET + np.array([1.0, 0.0, 0.0])
    here, beyond = robot.stance_now, replace(robot.stance_now, body=away, feet=there)
    next_step = robot.plan(body_goal=away, touchdown=there)
    revision = robot.renewal(stamp_ns=robot.now + 1, body_goal=away, touchdown=there)
    robot.stance_now, robot.stance_at_end = beyond, here
    assert not robot.accept_plan(next_step)
    robot.stance_now, robot.stance_at_end = here, beyond
    assert not robot.accept_plan(revision)
    assert robot.accept_plan(next_step)
    robot.stance_now, robot.stance_at_end = beyond, here
    assert robot.accept_plan(revision)


def test_revision_that_only_repeats_the_step_is_not_checked_again() -> None:
    robot = in_mode(Mode.HOLD)
    turned = from_xyz_rpy((0.4, -0.2, 0.0), (0.0, 0.0, 0.7))  # the pose estimate in {world} is corrected meanwhile

    def corrected(plan: StepPlan, **changes: Any) -> StepPlan:
        moved = {"touchdown": apply(turned, plan.touchdown), "body_goal": turned @ plan.body_goal, "T_world_odom": turned}
        return replace(plan, stamp_ns=robot.now, **{**moved, **changes})

    robot.order("walk")
    first = robot.plan()
    assert robot.accept_plan(first)
    robot.cycle()
    out_of_reach = replace(robot.stance_now, feet=FEET + np.array([0.3, 0.0, 0.0]))
    robot.stance_now = robot.stance_at_end = out_of_reach
    robot.now += CYCLE
    assert not robot.accept_plan(corrected(first, duration=first.duration + 0.1)), "it is another plan"
    assert robot.accept_plan(corrected(first))
    robot.now += CYCLE
    robot.stance_at_end = replace(robot.stance_at_end, feet=FEET)
    assert robot.accept_plan(robot.plan()), "the next step is queued"
    robot.now += CYCLE
    assert robot.accept_plan(corrected(first)), "and the running one is still known"
    stale = corrected(first)
    assert not robot.accept_plan(stale), "a repeated plan must be newer, too"
    robot.now += CYCLE
    shear = turned.copy()
    shear[0, 1] += 0.5
    assert not robot.accept_plan(corrected(first, T_world_odom=shear))


def test_differences_between_repetitions_do_not_add_up_without_a_check() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    first = robot.plan()
    assert robot.accept_plan(first)
    robot.cycle()
    robot.stance_now = replace(robot.stance_now, feet=FEET + np.array([0.3, 0.0, 0.0]))  # every check would fail
    taken = []
    for count in range(1, 11):
        robot.now += CYCLE
        creeping = first.touchdown + np.array([count * 0.3e-6, 0.0, 0.0])  # [m] less than rounding from one to the next
        taken.append(robot.accept_plan(replace(first, stamp_ns=robot.now, touchdown=creeping)))
    assert taken == [True] * 3 + [False] * 7


def test_revision_with_more_clearance_is_refused_after_lift_off() -> None:
    robot = in_mode(Mode.WALK)
    higher = robot.renewal(clearance=np.full(6, 0.06))
    robot.lifted = robot.renewal().clearance
    assert not robot.accept_plan(higher)
    assert robot.guard.refused.endswith("needs more clearance than its feet were lifted with")
    assert robot.guard.refused_ns == -1, "the step itself is not refused: it is not tried in other ways"
    robot.lifted = np.full(6, np.inf)
    assert robot.accept_plan(higher)


def test_plan_cannot_revise_a_reversed_step() -> None:
    """Check that no plan revises a step that the actuator takes back."""
    robot = in_mode(Mode.WALK)
    robot.own = True
    assert not robot.accept_plan(robot.renewal())
    assert "does not follow step 1" in robot.guard.refused


def test_revision_that_its_step_has_overtaken_is_no_reported_refusal() -> None:
    robot = in_mode(Mode.WALK)
    late = robot.renewal()
    robot.cycle(ends=True)
    assert not robot.accept_plan(late)
    assert "does not follow step" in robot.guard.refused
    assert robot.guard.plan_refusal(robot.now) == ""
    assert not robot.accept_plan(robot.plan(step=robot.step + 2))
    assert "does not follow step" in robot.guard.plan_refusal(robot.now), "a planner that counts wrongly"


def test_planner_that_sends_only_revisions_of_an_ended_step_is_reported() -> None:
    robot = in_mode(Mode.WALK)
    late = robot.renewal()
    robot.cycle(ends=True)
    begun = robot.now
    while robot.now <= begun + DEADLINE_NS + CYCLE:
        assert not robot.accept_plan(replace(late, stamp_ns=robot.now))
        assert robot.guard.plan_refusal(robot.now) == "" or robot.now > begun + DEADLINE_NS
        robot.cycle()
    assert "does not follow step" in robot.guard.plan_refusal(robot.now)


def test_refusal_of_a_plan_is_reported_while_plans_arrive() -> None:
    robot = in_mode(Mode.WALK)
    assert not robot.accept_plan(robot.renewal(duration=9.0))
    assert "found 9.00 s" in robot.guard.plan_refusal(robot.now + PLAN_REFUSAL_NS)
    assert robot.guard.plan_refusal(robot.now + PLAN_REFUSAL_NS + 1) == ""


def test_plan_is_refused_while_foot_searches_for_ground() -> None:
    robot = in_mode(Mode.WALK)
    robot.searching, robot.trouble = True, "no ground under a foot"
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == "plan of step 2 refused: no ground under a foot"
    robot.cycle()
    assert robot.guard.reason == "no ground under a foot"
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "no ground under a foot")


def test_plan_of_previous_odometry_epoch_is_refused() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    plan = robot.plan()
    robot.guard.set_epoch(EPOCH + 1)
    assert robot.guard.epoch == EPOCH + 1
    assert not robot.accept_plan(plan)
    assert robot.accept_plan(replace(plan, epoch=EPOCH + 1))


def test_plan_is_refused_after_lease_expired() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.now += LEASE_NS + 1
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == "plan of step 1 refused: no order from a for 3 s, the lease has expired"
    robot.handle_order(ModeCommand(robot.now, "walk", robot.number, "a"))
    assert robot.accept_plan(robot.plan())


# -------------------------------------------------------------------------------------------------------- the deadline


def test_plan_deadline_sets_feet_down_before_walk_resumes() -> None:
    robot = in_mode(Mode.WALK)
    assert DEADLINE_NS == 180_000_000
    robot.now += DEADLINE_NS - 2 * CYCLE
    assert robot.cycle() == ()
    assert robot.guard.reason == "walking"
    assert robot.cycle(1) == (Act.SET_DOWN,)
    assert robot.cycle() == (), "once"
    assert robot.guard.reason == "no new plan received for 0.18 s"
    assert not robot.accept_plan(robot.renewal())
    assert robot.guard.refused == "plan of step 1 refused: no new plan received for 0.18 s, the feet are set down first"
    robot.trouble = "the step is reversed"
    robot.cycle(ends=True)
    assert robot.guard.reason == "no new plan received for 0.18 s; the step is reversed"
    assert robot.mode is Mode.HOLD
    robot.trouble = ""
    assert robot.accept_plan(robot.plan())
    assert robot.cycle() == ()
    assert robot.guard.reason == "walking"


def test_new_plan_extends_the_deadline() -> None:
    robot = in_mode(Mode.WALK)
    for _ in range(20):
        assert robot.cycle() == robot.cycle() == ()
        assert robot.accept_plan(robot.renewal())
    robot.now += DEADLINE_NS - CYCLE
    assert robot.cycle() == ()
    assert robot.cycle(1) == (Act.SET_DOWN,)


def test_reversed_step_has_no_deadline() -> None:
    robot = in_mode(Mode.WALK)
    robot.own = True
    assert robot.cycle(2 * DEADLINE_NS) == ()
    assert robot.guard.reason == "walking"


def test_plan_deadline_does_not_apply_after_stop_order() -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order("stop") == (Act.SET_DOWN,)
    assert robot.cycle(2 * DEADLINE_NS) == ()
    assert robot.cycle() == ()
    assert robot.guard.reason == "ordered to stop"


@pytest.mark.parametrize("way", ["a fault", "off"])
def test_missed_deadline_is_cleared_when_walk_ends(way: str) -> None:
    robot = in_mode(Mode.WALK)
    robot.cycle(2 * DEADLINE_NS)
    if way == "off":
        robot.order("off")
        robot.order("stand")
    else:
        robot.verdict = BROKEN
        robot.cycle()
        robot.verdict = Verdict()
    rested(robot)
    robot.order("walk")
    assert robot.accept_plan(robot.plan())


# -------------------------------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize(
    ("mode", "acts", "then"),
    [
        (Mode.READY, (), Mode.READY),
        (Mode.STAND, (Act.FREEZE,), Mode.FAULT),
        (Mode.HOLD, (), Mode.FAULT),
        (Mode.WALK, (Act.SET_DOWN,), Mode.FAULT),
        (Mode.SIT, (Act.FREEZE,), Mode.FAULT),
    ],
)
def test_fault_stops_robot_until_it_clears(mode: Mode, acts: tuple[Act, ...], then: Mode) -> None:
    robot = in_mode(mode)
    robot.verdict = BROKEN
    assert robot.cycle() == acts
    assert robot.mode is then
    if then is Mode.READY:
        return
    assert robot.guard.reason == "a servo is silent"
    robot.verdict = Verdict(broken="another one is")
    assert robot.cycle(ends=True) == ()
    assert robot.guard.reason == "another one is"
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused.endswith("refused: another one is")
    robot.verdict = Verdict()
    assert robot.cycle() == ()
    if mode in (Mode.STAND, Mode.SIT):
        assert (robot.mode, robot.guard.reason) == (Mode.READY, "the fault has cleared; order `stand` or `sit`")
        robot.order("stand")
        robot.verdict = BROKEN
        robot.cycle()
        robot.order("off")
        robot.verdict = Verdict()
        robot.cycle()
        robot.order("stand")
        robot.cycle(ends=True)
        robot.verdict = BROKEN
        robot.cycle()
        robot.verdict = Verdict()
        robot.cycle()
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "the fault has cleared")


def test_fault_lasts_until_feet_are_down_then_walk_resumes() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = BROKEN
    robot.cycle()
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.mode is Mode.FAULT
    robot.order("stand")
    assert robot.guard.objection == "`stand` refused: feet are being set down"
    robot.cycle(ends=True)
    assert robot.mode is Mode.HOLD
    assert robot.accept_plan(robot.plan())


@pytest.mark.parametrize("way", ["ready", "sit", "a fault while it rises"])
def test_fault_lasts_until_feet_are_down_after_any_stand_up(way: str) -> None:
    robot = in_mode(Mode.OFF if way == "ready" else Mode.SIT if way == "sit" else Mode.STAND)
    if way != "a fault while it rises":
        robot.order("ready")
    if way == "sit":
        robot.order("sit")
    robot.verdict = BROKEN if "fault" in way else Verdict()
    robot.cycle()
    robot.verdict = Verdict()
    rested(robot)
    assert robot.mode is Mode.READY
    robot.order("stand")
    rested(robot)
    robot.walking()
    robot.verdict = BROKEN
    assert robot.cycle() == (Act.SET_DOWN,)
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.mode is Mode.FAULT
    robot.cycle(ends=True)
    assert robot.mode is Mode.HOLD


@pytest.mark.parametrize("order", ["off", "ready"])
def test_unfinished_step_does_not_block_fault_end_or_sit_order(order: str) -> None:
    """Check that an unfinished step blocks neither a fault's end nor an order to sit."""
    robot = in_mode(Mode.WALK)
    robot.verdict = BROKEN
    robot.cycle()
    robot.order(order)
    robot.verdict = Verdict()
    robot.cycle()
    assert not robot.walk.resting
    robot.order("stand")
    robot.verdict = BROKEN
    assert robot.cycle() == (Act.FREEZE,)
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.mode is Mode.READY
    robot.order("sit")
    assert robot.cycle() == (Act.LIE_DOWN,)


def test_sit_order_in_fault_lies_down_and_turns_torque_off() -> None:
    robot = in_mode(Mode.FAULT)
    robot.order("sit")
    assert robot.cycle() == (Act.LIE_DOWN,)
    assert robot.cycle() == ()
    assert robot.mode is Mode.SIT
    assert robot.cycle(ends=True) == (Act.TORQUE_OFF,)
    assert (robot.mode, robot.guard.reason) == (Mode.OFF, "ordered to sit")


def test_sit_order_before_a_fault_is_obeyed_once_the_fault_has_cleared() -> None:
    robot = in_mode(Mode.WALK)
    robot.order("sit")
    robot.verdict = BROKEN
    robot.cycle()
    for _ in range(3):
        assert robot.cycle(ends=True) == (), "the robot does not begin to lie down"
        assert robot.mode is Mode.FAULT
    robot.verdict = Verdict()
    assert robot.cycle(ends=True) == (Act.LIE_DOWN,)
    assert (robot.mode, robot.guard.reason) == (Mode.SIT, "ordered to sit")
    robot.cycle(ends=True)
    assert robot.mode is Mode.READY, "it keeps its torque"


@pytest.mark.parametrize(("order", "then"), [("stop", Mode.FAULT), ("ready", Mode.READY)])
def test_sit_order_in_fault_can_be_cancelled(order: str, then: Mode) -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = BROKEN
    robot.cycle()
    robot.order("sit")
    assert robot.cycle() == ()
    robot.order(order)
    assert robot.cycle(ends=True) == ()
    assert robot.mode is then
    robot.verdict = Verdict()
    robot.cycle(ends=True)
    robot.order("sit")
    rested(robot)
    assert robot.mode is Mode.READY, "it keeps its torque"


# ---------------------------------------------------------------------------------------- unsustainable conditions


@pytest.mark.parametrize("mode", POWERED)
@pytest.mark.parametrize("broken", [True, False])
def test_unsustainable_condition_lies_down_and_turns_torque_off(mode: Mode, broken: bool) -> None:
    robot = in_mode(mode)
    robot.verdict = replace(SPENT, broken="a servo is silent" if broken else "")
    acts = robot.cycle()
    if mode is Mode.WALK:
        assert acts == (Act.SET_DOWN,)
        assert not robot.accept_plan(robot.renewal())
        acts = robot.cycle(ends=True)
    frozen = (Act.FREEZE,) * (broken and mode in (Mode.STAND, Mode.SIT))
    lies = (Act.LIE_DOWN,) * (broken or mode is not Mode.SIT)
    assert acts == (*frozen, *lies)
    assert robot.mode is Mode.SIT
    assert robot.guard.reason == "the battery is low"
    assert robot.cycle() == ()
    assert robot.cycle(ends=True) == (Act.TORQUE_OFF,)
    assert (robot.mode, robot.guard.reason) == (Mode.OFF, "the battery is low")


def test_forced_sit_down_during_walk_is_not_cancelled_by_orders() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = SPENT
    assert robot.cycle() == (Act.SET_DOWN,)
    robot.order("walk")
    assert robot.guard.objection == "`walk` refused: the battery is low"
    robot.order("stop")
    robot.verdict = Verdict()
    assert robot.cycle() == ()
    assert robot.cycle(ends=True) == (Act.LIE_DOWN,)
    assert robot.cycle(ends=True) == (Act.TORQUE_OFF,)


def test_fault_during_set_down_is_reported_before_low_battery() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = SPENT
    robot.cycle()
    robot.verdict = replace(SPENT, broken="a servo is silent")
    assert robot.cycle() == (Act.SET_DOWN,)
    assert (robot.mode, robot.guard.reason) == (Mode.FAULT, "a servo is silent")
    assert robot.cycle(ends=True) == (Act.LIE_DOWN,)
    assert (robot.mode, robot.guard.reason) == (Mode.SIT, "the battery is low")


def test_sit_order_does_not_replace_reason_of_forced_sit() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = SPENT
    robot.cycle()
    robot.order("sit")
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.SIT, "the battery is low")


def test_ready_order_does_not_prevent_forced_sit_down() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = replace(SPENT, broken="a servo is silent")
    robot.cycle()
    assert robot.order("ready") == (Act.TORQUE_ON,)
    assert robot.cycle() == (Act.LIE_DOWN,)
    assert robot.cycle(ends=True) == (Act.TORQUE_OFF,)


def test_walk_order_is_accepted_after_low_battery_clears() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = SPENT
    robot.cycle()
    robot.verdict = Verdict()
    robot.cycle()
    robot.order("walk")
    assert robot.accept_plan(robot.renewal())
    robot.verdict = SPENT
    assert robot.cycle() == (Act.SET_DOWN,)


def test_stop_during_forced_sit_is_obeyed_and_sit_needs_new_order() -> None:
    robot = in_mode(Mode.HOLD)
    robot.verdict = SPENT
    assert robot.cycle() == (Act.LIE_DOWN,)
    assert robot.order("stop", "b") == (Act.FREEZE,)
    assert robot.cycle() == robot.cycle() == ()
    assert robot.mode is Mode.READY
    robot.order("stand")
    assert robot.guard.objection == "`stand` refused: the battery is low"
    robot.order("sit")
    assert robot.cycle() == (Act.LIE_DOWN,)
    assert robot.cycle(ends=True) == (Act.TORQUE_OFF,)


@pytest.mark.parametrize("order", ["stand", "ready"])
def test_forced_sit_recurs_after_stop_and_cleared_condition(order: str) -> None:
    robot = in_mode(Mode.HOLD)
    robot.verdict = SPENT
    robot.cycle()
    robot.order("stop")
    robot.cycle()
    robot.verdict = Verdict()
    robot.cycle()
    robot.verdict = SPENT
    assert robot.cycle() == (Act.LIE_DOWN,), "it comes anew"
    robot.order("stop")
    robot.verdict = Verdict()
    robot.cycle()
    robot.order(order)
    robot.cycle(ends=True)
    robot.order("sit")
    rested(robot)
    assert robot.mode is Mode.READY
    robot.verdict = SPENT
    assert robot.cycle() == (Act.LIE_DOWN,)


def test_stand_order_cancels_outdated_forced_sit_which_may_recur() -> None:
    robot = in_mode(Mode.HOLD)
    robot.verdict = SPENT
    robot.cycle()
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.order("stand") == (Act.RISE,)
    robot.cycle(ends=True)
    robot.order("sit")
    rested(robot)
    assert robot.mode is Mode.READY
    robot.order("stand")
    robot.cycle(ends=True)
    robot.verdict = SPENT
    assert robot.cycle() == (Act.LIE_DOWN,)
