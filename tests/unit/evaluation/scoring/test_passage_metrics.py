"""Footholds on pillars, feet off the ground, and results of planning."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.evaluation import report as reports
from sextant.evaluation.report import FootholdEdge, Passage, Section
from sextant.evaluation.scoring.passage_metrics import feet_off, steps_of, tipped
from sextant.evaluation.trace.course import Course
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Pillars, Plane

PLATFORM = Box((0.0, 0.0), (1.0, 1.0), 0.0)
GAP = Scenario("gap", (Plane(height=-0.4), PLATFORM, Pillars(((0.7, 0.1), (0.9, -0.1)), 0.10, 0.02)), Goal(1.0))
N = 100


@given(st.floats(-0.049, 0.049), st.floats(-0.049, 0.049), st.floats(-3.0, 3.0))
def test_edge_distance_is_distance_to_nearest_side(x, y, yaw):
    course = Course(GAP, 0)
    T = from_xyz_rpy((0.3, -0.2, 0.5), (0.0, 0.0, yaw))
    course.lay(T, 0.0)
    seen = ((np.array([0.7 + x, 0.1 + y]) - T[:2, 3]) @ T[:2, :2])[None]
    assert course.edge_distance(seen)[0] == pytest.approx(0.05 - max(abs(x), abs(y)), abs=0.0008)


def test_adjacent_tops_merge_unless_heights_differ():
    row = tuple(Box((0.7 + 0.08 * k, 0.1), (0.081, 0.10), 0.0 if k < 3 else 0.03) for k in range(4))
    course = Course(replace(GAP, terrain=(Plane(height=-0.4), PLATFORM, *row)), 0)
    course.lay(np.eye(4), 0.0)
    joint, beside_a_step = np.array([[0.74, 0.1]]), np.array([[0.88, 0.1]])
    assert course.edge_distance(joint)[0] == pytest.approx(0.05, abs=0.0008)
    assert course.edge_distance(beside_a_step)[0] == pytest.approx(0.02, abs=0.0012)


def test_edge_distance_is_nan_off_pillars_and_on_platforms():
    course = Course(GAP, 0)
    course.lay(np.eye(4), 0.0)
    places = np.array([[0.7, 0.2], [0.0, 0.0], [0.49, 0.0], [2.0, 0.0]])
    assert np.isnan(course.edge_distance(places)).all()


def foot_and_ground_heights(**feet):
    """Return underside and ground heights (N, 6) of feet that stand at height 0.

    `feet` overrides a foot by its number: a pair of arrays (underside, ground).
    """
    underside, ground = np.zeros((N, 6)), np.zeros((N, 6))
    for leg, (under, below) in feet.items():
        underside[:, int(leg[1:])], ground[:, int(leg[1:])] = under, below
    return underside, ground


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize(
    ("under", "below"),
    [(0.0, -0.4), (0.0, -np.inf), (-0.4, -0.4), (-0.02, -0.4)],
    ids=["hung on an edge", "over an abyss", "on the floor of the gap", "slipped off"],
)
def test_unsupported_stance_foot_counts_as_off(leg, under, below):
    underside, ground = foot_and_ground_heights(**{f"f{leg}": (under, below)})
    swings = np.ones((N, 6), dtype=bool)
    assert feet_off(underside, ground, swings) == 1
    swings[:, leg] = False  # in the air by plan
    assert feet_off(underside, ground, swings) == 0


def test_feet_off_counts_each_sufficiently_long_interval():
    here = np.zeros(N, dtype=bool)
    here[10:20] = here[40:60] = here[80:83] = True  # 0.2 s, 0.4 s, and 0.06 s at the end of a swing
    underside, ground = foot_and_ground_heights(f2=(0.0, np.where(here, -0.4, 0.0)))
    assert feet_off(underside, ground, np.ones((N, 6), dtype=bool)) == 2


@given(st.lists(st.floats(-0.03, 0.03), min_size=6, max_size=6), st.floats(-0.003, 0.003))
def test_supported_feet_are_not_off_at_any_ground_height(heights, dent):
    ground = np.tile(heights, (N, 1))
    assert feet_off(ground + dent, ground, np.ones((N, 6), dtype=bool)) == 0


def test_passage_round_trips_through_table():
    sections = (
        Section("partial", "look again", 900, 70, 12.5, 30),
        Section("no way", "too wide", 5, 1, float("nan"), 0),
    )
    passage = Passage(31, FootholdEdge(0.03, 0.045), 1, False, sections)
    table = reports.plain(passage)
    assert reports.check(table, Passage) == []
    assert repr(reports.passage_of(table)) == repr(passage), "compared as text: what was not measured is NaN"
    assert reports.plain(reports.passage_of(reports.plain(Passage()))) == reports.plain(Passage())


def test_invalid_passage_fields_are_named():
    table = reports.plain(Passage(sections=(Section("partial", "", 1, 1, 1.0, 1),)))
    table["sections"][0]["expanded"] = "many"
    table |= {"passable": 1}
    assert reports.check(table, Passage) == [
        "passable: true, false or null expected, found int '1'",
        "sections[0].expanded: int expected, found str 'many'",
    ]
    assert reports.check(table | {"sections": 3}, Passage)[-1] == "sections: a list expected, found int '3'"


def test_without_timing_drops_planning_times(story):
    report = story().judged().result()
    fast, slow = (replace(report, passage=Passage(sections=(Section("complete", "", 9, 8, ms, 3),))) for ms in (1.0, 2.0))
    assert reports.to_json(fast) != reports.to_json(slow)
    assert reports.to_json(reports.without_timing(fast)) == reports.to_json(reports.without_timing(slow))
    other = replace(report, passage=Passage(sections=(Section("complete", "", 9, 7, 1.0, 3),)))
    assert reports.to_json(reports.without_timing(fast)) != reports.to_json(reports.without_timing(other))


# -- by the scorer

EITHER = Scenario("either", (Plane(),), Goal(0.5, expect="either"))


@pytest.mark.slow
def test_report_contains_planner_sections(story):
    passage = story(sections=2).judged().result().passage
    assert [(s.state, s.generated, s.expanded, s.steps) for s in passage.sections] == [
        ("partial", 100, 10, 12),
        ("partial", 200, 20, 12),
    ]
    assert story().judged().result().passage.sections == ()


def test_section_steps_count_only_leg_steps(story):
    plan = story(sections=1).section(0, 1)
    assert steps_of(plan) == 12
    assert steps_of(replace(plan, leg=np.array([0, 6, *range(6), 6, 1, 2, 3], dtype=np.uint8))) == 10
    assert steps_of(replace(plan, state="no way")) == 0


def test_level_ground_has_no_feet_off_and_no_pillar_touchdowns(story):
    passage = story().judged().result().passage
    assert (passage.feet_off, passage.pillar_touchdowns) == (0, 0)
    assert np.isnan(passage.foothold_edge_m.median)


@pytest.mark.slow
def test_feet_over_gap_are_counted_as_off(story):
    gap = Scenario("gap", (Plane(height=-0.4), Box((0.0, 0.0), (0.8, 2.0), 0.0), Box((1.2, 0.0), (0.8, 2.0), 0.0)), Goal(0.5))
    level = story(scenario=replace(gap, terrain=(Plane(),)))
    bare = level.judged().result()
    told = story(scenario=gap, level=True).judged().result()
    assert bare.passage.feet_off == 0
    assert told.passage.feet_off > 5
    assert told.missteps < told.passage.feet_off  # the floor below would carry a foot


@pytest.mark.slow
def test_pillar_footholds_edge_distance_is_measured(story):
    """Walk on one row of narrow slabs along the way, in place of the plane."""
    slabs = tuple(Box((1.0, y), (3.0, 0.16), 0.0) for y in sorted({round(float(f), 3) for f in story().planted(0)[:, 1]}))
    scenario = Scenario("slabs", (Plane(height=-0.4), *slabs), Goal(0.5))
    passage = story(scenario=scenario, level=True).judged().result().passage
    assert passage.feet_off == 0
    assert passage.pillar_touchdowns == 30
    assert passage.foothold_edge_m.median == pytest.approx(0.08, abs=0.001)
    assert passage.foothold_edge_m.p05 <= passage.foothold_edge_m.median


@pytest.mark.slow
@pytest.mark.parametrize(
    ("passable", "arrives", "right"),
    [
        (None, True, True),
        (None, False, True),
        (True, True, True),
        (True, False, False),
        (False, True, False),
        (False, False, True),
    ],
)
def test_success_depends_on_passability_of_random_gap(story, passable, arrives, right):
    told = story(scenario=EITHER, tail_s=12.0) if arrives else story(scenario=EITHER, beyond=-0.2, tail_s=12.0, refusal="a gap")
    result = replace(told, passable=passable).judged().result()
    assert result.success == right
    assert result.passage.passable is passable
    assert (result.reason == reports.ARRIVED) == (arrives and right)


@pytest.mark.slow
def test_stopping_on_pillar_is_not_a_refusal(story):
    slabs = tuple(Box((1.0, y), (3.0, 0.16), 0.0) for y in sorted({round(float(f), 3) for f in story().planted(0)[:, 1]}))
    scenario = Scenario("slabs", (Plane(height=-0.4), *slabs), Goal(0.5, expect="either"))
    told = story(scenario=scenario, level=True, beyond=-0.2, tail_s=12.0, refusal="a gap")
    assert not told.judged().result().success


@pytest.mark.parametrize(("depth", "carries", "count"), [(0.005, True, 0), (0.015, True, 1), (0.015, False, 0)])
def test_foot_on_a_low_top_counts_as_tipped(depth, carries, count):
    top = np.array([[0.5, 0.0, -0.02]]), np.array([[0.1, 0.1, 0.02]]), np.eye(3)[None]
    feet = np.full((N, 6, 3), 9.0)
    feet[:, 2] = 0.45, 0.02, 0.01
    feet[40:80, 2, 2] -= depth
    assert tipped(feet, np.full((N, 6), carries), 0.01, top) == count
