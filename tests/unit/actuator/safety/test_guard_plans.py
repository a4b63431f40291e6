"""Guard and plans: acceptance, the deadline, faults and unsustainable conditions."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.safety.command_arbiter import LEASE_NS
from sextant.services.actuator.safety.guard import DEADLINE_NS, Act
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.wire.messages import Mode, ModeCommand
from tests.support.guarded import BAD, BROKEN, CYCLE, EPOCH, FEET, PROFILE, SPENT, in_mode, rested

POWERED = [mode for mode in Mode if mode is not Mode.OFF]

# ---------------------------------------------------------------------------------------------------------------- plans


def test_a_plan_is_walked_to_its_end_and_then_it_holds() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    assert robot.accept_plan(robot.plan())
    assert (robot.mode, robot.guard.reason, robot.guard.refused) == (Mode.WALK, "walking", "")
    robot.cycle()
    robot.cycle(ends=True)
    assert robot.mode is Mode.HOLD
    assert robot.guard.reason == "the last accepted step is finished; no new plan received"


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_plan_is_refused_in_words_and_changes_nothing(bad: str) -> None:
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
def test_a_plan_of_no_numbers_does_not_come_into_being(field: str, nonsense: float) -> None:
    robot = in_mode(Mode.HOLD)
    with pytest.raises(ValueError, match=rf"StepPlan\.{field}"):
        robot.plan(**{field: np.asarray(getattr(robot.plan(), field)) * 0 + nonsense if field != "duration" else nonsense})


def test_a_revision_is_judged_from_where_the_robot_is_and_the_next_step_from_where_this_one_ends() -> None:
    robot = in_mode(Mode.WALK)
    away = from_xyz_rpy((1.0, 0.0, PROFILE.stance.body_height), np.zeros(3))
    there = FEET + np.array([1.0, 0.0, 0.0])
    ends_there, is_there = replace(robot.legs, body=away, feet=there), replace(robot.legs, body_now=away, feet_now=there)
    next_step = robot.plan(body_goal=away, touchdown=there)
    revision = robot.renewal(stamp_ns=robot.now + 1, body_goal=away, touchdown=there)
    assert not robot.guard.accept_plan(next_step, robot.now, is_there)
    assert not robot.guard.accept_plan(revision, robot.now, ends_there)
    assert robot.guard.accept_plan(next_step, robot.now, ends_there)
    assert robot.guard.accept_plan(revision, robot.now, is_there)


def test_a_revision_for_higher_feet_is_refused_once_they_are_in_the_air() -> None:
    robot = in_mode(Mode.WALK)
    higher = robot.renewal(clearance=np.full(6, 0.06))
    robot.lifted = robot.renewal().clearance
    assert not robot.accept_plan(higher)
    assert robot.guard.refused.endswith("needs more clearance than its feet were lifted with")
    assert robot.guard.refused_ns == -1, "the step itself is not refused: it is not tried in other ways"
    robot.lifted = np.full(6, np.inf)
    assert robot.accept_plan(higher)


def test_a_step_of_its_own_is_not_revised() -> None:
    """Check that no plan revises a step that the actuator takes back."""
    robot = in_mode(Mode.WALK)
    robot.own = True
    assert not robot.accept_plan(robot.renewal())
    assert "does not follow step 1" in robot.guard.refused


def test_while_a_foot_looks_for_ground_no_plan_is_taken() -> None:
    robot = in_mode(Mode.WALK)
    robot.searching, robot.trouble = True, "no ground under a foot"
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == "plan of step 2 refused: no ground under a foot"
    robot.cycle()
    assert robot.guard.reason == "no ground under a foot"
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "no ground under a foot")


def test_a_new_odometry_has_plans_of_its_own() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    plan = robot.plan()
    robot.guard.set_epoch(EPOCH + 1)
    assert robot.guard.epoch == EPOCH + 1
    assert not robot.accept_plan(plan)
    assert robot.accept_plan(replace(plan, epoch=EPOCH + 1))


def test_without_a_living_lease_no_plan_is_taken() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.now += LEASE_NS + 1
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == "plan of step 1 refused: no order from a for 3 s, the lease has expired"
    robot.handle_order(ModeCommand(robot.now, "walk", robot.number, "a"))
    assert robot.accept_plan(robot.plan())


# -------------------------------------------------------------------------------------------------------- the deadline


def test_a_walk_without_a_new_plan_ends_after_the_deadline_and_goes_on_when_the_feet_are_down() -> None:
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


def test_a_new_plan_puts_the_deadline_off() -> None:
    robot = in_mode(Mode.WALK)
    for _ in range(20):
        assert robot.cycle() == robot.cycle() == ()
        assert robot.accept_plan(robot.renewal())
    robot.now += DEADLINE_NS - CYCLE
    assert robot.cycle() == ()
    assert robot.cycle(1) == (Act.SET_DOWN,)


def test_a_step_of_its_own_has_no_deadline() -> None:
    robot = in_mode(Mode.WALK)
    robot.own = True
    assert robot.cycle(2 * DEADLINE_NS) == ()
    assert robot.guard.reason == "walking"


def test_a_walk_that_was_ordered_to_stop_is_not_stopped_once_more_for_want_of_a_plan() -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order("stop") == (Act.SET_DOWN,)
    assert robot.cycle(2 * DEADLINE_NS) == ()
    assert robot.cycle() == ()
    assert robot.guard.reason == "ordered to stop"


@pytest.mark.parametrize("way", ["a fault", "off"])
def test_a_deadline_that_was_missed_is_forgotten_with_the_walk(way: str) -> None:
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
def test_what_is_broken_stops_it_until_it_is_whole(mode: Mode, acts: tuple[Act, ...], then: Mode) -> None:
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


def test_feet_come_down_before_a_fault_is_over_and_the_walk_goes_on_by_itself() -> None:
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
def test_however_it_came_to_stand_a_fault_lasts_until_its_feet_are_down(way: str) -> None:
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
def test_legs_that_stopped_in_mid_step_are_in_nobodys_way(order: str) -> None:
    """Check that an unfinished step blocks neither a fault's end nor an order to sit."""
    robot = in_mode(Mode.WALK)
    robot.verdict = BROKEN
    robot.cycle()
    robot.order(order)
    robot.verdict = Verdict()
    robot.cycle()
    assert not robot.legs.resting
    robot.order("stand")
    robot.verdict = BROKEN
    assert robot.cycle() == (Act.FREEZE,)
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.mode is Mode.READY
    robot.order("sit")
    assert robot.cycle() == (Act.LIE_DOWN,)


