"""Gaps with pillars, crossed in lockstep: surveyed, planned, and walked.

One leg moves at a time.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sextant.services.planner.gap_crossing.strip_survey import STRIP, TURNING_WIDTH
from sextant.shared.geometry import yaw_of
from sextant.shared.scenario.course import Course, Gap, Level
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.scenario.terrain import Box, Pillars, Plane
from sextant.shared.wire import topics
from tests.support.walks import walk

WANTED = (topics.PASSAGE_PLAN, topics.PASSAGE_REQUEST, topics.ACTUATOR_STATE, topics.PLANNER_STATUS)


def short_gap() -> Scenario:
    """Return the first third of a passage: a gap with one pillar on each side."""
    passage = load_scenario("passage1")
    course = Course((Level(1.3), Gap(0.315), Level(1.5)), 1.6)
    pillars = Pillars(((0.8575, 0.16), (0.8575, -0.16)), 0.10, 0.0, length=0.17, depth=0.4, jitter=0.01)
    return replace(passage, goal=replace(passage.goal, distance=1.2), terrain=(Plane(height=-0.4), course, pillars))


def bridge_aside(degrees: float) -> Scenario:
    """Return a passage whose two rows of pillars lead aside of the way, from the near edge of the gap on."""
    passage, direction = load_scenario("passage1"), np.radians(degrees)
    along, left = np.array([np.cos(direction), np.sin(direction)]), np.array([-np.sin(direction), np.cos(direction)])
    near = np.array([0.8, 0.0])  # [m] middle of the near edge
    boxes = tuple(
        Box(tuple(near + ahead * along + side * left), size=(0.17, 0.10), top=0.0, depth=0.4, yaw_deg=degrees)
        for ahead in (0.17, 0.43, 0.69)
        for side in (-0.16, 0.16)
    )
    course = Course((Level(1.4), Gap(0.8), Level(1.8)), 2.4)
    return replace(passage, goal=replace(passage.goal, distance=2.3), terrain=(Plane(height=-0.4), course, *boxes))


@pytest.mark.rare
def test_bridge_that_leads_aside_is_crossed_with_turns_of_the_body() -> None:
    found = walk(bridge_aside(22.0), 1000, WANTED)
    report = found.report
    assert report.success, report.reason
    assert (report.falls, report.shutdowns, report.passage.feet_off) == (0, 0, 0)
    assert report.min_stability_margin_m >= 0.02
    widths = [r.width for r in found.heard.of(topics.PASSAGE_REQUEST)]
    assert widths[0] == STRIP[1], "the crossing is tried straight on first"
    assert TURNING_WIDTH in widths
    yaws = [np.degrees(yaw_of(s.body_ref)) for s in found.states()]
    assert max(yaws) > 10.0


def uneven_pillars() -> Scenario:
    """Return a passage whose pillars are 4 cm higher and lower in turn, so that high ones hide low ones from before the gap."""
    passage, along = load_scenario("passage1"), (0.96, 1.2, 1.44)
    course = Course((Level(1.4), Gap(0.8), Level(1.8)), 1.6)
    high = tuple((x, side * 0.16) for x, side in zip(along, (1, -1, 1), strict=True))
    low = tuple((x, -y) for x, y in high)
    pillars = (Pillars(xy, 0.10, top, length=0.17, depth=0.4, jitter=0.01) for xy, top in ((high, 0.04), (low, -0.04)))
    return replace(passage, goal=replace(passage.goal, distance=2.3), terrain=(Plane(height=-0.4), course, *pillars))


@pytest.mark.rare
def test_pillars_of_changing_heights_are_crossed_with_looks_from_nearer() -> None:
    found = walk(uneven_pillars(), 1000, WANTED)
    report, plans = found.report, found.heard.of(topics.PASSAGE_PLAN)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns) == (0, 0)
    assert report.min_stability_margin_m >= 0.02
    assert [plan.state for plan in plans].count("partial") >= 1, "it goes nearer to see the hidden pillars"
    assert plans[-1].state == "complete"
    heights = np.concatenate([plan.body[:, 2] for plan in plans if plan.state != "no way"])
    assert np.ptp(heights) > 0.04


@pytest.mark.parametrize("scenario", [short_gap(), pytest.param(load_scenario("passage3"), marks=pytest.mark.rare)])
def test_robot_crosses_passage(scenario: Scenario) -> None:
    found = walk(scenario, 1000, WANTED)
    report, plans = found.report, found.heard.of(topics.PASSAGE_PLAN)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns, report.passage.feet_off) == (0, 0, 0)
    assert report.missteps <= 1  # next to an edge
    assert report.distance_m >= scenario.goal.distance
    assert report.min_stability_margin_m >= 0.02
    assert report.passage.pillar_touchdowns >= 6
    assert report.passage.foothold_edge_m.median >= 0.03
    assert [plan.state for plan in plans] == [section.state for section in report.passage.sections]
    assert len(plans) <= 4
    assert plans[-1].state == "complete"
    assert {(r.length, r.width) for r in found.heard.of(topics.PASSAGE_REQUEST)} == {STRIP}
    # The body is raised to look before the plan.
    before = [s.body_ref[2, 3] for s in found.states() if s.stamp_ns < plans[0].stamp_ns]
    assert max(before) > scenario.walk.body_height + 0.03
    # One leg at a time, and none goes far back.
    over_ns = max(s.stamp_ns for s in found.statuses() if s.reason.startswith("gap crossing"))
    crossing = [s for s in found.states() if plans[0].stamp_ns < s.stamp_ns < over_ns]
    assert max(int(s.swing.sum()) for s in crossing) == 1
    for plan in plans:
        for leg in range(6):
            ahead = plan.footholds[plan.leg == leg][:, 0].tolist()
            assert all(b > a - 0.05 for a, b in pairwise(ahead))


@pytest.mark.rare
def test_sinking_pillar_is_detected_by_touch_and_passage_is_replanned() -> None:
    found = walk(load_scenario("passage_gives_way"), 1000, WANTED)
    report, plans = found.report, found.heard.of(topics.PASSAGE_PLAN)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns) == (0, 0)
    assert len(plans) >= 2, "after a foot has sunk, the rest is planned again"
    statuses = found.heard.of(topics.PLANNER_STATUS)
    assert any(s.reason.startswith("surveying the gap again: ") for s in statuses)
