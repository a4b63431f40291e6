"""Path planner: the cheapest path over the traversability map, or the obstacle."""

from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.navigation.traversability import FAR, OPEN, CostMap
from sextant.services.planner.terrain import MAX_SAMPLED_LINE_M
from sextant.shared.geometry import Array

_ESCAPE = 8.0  # cost per metre from an impassable place to free ground
_EIGHT_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
_FOUR_NEIGHBOURS = ((-1, 0), (1, 0), (0, -1), (0, 1))
_DIAGONAL = 0.41421356  # difference between a diagonal and a straight step
_MISSES = 4  # consecutive cells without a straight line, after which the search for longer lines ends
_FLAT = 0.20  # [m] width of a region up to which it is reported as a line


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPath:
    """A path."""

    corners: Array  # (k, 2) [m] {world}, including start and end
    cost: float  # [m] of open ground at the same cost


@dataclass(frozen=True, slots=True)
class NoPath:
    """Reason why there is no path."""

    reason: str


def find_path(cost_map: CostMap, start: Array, goal: Array, nearby: float) -> PlannedPath | NoPath:
    """Find the cheapest path.

    Args:
        cost_map: The traversability map.
        start: (2,) [m] {world} start of the path.
        goal: (2,) [m] {world} end of the path. If it lies outside the map, the path ends at the border towards it.
        nearby: [m] permitted distance from the goal if the robot cannot stand on the goal itself.
    """
    # 1. The end: the goal, or the last cell towards it, or a free cell near it.
    aim = _clipped(cost_map, start, goal)
    end = _nearest_free(cost_map, cost_map.cell(aim), nearby if aim is goal else np.inf)
    if end is None:
        return NoPath(f"no path to {_place(goal)}: {_around(cost_map, cost_map.cell(goal))} is too close to the goal")
    # 2. The cells of the path.
    cells, reached = cheapest_cells(cost_map.cost, cost_map.room, cost_map.cell(start), end)
    if cells is None:
        words = f"blocked by {describe_enclosure(cost_map, reached)}; {gap(cost_map, cost_map.cell(start), end)}"
        return NoPath(f"no path to {_place(goal)}: {words}")
    # 3. The corners of the path.
    points = cost_map.centres(cells)
    last = goal if aim is goal and cost_map.cell(goal) == end else points[-1]
    points = np.vstack([start, points[1:-1], last])
    corners = straightened(cost_map, points)
    return PlannedPath(corners, cost_of(cost_map, corners))


