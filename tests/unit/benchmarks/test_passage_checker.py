"""The checker finds errors in spoiled plans, and none in the roadmap's plans."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peers import passage as bench
from benchmarks.peers.passage_checker import Demands, violations
from benchmarks.peers.passage_strips import BEYOND, NEAR, START, heights, random_blocks, thesis_blocks
from sextant.evaluation.scoring.passage_truth import stance_at
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.roadmap.backtracking import StepHistory
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import PassageStep, Roadmap, SectionPlan, Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
GAP, HEIGHT = 0.8, 0.11
START_STANCE = stance_at(PROFILE, START, HEIGHT)


def bridge_field(scenario: int) -> StripMap:
    return strip_of(heights(thesis_blocks(scenario, GAP, 0.17, 0.20, 0.03, 0.28), GAP))


def scattered_field(seed: int, relief: float) -> StripMap:
    return strip_of(heights(random_blocks(np.random.default_rng(seed), GAP, 0.12, 0.9, 0.10, relief), GAP))


@pytest.fixture(scope="module")
def roadmap() -> Roadmap:
    return Roadmap(PROFILE, PassageSettings(body_height=HEIGHT))


def planned_crossing(roadmap: Roadmap, field: StripMap, seed: int) -> SectionPlan:
    roadmap.begin(field, START_STANCE, NEAR + GAP + BEYOND, seed)
    found = roadmap.grow(10**6)
    assert isinstance(found, SectionPlan)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [1, 2, 3])
def test_bridge_plans_have_no_violations(roadmap: Roadmap, scenario: int) -> None:
    field = bridge_field(scenario)
    assert violations(PROFILE, field, START_STANCE, planned_crossing(roadmap, field, scenario).steps) == []


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "relief"), [(1, 0.0), (2, 0.0), (3, 0.015), (4, 0.015)])
def test_scattered_pillar_plans_have_no_violations(roadmap: Roadmap, seed: int, relief: float) -> None:
    field = scattered_field(seed, relief)
    assert violations(PROFILE, field, START_STANCE, planned_crossing(roadmap, field, seed).steps) == []


@pytest.mark.parametrize("seed", [1000, 1001])
@pytest.mark.parametrize("done", [20, 44])
def test_backtracking_plan_has_no_violations(roadmap: Roadmap, seed: int, done: int) -> None:
    field = bench.ground("scenario 3", seed)
    steps, feet = planned_crossing(roadmap, field, seed).steps[:done], START_STANCE.feet.copy()
    for step in steps:
        if step.leg >= 0:
            feet[step.leg] = step.touchdown
    trail = StepHistory()
    trail.begin(START_STANCE, steps)
    back = trail.back([], 0.05)
    assert len(back) >= 3
    assert violations(PROFILE, field, Stance(steps[-1].body, feet), back) == []


@pytest.mark.slow
def test_steep_swing_near_coxa_keeps_leg_clearance() -> None:
    """Keep the distance between legs where a foot rises steeply near its coxa.

    The foot is pushed outward there. In one of a thousand plans, this one, the legs once came too near.
    """
    field, roadmap = bench.ground("scenario 3", 1205), Roadmap(PROFILE, PassageSettings(body_height=bench.HEIGHT))
    start = stance_at(PROFILE, START, bench.HEIGHT)
    roadmap.begin(field, start, NEAR + GAP + BEYOND, seed=1)
    found = roadmap.grow(10**6)
    assert isinstance(found, SectionPlan)
    assert violations(PROFILE, field, start, found.steps) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda step: replace(step, touchdown=step.touchdown + np.array([0.0, 0.0, 0.02])), "over the ground"),
        (lambda step: replace(step, touchdown=step.touchdown + np.array([0.4, 0.0, 0.0])), "out of reach"),
        (lambda step: replace(step, body=step.body + np.array([0.12, 0.0, 0.0])), "the body moves"),
        (lambda step: replace(step, body=step.body - np.array([0.0, 0.0, 0.08])), "the trunk"),
        (lambda step: replace(step, clearance=0.001), "passes"),
        (lambda step: replace(step, clearance=0.2), "clearance"),
        (lambda step: replace(step, clearance=np.nan), "clearance"),
        (lambda step: replace(step, touchdown=step.touchdown * np.nan), "none that could be taken"),
        (lambda step: replace(step, body=np.full(3, np.inf)), "none that could be taken"),
        (lambda step: replace(step, leg=6), "none that could be taken"),
        (lambda step: replace(step, touchdown=step.touchdown + np.array([9.0, 0.0, 0.0])), "outside the strip"),
    ],
)
def test_corrupted_step_is_detected(roadmap: Roadmap, spoil: Callable[[PassageStep], PassageStep], said: str) -> None:
    field = bridge_field(1)
    steps = list(planned_crossing(roadmap, field, 1).steps)
    at = next(k for k, step in enumerate(steps) if step.leg >= 0 and k > 3)
    steps[at] = spoil(steps[at])
    assert any(said in words for words in violations(PROFILE, field, START_STANCE, steps[: at + 1]))


@pytest.mark.slow
def test_foot_off_foothold_is_detected(roadmap: Roadmap) -> None:
    field = bridge_field(1)
    steps = planned_crossing(roadmap, field, 1).steps
    bare = StripMap(field.elevation, np.full_like(field.evaluation, 3), field.resolution, field.T_world_strip)
    assert any("on a cell of value 3" in words for words in violations(PROFILE, bare, START_STANCE, steps))


def test_too_close_feet_and_legs_are_detected() -> None:
    rear, middle = START_STANCE.feet[4], START_STANCE.feet[5]
    assert np.linalg.norm(rear - middle) > 0.1
    step = PassageStep(4, middle - np.array([0.04, 0.0, 0.0]), 0.03, START_STANCE.body, 0.03)
    words = violations(PROFILE, bridge_field(1), START_STANCE, [step])
    assert any("rear foot 0.040 m from another" in each for each in words)
    assert any("legs" in each and "apart" in each for each in words)


def test_overloaded_joint_is_detected() -> None:
    demands = Demands(torque=0.05)
    stay = PassageStep(-1, START_STANCE.body, 0.0, START_STANCE.body, 0.03)
    assert violations(PROFILE, bridge_field(1), START_STANCE, [stay]) == []
    assert any(" N m at the " in words for words in violations(PROFILE, bridge_field(1), START_STANCE, [stay], demands))


def test_ground_collision_is_detected_up_to_trunk_corner() -> None:
    length, width, height = PROFILE.body.size
    stay = PassageStep(-1, START_STANCE.body, 0.0, START_STANCE.body, 0.03)
    for inside in (np.array([length, width]) / 2, np.full(2, 0.004)):  # [m] from the corner
        field = bridge_field(1)
        elevation = field.elevation.copy()
        place = START_STANCE.body[:2] + np.array([length, width]) / 2 - inside
        i, j = np.rint((place - field.first_cell) / field.resolution).astype(int)
        elevation[i, j] = START_STANCE.body[2] - height / 2 - 0.01
        risen = replace(field, elevation=elevation)
        assert any("the trunk 0.010 m over" in words for words in violations(PROFILE, risen, START_STANCE, [stay]))


def test_body_outside_support_polygon_is_detected() -> None:
    leant = replace(START_STANCE, body=START_STANCE.body + np.array([0.0, 0.19, 0.0]))
    stay = PassageStep(-1, leant.body, 0.0, leant.body, 0.03)
    assert any("inside its standing feet" in words for words in violations(PROFILE, bridge_field(1), leant, [stay]))
