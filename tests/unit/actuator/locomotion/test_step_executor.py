"""Step execution: smooth feet in {body}, through the plans' goals, to rest."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.step_executor import StepExecutor, Targets
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation
from tests.support.walker_steps import (
    ALL,
    DT,
    DURATION,
    REST,
    SETTINGS,
    START,
    TRIPOD,
    Flags,
    body_at,
    cycle,
    largest_jump,
    new_walker,
    plan_to,
    reaches,
    walk,
)


@given(st.lists(st.tuples(st.floats(-0.05, 0.07), st.floats(-0.04, 0.04), st.floats(-0.12, 0.12)), min_size=1, max_size=3))
@settings(max_examples=10)
def test_feet_do_not_jump_in_body_frame(moves: list[tuple[float, float, float]]) -> None:
    walker, goal, plans = new_walker(), START, []
    for number, (x, y, yaw) in enumerate(moves, 1):
        goal = goal @ from_xyz_rpy((x, y, 0.0), (0.0, 0.0, yaw))
        plans.append(plan_to(number, goal))
    targets, _ = walk(walker, plans, rest_s=0.5)
    # The longest swing is some 0.3 m in 0.6 s, with a peak at twice the mean speed. Nothing else moves that fast.
    assert largest_jump([Targets(REST, np.ones(6), np.eye(3)), *targets]) < 2.5 * 0.3 * DT / 0.6


@pytest.mark.parametrize("dt", [0.02, 0.019, 0.0213])
def test_the_body_passes_through_every_goal(dt: float) -> None:
    walker = new_walker()
    goals = [body_at(0.04), body_at(0.10, 0.01, 0.05), body_at(0.15, 0.0, 0.0, 0.11)]
    for number, goal in enumerate(goals, 1):
        walker.accept(plan_to(number, goal))
        cycle(walker, dt)
        while walker.phase < 1.0:
            cycle(walker, dt)
        np.testing.assert_allclose(walker.body_ref, goal, atol=1e-9)
        np.testing.assert_allclose(walker.feet_odom[walker_swing(number)], landed(number, goal), atol=1e-9)
        assert walker.step == number


@pytest.mark.parametrize(("felt", "advanced_s"), [(True, 0.08), (False, 0.04)])
def test_a_late_cycle_does_not_hurry_feet_whose_contact_is_not_measured(felt: bool, advanced_s: float) -> None:
    walker = new_walker()
    walker.accept(plan_to(1, body_at(0.04)))
    walker.update(DT, walker.body_ref, FootContact(~ALL, ALL, walker.feet_odom))
    before = walker.phase
    walker.update(0.08, walker.body_ref, FootContact(~ALL, ALL, walker.feet_odom) if felt else None)
    assert (walker.phase - before) * DURATION == pytest.approx(advanced_s)


def walker_swing(number: int) -> Flags:
    return np.asarray(TRIPOD if number % 2 else ~TRIPOD)


def landed(number: int, goal: Array) -> Array:
    return np.asarray(apply(goal, REST + np.array([0.03, 0.0, 0.0]))[walker_swing(number)])


@pytest.mark.parametrize("dt", [0.02, 0.019, 0.0199, 0.0213])
def test_body_speed_is_even_between_equal_steps(dt: float) -> None:
    """Check that equal steps in a row give one even motion for any cycle time."""
    walker = new_walker()
    _, places = walk(walker, [plan_to(n, body_at(0.06 * n)) for n in range(1, 6)], dt)
    whole = np.diff(places[:, 0])[round(1.2 * DURATION / dt) : -round(0.3 * DURATION / dt)]
    speed = 0.06 / DURATION * dt
    at_the_seams = np.sort(whole)[3:]  # the last cycle of a step may be shorter
    assert at_the_seams.min() > 0.9 * speed
    assert whole.max() < 1.1 * speed


def test_body_comes_to_rest_after_last_plan() -> None:
    walker = new_walker()
    walk(walker, [plan_to(n, body_at(0.06 * n)) for n in (1, 2)], rest_s=1.0)
    before = cycle(walker)
    assert walker.resting
    for _ in range(50):
        after = cycle(walker)
    np.testing.assert_allclose(after.feet, before.feet, atol=1e-6)
    np.testing.assert_array_equal(after.share, np.ones(6))
    coasted = walker.body_ref[0, 3] - 0.12
    assert 0.0 <= coasted < 0.06 / DURATION * SETTINGS.brake_s * 1.5


def test_a_stop_plan_ends_at_rest() -> None:
    walker = new_walker()
    walk(walker, [plan_to(1, body_at(0.06)), plan_to(2, body_at(0.10), stop=True)], rest_s=0.5)
    np.testing.assert_allclose(walker.body_ref, body_at(0.10), atol=1e-6)


@given(st.floats(0.0, 0.9), st.sampled_from([0.6, 0.8, 1.1]))
@settings(max_examples=25)
def test_set_down_stands_on_known_footholds_within_500_ms(at: float, duration: float) -> None:
    walker, goal = new_walker(), body_at(0.04)
    walker.accept(plan_to(1, goal, duration=duration))
    stood, targets = walker.feet_odom, [cycle(walker)]
    walker.accept(plan_to(2, body_at(0.08)))
    while walker.phase < at:
        targets.append(cycle(walker))
    flying = walker.phase * duration > SETTINGS.unload_s + DT
    walker.set_down(reaches)
    walker.set_down(reaches)  # a second call changes nothing
    took = 0
    while not walker.resting:
        targets.append(cycle(walker))
        took += 1
    targets += [cycle(walker) for _ in range(50)]
    assert took * DT <= 0.5
    assert walker.step == 1, "the plan that waited is forgotten"
    np.testing.assert_allclose(walker.load_share, 1.0)
    landed = apply(np.eye(4), plan_to(1, goal).touchdown)
    back, there = (np.abs(walker.feet_odom - place)[TRIPOD].max() < 1e-3 for place in (stood, landed))
    assert back or there
    assert flying or back, "legs that were not lifted stay"
    np.testing.assert_allclose(walker.feet_odom[~TRIPOD], stood[~TRIPOD], atol=1e-6)
    assert largest_jump(targets) < 2.5 * 0.3 * DT / 0.4


@pytest.mark.parametrize("at", [0.15, 0.3, 0.45, 0.6, 0.75])
def test_feet_with_heavy_rotors_are_set_down_more_slowly(at: float) -> None:
    descents = []
    for inertia_s in (0.0, 0.04):
        walker = StepExecutor(SETTINGS, REST.copy(), START, inertia_s=inertia_s)
        walker.accept(plan_to(1, body_at(0.04), duration=1.0))
        cycle(walker)
        while walker.phase < at:
            cycle(walker)
        walker.set_down(reaches)
        heights = []
        while not walker.resting:
            heights.append(cycle(walker).feet[TRIPOD, 2])
        descents.append(-np.diff(heights, axis=0).min())
    assert descents[1] <= descents[0]
    assert descents[1] / DT < 0.30


@given(st.floats(0.1, 0.9), st.sampled_from([0.6, 0.8, 1.1]))
@settings(max_examples=25)
def test_body_stops_before_feet_are_set_down(at: float, duration: float) -> None:
    walker, places = new_walker(), []
    walk(walker, [plan_to(1, body_at(0.04), ahead=0.02, duration=duration)])
    walker.accept(plan_to(2, body_at(0.08), ahead=0.02, duration=duration))
    while walker.phase < at or walker.step == 1:
        cycle(walker)
        places.append(walker.body_ref[0, 3])
    stop_at = len(places)
    walker.set_down(reaches)
    while not walker.resting:
        cycle(walker)
        places.append(walker.body_ref[0, 3])
    speeds = np.diff(places) / DT
    assert abs(speeds[-1]) < 0.01, "the last cycle but one"
    assert np.abs(np.diff(speeds)).max() < 0.05, "it neither starts nor stops with a jerk"
    after = speeds[stop_at:]
    assert after.max() <= speeds[stop_at - 1] + 0.01, "it does not hurry with the feet"
    assert np.abs(after[round(0.2 / DT) :]).max(initial=0.0) < 0.02, "it all but rests before they are down"
    for _ in range(10):
        cycle(walker)
    assert walker.body_ref[0, 3] == pytest.approx(places[-1], abs=0.003)


def test_set_down_moves_body_until_touchdowns_are_in_reach() -> None:
    walker, goal = new_walker(), body_at(0.08)
    plan = plan_to(1, goal, ahead=0.05)
    walker.accept(plan)
    cycle(walker)
    while walker.phase < 0.6:
        cycle(walker)
    asked: list[float] = []

    def reach_from(x: float) -> Callable[[Array], bool]:
        def near(feet: Array) -> bool:
            asked.append(plan.touchdown[0, 0] - feet[0, 0])  # where the body would be
            np.testing.assert_allclose(apply(body_at(asked[-1]), feet)[TRIPOD], plan.touchdown[TRIPOD], atol=1e-9)
            np.testing.assert_allclose(apply(body_at(asked[-1]), feet)[~TRIPOD], apply(START, REST)[~TRIPOD], atol=1e-9)
            return asked[-1] > x

        return near

    walker.set_down(reach_from(0.07))
    while not walker.resting:
        cycle(walker)
    assert len(asked) > 1
    assert asked == sorted(asked)
    assert asked[-2] <= 0.07 < asked[-1]
    assert walker.body_ref[0, 3] == pytest.approx(asked[-1], abs=1e-3)
    np.testing.assert_allclose(walker.feet_odom[TRIPOD], plan.touchdown[TRIPOD], atol=1e-3)


@pytest.mark.parametrize("at", [0.2, 0.22])
def test_reversal_in_mid_air_is_not_taken_for_ground_contact(at: float) -> None:
    walker = new_walker()
    stood = walker.feet_odom
    walker.accept(plan_to(1, body_at(0.04), duration=1.0))
    cycle(walker)
    while walker.phase < at:
        cycle(walker)
    assert (walker.feet_odom[TRIPOD, 2] - stood[TRIPOD, 2] > 0.0155).any()
    walker.set_down(reaches)
    while not walker.resting:
        high = walker.feet_odom[:, 2] - stood[:, 2] > 0.0155
        walker.update(DT, walker.body_ref, FootContact(TRIPOD & high, ALL, walker.feet_odom))
    np.testing.assert_allclose(walker.feet_odom[TRIPOD], stood[TRIPOD], atol=1e-3)


def test_set_down_does_not_affect_motions_without_swing_plan() -> None:
    walker = new_walker()
    walker.set_down(reaches)
    assert walker.resting
    walker.accept(plan_to(1, body_at(0.03), swing=np.zeros(6, dtype=bool)))
    for _ in range(20):
        cycle(walker)
    walker.set_down(reaches)
    assert walker.resting, "a body over six feet stops"
    before = walker.body_ref[0, 3]
    for _ in range(50):
        cycle(walker)
    assert 0.0 <= walker.body_ref[0, 3] - before < 0.01
    walker.lower(np.where(TRIPOD, 0.02, 0.0))
    for _ in range(10):
        cycle(walker)
    walker.set_down(reaches)
    assert not walker.resting, "feet that come down by themselves go on"


@pytest.mark.slow
@settings(max_examples=40)
@given(st.lists(st.floats(-0.08, 0.08), min_size=3, max_size=3), st.integers(0, 5), st.floats(0.2, 1.0))
def test_displaced_leg_is_put_back_through_the_air(off: list[float], leg: int, pace: float) -> None:
    walker = new_walker()
    belongs, body, legs = walker.feet_odom, walker.body_ref, np.arange(6) == leg
    off[0] += math.copysign(0.02, off[0])
    lies = belongs + np.where(legs[:, None], off, 0.0)
    walker.put_back(legs, lies)
    np.testing.assert_allclose(walker.feet_odom, lies, atol=1e-9)
    unsure = FootContact(legs & False, legs & False, lies)  # no foot reports contact, which does not cancel the motion
    highest, elapsed = -np.inf, 0.0
    while not walker.resting:
        assert walker.gentle
        assert not walker.planned
        share = walker.update(DT, walker.body_ref, unsure, pace).share
        if walker.phase < 0.8:
            assert share[leg] == 0.0, "it carries nothing"
        np.testing.assert_allclose(walker.feet_odom[~legs], belongs[~legs], atol=1e-9)
        np.testing.assert_allclose(walker.body_ref, body, atol=1e-9)
        highest = max(highest, float(walker.feet_odom[leg, 2]))
        elapsed += DT
    assert highest > max(belongs[leg, 2], lies[leg, 2]) + 0.02
    np.testing.assert_allclose(walker.feet_odom, belongs, atol=1e-9)
    assert elapsed == pytest.approx(1.0 / pace, abs=2 * DT)
    assert not walker.gentle
    walker.accept(plan_to(1, body_at(0.03)))
    for _ in range(5):
        walker.update(DT, walker.body_ref, pace=0.0)
    assert walker.phase > 0.0, "a step of a plan does not wait"


@pytest.mark.parametrize("late", [0.0, 0.03])
def test_contact_of_reversed_foot_counts_only_near_its_foothold(late: float) -> None:
    """Check that contact counts only where the measured foot is nearly back.

    Joints lag: the foot may be centimetres above its command.
    """
    walker = new_walker()
    walker.accept(plan_to(1, body_at(0.03)))
    for _ in range(8):
        cycle(walker)
    walker.set_down(reaches)
    assert walker.trouble == "the step is reversed"
    walker.take_findings()
    while not walker.resting:
        feet = walker.feet_odom + late * TRIPOD[:, None] * [0.0, 0.0, 1.0]
        walker.update(DT, walker.body_ref, FootContact(TRIPOD, ~TRIPOD, feet))
    assert bool(walker.take_findings()) == (late == 0.0)


def test_foot_with_unknown_contact_gives_no_finding() -> None:
    walker = new_walker()
    walk(walker, [plan_to(1, body_at(0.03))])
    walker.take_findings()
    torque_disabled = np.arange(6) == 2
    walker.update(DT, walker.body_ref, FootContact(TRIPOD & False, TRIPOD, walker.feet_odom, known=~torque_disabled))
    assert {found.leg for found in walker.take_findings()} == {0, 4}
    walker.update(DT, walker.body_ref, FootContact(TRIPOD & False, TRIPOD, walker.feet_odom))
    assert not walker.take_findings()


def test_plan_may_be_replaced_until_feet_are_lifted() -> None:
    """Check that a newer plan may replace a step that has just begun.

    The new plan lifts the feet higher and takes longer.
    """
    walker = new_walker()
    low = plan_to(1, body_at(0.03), duration=0.8)
    walker.accept(low)
    cycle(walker)
    assert (walker.phase, np.isinf(walker.clearance).all()) == (pytest.approx(DT / 0.8), True)
    high = replace(plan_to(1, body_at(0.05), duration=1.2), revision=2, clearance=low.clearance + 0.03)
    before = walker.body_ref
    walker.accept(high)
    highest, feet, place = 0.0, walker.feet_odom, before
    while not walker.resting:
        cycle(walker)
        assert np.linalg.norm(walker.body_ref[:3, 3] - place[:3, 3]) < 0.0025, "the body does not jump"
        place = walker.body_ref
        highest = max(highest, float((walker.feet_odom - feet)[TRIPOD, 2].max()))
    assert highest > low.clearance[0] + 0.02
    np.testing.assert_allclose(walker.feet_odom[TRIPOD], high.touchdown[TRIPOD], atol=1e-3)
    np.testing.assert_allclose(walker.body_ref[:3, 3], high.body_goal[:3, 3], atol=1e-3)


def test_clearance_is_reported_only_while_feet_are_lifted() -> None:
    walker = new_walker()
    plan = plan_to(1, body_at(0.03))
    walker.accept(plan)
    assert np.isinf(walker.clearance).all()
    while walker.phase < 0.3 or walker.resting:
        cycle(walker)
    np.testing.assert_array_equal(walker.clearance, plan.clearance)
    while not walker.resting:
        cycle(walker)
    assert np.isinf(walker.clearance).all()


@given(
    st.lists(st.tuples(st.integers(0, 35), st.tuples(*[st.floats(-0.02, 0.02)] * 3)), max_size=3),
    st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-0.05, 0.05)),
)
@settings(max_examples=10)
def test_revision_moves_only_the_touchdowns(
    revisions: list[tuple[int, tuple[float, float, float]]], correction: tuple[float, float, float]
) -> None:
    """Check that a revision moves only touchdowns, even if {world} has shifted since.

    The body follows its planned path over its standing feet.
    """
    plan = plan_to(1, body_at(0.06, 0.0, 0.05))
    plain, revised = new_walker(), new_walker()
    plain.accept(plan)
    revised.accept(plan)
    T_world_odom = from_xyz_rpy((*correction[:2], 0.0), (0.0, 0.0, correction[2]))
    wanted = plan.touchdown
    for k in range(40):
        for at, shift in revisions:
            if at == k and k:
                wanted = apply(inverse(T_world_odom), plan.touchdown + shift)
                moved = replace(
                    plan, revision=2, T_world_odom=T_world_odom, touchdown=plan.touchdown + shift, body_goal=plan.body_goal
                )
                revised.accept(moved)
        a, b = cycle(plain), cycle(revised)
        np.testing.assert_allclose(revised.body_ref, plain.body_ref, atol=1e-9)
        np.testing.assert_allclose(b.feet[~TRIPOD], a.feet[~TRIPOD], atol=1e-9)
        np.testing.assert_array_equal(b.share, a.share)
    assert revised.resting
    if not revisions or max(at for at, _ in revisions) < 34:  # later the foot is already down
        np.testing.assert_allclose(revised.feet_odom[TRIPOD], wanted[TRIPOD], atol=1e-9)


def test_arc_setting_selects_swing_trajectory() -> None:
    ways = {}
    for arc in ("flow", "sixth_order"):
        walker = StepExecutor(replace(SETTINGS, arc=arc), REST.copy(), START)
        targets, _ = walk(walker, [plan_to(1, body_at(0.05))])
        np.testing.assert_allclose(walker.feet_odom[TRIPOD], landed(1, body_at(0.05)), atol=1e-9)
        assert largest_jump(targets) < 0.02
        ways[arc] = np.array([t.feet[0] for t in targets])
    assert np.abs(ways["flow"] - ways["sixth_order"]).max() > 0.005


def test_load_shares_are_bounded_and_three_legs_carry_full_load() -> None:
    targets, _ = walk(new_walker(), [plan_to(n, body_at(0.05 * n)) for n in range(1, 5)], rest_s=0.2)
    shares = np.array([t.share for t in targets])
    assert (shares >= 0.0).all()
    assert (shares <= 1.0).all()
    assert ((shares == 1.0).sum(axis=1) >= 3).all()
    assert np.abs(np.diff(shares, axis=0)).max() <= max(DT / SETTINGS.unload_s, DT / SETTINGS.load_s) + 1e-9


def test_moving_foot_carries_no_load() -> None:
    walker, before = new_walker(), REST.copy()
    walker.accept(plan_to(1, body_at(0.0)))
    while walker.phase < 1.0 or walker.step == 0:
        targets = cycle(walker)
        flying = np.linalg.norm(targets.feet - before, axis=1) > 1e-9
        assert not (flying & (targets.share > 1e-9)).any()
        before = targets.feet


def test_stance_feet_do_not_move_while_the_body_moves() -> None:
    walker = new_walker()
    feet = walker.feet_odom
    walker.accept(plan_to(1, body_at(0.06, 0.02, 0.1)))
    for _ in range(40):
        targets = cycle(walker)
        np.testing.assert_allclose(walker.feet_odom[~TRIPOD], feet[~TRIPOD], atol=1e-9)
        np.testing.assert_allclose(apply(walker.body_ref, targets.feet)[~TRIPOD], feet[~TRIPOD], atol=1e-9)


def test_command_converges_to_measured_pose_in_the_plane() -> None:
    """Check that the commanded body converges to the measured pose in the plane.

    Feet roll and slip.
    """
    walker = new_walker()
    measured = body_at(0.02, -0.01, 0.05)
    feet = walker.feet_odom
    for _ in range(300):
        targets = walker.update(DT, measured)
    np.testing.assert_allclose(walker.body_ref, measured, atol=1e-4)
    np.testing.assert_allclose(targets.feet, REST, atol=1e-6)  # nothing moves in {body}
    np.testing.assert_allclose(walker.feet_odom, apply(measured @ inverse(START), feet), atol=1e-4)


@pytest.mark.parametrize(("axis", "size"), [(0, 0.006), (1, np.radians(1.0)), (2, np.radians(1.0))])
def test_sag_roll_and_pitch_are_corrected_up_to_a_limit(axis: int, size: float) -> None:
    """Check that the feet oppose a low, rolled or pitched body, up to a limit."""
    offset = np.zeros(3)
    offset[axis] = size
    measured = START @ from_xyz_rpy((0.0, 0.0, -offset[0]), (offset[1], offset[2], 0.0))
    walker = new_walker()
    for _ in range(25):
        targets = walker.update(DT, measured)
    lowered = targets.feet[:, 2] - REST[:, 2]
    side, front = np.sign(REST[:, 1]), np.sign(np.round(REST[:, 0], 3))
    if axis == 0:
        assert (lowered < 0).all()
    elif axis == 1:  # roll raises the left side: its feet are drawn in and the right ones pushed out
        assert (lowered * side > 0).all()
    else:  # pitch lowers the front: its feet are pushed out
        assert (lowered * front <= 1e-12).all()
    for _ in range(300):
        targets = walker.update(DT, measured)
    assert np.abs(targets.feet[:, 2] - REST[:, 2]).max() < 0.03


@given(st.floats(-0.008, 0.008), st.floats(-0.025, 0.025), st.floats(-0.025, 0.025))
@settings(max_examples=10, deadline=None)
def test_swing_feet_land_without_stance_correction(sag: float, roll: float, pitch: float) -> None:
    """Check that the correction of the standing feet does not apply to swinging feet.

    Otherwise they would land too low or too high.
    """
    walker = new_walker()
    walker.accept(plan_to(1, body_at(0.03)))
    off = from_xyz_rpy((0.0, 0.0, -sag), (roll, pitch, 0.0))
    while walker.phase == 1.0 or walker.load_share[TRIPOD].max() > 0 or walker.phase < 0.5:
        walker.update(DT, walker.body_ref @ off)
    while walker.load_share[TRIPOD].max() == 0:
        targets = walker.update(DT, walker.body_ref @ off)
    told = apply(walker.body_ref, targets.feet) - walker.feet_odom
    assert np.abs(told[TRIPOD]).max() < 1e-3
    arms = np.abs(REST[~TRIPOD, :2]).max()
    assert np.abs(told[~TRIPOD]).max() > 0.5 * max(abs(sag), abs(roll) * arms, abs(pitch) * arms) - 1e-9


def test_foot_lands_without_height_correction_of_last_stance() -> None:
    """Check that a foot lands without the height correction of its last stance.

    The correction of one stance does not predict the next, on other ground.
    """
    walker = new_walker()
    low = from_xyz_rpy((0.0, 0.0, -0.004), np.zeros(3))
    for _ in range(25):
        walker.update(DT, walker.body_ref @ low)
    pressed = walker.feet_odom[:, 2] - apply(walker.body_ref, cycle(walker).feet)[:, 2]
    assert (pressed > 0.005).all()
    walk(walker, [plan_to(1, body_at(0.03))])
    told = apply(walker.body_ref, cycle(walker).feet)
    pressed = walker.feet_odom[:, 2] - told[:, 2]
    assert np.abs(pressed[TRIPOD]).max() < 3e-4
    assert (pressed[~TRIPOD] > 0.005).all()


def test_yaw_wraps_at_180_deg() -> None:
    start = from_xyz_rpy(START[:3, 3], (0.0, 0.0, np.pi - 0.02))
    walker = StepExecutor(SETTINGS, REST.copy(), start)
    goal = from_xyz_rpy(START[:3, 3], (0.0, 0.0, -np.pi + 0.03))
    walker.accept(plan_to(1, goal))
    previous = start
    for _ in range(40):
        cycle(walker)
        assert abs(rpy_from_rotation(previous[:3, :3].T @ walker.body_ref[:3, :3])[2]) < 0.01
        previous = walker.body_ref
    np.testing.assert_allclose(walker.body_ref, goal, atol=1e-9)


def test_predicted_end_stance_matches_final_stance() -> None:
    walker = new_walker()
    np.testing.assert_allclose(walker.stance_at_end[1], walker.feet_odom)
    walker.accept(plan_to(1, body_at(0.06)))
    for _ in range(20):
        cycle(walker)
    body, feet = walker.stance_at_end
    while not walker.resting:
        cycle(walker)
    np.testing.assert_allclose(body, walker.body_ref, atol=1e-9)
    np.testing.assert_allclose(feet, walker.feet_odom, atol=1e-9)


def test_doubtful_stance_leg_is_tested_before_others_lift() -> None:
    """Check the rise of a robot that is held up, without load on any foot."""
    walker = new_walker()
    walker.seek_ground(ALL)
    assert not walker.searching.any()
    walker.accept(plan_to(1, body_at(0.03)))
    hangs = np.arange(6) == 1
    for _ in range(60):
        walker.update(DT, walker.body_ref, FootContact(~ALL, ~hangs, walker.feet_odom))
        if walker.searching.any():
            break
    np.testing.assert_array_equal(walker.searching, hangs)
    assert walker.resting is False
    assert "no ground under the right front foot" in walker.trouble


def test_hanging_foot_of_a_standing_robot_reaches_down_to_the_ground() -> None:
    """Check the rise on uneven ground, where only some of the feet carry load."""
    walker = new_walker()
    hangs, start = np.arange(6) == 1, walker.feet_odom[1, 2]
    walker.seek_ground(hangs)
    np.testing.assert_array_equal(walker.searching, hangs)
    while walker.searching.any():
        touches = hangs & (walker.feet_odom[:, 2] < start - 0.012)
        walker.update(DT, walker.body_ref, FootContact(touches, ~hangs | touches, walker.feet_odom))
    assert walker.resting
    assert walker.feet_odom[1, 2] == pytest.approx(start - 0.012, abs=0.002)
    assert "ground found 12 mm lower than expected" in walker.trouble
