"""Detection of a gap on the straight way to a goal."""

from collections.abc import Callable

import numpy as np
import pytest

from sextant.services.planner.gap_crossing.gap_detection import GapEdge, detect_gap
from sextant.services.planner.gap_crossing.params import GapDetectionParams
from sextant.services.planner.navigation.params import CostmapParams
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array

Maker = Callable[..., Terrain]
MAX_STEP_M = CostmapParams().max_step_m
GOAL = np.array([1.6, 0.0])
HERE = np.array([0.0, 0.0])


def ditch(begin: float, end: float, floor: float = -0.4) -> Callable[[Array, Array], Array]:
    return lambda x, y: np.where((x > begin) & (x < end), floor, 0.0) + 0.0 * y


def score(begin: float, end: float) -> Callable[[Array, Array], Array]:
    return lambda x, y: np.where((x > begin) & (x < end), 9.0, 0.0) + 0.0 * y


@pytest.mark.parametrize("begin", [0.2, 0.437, 0.9])
@pytest.mark.parametrize("length", [0.1, 0.5])
def test_gap_edge_is_detected_at_end_of_ground(make_terrain: Maker, begin: float, length: float) -> None:
    terrain = make_terrain(ditch(begin, begin + length), score(begin, begin + length))
    found = detect_gap(terrain, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams())
    assert isinstance(found, GapEdge)
    assert found.distance == pytest.approx(begin, abs=0.021)
    assert found.heading == pytest.approx(0.0)


@pytest.mark.parametrize("width", [0.30, 0.33, 0.36])
def test_bridge_too_narrow_for_a_path_is_a_gap_and_a_rough_patch_is_not(make_terrain: Maker, width: float) -> None:
    def off(x: Array, y: Array) -> Array:
        return (x > 0.5) & (x < 1.2) & (np.abs(y) > width / 2)

    bridge = make_terrain(lambda x, y: np.where(off(x, y), -0.4, 0.0), lambda x, y: np.where(off(x, y), 9.0, 0.0))
    found = detect_gap(bridge, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams())
    assert isinstance(found, GapEdge)
    assert found.distance == pytest.approx(0.5, abs=0.021)
    rough = make_terrain(lambda x, y: 0.0 * x * y, lambda x, y: np.where(off(x, y) & (np.abs(y) > 0.17), 9.0, 0.0))
    assert isinstance(detect_gap(rough, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams()), str)


def test_level_ground_has_no_gap(make_terrain: Maker) -> None:
    assert (
        detect_gap(make_terrain(ditch(3.0, 4.0), score(3.0, 4.0)), HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams())
        == "no gap on the straight line to the goal"
    )


def test_ditch_narrower_than_step_is_not_gap(make_terrain: Maker) -> None:
    assert isinstance(
        detect_gap(make_terrain(ditch(0.5, 0.54), score(0.5, 0.54)), HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams()), str
    )


def test_wall_before_gap_is_reported(make_terrain: Maker) -> None:
    terrain = make_terrain(
        lambda x, y: np.where((x > 0.4) & (x < 0.6), 0.3, np.where(x > 0.9, -0.4, 0.0)) + 0.0 * y, score(0.38, 9.0)
    )
    found = detect_gap(terrain, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams())
    assert isinstance(found, str)
    assert "an obstacle" in found


def test_unseen_ground_is_not_gap(make_terrain: Maker) -> None:
    terrain = make_terrain(
        lambda x, y: np.where(x > 0.6, np.nan, 0.0) + 0.0 * y, lambda x, y: np.where(x > 0.6, np.nan, 0.0) + 0.0 * y
    )
    assert isinstance(detect_gap(terrain, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams()), str)


def test_gap_with_pillars_is_detected(make_terrain: Maker) -> None:
    def pillars(x: Array, y: Array) -> Array:
        return (np.abs(np.abs(y) - 0.17) < 0.05) & (np.abs(x % 0.2 - 0.1) < 0.05)

    def inside(x: Array) -> Array:
        return (x > 0.5) & (x < 1.3)

    terrain = make_terrain(
        lambda x, y: np.where(inside(x) & ~pillars(x, y), -0.4, 0.0),
        lambda x, y: np.where(inside(x) & ~pillars(x, y), 9.0, 0.0),
    )
    found = detect_gap(terrain, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams())
    assert isinstance(found, GapEdge)
    assert found.distance == pytest.approx(0.5, abs=0.021)


@pytest.mark.parametrize("short", [0.02, 0.05, 0.09, 0.11])
def test_gap_starting_just_before_goal_is_detected(make_terrain: Maker, short: float) -> None:
    """Check a goal above the gap, so near its edge that no wall could begin before it."""
    edge = float(GOAL[0]) - short
    terrain = make_terrain(ditch(edge, 9.0), score(edge, 9.0), half=2.0)
    found = detect_gap(terrain, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams())
    assert isinstance(found, GapEdge)
    assert found.distance == pytest.approx(edge, abs=0.021)


def test_wall_just_before_goal_is_reported(make_terrain: Maker) -> None:
    terrain = make_terrain(lambda x, y: np.where(x > 1.52, 0.3, 0.0) + 0.0 * y, score(1.5, 9.0), half=2.0)
    assert (
        detect_gap(terrain, HERE, GOAL, 0.0, MAX_STEP_M, GapDetectionParams())
        == "an obstacle blocks the straight line to the goal after 1.5 m"
    )
