"""Traversability: steps, walls, gaps, holes and unseen ground."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.planner.navigation.params import CostmapParams
from sextant.services.planner.navigation.traversability import (
    BARE,
    HOLE,
    OPEN,
    STEP,
    STUCK,
    CostMap,
    LocalGroundMap,
    RequiredSpace,
)
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile

CAMERA = load_profile("phantomx_mk2").camera
PARAMS = CostmapParams()
SIZE = RequiredSpace(0.25, 0.18, 0.40)
HERE = from_xyz_rpy((0.0, 0.0, 0.1), np.zeros(3))
NOWHERE = np.zeros((0, 2))
Maker = Callable[..., Terrain]


def cost_map_of(terrain: Terrain, stuck: Array = NOWHERE) -> CostMap:
    ground = LocalGroundMap(PARAMS)
    ground.add_map(terrain, HERE, CAMERA, 0.0)
    return ground.cost_map(SIZE, np.zeros(3), stuck, 0.08)


def kinds(found: CostMap) -> set[int]:
    return set(np.unique(found.stops).tolist())


def edges(height: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Array]:
    """Return a score that allows no foot within 2 cm of a height jump or the unknown."""

    def score(x: Array, y: Array) -> Array:
        offsets = [(0.02 * np.cos(a), 0.02 * np.sin(a)) for a in np.arange(8) * np.pi / 4]
        around = np.array([height(x + dx, y + dy) for dx, dy in offsets])
        return np.where(np.ptp(around, axis=0) > 0.01, 9.0, np.where(np.isnan(height(x, y)), np.nan, 0.0))

    return score


def ditch_height(depth: float, width: float) -> Callable[[Array, Array], Array]:
    """Return level ground with a ditch across, from x = 0.6 m on."""
    return lambda x, y: np.where((x > 0.602) & (x < 0.602 + width), -depth, 0.0)


def test_level_ground_has_unit_cost(make_terrain: Maker) -> None:
    found = cost_map_of(make_terrain(half=1.28))
    assert kinds(found) == {OPEN}
    assert found.cost[found.cell(np.zeros(2))] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("rise", "stops"), [(0.03, OPEN), (0.05, OPEN), (0.08, STEP), (0.3, STEP), (-0.05, OPEN), (-0.2, STEP)]
)
def test_low_step_is_traversable_and_wall_is_not(rise: float, stops: int, make_terrain: Maker) -> None:
    def height(x: Array, y: Array) -> Array:
        return np.where(x > 0.6, rise, 0.0)

    found = cost_map_of(make_terrain(height, edges(height), half=1.28))
    assert kinds(found) == {OPEN, stops}
    at = found.cell(np.array([0.62 if rise > 0 else 0.58, 0.0]))
    assert found.stops[at] == stops
    near = found.cost[found.cell(np.array([0.45, 0.0]))]
    assert np.isinf(near) if stops == STEP else 1.0 < near < 6.0
    assert np.isfinite(found.cost[found.cell(np.array([0.30, 0.0]))])


def test_slope_is_traversable(make_terrain: Maker) -> None:
    assert np.tan(np.radians(20.0)) * 0.15 < PARAMS.max_step_m
    assert kinds(cost_map_of(make_terrain(lambda x, y: np.tan(np.radians(20.0)) * x, half=1.28))) == {OPEN}


@pytest.mark.parametrize(("width", "open_"), [(0.06, True), (0.10, True), (0.40, False)])
def test_narrow_ditch_is_traversable_and_wide_one_is_not(width: float, open_: bool, make_terrain: Maker) -> None:
    height = ditch_height(0.3, width)
    found = cost_map_of(make_terrain(height, edges(height), half=1.28))
    assert (kinds(found) == {OPEN}) is open_
    row = found.cost[:, found.cell(np.zeros(2))[1]]
    assert np.isinf(row).any() != open_
    assert row[found.cell(np.array([0.62, 0.0]))[0]] > 1.2, "it is dear"


@pytest.mark.parametrize(
    ("half", "beside", "open_"), [(0.15, -0.4, False), (0.22, -0.4, True), (0.22, 0.3, False), (0.35, 0.3, True)]
)
@pytest.mark.parametrize("shows", [True, False])
def test_lane_between_holes_may_be_narrower_than_between_walls(
    half: float, beside: float, open_: bool, shows: bool, make_terrain: Maker
) -> None:
    """Check a lane along x between ground that is too high, too low or not shown.

    Lower ground may be unseen.
    """
    lower = beside if shows or beside > 0.0 else np.nan

    def height(x: Array, y: Array) -> Array:
        return np.where(np.abs(y) > half, lower, 0.0) + 0.0 * x

    ground, terrain = LocalGroundMap(PARAMS), make_terrain(height, edges(height), half=1.28)
    for _ in range(4):
        ground.add_map(terrain, HERE, CAMERA, 0.0)
    found = ground.cost_map(SIZE, np.zeros(3), NOWHERE, 0.08)
    assert np.isfinite(found.cost[found.cell(np.array([0.7, 0.0]))]) == open_


def test_required_space_on_top_of_wall_is_that_next_to_hole(make_terrain: Maker) -> None:
    def height(x: Array, y: Array) -> Array:
        return np.where(x > 0.6, 0.3, 0.0)

    terrain, places = make_terrain(height, edges(height), half=1.28), ((0.43, 0.0), (0.82, 0.0))
    ground = LocalGroundMap(PARAMS)
    ground.add_map(terrain, HERE, CAMERA, 0.0)
    found = ground.cost_map(SIZE, np.zeros(3), NOWHERE, 0.08)
    below, above = (found.cell(np.array(place)) for place in places)
    assert np.isinf(found.cost[below])
    assert np.isfinite(found.cost[above])
    assert (found.needs[below], found.needs[above]) == (SIZE.half_width, SIZE.beside_hole)


def test_wide_stretch_without_footholds_is_closed(make_terrain: Maker) -> None:
    wide = cost_map_of(make_terrain(score=lambda x, y: np.where((x > 0.5) & (x < 0.9), 9.0, 0.0), half=1.28))
    assert kinds(wide) == {OPEN, BARE}
    narrow = cost_map_of(make_terrain(score=lambda x, y: np.where((x > 0.5) & (x < 0.6), 9.0, 0.0), half=1.28))
    assert kinds(narrow) == {OPEN}


def test_unseen_ground_is_open_but_costly_most_near_robot(make_terrain: Maker) -> None:
    def height(x: Array, y: Array) -> Array:
        return np.where(y > 0.3, np.nan, 0.0)

    found = cost_map_of(make_terrain(height, height, half=1.28))
    assert kinds(found) == {OPEN}
    seen, far, beside = (found.cost[found.cell(np.array(place))] for place in ((0.9, -0.6), (0.9, 0.9), (0.0, 0.4)))
    assert seen == pytest.approx(1.0)
    assert 1.0 < far < 3.0
    assert beside > 5.0


@pytest.mark.parametrize("yaw", [-2.0, 0.0, 1.0, 3.0])
def test_cost_of_unseen_ground_grows_with_turn_angle(yaw: float, make_terrain: Maker) -> None:
    def height(x: Array, y: Array) -> Array:
        return np.where(np.hypot(x, y) > 0.55, np.nan, 0.0)

    ground = LocalGroundMap(PARAMS)
    ground.add_map(make_terrain(height, height, half=1.28), HERE, CAMERA, 0.0)
    found = ground.cost_map(SIZE, np.array([0.0, 0.0, yaw]), NOWHERE, 0.08)
    off = yaw + np.array([0.0, 0.6, 1.2, 1.8, 2.4, 3.1])
    for side in (off, 2.0 * yaw - off):
        costs = found.at(found.cost, np.column_stack([np.cos(side), np.sin(side)]))
        assert (np.diff(costs) > 0.2).all()
    at = found.cell(np.zeros(2))
    assert found.cost[at] == pytest.approx(1.0), "seen ground costs the same in every heading"


def test_unseen_ground_in_view_is_hole_unless_occluded(make_terrain: Maker) -> None:
    def hole(x: Array, y: Array) -> Array:
        return np.where((x > 0.8) & (x < 1.1) & (np.abs(y) < 0.2), np.nan, 0.0)

    def behind(x: Array, y: Array) -> Array:
        return np.where((x > 0.7) & (x < 0.8), 0.3, hole(x, y))

    for height, expected in ((hole, {OPEN, HOLE}), (behind, {OPEN, STEP})):
        ground, terrain = LocalGroundMap(PARAMS), make_terrain(height, height, half=1.28)
        for _ in range(6):
            ground.add_map(terrain, HERE, CAMERA, 0.0)
        found = ground.cost_map(SIZE, np.zeros(3), NOWHERE, 0.08)
        assert kinds(found) == expected


def test_place_of_stall_is_closed(make_terrain: Maker) -> None:
    found = cost_map_of(make_terrain(half=1.28), np.array([[0.5, 0.0]]))
    assert kinds(found) == {OPEN, STUCK}
    assert np.isinf(found.cost[found.cell(np.array([0.4, 0.1]))])


def test_seen_ground_is_kept_when_map_moves(make_terrain: Maker) -> None:
    ground = LocalGroundMap(PARAMS)

    def wall(x: Array, y: Array) -> Array:
        return np.where((x > 0.5) & (x < 0.7), 0.3, 0.0)

    for x in np.arange(0.0, 2.1, 0.5):
        terrain = make_terrain(wall, edges(wall), half=1.0, origin=(float(x), 0.0))
        ground.add_map(terrain, from_xyz_rpy((x, 0.0, 0.1), np.zeros(3)), CAMERA, 0.0)
    found = ground.cost_map(SIZE, np.array([2.0, 0.0, 0.0]), NOWHERE, 0.08)
    assert found.stops[found.cell(np.array([0.52, 0.0]))] == STEP
    assert not found.unseen[found.cell(np.array([-0.8, 0.5]))]
    assert found.unseen[found.cell(np.array([2.0, 1.5]))]


@pytest.mark.parametrize("cells", [1, 2, 7])
@pytest.mark.parametrize("at", [0.0, 0.013, -1.0])
def test_maps_of_few_cells_are_accepted(cells: int, at: float, make_terrain: Maker) -> None:
    whole = make_terrain(half=0.1, origin=(at, at)).map
    names = ("elevation", "variance", "score", "assumed", "evaluation")
    found = cost_map_of(Terrain(replace(whole, **{name: getattr(whole, name)[:cells, :cells] for name in names})))
    assert found.unseen.mean() > 0.99
