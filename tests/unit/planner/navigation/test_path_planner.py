"""Path planner: the cheapest path, never over closed cells, or a reason."""

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.planner.navigation.path_planner import (
    NoPath,
    PlannedPath,
    cheapest_cells,
    cost_of,
    find_path,
    find_widest_path,
    straightened,
)
from sextant.services.planner.navigation.traversability import BARE, FAR, HOLE, OPEN, STEP, CostMap
from sextant.shared.geometry import Array

EDGE = 0.05


def obstacle_name(kind: int) -> str:
    return cost_map(np.ones((1, 1))).obstacle_name(kind)


HALF = 0.25  # [m] half of the robot's width


def cost_map(cost: Array, stops: Array | None = None) -> CostMap:
    """Return ground with given costs, where closed cells are steps."""
    closed = np.isinf(cost)
    kinds = np.where(closed, STEP, OPEN) if stops is None else stops
    cells = np.argwhere(closed)
    grid = np.indices(cost.shape).transpose(1, 2, 0)
    far = np.full(cost.shape, 9.0)
    room = np.min([far, *(np.linalg.norm(grid - cell, axis=2) for cell in cells)], axis=0) * EDGE
    nothing = np.zeros(cost.shape)
    needs = np.full(cost.shape, HALF)
    return CostMap(np.zeros(2, dtype=np.int64), EDGE, cost, room, needs, kinds.astype(np.int8), nothing > 0, nothing)


def reference(cost: Array, start: tuple[int, int]) -> Array:
    """Return the cost of the way to each cell, by iteration until nothing changes."""
    best = np.full(cost.shape, np.inf)
    best[start] = 0.0
    n, m = cost.shape
    for _ in range(n * m):
        before = best.copy()
        for i, j in np.ndindex(n, m):
            for di, dj in [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]:
                a, b = i + di, j + dj
                if not (0 <= a < n and 0 <= b < m) or np.isinf([cost[i, j], cost[a, b], cost[a, j], cost[i, b]]).any():
                    continue
                best[a, b] = min(best[a, b], best[i, j] + np.hypot(di, dj) * (cost[i, j] + cost[a, b]) / 2)
        if np.array_equal(best, before):
            break
    return best


def path_cost(cost: Array, cells: Array) -> float:
    return sum(
        float(np.hypot(*(b - a)) * (cost[tuple(a)] + cost[tuple(b)]) / 2) for a, b in pairwise(np.asarray(cells, dtype=int))
    )


@st.composite
def grounds(draw: st.DrawFn) -> Array:
    """Return small grounds with walls, open at start and goal."""
    n, m = draw(st.integers(2, 7)), draw(st.integers(2, 7))
    values = st.sampled_from([1.0, 1.5, 4.0, np.inf])
    cost = np.array(draw(st.lists(values, min_size=n * m, max_size=n * m))).reshape(n, m)
    cost[0, 0], cost[-1, -1] = 1.0, 1.0
    return cost


@settings(max_examples=80, deadline=None)
@given(grounds())
def test_path_is_cheapest_or_none_like_brute_force(cost: Array) -> None:
    ground, end = cost_map(cost), (cost.shape[0] - 1, cost.shape[1] - 1)
    best = reference(cost, (0, 0))
    cells, reached = cheapest_cells(ground.cost, ground.room, (0, 0), end)
    if cells is None:
        assert np.isinf(best[end])
        np.testing.assert_array_equal(reached, np.isfinite(best))
        return
    assert np.isfinite(cost[tuple(cells.T)]).all()
    assert tuple(cells[0]) == (0, 0)
    assert tuple(cells[-1]) == end
    assert path_cost(cost, cells) == pytest.approx(best[end])
    for a, b in pairwise(cells):
        assert np.abs(b - a).max() == 1
        assert np.isfinite([cost[a[0], b[1]], cost[b[0], a[1]]]).all(), "no corner is cut"