def cheapest_cells(
    cost: Array, room: Array, start: tuple[int, int], end: tuple[int, int]
) -> tuple[NDArray[np.int64] | None, NDArray[np.bool_]]:
    """Find the cheapest path between two cells by A*.

    Each cell has eight neighbours. A diagonal step must not cut the corner of a closed cell. If the start is closed, the path
    first passes closed cells, each at least as far from its obstacle as the one before.

    Args:
        cost: (n, m) cost per cell length, 1 or more; inf for closed cells.
        room: (n, m) [m] distance to the obstacle that closes a cell.
        start: First cell.
        end: Last cell.

    Returns:
        The cells (k, 2), or None; and the cells (n, m) that the search has expanded.
    """
    # Cells are numbered row by row, with a closed border around the grid.
    n, m = cost.shape
    row, closed = m + 2, float("inf")
    price: list[float] = np.pad(cost, 1, constant_values=np.inf).ravel().tolist()
    space: list[float] = np.pad(room, 1, constant_values=-1.0).ravel().tolist()
    first, last = ((i + 1) * row + j + 1 for i, j in (start, end))
    steps = [(i * row + j, i * row if i and j else 0, j if i and j else 0, float(np.hypot(i, j))) for i, j in _EIGHT_NEIGHBOURS]
    best, before, done = [closed] * len(price), [first] * len(price), bytearray(len(price))
    best[first] = 0.0
    heap = [(0.0, first)]
    while heap:
        cell = heappop(heap)[1]
        if done[cell]:
            continue
        done[cell] = 1
        if cell == last:
            break
        here, so_far = price[cell], best[cell]
        for step, down, across, length in steps:
            to = cell + step
            there = price[to]
            if here < closed:
                # Both cells next to a diagonal must be open, so no corner of a closed cell is cut.
                if there == closed or price[cell + down] == closed or price[cell + across] == closed:
                    continue
                total = so_far + length * (here + there) / 2
            elif there < closed or space[to] > space[cell] or space[to] == space[cell] > 0.0:
                total = so_far + length * _ESCAPE
            else:
                continue
            if total < best[to]:
                best[to], before[to] = total, cell
                i, j = abs(to // row - 1 - end[0]), abs(to % row - 1 - end[1])
                heappush(heap, (total + max(i, j) + _DIAGONAL * min(i, j), to))
    reached = np.frombuffer(done, dtype=np.bool_).reshape(n + 2, row)[1:-1, 1:-1].copy()
    if not done[last]:
        return None, reached
    cells = [last]
    while cells[-1] != first:
        cells.append(before[cells[-1]])
    return np.stack(np.divmod(np.array(cells[::-1]), row), axis=1) - 1, reached


def straightened(cost_map: CostMap, points: Array) -> Array:
    """Return the corners (k, 2) [m] of a path (n, 2) [m] with straight segments.

    A straight segment costs no more than the part of the path that it replaces.
    """
    so_far = np.concatenate([[0.0], np.cumsum([cost_of(cost_map, points[k : k + 2]) for k in range(len(points) - 1)])])
    corners, at = [0], 0
    while at < len(points) - 1:
        far, misses = at + 1, 0
        for to in range(at + 2, len(points)):
            if cost_of(cost_map, points[[at, to]]) <= (so_far[to] - so_far[at]) * (1.0 + 1e-9):
                far, misses = to, 0
            else:
                misses += 1
            if misses > _MISSES:
                break
        corners.append(far)
        at = far
    return np.asarray(points[corners])


def cost_of(cost_map: CostMap, corners: Array) -> float:
    """Return the cost of a path (k, 2) [m], in metres of open ground.

    It is inf if the path enters closed ground. Only its beginning may be closed.
    """
    total, left = 0.0, False
    for a, b in pairwise(corners):
        length = float(np.linalg.norm(b - a))
        count = max(2, int(np.ceil(2.0 * min(length, MAX_SAMPLED_LINE_M) / cost_map.edge)) + 1)
        costs = cost_map.at(cost_map.cost, a + np.linspace(0.0, 1.0, count)[:, None] * (b - a))
        closed = np.isinf(costs)
        # The path may leave a closed place, but must not enter one.
        if (closed[1:] & ~closed[:-1]).any() or (left and closed[0]):
            return float("inf")
        left |= not closed[-1]
        costs = np.where(closed, _ESCAPE, costs)
        total += length * float((costs[:-1] + costs[1:]).mean()) / 2
    return total


def describe_enclosure(cost_map: CostMap, reached: NDArray[np.bool_]) -> str:
    """Return the obstacles around the cells (n, m) that were reached, as text."""
    grown = reached
    cells = int(np.ceil((cost_map.room.max() if cost_map.room.size else 0.0) / cost_map.edge))
    for _ in range(cells):
        wide = np.pad(grown, 1)
        grown = wide[1:-1, 1:-1] | wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:]
    kinds = np.where(grown, cost_map.stops, OPEN)
    said = []
    for kind in sorted(set(np.unique(kinds).tolist()) - {OPEN}, key=lambda k: (k == FAR, -int((kinds == k).sum()))):
        if kind == FAR:
            said.append(cost_map.obstacle_name(FAR))
            continue
        where = cost_map.centres(np.argwhere(kinds == kind))
        said.append(f"{cost_map.obstacle_name(kind)} {_extent(where)}")
    return "; ".join(said) or "the end of the mapped ground"


