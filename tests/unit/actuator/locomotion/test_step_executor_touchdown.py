"""Step execution with foot contact: ground that is early, late or missing."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.step_executor import StepExecutor, Targets
from sextant.shared.geometry import apply, from_xyz_rpy
from sextant.shared.wire.messages import StepPlan
from tests.support.walker_steps import (
    ALL,
    DT,
    NOTHING,
    REST,
    SETTINGS,
    START,
    TRIPOD,
    body_at,
    cycle,
    largest_jump,
    new_walker,
    plan_to,
    walk,
)


def execute_step(walker: StepExecutor, ground: dict[int, float], plan: StepPlan) -> list[Targets]:
    """Execute one step and return its targets.

    Feet follow their commands, except where they meet ground at a height [m] {odom} and report contact.
    """
    walker.accept(plan)
    targets = [cycle(walker)]
    while not walker.resting:
        feet, touches = walker.feet_odom, NOTHING.copy()
        for leg, height in ground.items():
            touches[leg] = walker.awaiting[leg] and feet[leg, 2] <= height
            feet[leg, 2] = max(feet[leg, 2], height)
        targets.append(walker.update(DT, walker.body_ref, FootContact(touches, ALL, feet)))
    return targets


def test_step_without_contact_follows_the_plan() -> None:
    plan = plan_to(1, body_at(0.06))
    by_plan, _ = walk(new_walker(), [plan])
    for a, b in zip(by_plan, execute_step(new_walker(), {}, plan), strict=False):
        np.testing.assert_array_equal(a.feet, b.feet)
        np.testing.assert_array_equal(a.share, b.share)


@given(st.floats(0.01, 0.035), st.sampled_from([0, 2, 4]))
@settings(max_examples=15)
def test_early_touchdown_stops_foot_and_loads_it(height: float, leg: int) -> None:
    walker, plan = new_walker(), plan_to(1, body_at(0.06))
    low = float(plan.touchdown[leg, 2])
    targets = execute_step(walker, {leg: low + height}, plan)
    others = TRIPOD & (np.arange(6) != leg)
    np.testing.assert_allclose(walker.feet_odom[others], plan.touchdown[others], atol=1e-9)
    assert walker.feet_odom[leg, 2] == pytest.approx(low + height, abs=1e-3)
    assert walker.ground[leg] == pytest.approx(low + height)
    np.testing.assert_array_equal(targets[-1].share, np.ones(6))
    loads = [t.share[leg] for t in targets]
    assert min(loads) == 0.0
    assert largest_jump(targets) < 2.5 * 0.3 * DT / 0.6
    assert np.abs(np.diff(loads)).max() <= max(DT / SETTINGS.unload_s, DT / SETTINGS.load_s) + 1e-9


def test_predicted_end_stance_includes_early_touchdown() -> None:
    walker, plan = new_walker(), plan_to(1, body_at(0.06))
    walker.accept(plan)
    low, expected = float(plan.touchdown[2, 2]), None
    cycle(walker)
    while not walker.resting:
        feet = walker.feet_odom
        touches = (np.arange(6) == 2) & walker.awaiting & (feet[:, 2] < low + 0.025)
        walker.update(DT, walker.body_ref, FootContact(touches, ALL, feet))
        if touches.any():
            expected = feet[2]
        if expected is not None and not walker.resting:
            np.testing.assert_allclose(walker.stance_at_end[1][2], expected, atol=1e-9)
    np.testing.assert_allclose(walker.feet_odom[2], expected, atol=1e-3)


@pytest.mark.parametrize("known", [True, False])
def test_foothold_height_follows_sinking_foot_by_at_most_10_mm(
    known: bool,
) -> None:
    walker, plan, leg = new_walker(), plan_to(1, body_at(0.06)), 2
    execute_step(walker, {leg: float(plan.touchdown[leg, 2]) + 0.02}, plan)
    stands, other = walker.feet_odom[leg, 2], walker.feet_odom[1, 2]
    sure = ALL & ((np.arange(6) != leg) | known)
    for sinks, follows in ((0.004, 0.004), (0.025, 0.010)):
        for _ in range(100):
            feet = walker.feet_odom
            feet[leg, 2] = stands - sinks
            walker.update(DT, walker.body_ref, FootContact(NOTHING, ALL, feet, known=sure))
        assert walker.feet_odom[leg, 2] == pytest.approx(stands - follows * known, abs=5e-4)
        assert walker.ground[leg] == pytest.approx(stands - follows * known, abs=5e-4)
    assert walker.feet_odom[1, 2] == pytest.approx(other, abs=1e-6)


def test_contact_while_rising_or_at_target_does_not_stop_the_foot() -> None:
    plan = plan_to(1, body_at(0.06))
    walker = new_walker()
    walker.accept(plan)
    cycle(walker)
    while not walker.resting:
        feet = walker.feet_odom
        near = feet[:, 2] < plan.touchdown[:, 2] + 0.004
        rising = np.full(6, walker.phase < 0.4)
        walker.update(DT, walker.body_ref, FootContact(TRIPOD & (near | rising), ALL, feet))
    np.testing.assert_allclose(walker.feet_odom[TRIPOD], plan.touchdown[TRIPOD], atol=1e-9)


def test_touchdown_is_awaited_only_while_foot_descends() -> None:
    walker = new_walker()
    assert not walker.awaiting.any()
    walker.accept(plan_to(1, body_at(0.06)))
    heights, awaited = [], []
    while not walker.resting or not heights:
        cycle(walker)
        heights.append(walker.feet_odom[0, 2])
        awaited.append(walker.awaiting.copy())
    assert not np.array(awaited)[:, ~TRIPOD].any()
    assert not np.array(awaited)[: int(np.argmax(heights)) - 5].any()
    landed = int(np.argmin(np.abs(np.array(heights[10:]) - heights[-1]) > 1e-9)) + 10
    assert np.array(awaited)[int(np.argmax(heights)) + 1 : landed, TRIPOD].all()
    assert not np.array(awaited)[landed:].any()


def walk_over_holes(
    walker: StepExecutor, holes: dict[int, float], plans: list[StepPlan]
) -> tuple[list[Targets], list[list[str]]]:
    """Execute steps and half a second of rest; return targets and reported troubles.

    Feet bear load where they stand, except those whose ground lies lower than planned by the given depth [m].
    """
    foothold = {leg: float(plans[0].touchdown[leg, 2]) for leg in holes}
    waiting, targets, said, rest_s = list(plans), [], [], 0.5
    while waiting or rest_s > 0:
        if waiting and walker.resting:
            walker.accept(waiting.pop(0))
        rest_s -= DT if walker.resting and not waiting else 0.0
        bears, touches = ~walker.swing, walker.searching | walker.pressing
        feet = apply(walker.body_ref, targets[-1].feet) if walker.pressing.any() else walker.feet_odom
        for leg, depth in holes.items():
            stands = feet[leg, 2] <= foothold[leg] - depth
            bears[leg] &= stands or feet[leg, 0] < plans[0].touchdown[leg, 0] - 0.02  # back where it came from
            touches[leg] &= stands
        targets.append(walker.update(DT, walker.body_ref, FootContact(touches, bears, feet)))
        said.append([walker.trouble])
    return targets, said


STEPS_2 = [plan_to(1, body_at(0.05)), plan_to(2, body_at(0.10))]


def test_loaded_feet_follow_the_plan() -> None:
    plain, proven = new_walker(), new_walker()
    by_plan, _ = walk(plain, STEPS_2[:1], rest_s=0.1)
    felt, said = walk_over_holes(proven, {}, STEPS_2[:1])
    for a, b in zip(by_plan, felt, strict=False):
        np.testing.assert_array_equal(a.feet, b.feet)
        np.testing.assert_array_equal(a.share, b.share)
    assert said[-1] == [""]


@given(st.floats(0.001, 0.005), st.sampled_from([0, 2, 4]))
@settings(max_examples=10)
def test_foot_a_little_above_the_ground_presses_down_and_the_step_goes_on(depth: float, leg: int) -> None:
    walker = new_walker()
    targets, said = walk_over_holes(walker, {leg: depth}, STEPS_2)
    assert {words for (words,) in said} == {""}
    low = float(STEPS_2[0].touchdown[leg, 2])
    lowest = min(float(apply(START, one.feet)[leg, 2]) for one in targets)
    assert lowest <= low - depth
    assert low - depth - 1e-9 <= walker.feet_odom[leg, 2] <= low, "where it stands is not lower than the ground"
    assert largest_jump(targets) < 2.5 * 0.3 * DT / 0.6
    assert walker.step == 2
    assert not walker.pressing.any()
    np.testing.assert_allclose(walker.feet_odom[~TRIPOD], STEPS_2[1].touchdown[~TRIPOD], atol=1e-6)


@given(st.floats(0.008, 0.036), st.sampled_from([0, 2, 4]))
@settings(max_examples=10)
def test_foot_reaches_down_to_lower_ground_before_others_lift(depth: float, leg: int) -> None:
    walker = new_walker()
    targets, said = walk_over_holes(walker, {leg: depth}, STEPS_2)
    low = float(STEPS_2[0].touchdown[leg, 2])
    assert walker.feet_odom[leg, 2] == pytest.approx(low - depth, abs=2e-3)
    (lower_mm,) = {
        int(found[1]) for (words,) in said if (found := re.fullmatch(r"ground found (\d+) mm lower than expected", words))
    }
    assert lower_mm * 1e-3 == pytest.approx(depth, abs=2e-3)
    assert largest_jump(targets) < 2.5 * 0.3 * DT / 0.6
    assert [f for f in walker.take_findings() if f.leg == leg][-1].carries
    np.testing.assert_array_equal(targets[-1].share, np.ones(6))
    assert walker.resting
    np.testing.assert_allclose(walker.feet_odom[~TRIPOD], apply(START, REST)[~TRIPOD], atol=1e-9)  # no other leg was lifted


def cycles_until_leg_presses(leg: int, leans: bool, bears_from: int, unheard: int = 0) -> int | None:
    """Return the cycles of waiting for a leg before it presses down, or None.

    The leg leans, or bears from cycle `bears_from` on. During the first `unheard` cycles its servo does not answer.
    """
    walker, waiting, waited = new_walker(), list(STEPS_2), 0
    while not (walker.step == 2 and walker.load_share[~TRIPOD].max() == 0):  # the other legs lift
        if waiting and walker.resting:
            walker.accept(waiting.pop(0))
        waited += bool(walker.step == 2 and walker.awaiting[leg])
        bears, feels = ~walker.swing, np.zeros(6, dtype=bool)
        bears[leg], feels[leg] = waited >= bears_from, leans
        walker.update(
            DT, walker.body_ref, FootContact(~ALL, bears, walker.feet_odom, may_bear=feels, heard=ALL & (waited > unheard))
        )
        if walker.pressing.any():
            return waited
    return None


@pytest.mark.parametrize("leg", [0, 2, 4])
def test_foot_with_partial_contact_gets_longer_wait(leg: int) -> None:
    """Check that a foot that may stand by its last reading gets time for the next one.

    For a foot without contact the wait stays short.
    """
    short, long = cycles_until_leg_presses(leg, False, 99), cycles_until_leg_presses(leg, True, 99)
    assert short is not None
    assert long is not None
    assert short * DT < 0.12
    assert short < long < short + 4
    assert cycles_until_leg_presses(leg, False, short) is None
    assert cycles_until_leg_presses(leg, False, short + 1) == short
    assert cycles_until_leg_presses(leg, True, long) is None
    assert cycles_until_leg_presses(leg, True, long + 1) == long


@pytest.mark.parametrize("leans", [False, True])
def test_wait_for_silent_servo_is_extended_by_at_most_200_ms(leans: bool) -> None:
    usual = cycles_until_leg_presses(2, leans, 99)
    assert usual is not None
    for cycles in (1, 4, 9):  # in the first cycle the foot does not wait yet
        assert cycles_until_leg_presses(2, leans, 99, unheard=cycles) == usual + cycles - 1
    for_ever = cycles_until_leg_presses(2, leans, 99, unheard=99)
    assert for_ever is not None
    assert (for_ever - usual) * DT == pytest.approx(0.2)


def test_undetected_stance_foot_pushes_down_by_less_than_8_mm() -> None:
    """Check a foot below its femur's axis, where the femur's load shows no contact.

    All joints together show it once the leg hardly moves.
    """
    walker, leg = new_walker(), 2
    low, waiting = float(STEPS_2[0].touchdown[leg, 2]), list(STEPS_2)
    for _ in range(round(2.0 / DT)):
        if waiting and walker.resting:
            walker.accept(waiting.pop(0))
        bears = ~walker.swing & (np.arange(6) != leg)
        pushes = walker.feet_odom[:, 2] < low - 0.001
        walker.update(DT, walker.body_ref, FootContact(~ALL, bears, walker.feet_odom, pushes))
        if walker.trouble.startswith("ground found"):
            break
    assert low - 0.008 < walker.feet_odom[leg, 2] < low - 0.004
    assert not walker.searching.any()
    assert "ground found" in walker.trouble


@given(st.floats(0.5, 0.8), st.sampled_from([0, 2, 4]))
@settings(max_examples=10)
def test_foot_stopped_by_false_contact_descends_before_others_lift(at: float, leg: int) -> None:
    """Check that a foot stopped by a false touch has to bear load first.

    A leg that accelerates gives a similar signal.
    """
    walker, waiting, low = new_walker(), list(STEPS_2), float(STEPS_2[0].touchdown[leg, 2])
    stopped, said = False, set()
    for _ in range(round(6.0 / DT)):
        if waiting and walker.resting:
            walker.accept(waiting.pop(0))
        stands = walker.feet_odom[:, 2] < low + 0.001
        touches = walker.searching & stands
        if walker.step == 1 and walker.phase > at and not stopped:
            touches[leg] = stopped = True
        walker.update(DT, walker.body_ref, FootContact(touches, ~walker.swing & stands, walker.feet_odom))
        said.add(walker.trouble)
        if walker.step == 2 and walker.swing.any() and walker.feet_odom[~TRIPOD, 2].max() > low + 0.01:
            break
    assert walker.step == 2
    assert walker.feet_odom[leg, 2] == pytest.approx(low, abs=2e-3)
    assert not any("reversed" in words for words in said), "nothing was wrong with the step"


@given(st.sampled_from([0, 2, 4]))
@settings(max_examples=3)
def test_missing_ground_reverses_the_step(leg: int) -> None:
    walker = new_walker()
    stood = walker.feet_odom
    targets, said = walk_over_holes(walker, {leg: 1.0}, STEPS_2)
    assert walker.resting
    np.testing.assert_allclose(walker.feet_odom[:, :2], stood[:, :2], atol=1e-6)
    np.testing.assert_allclose(walker.body_ref[:2, 3], START[:2, 3], atol=1e-6)
    assert "no ground under" in said[-1][0]
    assert "reversed" in said[-1][0]
    (lost,) = [f for f in walker.take_findings() if not f.carries]
    assert lost.leg == leg
    assert STEPS_2[0].touchdown[leg, 2] - 0.045 < lost.p_odom[2] < STEPS_2[0].touchdown[leg, 2] - 0.03
    assert largest_jump(targets) < 2.5 * 0.3 * DT / 0.6
    assert min(t.feet[leg, 2] for t in targets) > REST[leg, 2] - 0.06, "it reaches down no further"
    np.testing.assert_array_equal(targets[-1].share, np.ones(6))


@pytest.mark.parametrize("at", [0.0, 0.2, 0.7])
def test_turn_of_odom_frame_rotates_feet_but_not_body_motion(at: float) -> None:
    """Check a turn of {odom} before a step and during it, with a waiting plan too."""
    walker, plans = new_walker(), [plan_to(1, body_at(0.03)), plan_to(2, body_at(0.06), stop=True)]
    walker.accept(plans[0])
    while walker.phase < at or walker.resting:
        cycle(walker)
    if at > 0.5:
        walker.accept(plans.pop())
    turn = from_xyz_rpy((0.0, 0.0, 0.0), (0.03, -0.05, 0.0))
    body, stance = walker.body_ref, walker.stance_at_end
    standing = ~walker.swing
    feet, ground = walker.feet_odom, walker.ground
    walker.turn(turn)
    np.testing.assert_allclose(walker.body_ref, body, atol=1e-12)
    np.testing.assert_allclose(walker.feet_odom, apply(turn, feet), atol=1e-12)
    np.testing.assert_allclose(walker.stance_at_end[1], apply(turn, stance[1]), atol=1e-12)
    on_ground = apply(turn, np.column_stack([feet[:, :2], ground]))
    np.testing.assert_allclose(walker.ground[standing], on_ground[standing, 2], atol=1e-12)
    targets, _ = walk(walker, [])
    assert largest_jump(targets) < 0.02
    last = plan_to(2, body_at(0.06)) if at > 0.5 else plans[0]
    np.testing.assert_allclose(walker.body_ref[:3, :3], last.body_goal[:3, :3], atol=1e-9)
    landed = apply(turn, last.touchdown)
    np.testing.assert_allclose(walker.feet_odom[last.swing], landed[last.swing], atol=2e-3)


def test_heaving_foot_stops_and_must_prove_contact_before_next_step() -> None:
    walker = new_walker()
    walker.accept(plan_to(1, body_at(0.03)))
    while walker.resting or walker.phase < 0.7:
        walker.update(DT, walker.body_ref, FootContact(np.zeros(6, dtype=bool), ALL, walker.feet_odom))
    at = walker.feet_odom
    lifts_body, bears = np.arange(6) == 2, np.arange(6) != 2
    for _ in range(60):
        walker.update(DT, walker.body_ref, FootContact(np.zeros(6, dtype=bool), bears, at, lifts_body=lifts_body))
    np.testing.assert_allclose(walker.feet_odom[2], at[2], atol=2e-3)
    assert walker.feet_odom[0, 2] < at[0, 2]
    walker.accept(plan_to(2, body_at(0.06)))
    while not walker.searching.any():
        assert not walker.resting or walker.step == 1
        walker.update(DT, walker.body_ref, FootContact(np.zeros(6, dtype=bool), bears, walker.feet_odom))
    assert walker.searching.tolist() == lifts_body.tolist()