@settings(max_examples=40, deadline=None)
@given(grounds())
def test_reverse_path_has_equal_cost(cost: Array) -> None:
    ground, end = cost_map(cost), (cost.shape[0] - 1, cost.shape[1] - 1)
    there, _ = cheapest_cells(ground.cost, ground.room, (0, 0), end)
    back, _ = cheapest_cells(ground.cost, ground.room, end, (0, 0))
    assert (there is None) == (back is None)
    if there is not None and back is not None:
        assert path_cost(cost, there) == pytest.approx(path_cost(cost, back))


@settings(max_examples=80, deadline=None)
@given(grounds())
def test_straightened_path_costs_no_more_and_avoids_closed_cells(cost: Array) -> None:
    ground = cost_map(cost)
    cells, _ = cheapest_cells(ground.cost, ground.room, (0, 0), (cost.shape[0] - 1, cost.shape[1] - 1))
    if cells is None:
        return
    points = ground.centres(cells)
    corners = straightened(ground, points)
    assert cost_of(ground, corners) <= cost_of(ground, points) * (1.0 + 1e-6)
    np.testing.assert_array_equal(corners[[0, -1]], points[[0, -1]])
    for a, b in pairwise(corners):
        line = a + np.linspace(0.0, 1.0, 50)[:, None] * (b - a)
        assert np.isfinite(ground.at(ground.cost, line)).mean() > 0.9


def test_path_over_open_ground_is_straight_to_goal() -> None:
    start, goal = np.array([0.11, 0.12]), np.array([1.83, 0.77])
    way = find_path(cost_map(np.ones((40, 20))), start, goal, 0.03)
    assert isinstance(way, PlannedPath)
    np.testing.assert_array_equal(way.corners, [start, goal])
    assert way.cost == pytest.approx(float(np.linalg.norm(goal - start)))


def test_path_within_one_cell_is_straight() -> None:
    start, goal = np.array([0.11, 0.12]), np.array([0.14, 0.12])
    way = find_path(cost_map(np.ones((40, 20))), start, goal, 0.03)
    assert isinstance(way, PlannedPath)
    np.testing.assert_array_equal(way.corners, [start, goal])


def test_costly_ground_is_bypassed_if_detour_is_cheaper() -> None:
    cost = np.ones((40, 40))
    cost[18:22, 5:35] = 30.0
    way = find_path(cost_map(cost), np.array([0.5, 1.0]), np.array([1.5, 1.0]), 0.03)
    assert isinstance(way, PlannedPath)
    assert np.ptp(way.corners[:, 1]) > 0.7
    cost[18:22] = 30.0
    way = find_path(cost_map(cost), np.array([0.5, 1.0]), np.array([1.5, 1.0]), 0.03)
    assert isinstance(way, PlannedPath)
    assert np.ptp(way.corners[:, 1]) < 0.1, "there is no cheaper one"


@pytest.mark.parametrize(("max_step_m", "words"), [(0.065, "6.5 cm"), (0.29, "29 cm"), (0.005, "0.5 cm")])
def test_step_is_named_with_its_limit(max_step_m: float, words: str) -> None:
    limited = replace(cost_map(np.ones((1, 1))), max_step_m=max_step_m)
    assert limited.obstacle_name(STEP) == f"a step of more than {words}"


@pytest.mark.parametrize("kind", [STEP, BARE, HOLE])
def test_missing_path_names_obstacle_and_place(kind: int) -> None:
    cost = np.ones((40, 20))
    cost[27:29] = np.inf
    stops = np.where(np.isinf(cost), kind, OPEN)
    found = find_path(cost_map(cost, stops), np.array([0.5, 0.5]), np.array([1.8, 0.5]), 0.03)
    assert found == NoPath(
        f"no path to (1.8, 0.5): blocked by {obstacle_name(kind)} from y = 0.0 to 1.0 m at x = 1.4 m; there is no opening"
    )


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_widest_path_matches_connectivity_threshold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    room = np.where(rng.random((8, 9)) < 0.3, 0.0, rng.random((8, 9)))
    start, end = (0, 0), (7, 8)
    least, cell = find_widest_path(room, start, end)

    def reached(above: float) -> bool:
        open_ = room > above
        open_[start] = open_[end] = True
        seen = np.zeros(room.shape, dtype=bool)
        seen[start] = True
        for _ in range(room.size):
            wide = np.pad(seen, 1)
            seen |= open_ & (wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:])
        return bool(seen[end])

    assert reached(0.0) == (cell is not None)
    if cell is not None:
        assert room[cell] == least
        assert reached(np.nextafter(least, 0.0))
        assert not reached(least)