def gap(cost_map: CostMap, start: tuple[int, int], end: tuple[int, int]) -> str:
    """Return the widest gap between two cells and the required room, as text.

    It is the narrowest place of the path with the most room.
    """
    spare = cost_map.room - cost_map.needs
    _, cell = find_widest_path(np.where(cost_map.stops == OPEN, spare + cost_map.needs.max(), 0.0), start, end)
    if cell is None:
        return "there is no opening"
    at, room, needed = _place(cost_map.centres(np.array([cell]))[0]), cost_map.room[cell], cost_map.needs[cell]
    return f"the widest opening, at {at}, has {room:.2f} m on either side of its middle, the robot needs {needed:.2f} m"


def find_widest_path(room: Array, start: tuple[int, int], end: tuple[int, int]) -> tuple[float, tuple[int, int] | None]:
    """Find the path between two cells of a grid (n, m) whose narrowest cell is widest.

    Return the room of that cell and the cell. The room of both ends does not count. The cell is None if every path crosses
    cells without room.
    """
    n, m = room.shape
    rest: list[list[float]] = room.tolist()
    rest[end[0]][end[1]] = np.inf
    done = np.zeros((n, m), dtype=bool).tolist()
    heap = [(-np.inf, start, start)]
    while heap:
        least, cell, narrow = heappop(heap)
        if done[cell[0]][cell[1]]:
            continue
        done[cell[0]][cell[1]] = True
        if cell == end:
            return -least, narrow
        for i, j in _FOUR_NEIGHBOURS:
            to = cell[0] + i, cell[1] + j
            if 0 <= to[0] < n and 0 <= to[1] < m and not done[to[0]][to[1]] and rest[to[0]][to[1]] > 0.0:
                here = -rest[to[0]][to[1]]
                heappush(heap, (here, to, to) if here > least else (least, to, narrow))
    return 0.0, None


def _extent(places: Array) -> str:
    """Return the extent of places (k, 2) [m], as text."""
    (x0, y0), (x1, y1) = places.min(axis=0).tolist(), places.max(axis=0).tolist()
    if x1 - x0 <= _FLAT and y1 - y0 <= _FLAT:
        return f"at {_place(np.array([x0 + x1, y0 + y1]) / 2)}"
    if x1 - x0 <= _FLAT:
        return f"from y = {y0:.1f} to {y1:.1f} m at x = {(x0 + x1) / 2:.1f} m"
    if y1 - y0 <= _FLAT:
        return f"from x = {x0:.1f} to {x1:.1f} m at y = {(y0 + y1) / 2:.1f} m"
    return f"within x = {x0:.1f} to {x1:.1f} m, y = {y0:.1f} to {y1:.1f} m"


def _place(xy: Array) -> str:
    return f"({xy[0]:.1f}, {xy[1]:.1f})"


def _around(cost_map: CostMap, cell: tuple[int, int]) -> str:
    """Return the obstacle nearest to a cell, as text."""
    stops = np.argwhere(cost_map.stops != OPEN)
    if not len(stops):
        return "nothing"
    i, j = stops[int(np.argmin(((stops - cell) ** 2).sum(axis=1)))]
    return f"{cost_map.obstacle_name(int(cost_map.stops[i, j]))} at {_place(cost_map.centres(np.array([[i, j]]))[0])}"


def _clipped(cost_map: CostMap, start: Array, goal: Array) -> Array:
    """Return the goal, or the last place towards it that lies in the map."""
    if cost_map.holds(goal):
        return goal
    s = np.linspace(0.0, 1.0, 257)[:, None]
    line = start + s * (goal - start)
    inside = [k for k, place in enumerate(line) if cost_map.holds(place)]
    return np.asarray(line[max(inside, default=0)])


def _nearest_free(cost_map: CostMap, cell: tuple[int, int], within: float) -> tuple[int, int] | None:
    """Return the free cell nearest to a cell, within a distance [m], or None."""
    if np.isfinite(cost_map.cost[cell]):
        return cell
    free = np.argwhere(np.isfinite(cost_map.cost))
    if not len(free):
        return None
    off = np.linalg.norm(free - cell, axis=1) * cost_map.edge
    k = int(np.argmin(off))
    return (int(free[k, 0]), int(free[k, 1])) if off[k] <= within else None
