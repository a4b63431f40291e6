"""The scorer's answer whether a random gap can be crossed.

It uses the true ground alone, and only on request.
"""

from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.scoring import passage_truth
from sextant.evaluation.scoring.passage_truth import decided_by_seed, gap_begins, strip_from, way_exists
from sextant.evaluation.trace.course import Course
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import PillarField, Plane

PROFILE = load_profile("phantomx_mk2")
FIELD = load_scenario("pillar_field")


def with_density(density: float) -> Scenario:
    parts = [replace(p, density=(density, density)) if isinstance(p, PillarField) else p for p in FIELD.terrain]
    return replace(FIELD, terrain=tuple(parts))


def course_of(scenario: Scenario, x: float = 0.0, yaw: float = 0.0) -> Course:
    course = Course(scenario, 1000)
    course.lay(from_xyz_rpy((x, 0.0, 0.1), (0.0, 0.0, yaw)), 0.0)
    return course


def test_only_random_pillar_fields_depend_on_seed() -> None:
    assert decided_by_seed(FIELD)
    assert not decided_by_seed(load_scenario("passage1"))
    assert not decided_by_seed(replace(FIELD, goal=replace(FIELD.goal, expect="arrival")))


@pytest.mark.parametrize("x", [-0.02, 0.0, 0.02])
def test_gap_begin_matches_terrain(x: float) -> None:
    assert gap_begins(course_of(FIELD, x), 2.3) == pytest.approx(0.8 - x, abs=0.011)
    assert gap_begins(course_of(Scenario("level", (Plane(),), Goal(2.0))), 2.0) == 2.0


def test_strip_elevation_matches_simulated_ground() -> None:
    course = course_of(FIELD, 0.01, 0.03)
    field = strip_from(course, -0.1, 0.105)
    i, j = np.random.default_rng(0).integers(0, field.elevation.shape, (200, 2)).T
    xy = np.column_stack([i, j]) * field.resolution + field.first_cell + [-0.1, 0.0]
    np.testing.assert_allclose(field.elevation[i, j], course.height_at(xy), atol=1e-6)


@pytest.mark.slow
def test_gap_without_pillars_is_impassable(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {}
    monkeypatch.setattr(
        passage_truth,
        "passable",
        lambda profile, settings, *told: found.setdefault("way", _one_attempt(profile, settings, *told)),
    )
    assert way_exists(PROFILE, with_density(0.0), course_of(with_density(0.0))) is False
    assert found == {"way": False}


def _one_attempt(*told: object) -> bool | None:
    from sextant.services.planner.roadmap.exhaustive import passable

    return passable(*told, attempts=1)  # type: ignore[arg-type]


def test_gap_full_of_pillars_is_passable() -> None:
    full = replace(FIELD, terrain=(*with_density(0.0).terrain, PillarField((0.8, 1.6), (-0.6, 0.6), (0.0, 0.0), 0.12, 0.0)))
    bridge = replace(full, terrain=(*full.terrain, *load_scenario("passage1").terrain[2:]))
    assert way_exists(PROFILE, bridge, course_of(bridge))


@pytest.mark.slow
@pytest.mark.parametrize("way", [True, False, None])
def test_scorer_checks_passability_once_if_seed_decides(story, way, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(passage_truth, "way_exists", lambda *of: (asked.append(of), way)[1])
    goal = Goal(0.5, route=True, passage=True, expect="either")
    strewn = Scenario("strewn", (Plane(), PillarField((0.0, 1.0), (-0.5, 0.5), (0.0, 0.0), 0.12, 0.0)), goal)
    scorer = story(scenario=strewn, tail_s=12.0).judge()
    results = [scorer.result(in_a_hurry=True), scorer.result(), scorer.result()]
    assert [result.passage.passable for result in results] == [None, way, way]
    assert [result.success for result in results] == [True, way is not False, way is not False]
    assert len(asked) == 1
    plain = story(scenario=replace(strewn, terrain=(Plane(),)), tail_s=12.0).judge()
    assert plain.result().passage.passable is None
    assert len(asked) == 1