@pytest.mark.parametrize("open_cells", [1, 3, 7])
def test_too_narrow_opening_is_reported_with_required_width(open_cells: int) -> None:
    cost, first = np.ones((40, 20)), 6
    cost[27:29] = np.inf
    cost[27:29, first : first + open_cells] = 1.0
    ground = cost_map(cost)
    ground.cost[ground.room < HALF] = np.inf
    found = find_path(ground, np.array([0.5, 0.5]), np.array([1.8, 0.5]), 0.03)
    assert isinstance(found, NoPath)
    room = (open_cells // 2 + 1) * EDGE
    at = f"(1.4, {(first + open_cells / 2) * EDGE:.1f})"
    assert found.reason.endswith(
        f"; the widest opening, at {at}, has {room:.2f} m on either side of its middle, the robot needs {HALF:.2f} m"
    )


def test_blocked_goal_is_reported_unless_tolerance_reaches_free_cell() -> None:
    cost = np.ones((40, 20))
    cost[28:30] = np.inf
    start, goal = np.array([0.5, 0.5]), np.array([1.43, 0.5])
    found = find_path(cost_map(cost), start, goal, 0.03)
    assert isinstance(found, NoPath)
    assert found.reason.startswith(f"no path to (1.4, 0.5): {obstacle_name(STEP)} at (1.4, 0.5)")
    way = find_path(cost_map(cost), start, goal, 0.2)
    assert isinstance(way, PlannedPath)
    assert way.corners[-1][0] < 1.4


def test_path_leaves_closed_start_directly_and_not_through_wall() -> None:
    cost = np.ones((40, 20))
    cost[20] = np.inf
    stops = np.where(np.isinf(cost), STEP, OPEN)
    room = np.abs(np.arange(40) - 20)[:, None] * EDGE * np.ones((1, 20))
    cost[room < HALF] = np.inf
    nothing = np.zeros(cost.shape)
    needs = np.full(cost.shape, HALF)
    ground = CostMap(np.zeros(2, dtype=np.int64), EDGE, cost, room, needs, stops.astype(np.int8), nothing > 0, nothing)
    out = find_path(ground, np.array([0.93, 0.5]), np.array([0.2, 0.5]), 0.03)
    assert isinstance(out, PlannedPath)
    assert out.corners[:, 0].max() == 0.93
    assert isinstance(find_path(ground, np.array([0.93, 0.5]), np.array([1.8, 0.5]), 0.03), NoPath)


def test_path_to_goal_outside_map_ends_at_map_border() -> None:
    way = find_path(cost_map(np.ones((40, 20))), np.array([0.5, 0.5]), np.array([9.0, 0.5]), 0.03)
    assert isinstance(way, PlannedPath)
    assert 1.9 < way.corners[-1][0] <= 2.0


def test_path_stays_within_allowed_distance_of_straight_line() -> None:
    cost = np.ones((40, 60))
    cost[18:22, 10:50] = np.inf
    start, goal = np.array([0.5, 1.5]), np.array([1.5, 1.5])
    ground = cost_map(cost)
    assert isinstance(find_path(ground, start, goal, 0.03), PlannedPath)
    near = ground.beside(start, goal, 0.9)
    found = find_path(near, start, goal, 0.03)
    assert isinstance(found, NoPath)
    assert obstacle_name(FAR) in found.reason


def test_cost_of_very_long_path_uses_bounded_memory() -> None:
    ground = cost_map(np.ones((4, 4)))
    tracemalloc.start()
    cost = cost_of(ground, np.array([[0.1, 0.1], [1e6, 0.1]]))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert cost == pytest.approx(1e6)
    assert most < 10e6
