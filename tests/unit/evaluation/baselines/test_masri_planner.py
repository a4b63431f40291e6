"""Masri's planner as published: it makes his tests, and no others."""

import numpy as np
import pytest

from benchmarks.peers.passage import HEIGHT, ground
from benchmarks.peers.passage_strips import BEYOND, FLOOR, GAP, NEAR, START, heights
from sextant.evaluation.baselines.masri_planner import SECTIONS, Crossing, MasriPlanner
from sextant.evaluation.scoring.passage_truth import stance_at
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
STANCE = stance_at(PROFILE, START, HEIGHT)
GOAL = NEAR + GAP + BEYOND
GAIT = (3, 2, 1, 4, 5, 0)
CASES = ("scenario 1", "scenario 2", "scenario 3")


@pytest.fixture(scope="module")
def planner() -> MasriPlanner:
    return MasriPlanner(PROFILE)


def walked(field: StripMap, crossing: Crossing) -> None:
    """Check a crossing by his tests, in separate code."""
    length, width, _ = PROFILE.body.size
    feet, body, due = STANCE.feet.copy(), STANCE.body, 0
    for step in crossing.steps:
        due = due if step.leg == GAIT[due] else 0  # a section begins
        assert step.leg == GAIT[due]
        due = (due + 1) % 6
        assert np.linalg.norm((step.body - body)[:2]) <= 0.035 + 1e-9
        feet[step.leg], body = step.touchdown, step.body
        local = feet - body
        assert within_limits(PROFILE, body_inverse(PROFILE, local)).all()
        assert not ((np.abs(local[:, 0]) < length / 2) & (np.abs(local[:, 1]) < width / 2)).any()
        assert (local[:2, 0] >= length / 2).all()
        assert (local[3:5, 0] <= -length / 2).all()
        apart = np.linalg.norm(feet[:, None, :2] - feet[None, :, :2], axis=-1)[~np.eye(6, dtype=bool)]
        assert apart.min() >= 0.06
        i, j = np.rint((step.touchdown[:2] - field.first_cell) / field.resolution).astype(int)
        assert -127 <= field.evaluation[i, j] <= -1
        assert step.touchdown[2] == pytest.approx(field.elevation[i, j] + PROFILE.foot.radius)


@pytest.mark.parametrize("case", CASES)
def test_crossings_pass_his_tests_and_reach_the_goal(planner: MasriPlanner, case: str) -> None:
    solved = 0
    for seed in range(1000, 1004):
        field = ground(case, seed)
        found = planner.plan(field, STANCE, GOAL)
        walked(field, found)
        solved += found.complete
        if found.complete:
            assert found.steps[-1].body[0] >= GOAL
            assert len(found.generated) == len(found.expanded) == SECTIONS
    assert solved >= 2


def test_same_seed_gives_the_same_plan(planner: MasriPlanner) -> None:
    field = ground("scenario 1", 1000)
    first, second = (planner.plan(field, STANCE, GOAL, seed=7) for _ in range(2))
    assert first.generated == second.generated
    assert [step.touchdown.tolist() for step in first.steps] == [step.touchdown.tolist() for step in second.steps]


def test_margin_tells_that_the_centre_of_mass_leaves_the_feet(planner: MasriPlanner) -> None:
    least = []
    for seed in range(1000, 1010):
        found = planner.plan(ground("scenario 1", seed), STANCE, GOAL)
        least.append(min(step.margin for step in found.steps))
    assert min(least) < 0.0 < max(least)


def test_gap_without_pillars_has_no_plan(planner: MasriPlanner) -> None:
    field = strip_of(heights([], GAP), HEIGHT)
    assert field.elevation.min() == np.float32(FLOOR)
    found = planner.plan(field, STANCE, GOAL)
    assert not found.complete
    assert all(step.touchdown[0] < NEAR for step in found.steps)
