"""The cheapest way over coarse cells from one place to another, or what stands around the place it begins at."""

from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from services.planner.crossing import FAR, OPEN, WORDS, Crossing
from shared.geometry import Array

_ESCAPE = 8.0  # price of a metre out of a place where the robot ought not to be
_STEPS = [(i, j, float(np.hypot(i, j))) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
_FLAT = 0.20  # [m] of a region's width up to which it is a line


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A way to walk."""

    corners: Array  # (k, 2) [m] {world}, where it begins and ends included
    cost: float  # [m] of open ground that would be as dear


@dataclass(frozen=True, slots=True)
class NoWay:
    """Why there is none, in words."""

    reason: str


def find_way(crossing: Crossing, start: Array, goal: Array, nearby: float) -> Way | NoWay:
    """The cheapest way.

    Args:
        crossing: What can be crossed.
        start: (2,) [m] {world} where it begins.
        goal: (2,) [m] {world} where it ends; if that lies beyond what is kept of the ground, at the border before it.
        nearby: [m] from the goal that will do where the robot cannot stand on the goal itself.
    """
    # 1. Where it ends: at the goal, or as far towards it as the cells reach, or beside it.
    aim = _clipped(crossing, start, goal)
    end = _nearest_free(crossing, crossing.cell(aim), nearby if aim is goal else np.inf)
    if end is None:
        return NoWay(f"no way to {_place(goal)}: {_around(crossing, crossing.cell(goal))} is too near to it")
    # 2. The cells on the way.
    cells, reached = cheapest_cells(crossing.cost, crossing.room, crossing.cell(start), end)
    if cells is None:
        return NoWay(f"no way to {_place(goal)}: {enclosure(crossing, reached)}")
    # 3. Its corners.
    points = crossing.centres(cells)
    points[0] = start
    if aim is goal and crossing.cell(goal) == end:
        points[-1] = goal
    corners = straightened(crossing, points)
    return Way(corners, cost_of(crossing, corners))


def cheapest_cells(
    cost: Array, room: Array, start: tuple[int, int], end: tuple[int, int]
) -> tuple[NDArray[np.int64] | None, NDArray[np.bool_]]:
    """The cheapest way between two cells by A*, to the eight neighbours of each and never past a closed one's corner.

    Where the start is closed, cells as closed lead out of it that have no less room.

    Args:
        cost: (n, m) of a cell's length in a cell, 1 or more; inf where it is closed.
        room: (n, m) distance to what closes them.
        start: Where it begins.
        end: Where it ends.

    Returns:
        The cells (k, 2), or None; and which cells (n, m) were looked at.
    """
    n, m = cost.shape
    price: list[list[float]] = cost.tolist()
    space: list[list[float]] = room.tolist()
    closed = float("inf")
    best: dict[tuple[int, int], float] = {start: 0.0}
    before: dict[tuple[int, int], tuple[int, int]] = {}
    done: set[tuple[int, int]] = set()
    heap = [(_octile(start, end), start)]
    while heap:
        _, cell = heappop(heap)
        if cell in done:
            continue
        done.add(cell)
        if cell == end:
            break
        i, j = cell
        here, free = price[i][j], price[i][j] < closed
        for di, dj, length in _STEPS:
            a, b = i + di, j + dj
            if not (0 <= a < n and 0 <= b < m):
                continue
            there = price[a][b]
            if free:
                if there == closed or (di and dj and (price[a][j] == closed or price[i][b] == closed)):
                    continue
                step = length * (here + there) / 2
            elif there < closed or space[a][b] > space[i][j] or space[a][b] == space[i][j] > 0.0:
                step = length * _ESCAPE
            else:
                continue
            total = best[cell] + step
            if total < best.get((a, b), closed):
                best[a, b] = total
                before[a, b] = cell
                heappush(heap, (total + _octile((a, b), end), (a, b)))
    reached = np.zeros((n, m), dtype=np.bool_)
    reached[tuple(np.array(sorted(done)).T)] = True
    if end not in done:
        return None, reached
    cells = [end]
    while cells[-1] != start:
        cells.append(before[cells[-1]])
    return np.array(cells[::-1], dtype=np.int64), reached


def straightened(crossing: Crossing, points: Array) -> Array:
    """The corners (k, 2) [m] of a way (n, 2) [m] whose straight stretches cost no more than what they leave out."""
    corners, at = [0], 0
    while at < len(points) - 1:
        far = at + 1
        for to in range(len(points) - 1, at + 1, -1):
            if cost_of(crossing, points[[at, to]]) <= cost_of(crossing, points[at : to + 1]) * (1.0 + 1e-9):
                far = to
                break
        corners.append(far)
        at = far
    return np.asarray(points[corners])


def cost_of(crossing: Crossing, corners: Array) -> float:
    """What a way (k, 2) [m] costs, [m] of open ground; inf where it is closed but for its beginning, which may be."""
    total, left = 0.0, False
    for a, b in pairwise(corners):
        length = float(np.linalg.norm(b - a))
        count = max(2, int(np.ceil(2.0 * length / crossing.edge)) + 1)
        costs = crossing.at(crossing.cost, a + np.linspace(0.0, 1.0, count)[:, None] * (b - a))
        closed = np.isinf(costs)
        # Out of a place where it ought not to be it may go, but not back into one.
        if (closed[1:] & ~closed[:-1]).any() or (left and closed[0]):
            return float("inf")
        left |= not closed[-1]
        costs = np.where(closed, _ESCAPE, costs)
        total += length * float((costs[:-1] + costs[1:]).mean()) / 2
    return total


def enclosure(crossing: Crossing, reached: NDArray[np.bool_]) -> str:
    """What stands around the cells (n, m) that were reached, in words."""
    grown = reached
    cells = int(np.ceil((crossing.room.max() if crossing.room.size else 0.0) / crossing.edge))
    for _ in range(cells):
        wide = np.pad(grown, 1)
        grown = wide[1:-1, 1:-1] | wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:]
    kinds = np.where(grown, crossing.stops, OPEN)
    said = []
    for kind in sorted(set(np.unique(kinds).tolist()) - {OPEN}, key=lambda k: (k == FAR, -int((kinds == k).sum()))):
        if kind == FAR:
            said.append(WORDS[FAR])
            continue
        where = crossing.centres(np.argwhere(kinds == kind))
        said.append(f"{WORDS[kind]} {_extent(where)}")
    return "; ".join(said) or "what is seen of the ground ends there"


def _extent(places: Array) -> str:
    """Where places (k, 2) [m] lie, in words."""
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


def _around(crossing: Crossing, cell: tuple[int, int]) -> str:
    """What is nearest to a cell of all that cannot be crossed, in words."""
    stops = np.argwhere(crossing.stops != OPEN)
    if not len(stops):
        return "nothing"
    i, j = stops[int(np.argmin(((stops - cell) ** 2).sum(axis=1)))]
    return f"{WORDS[int(crossing.stops[i, j])]} at {_place(crossing.centres(np.array([[i, j]]))[0])}"


def _clipped(crossing: Crossing, start: Array, goal: Array) -> Array:
    """The goal, or the last place towards it that lies on a cell."""
    if crossing.holds(goal):
        return goal
    s = np.linspace(0.0, 1.0, 257)[:, None]
    line = start + s * (goal - start)
    inside = [k for k, place in enumerate(line) if crossing.holds(place)]
    return np.asarray(line[max(inside, default=0)])


def _nearest_free(crossing: Crossing, cell: tuple[int, int], within: float) -> tuple[int, int] | None:
    """The free cell nearest to one, if there is one within a distance [m] of its middle."""
    if np.isfinite(crossing.cost[cell]):
        return cell
    free = np.argwhere(np.isfinite(crossing.cost))
    if not len(free):
        return None
    off = np.linalg.norm(free - cell, axis=1) * crossing.edge
    k = int(np.argmin(off))
    return (int(free[k, 0]), int(free[k, 1])) if off[k] <= within else None


def _octile(a: tuple[int, int], b: tuple[int, int]) -> float:
    """Length of the shortest way between two cells where all is open, at most."""
    i, j = abs(a[0] - b[0]), abs(a[1] - b[1])
    return max(i, j) + 0.41421356237 * min(i, j)