def test_ordered_to_sit_in_a_fault_it_lies_down_whatever_is_broken_and_lets_go() -> None:
    robot = in_mode(Mode.FAULT)
    robot.order("sit")
    assert robot.cycle() == (Act.LIE_DOWN,)
    assert robot.cycle() == ()
    assert robot.mode is Mode.SIT
    assert robot.cycle(ends=True) == (Act.TORQUE_OFF,)
    assert (robot.mode, robot.guard.reason) == (Mode.OFF, "ordered to sit")


@pytest.mark.parametrize(("order", "then"), [("stop", Mode.FAULT), ("ready", Mode.READY)])
def test_an_order_to_sit_in_a_fault_can_be_taken_back(order: str, then: Mode) -> None:
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
def test_what_cannot_be_borne_lays_it_down_and_lets_go(mode: Mode, broken: bool) -> None:
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


def test_once_decided_it_is_done() -> None:
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


def test_what_breaks_while_its_feet_come_down_is_named_first() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = SPENT
    robot.cycle()
    robot.verdict = replace(SPENT, broken="a servo is silent")
    assert robot.cycle() == (Act.SET_DOWN,)
    assert (robot.mode, robot.guard.reason) == (Mode.FAULT, "a servo is silent")
    assert robot.cycle(ends=True) == (Act.LIE_DOWN,)
    assert (robot.mode, robot.guard.reason) == (Mode.SIT, "the battery is low")


def test_an_order_to_sit_does_not_hide_why_it_must() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = SPENT
    robot.cycle()
    robot.order("sit")
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.SIT, "the battery is low")


def test_servos_that_are_taken_up_again_do_not_save_it_from_lying_down() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = replace(SPENT, broken="a servo is silent")
    robot.cycle()
    assert robot.order("ready") == (Act.TORQUE_ON,)
    assert robot.cycle() == (Act.LIE_DOWN,)
    assert robot.cycle(ends=True) == (Act.TORQUE_OFF,)


def test_an_order_counts_again_when_the_cause_is_gone() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = SPENT
    robot.cycle()
    robot.verdict = Verdict()
    robot.cycle()
    robot.order("walk")
    assert robot.accept_plan(robot.renewal())
    robot.verdict = SPENT
    assert robot.cycle() == (Act.SET_DOWN,)


def test_anybody_stops_it_even_then_and_it_is_not_taken_up_by_itself() -> None:
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
def test_stopped_then_whole_it_begins_anew(order: str) -> None:
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


def test_risen_from_a_seat_that_was_no_longer_needed_it_walks_and_sits_again_when_it_must() -> None:
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
