"""Start of a gap crossing: by a goal that cannot be walked to, or by order.

The tests also cover the requests that are sent, and other commands that take over.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.approach import GapCrossingController
from sextant.services.planner.gap_crossing.gap_detection import GapEdge, detect_gap
from sextant.services.planner.gap_crossing.outcome import CannotCross, Completed, Outcome, Wait
from sextant.services.planner.gap_crossing.params import GapApproachParams, GapDetectionParams
from sextant.services.planner.navigation.params import CostmapParams
from sextant.services.planner.navigation.path_follower import MotionCommand
from sextant.services.planner.robot_estimate import WorldStance
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, yaw_of
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import Goal, Message, PassageRequest, PlannerStatus, StepPlan, TerrainMap, VelocityCommand
from tests.unit.planner.conftest import terrain_of
from tests.unit.planner.test_service import HEIGHT, Rig

EDGE = 0.6  # [m] x at which the gap begins
GOAL = Goal(0, np.array([[2.5, 0.0]]), 0.05, 0.1, HEIGHT, 0.03)


def gap(width: float = 9.0) -> TerrainMap:
    """Return level ground with a gap across the way, and drops all around further out."""

    def out(x: Array, y: Array) -> Array:
        beyond = (x > EDGE) & (x < EDGE + width)
        return beyond | (np.abs(y) > 0.75) | (x < -0.75)

    terrain: Terrain = terrain_of(
        lambda x, y: np.where(out(x, y), -0.4, 0.0), lambda x, y: np.where(out(x, y), 9.0, 0.0), half=3.0
    )
    return terrain.map


def walk_until_request(goal: Goal, map_: TerrainMap, cycles: int = 6000) -> tuple[Rig, list[Message]]:
    """Walk by the plans until the planner requests a strip or is blocked.

    Returns the rig and all messages.
    """
    rig = Rig()
    rig.command, rig.goal, rig.terrain = None, goal, map_
    heard: list[Message] = []
    for _ in range(cycles):
        said = rig.cycle()
        heard += said
        if any(isinstance(m, PassageRequest) for m in said):
            break
        if any(isinstance(m, PlannerStatus) and m.state == "blocked" for m in said):
            break
        for plan in (m for m in said if isinstance(m, StepPlan)):
            rig.begin(plan)
            rig.finish(plan)
            assert rig.pose is not None
            rig.pose = replace(rig.pose, T_world_body=rig.state.T_odom_body)
    return rig, heard


@pytest.mark.parametrize("ordered", [False, True])
def test_robot_walks_to_gap_edge_and_requests_passage_map(ordered: bool) -> None:
    rig, heard = walk_until_request(replace(GOAL, gap_crossing="always" if ordered else "if needed"), gap(0.8))
    request = heard[-1] if isinstance(heard[-1], PassageRequest) else next(m for m in heard if isinstance(m, PassageRequest))
    body = rig.state.T_odom_body
    assert body[0, 3] == pytest.approx(EDGE - 0.36, abs=0.07)
    assert abs(np.degrees(yaw_of(body) - np.arctan2(-body[1, 3], 2.5 - body[0, 3]))) < 2.0
    assert request.heading == pytest.approx(yaw_of(body), abs=np.radians(2.0))
    ahead = np.array([np.cos(request.heading), np.sin(request.heading)])
    np.testing.assert_allclose(request.origin, body[:2, 3] - 0.5 * ahead, atol=1e-6)


def test_goal_just_beyond_gap_edge_requests_passage_map() -> None:
    """Check a goal right behind an edge.

    The straight way to it shows neither a wall nor the gap's far edge.
    """
    rig, heard = walk_until_request(replace(GOAL, waypoints=np.array([[EDGE + 0.08, 0.0]])), gap())
    assert any(isinstance(m, PassageRequest) for m in heard)
    assert rig.status().state != "blocked"


def test_refusal_without_gap_names_path_and_obstacle() -> None:
    """Check that walls all around are not a gap."""
    terrain = terrain_of(
        lambda x, y: np.where(np.maximum(np.abs(x), np.abs(y)) > 0.6, 0.3, 0.0),
        lambda x, y: np.where(np.maximum(np.abs(x), np.abs(y)) > 0.58, 9.0, 0.0),
        half=3.0,
    )
    rig, _ = walk_until_request(GOAL, terrain.map)
    status = rig.status()
    assert status.state == "blocked"
    assert status.reason.startswith("no path to (2.5, 0.0)")
    assert "no gap crossing: an obstacle blocks the straight line to the goal after 0.6 m" in status.reason


def test_goal_without_gap_crossing_is_blocked_at_once_where_no_path_leads() -> None:
    rig, heard = walk_until_request(replace(GOAL, gap_crossing="never"), gap(0.8))
    status = rig.status()
    assert status.state == "blocked"
    assert status.reason.startswith("no path to (2.5, 0.0)")
    assert not status.invalid_command
    assert not any(isinstance(m, PassageRequest | StepPlan) for m in heard)


def test_velocity_command_overrides_gap_crossing() -> None:
    rig, _ = walk_until_request(replace(GOAL, gap_crossing="always"), gap(0.8))
    rig.command = VelocityCommand(0, np.array([-0.05, 0.0]), 0.0, HEIGHT, 0.03)
    said = [m for _ in range(40) for m in rig.cycle()]
    assert any(isinstance(m, StepPlan) and m.body_goal[0, 3] < rig.state.T_odom_body[0, 3] for m in said)
    assert not any(isinstance(m, PassageRequest) for m in said[1:])


def test_ordered_crossing_without_mapped_gap_requests_map_in_place() -> None:
    rig = Rig()
    rig.command, rig.goal = None, replace(GOAL, gap_crossing="always")
    heard = [m for _ in range(60) for m in rig.cycle()]
    assert not any(isinstance(m, StepPlan) for m in heard)
    request = next(m for m in heard if isinstance(m, PassageRequest))
    np.testing.assert_allclose(request.origin, [-0.5, 0.0], atol=1e-6)


@pytest.mark.parametrize("passage", [False, True])
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"waypoints": np.array([[1e9, 0.0]])}, "waypoints within 10000 m"),
        ({"body_height": -0.1}, "a body height of"),
        ({"lift": 3.0}, "a lift of"),
        ({"speed": 0.0}, "speed greater than 0"),
    ],
)
def test_invalid_goal_is_refused_with_reason(changes: dict[str, Any], words: str, passage: bool) -> None:
    rig = Rig()
    rig.command, rig.goal = None, replace(GOAL, gap_crossing="always" if passage else "if needed", **changes)
    assert rig.plans(20) == []
    assert rig.status().state == "blocked"
    assert words in rig.status().reason


def test_gap_detection_for_distant_goal_is_limited_to_map() -> None:
    terrain = Terrain(gap(0.8))
    near, far = (
        detect_gap(terrain, np.zeros(2), np.array([x, 0.0]), 0.0, CostmapParams().max_step_m, GapDetectionParams())
        for x in (2.5, 9e3)
    )
    assert isinstance(near, GapEdge)
    assert near == far


@pytest.mark.slow
def test_crossing_without_map_is_refused_and_retried_later() -> None:
    rig = Rig()
    rig.command, rig.goal = None, replace(GOAL, gap_crossing="always")
    rig.plans(400)  # 8 s
    assert rig.status().reason.startswith("no gap crossing: no valid map of the gap received from the mapper")
    asked_s = [t * 0.02 for t in range(3000) if any(isinstance(m, PassageRequest) for m in rig.cycle())]
    begun_s = [b for a, b in pairwise([-10.0, *asked_s]) if b - a > 5.0]
    patience_s = 20.0  # [s] that a client waits for a blocked planner after the refusal
    assert begun_s[0] < patience_s
    assert begun_s[1] - begun_s[0] > patience_s, "it is left alone for longer, so that a refusal stands in the end"


class BriefCrossing:
    """A crossing that ends at once."""

    report = None
    walked, straight_refusal = True, "all"
    outcome: Outcome = Completed("no gap ahead of the robot")

    def __init__(self, *_: object) -> None:
        """Start the crossing."""

    def advance(self, *_: object) -> Outcome:
        """Return the end."""
        return self.outcome


def at_the_edge() -> tuple[Rig, WorldStance]:
    """Return a robot that stands before the gap of `gap`, and its stance."""
    rig = Rig()
    body = rig.state.T_odom_body.copy()
    body[0, 3] = EDGE - GapApproachParams().start_distance_m
    return rig, WorldStance(body, apply(body, rig.state.feet))


@pytest.mark.parametrize("walked", [True, False])
def test_next_gap_is_crossed_unless_previous_survey_found_none(walked: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    crossings: list[object] = []

    class Crossing(BriefCrossing):
        """A crossing that is counted."""

        def __init__(self, *_: object) -> None:
            crossings.append(self)
            self.walked = walked

    monkeypatch.setattr("sextant.services.planner.gap_crossing.approach.GapCrossing", Crossing)
    (rig, standing), terrain = at_the_edge(), Terrain(gap(0.8))
    mode = GapCrossingController(load_profile("phantomx_mk2"), Settings())
    goal = replace(GOAL, gap_crossing="always")

    def ended() -> Outcome | MotionCommand:
        for k in range(100):
            state = replace(rig.state, stamp_ns=rig.state.stamp_ns + k * 20_000_000)
            found = mode.lead(goal, state, standing, standing.body, terrain, None, "")
            if isinstance(found, Completed | CannotCross):
                return found
        raise AssertionError("no end")

    assert ended() == Completed("no gap ahead of the robot")
    assert not mode.ordered(goal)
    assert ended() == (Completed("no gap ahead of the robot") if walked else CannotCross("no gap to cross was found from here"))
    assert len(crossings) == (2 if walked else 1)


def test_robot_rests_before_every_attempt_to_cross(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check a retry of a robot that still faces the gap: it has just come to rest again, and turns at once."""
    refused: list[object] = []

    class Crossing(BriefCrossing):
        """A crossing that records what it knows of earlier ones."""

        outcome = CannotCross("no path")

        def __init__(self, *given: object) -> None:
            refused.append(given[-1])

    monkeypatch.setattr("sextant.services.planner.gap_crossing.approach.GapCrossing", Crossing)
    (rig, standing), terrain = at_the_edge(), Terrain(gap(0.8))
    params = GapApproachParams()
    mode = GapCrossingController(load_profile("phantomx_mk2"), Settings())
    goal, now_ns = replace(GOAL, gap_crossing="always"), rig.state.stamp_ns
    for _ in range(2):
        begun_ns = now_ns
        while isinstance(
            mode.lead(goal, replace(rig.state, stamp_ns=now_ns), standing, standing.body, terrain, None, ""), Wait
        ):
            now_ns += 20_000_000
        assert (now_ns - begun_ns) * 1e-9 == pytest.approx(params.rest_s, abs=0.02)
        now_ns += round(params.refusal_s * 1e9)
    assert refused == ["", "all"]


def test_no_crossing_starts_before_its_search_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BriefCrossing, "outcome", CannotCross("no path"))
    monkeypatch.setattr("sextant.services.planner.gap_crossing.approach.GapCrossing", BriefCrossing)
    (rig, standing), terrain = at_the_edge(), Terrain(gap(0.8))
    compiled: list[bool] = []
    mode = GapCrossingController(load_profile("phantomx_mk2"), Settings(), lambda: bool(compiled))
    goal, now_ns = replace(GOAL, gap_crossing="always"), rig.state.stamp_ns

    def led() -> Outcome | MotionCommand:
        return mode.lead(goal, replace(rig.state, stamp_ns=now_ns), standing, standing.body, terrain, None, "")

    for _ in range(200):
        found = led()
        now_ns += 20_000_000
    assert found == Wait("waiting at the gap until the search of gap crossings is compiled")
    compiled.append(True)
    assert led() == CannotCross("no path")
