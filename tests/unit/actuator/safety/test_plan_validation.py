"""Plan validation: refusals and their reasons; accepted plans can be completed."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from sextant.services.actuator.safety.plan_validation import PlanCheck
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.kinematics import body_forward, body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin
from sextant.shared.wire.messages import StepPlan

Flags = NDArray[np.bool_]

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet()
START = from_xyz_rpy((0.0, 0.0, PROFILE.stance.body_height), np.zeros(3))
FEET = apply(START, REST)
TRIPOD = np.arange(6) % 2 == 0
TURN = "the body would turn by {} deg in one step (roll, pitch, yaw), at most 15, 15 and 25 deg allowed"
NOBODY = np.zeros(6, dtype=bool)
ANY = np.full(6, np.inf)  # [m] clearance limit: no foot has been lifted
NOW = 10_000_000_000
AGE = 0.6


def plan(**changes: Any) -> StepPlan:
    goal = from_xyz_rpy((0.04, 0.0, PROFILE.stance.body_height), np.zeros(3))
    good = StepPlan(
        stamp_ns=NOW,
        epoch=0,
        step=1,
        revision=1,
        T_world_odom=np.eye(4),
        swing=TRIPOD,
        touchdown=np.where(TRIPOD[:, None], apply(goal, REST + np.array([0.02, 0.0, 0.0])), FEET),
        clearance=np.full(6, 0.04),
        body_goal=goal,
        duration=0.8,
        stop=False,
    )
    return replace(good, **changes)


def refusal(
    a_plan: StepPlan, check: PlanCheck | None = None, running: int = 0, resting: bool = True, swing: Flags = NOBODY
) -> str:
    check = check or PlanCheck(PROFILE, AGE)
    return check.untimely(a_plan, NOW, running, resting, swing, ANY) or check.unwalkable(a_plan, START, FEET)


def goal(x: float = 0.0, roll: float = 0.0, yaw: float = 0.0, z: float = 0.1) -> Array:
    return from_xyz_rpy((x, 0.0, z), (roll, 0.0, yaw))


def test_valid_plan_is_accepted() -> None:
    assert refusal(plan()) == ""


FAR = apply(START, REST)
FAR[0] += [0.15, 0.15, 0.0]
SKEWED = np.diag([1.0, 1.0, 1.1, 1.0])
FAR_AWAY = from_xyz_rpy((0.0, 1e13, 0.0), np.zeros(3))
MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])
FOUR = np.array([True, True, True, True, False, False])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"stamp_ns": NOW - 700_000_000}, "plan of step 1 is 0.70 s old, at most 0.60 s allowed"),
        ({"stamp_ns": NOW + 5_000_000_000}, "plan of step 1 is stamped 5.00 s in the future"),
        ({"epoch": 7}, "plan of step 1 was made before {odom} restarted: epoch 0 expected, found 7"),
        ({"step": 2}, "plan of step 2 does not follow step 0"),
        ({"step": 0}, "plan of step 0 does not follow step 0"),
        ({"T_world_odom": SKEWED}, "the plan's T_world_odom is not a rigid transform"),
        ({"body_goal": MIRRORED}, "the plan's body_goal is not a rigid transform"),
        ({"T_world_odom": np.zeros((4, 4))}, "the plan's T_world_odom is not a rigid transform"),
        (
            {"T_world_odom": FAR_AWAY},
            "the plan's T_world_odom is more than 1000 km away, too far for millimetre precision",
        ),
        (
            {"body_goal": goal(-2e6)},
            "the plan's body_goal is more than 1000 km away, too far for millimetre precision",
        ),
        ({"body_goal": goal(0.25)}, "the body would travel 0.25 m in one step, at most 0.2 m allowed"),
        (
            {"body_goal": goal(roll=0.4)},
            TURN.format("[22.9, 0.0, 0.0]"),
        ),
        (
            {"body_goal": goal(roll=np.radians(15.5))},
            TURN.format("[15.5, 0.0, 0.0]"),
        ),
        (
            {"body_goal": goal(yaw=0.6)},
            TURN.format("[0.0, 0.0, 34.4]"),
        ),
        (
            {"body_goal": goal(yaw=np.radians(25.5))},
            TURN.format("[0.0, 0.0, 25.5]"),
        ),
        ({"duration": 0.1}, "a step of 0.3 to 4.0 s expected, found 0.10 s"),
        ({"duration": 9.0}, "a step of 0.3 to 4.0 s expected, found 9.00 s"),
        ({"clearance": np.full(6, 0.2)}, "clearances of 0 to 0.12 m expected, found 0.200 to 0.200 m"),
        ({"clearance": np.full(6, -0.01)}, "clearances of 0 to 0.12 m expected, found -0.010 to -0.010 m"),
        ({"swing": FOUR}, "only 2 legs would stand, three are needed"),
        (
            {"body_goal": goal(0.15)},
            "the centre of mass would be 28.4 mm outside the support polygon at the end, 5 mm inside needed",
        ),
        ({"touchdown": FAR}, "the touchdown of the left front leg is out of reach: 64 mm too far"),
        (
            {"body_goal": goal(z=0.215), "touchdown": apply(goal(z=0.215), REST)},
            "the standing foot of the right front leg is out of reach: 14 mm too far",
        ),
    ],
)
def test_refusal_states_its_reason(changes: dict[str, object], words: str) -> None:
    assert refusal(plan(**changes)) == words


@pytest.mark.parametrize(
    "changes",
    [
        {"stamp_ns": NOW - 600_000_000},
        {"stamp_ns": NOW + 600_000_000},
        {"duration": 0.3, "touchdown": FEET, "clearance": np.full(6, 0.002), "body_goal": START},
        {"duration": 4.0},
        {"clearance": np.zeros(6)},
        {"clearance": np.full(6, 0.12), "duration": 0.9},
    ],
)
def test_plan_at_the_limits_is_accepted(changes: dict[str, object]) -> None:
    assert refusal(plan(**changes)) == ""


OUT_AND_UP = plan().touchdown
OUT_AND_UP[0] += [0.0, 0.05, 0.03]
QUICK: dict[str, Any] = {"swing": NOBODY, "touchdown": FEET, "body_goal": goal(0.05, z=0.15), "duration": 0.3}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"clearance": np.full(6, 0.12), "duration": 0.5},
            "femur of the left front leg would turn by 180 deg in 0.50 s, at most 159",
        ),
        ({"duration": 0.3}, "femur of the left front leg would turn by 73 deg in 0.30 s, at most 58"),
        ({"touchdown": OUT_AND_UP, "duration": 0.3}, "femur of the left front leg would turn by 114 deg in 0.30 s, at most 58"),
        (QUICK, "tibia of the right rear leg would turn by 60 deg in 0.30 s, at most 58"),  # a standing leg
    ],
)
def test_plan_exceeding_joint_speed_or_acceleration_is_refused(changes: dict[str, object], words: str) -> None:
    assert refusal(plan(**changes)) == f"the {words} deg allowed"
    assert refusal(plan(**changes | {"duration": 1.2})) == ""


def test_revision_does_not_recheck_speed_of_stance_legs() -> None:
    landing, left = plan(**QUICK | {"swing": TRIPOD}), np.where(TRIPOD, 0.2, np.inf)
    check = PlanCheck(PROFILE, AGE)
    assert check.unwalkable(landing, START, FEET, revises=True, air_s=left) == ""
    words = "the femur of the left front leg would turn by 115 deg in 0.30 s, at most 58 deg allowed"
    for lifted in (False, True):
        until_now = {} if lifted else {"revises": True}
        air_s = left if lifted else np.full(6, np.inf)
        found = PlanCheck(PROFILE, AGE).unwalkable(landing, START, FEET, **until_now, air_s=air_s)
        assert found == words, "it has not been lifted, or is no revision: its whole way counts"


def test_world_frame_offset_is_limited_to_1000_km() -> None:
    for away, words in ((1e6, ""), (1e6 + 0.5, "the plan's T_world_odom is more than 1000 km away")):
        T_world_odom = from_xyz_rpy((0.0, -away, 0.0), np.zeros(3))
        there = plan(touchdown=apply(T_world_odom, plan().touchdown), body_goal=T_world_odom @ plan().body_goal)
        assert refusal(replace(there, T_world_odom=T_world_odom)).startswith(words)
        assert bool(words) == bool(refusal(replace(there, T_world_odom=T_world_odom)))


def test_refusal_states_margin_of_body_far_from_its_feet() -> None:
    found = PlanCheck(PROFILE, AGE).unwalkable(plan(), START, FEET + np.array([0.0, 1.5, 0.0]))
    centre = apply(START, resting_centre_of_mass(PROFILE))[:2]
    margin = support_margin((FEET + np.array([0.0, 1.5, 0.0]))[~TRIPOD][:, :2], centre)
    assert margin < -1.0
    assert (
        found
        == f"the centre of mass would be {-margin * 1e3:.1f} mm outside the support polygon at the start, 5 mm inside needed"
    )


def test_handover_time_is_excluded_from_swing_time() -> None:
    quick = plan(duration=0.4, clearance=np.full(6, 0.03))
    assert refusal(quick) == ""
    assert "in 0.25 s, at most" in refusal(quick, PlanCheck(PROFILE, AGE, handover_s=0.15))


def test_revision_is_checked_against_remaining_air_time() -> None:
    """Check joint speeds against the remaining time in the air.

    A foot that has met ground does not move, so it may be far from its planned place.
    """
    where = plan().touchdown
    now = where + np.array([0.0, 0.0, 0.005]) * TRIPOD[:, None]  # nearly at the touchdown
    for left_s, moved, refused in ((0.5, 0.03, False), (0.02, 0.001, False), (0.02, 0.08, True), (np.inf, 0.08, False)):
        left = np.where(TRIPOD, 0.3, np.inf)
        left[0] = left_s
        revised = plan(touchdown=where + np.array([moved, 0.0, 0.0]) * (np.arange(6) == 0)[:, None])
        found = PlanCheck(PROFILE, AGE).unwalkable(revised, START, now, revises=True, air_s=left)
        assert ("of the left front leg would turn by" in found) == refused, (left_s, moved, found)


@pytest.mark.parametrize("stamp_ns", [NOW - 600_000_001, NOW + 600_000_001])
def test_plan_age_limit_is_exact_to_1_ns(stamp_ns: int) -> None:
    assert refusal(plan(stamp_ns=stamp_ns)) != ""


def test_plan_with_zero_stamp_at_time_zero_is_accepted() -> None:
    assert PlanCheck(PROFILE, AGE).untimely(plan(stamp_ns=0), 0, 0, True, NOBODY, ANY) == ""


def test_body_travel_limit_is_0_2_m() -> None:
    """Check the limit of the travel of a step, 0.2 m.

    The test ignores other reasons of refusal.
    """
    check, where = PlanCheck(PROFILE, AGE), START.copy()
    where[0, 3] = 0.0
    for x, allowed in ((0.2, True), (0.2001, False)):
        reason = check.unwalkable(plan(body_goal=from_xyz_rpy((x, 0.0, START[2, 3]), np.zeros(3))), where, FEET)
        assert ("travel" not in reason) == allowed, reason


@pytest.mark.parametrize(("towards", "words"), [(0.01, ""), (0.0, "is out of reach: "), (-0.01, "is out of reach: ")])
def test_body_may_only_move_towards_foot_out_of_reach(towards: float, words: str) -> None:
    feet = FEET.copy()
    feet[0] += (0.16, 0.0, -0.03)
    body = START @ from_xyz_rpy((towards, 0.0, 0.0), np.zeros(3))
    assert not within_limits(PROFILE, body_inverse(PROFILE, apply(inverse(body), feet)))[0].all()
    found = PlanCheck(PROFILE, AGE).unwalkable(plan(body_goal=body, swing=NOBODY, touchdown=feet), START, feet)
    assert found == "" if not words else words in found


def test_touchdown_must_be_in_reach_even_from_foot_out_of_reach() -> None:
    feet, nearer, first = FEET.copy(), FEET.copy(), np.arange(6) == 0
    feet[0] += (0.16, 0.0, -0.03)
    nearer[0] += (0.15, 0.0, -0.02)
    found = PlanCheck(PROFILE, AGE).unwalkable(plan(body_goal=START, swing=first, touchdown=nearer), START, feet)
    assert found == "the touchdown of the left front leg is out of reach: 25 mm too far"


def with_a_foot_beyond(short: float, turned: float) -> Array:
    """Return feet (6, 3) [m] {odom} with the left front foot out of reach.

    It lies `short` [m] beyond its leg's reach, or `turned` [rad] beyond its coxa's limit.
    """
    T, links = PROFILE.T_body_coxa[0], PROFILE.links
    x, y, z = apply(inverse(T), REST[0])
    if short:
        angle, out, z = np.arctan2(y, x), links.coxa + PROFILE.leg_reach[0, 1] + short, 0.0
    else:
        angle, out = PROFILE.joint_limits[0, 0, 1] + turned, np.hypot(x, y)
    feet = REST.copy()
    feet[0] = apply(T, np.array([out * np.cos(angle), out * np.sin(angle), z]))
    return apply(START, feet)


@pytest.mark.parametrize(
    ("short", "turned", "why", "walked"),
    [
        (0.0048, 0.0, "5 mm too far", True),
        (0.0052, 0.0, "5 mm too far", False),
        # The foot's distance from the limit is then 4.8 mm.
        (0.0, 0.0048 / PROFILE.foot_radii[0], "its coxa would be turned left 3 deg too far", True),
        (0.0, 0.0052 / PROFILE.foot_radii[0], "its coxa would be turned left 3 deg too far", False),
        (0.10, 0.0, "100 mm too far", False),
    ],
)
def test_revision_tolerates_stance_foot_5_mm_out_of_reach(short: float, turned: float, why: str, walked: bool) -> None:
    feet = with_a_foot_beyond(short, turned)
    a_plan = plan(body_goal=START, swing=~TRIPOD, touchdown=feet)
    words = f"the standing foot of the left front leg is out of reach: {why}"
    assert PlanCheck(PROFILE, AGE).unwalkable(a_plan, START, feet) == words, "no step is begun with it"
    assert PlanCheck(PROFILE, AGE).unwalkable(a_plan, START, feet, revises=True) == ("" if walked else words)
    landing = replace(a_plan, swing=TRIPOD)
    found = PlanCheck(PROFILE, AGE).unwalkable(landing, START, feet, revises=True)
    assert found == words.replace("standing foot", "touchdown"), "a swinging foot has a choice"


@pytest.mark.parametrize(
    ("joint", "turned", "why"),
    [
        (0, -0.1, "coxa would be turned right 6 deg too far"),
        (1, 0.1, "femur would be raised 6 deg too far"),
        (2, -0.1, "tibia would be bent 6 deg too far"),
    ],
)
def test_refusal_states_joint_and_how_far_it_would_turn(joint: int, turned: float, why: str) -> None:
    q = body_inverse(PROFILE, REST)
    q[0, joint] = PROFILE.joint_limits[0, joint, int(turned > 0.0)] + turned
    feet = apply(START, body_forward(PROFILE, q))
    found = PlanCheck(PROFILE, AGE).unwalkable(plan(body_goal=START, swing=NOBODY, touchdown=feet), START, feet)
    assert found == f"the standing foot of the left front leg is out of reach: its {why}"


def test_refusal_states_foot_that_is_too_near() -> None:
    feet = REST.copy()
    feet[0] = apply(PROFILE.T_body_coxa[0], np.array([PROFILE.links.coxa + 0.001, 0.0, 0.0]))
    end = apply(START, feet)
    found = PlanCheck(PROFILE, AGE).unwalkable(plan(body_goal=START, swing=NOBODY, touchdown=end), START, end)
    assert found == "the standing foot of the left front leg is out of reach: 66 mm too near"


def test_plan_with_unstable_start_is_refused() -> None:
    outside = from_xyz_rpy((0.2, 0.0, 0.1), np.zeros(3))
    words = PlanCheck(PROFILE, AGE).unwalkable(plan(body_goal=outside), outside, FEET)
    assert words == "the centre of mass would be 71.5 mm outside the support polygon at the start, 5 mm inside needed"


@pytest.mark.parametrize(("centre", "refused"), [(0.0, False), (0.04, False), (0.24, True)])
def test_support_margin_uses_centre_of_mass(centre: float, refused: bool) -> None:
    profile = replace(PROFILE, body=replace(PROFILE.body, size=(0.5, 0.12, 0.04), centre_of_mass=(centre, 0.0, 0.0)))
    words = PlanCheck(profile, AGE).unwalkable(plan(), START, FEET)
    assert ("mm outside the support polygon" in words) == refused


def test_plan_is_accepted_once_and_only_with_newer_stamp() -> None:
    check = PlanCheck(PROFILE, AGE)
    assert refusal(plan(), check) == ""
    assert refusal(plan(), check) == "plan of step 1 is not newer than the last accepted one"
    assert refusal(plan(stamp_ns=NOW - 1), check) == "plan of step 1 is not newer than the last accepted one"
    assert refusal(plan(stamp_ns=NOW + 1), check) == ""


def test_refused_plan_does_not_affect_later_plans() -> None:
    check = PlanCheck(PROFILE, AGE)
    assert refusal(plan(duration=9.0, stamp_ns=NOW + 1), check)
    assert refusal(plan(stamp_ns=NOW + 5_000_000_000), check)
    assert refusal(plan(), check) == ""


def test_finished_step_cannot_be_revised() -> None:
    assert refusal(plan(step=4), running=4, resting=True) == "plan of step 4 does not follow step 4"
    assert refusal(plan(step=6), running=4, resting=False) == "plan of step 6 does not follow step 4"
    assert refusal(plan(step=4), running=4, resting=False, swing=TRIPOD) == ""


def test_revision_with_other_swing_legs_is_refused() -> None:
    words = "a revision of step 4 swings other legs than the running step"
    assert refusal(plan(step=4), running=4, resting=False, swing=~TRIPOD) == words


def test_revision_with_more_clearance_than_lifted_is_refused() -> None:
    """Check a revision made before the planner knew which plan of the step was begun.

    Its touchdowns may lie behind higher obstacles than the feet can clear.
    """
    lifted = plan().clearance
    higher = plan(step=4, clearance=lifted + 0.02 * TRIPOD)
    words = "a revision of step 4 needs more clearance than its feet were lifted with"
    check = PlanCheck(PROFILE, AGE)
    assert check.untimely(higher, NOW, 4, False, TRIPOD, lifted) == words
    assert check.untimely(higher, NOW, 4, False, TRIPOD, ANY) == "", "they stand yet"
    assert check.untimely(higher, NOW, 3, False, ~TRIPOD, lifted) == "", "it is of the next step"
    same = plan(step=4, clearance=lifted + 0.02 * ~TRIPOD)
    assert check.untimely(same, NOW, 4, False, TRIPOD, lifted) == "", "of legs that stand it says nothing"


small = st.floats(-0.15, 0.15)
poses = st.builds(lambda x, y, z, r, p, w: from_xyz_rpy((x, y, 0.1 + z), (r, p, w)), small, small, small, small, small, small)
matrices = hnp.arrays(np.float64, (4, 4), elements=st.floats(-1e3, 1e3))


@pytest.mark.slow
@given(
    st.one_of(poses, matrices),
    st.one_of(st.just(np.eye(4)), poses, matrices),
    hnp.arrays(np.bool_, 6),
    hnp.arrays(np.float64, (6, 3), elements=st.floats(-0.05, 0.05)),
    st.floats(-1.0, 10.0),
    hnp.arrays(np.float64, 6, elements=st.floats(-0.1, 0.2)),
)
@settings(max_examples=150)
def test_accepted_random_plans_end_in_reach_and_stable(
    body_goal: Array, T_world_odom: Array, swing: Flags, shift: Array, duration: float, clearance: Array
) -> None:
    wild = plan(
        body_goal=body_goal,
        T_world_odom=T_world_odom,
        swing=swing,
        touchdown=np.clip(apply(body_goal, REST), -1e6, 1e6) + shift,
        duration=duration,
        clearance=clearance,
    )
    with np.errstate(all="ignore"):
        if refusal(wild):
            return
    body = inverse(wild.T_world_odom) @ wild.body_goal
    feet = np.where(swing[:, None], apply(inverse(wild.T_world_odom), wild.touchdown), FEET)
    assert within_limits(PROFILE, body_inverse(PROFILE, apply(inverse(body), feet))).all()
    assert support_margin(feet[~swing][:, :2], body[:2, 3]) > 0
    assert support_margin(FEET[~swing][:, :2], START[:2, 3]) > 0


def test_random_plan_property_is_not_vacuous() -> None:
    """Check that the property above is not vacuous: many plans pass."""
    rng = np.random.default_rng(5)
    passed = 0
    for _ in range(50):
        body = from_xyz_rpy((*rng.uniform(-0.03, 0.03, 2), 0.1), (0.0, 0.0, rng.uniform(-0.1, 0.1)))
        passed += refusal(plan(body_goal=body, touchdown=apply(body, REST))) == ""
    assert passed > 25
