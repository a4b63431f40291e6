"""Coarse height map of the keyframes, for detecting and correcting wrong poses.

Registration finds the nearest pose that fits. Level floor fits at any pose, so most points of a frame still fit after the robot
was carried away, or slid further than registration searches. This map tests whether the other points fit, too. Each cell keeps
the lowest and the highest point seen in it, and a frame's points are compared with their cells.

How an edge divides between two cells depends on the viewpoint. Therefore a cell is known only after all its neighbours were
seen, and a point is compared with the height range of its cell and the neighbours. A point below this range contradicts the
map, because it would be seen through the ground. A point above the range contradicts the map only if an earlier ray has
passed higher; otherwise it may be a surface that has just come into view. The search for a lost frame tries poses around the
expected one, each at the height that fits best.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array as Pose
from sextant.shared.runtime.compiled import compiled

Array = NDArray[Any]

_RESOLUTION_M = 0.02  # [m] cell edge
_SIDE = 512  # [cells] edge of the grid, a circular buffer
_MAX_GAP_M = 0.08  # [m] maximum distance between neighbouring points of one surface
_MAX_SAMPLES = 1 + 2 * math.ceil(_MAX_GAP_M / (0.7 * _RESOLUTION_M))  # of a pixel: its point, and those up to two neighbours
_TOLERANCE_M = 0.015  # [m] by which a fitting point may be outside its cell's height range
_NOISE_SIGMAS = 2.0  # [sigma] of a pixel's depth noise, added to the tolerance
_SEARCH_RANGE_M, _SEARCH_TURN_RAD = 0.36, math.radians(18.0)  # [m] [rad] search range around the expected pose
_COARSE_STEP_M, _COARSE_STEP_RAD = 0.04, math.radians(3.0)  # [m] [rad] steps of the coarse search
_FINE_STEP_M, _FINE_STEP_RAD = 0.01, math.radians(1.0)  # [m] [rad] steps of the fine search ...
_FINE_STEPS = np.arange(-3, 4)  # ... and their numbers
_MISFIT_WEIGHT = 18.0  # [1] weight of a point that does not fit, relative to one that fits
_DISTANCE_COST = 0.4  # [1] cost of a place at a distance `_SEARCH_RANGE_M`, a turn `_SEARCH_TURN_RAD`, or a height ...
_COST_HEIGHT_M = 0.10  # [m] ... of this
_HEIGHT_STEPS = 12  # heights tried in each direction, `_TOLERANCE_M` apart
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_COARSE_POINTS, _FINE_POINTS = 300, 1000  # points compared per place in the coarse and in the fine search
_RAY_STRIDE = 4  # only every n-th ray is traced
_REFINED_PLACES = 6  # places of the coarse search from which the fine search starts in `find` ...
_REFINED_PER_START = 2  # ... and around each start pose of `relocalize`
_START_RANGE_M = 0.24  # [m] search range around each start pose of `relocalize`
_MIN_FIT_ANYWHERE = 0.9  # [1] minimum share of fitting points for a pose of `relocalize`
_MIN_KNOWN = 0.4  # [1] minimum share of points on known cells
_MIN_FIT = 0.85  # [1] minimum share of fitting points, of those on known cells, for a pose of `find`
_MIN_GAIN = 0.03  # [1] minimum gain of this share over the expected pose ...
_GAIN_SIGMAS = 3.0  # [sigma] ... plus this multiple of its counting error
_SAME_PLACE_M, _SAME_TURN_RAD = 0.05, math.radians(4.0)  # [m] [rad] beyond which two poses count as different ...
_SAME_HEIGHT_M = 0.04  # [m] ... or beyond this in height

_CELL = np.dtype(
    [
        ("tag", np.int64),  # number of the world cell stored here, see `_tag`
        ("low", np.float32),  # [m] {world} lowest and highest point seen; low > high if none
        ("high", np.float32),
        ("low_around", np.float32),  # [m] the same, including the neighbours
        ("high_around", np.float32),
        ("clear", np.float32),  # [m] {world} largest height at which a ray has passed
        ("seen_around", np.int32),  # number of seen cells among it and its eight neighbours
    ]
)


def surface_points(inverse_depth: Array, x: Array, y: Array) -> Array:
    """Convert an inverse depth image to points (n, 3) [m] {camera}, densified.

    The floor ahead has fewer samples than the grid has cells. Points on the straight line between two nearby neighbours are
    therefore added.

    Args:
        inverse_depth: (rows, columns) [1/m], 0 for none.
        x: (columns,) [1] x of each column's ray at unit depth.
        y: (rows,) [1] y of each row's ray at unit depth.
    """
    out = np.empty((_MAX_SAMPLES * inverse_depth.size, 3))
    return out[: _fill_between(inverse_depth, x, y, out)]


@dataclass(frozen=True, slots=True)
class RelocalizationResult:
    """Pose of a lost frame, or the reason why it was not found."""

    T_world_camera: Pose | None  # (4, 4), None if it was not found
    reason: str  # of the failure, empty when found


@dataclass(frozen=True, slots=True)
class MapContradiction:
    """Points of a frame that contradict the map."""

    share: float  # [1] of the points on known cells
    xy: NDArray[np.float64]  # (n, 2) [m] {world} of the contradicting points


class RelocalizationMap:
    """Lowest and highest point per cell, in a circular buffer."""

    def __init__(self, sigma: float) -> None:
        """Create an empty map.

        Args:
            sigma: [1/m] standard deviation of a pixel's depth, divided by its squared depth.
        """
        self._noise = _NOISE_SIGMAS * sigma
        self._cells = np.zeros((_SIDE, _SIDE), dtype=_CELL)
        self.clear()

    def clear(self) -> None:
        """Delete all cells."""
        self._cells["tag"] = -1

    def add(self, points: Array, T_world_camera: Pose) -> None:
        """Add points (n, 3) [m] {camera} that were seen from a pose (4, 4)."""
        _add(points, T_world_camera, self._cells)

    def contradiction(self, points: Array, T_world_camera: Pose) -> MapContradiction:
        """Find the points (n, 3) [m] {camera} of a frame at a pose that contradict the map.

        The module's docstring states when a point does. The result is empty if few points are on known cells.
        """
        points = _sample(points, _FINE_POINTS)
        outside = np.zeros(len(points), dtype=np.bool_)
        known, contradicting, _ = _count_points(points, T_world_camera, self._cells, self._noise, outside)
        if known < _MIN_KNOWN * len(points):
            return MapContradiction(0.0, np.zeros((0, 2)))
        return MapContradiction(contradicting / known, points[outside] @ T_world_camera[:2, :3].T + T_world_camera[:2, 3])

    def find(self, points: Array, T_world_camera: Pose) -> RelocalizationResult:
        """Search around the expected pose (4, 4) for points (n, 3) [m] {camera}.

        Roll and pitch of the expected pose are kept.
        """
        few, points = _sample(points, _COARSE_POINTS), _sample(points, _FINE_POINTS)
        n = len(points)
        known, _, fitting = _count_points(points, T_world_camera, self._cells, self._noise, np.zeros(n, dtype=np.bool_))
        # 1. Coarse search over all places.
        shifts = np.arange(-_SEARCH_RANGE_M, _SEARCH_RANGE_M + _COARSE_STEP_M / 2, _COARSE_STEP_M)
        angles = np.arange(-_SEARCH_TURN_RAD, _SEARCH_TURN_RAD + _COARSE_STEP_RAD / 2, _COARSE_STEP_RAD)
        places = _grid(shifts, angles)
        fits, scores, heights = self._score(few, T_world_camera, places)
        if fits.max() < 0.0:
            return RelocalizationResult(None, "lost: no mapped ground within the search range")
        # 2. Fine search around the best places. Among places that fit alike the nearest wins. Directions that the ground
        # does not constrain keep their expected values.
        around = _grid(_FINE_STEPS * _FINE_STEP_M, _FINE_STEPS * _FINE_STEP_RAD)
        best_places = places[_best_apart(places, scores - _distance_cost(places, heights), _REFINED_PLACES)]
        near = (best_places[:, None] + around).reshape(-1, 3)
        fits, scores, heights = self._score(points, T_world_camera, near)
        best = int(np.argmax(scores - _distance_cost(near, heights)))
        fit = float(fits[best])
        # 3. The best place must fit well, differ from the expected pose, and fit better than it. At the expected pose, points
        # on unknown cells count with the share of the best place.
        if fit < _MIN_FIT:
            return RelocalizationResult(
                None, f"lost: the best pose within {_SEARCH_RANGE_M:g} m fits {100 * max(fit, 0.0):.0f} % of the visible ground"
            )
        another = _is_apart(near[best], np.zeros(3)) or abs(heights[best]) > _SAME_HEIGHT_M
        fit_here = (fitting + fit * (n - known)) / n
        if not another or fit < fit_here + _MIN_GAIN + _GAIN_SIGMAS * math.sqrt(fit * (1.0 - fit) / n):
            return RelocalizationResult(None, "no pose nearby fits better than the expected one")
        T = _moved(T_world_camera, near[best])
        T[2, 3] += heights[best]
        return RelocalizationResult(T, "")

    def relocalize(self, points: Array, starts: Array) -> RelocalizationResult:
        """Search around several poses (k, 4, 4) for points (n, 3) [m] {camera}.

        Roll and pitch of these poses are kept. A pose is accepted only if no other fits as well.
        """
        few, points = _sample(points, _COARSE_POINTS), _sample(points, _FINE_POINTS)
        shifts = np.arange(-_START_RANGE_M, _START_RANGE_M + _COARSE_STEP_M / 2, _COARSE_STEP_M)
        places = _grid(shifts, np.arange(-_SEARCH_TURN_RAD, _SEARCH_TURN_RAD + _COARSE_STEP_RAD / 2, _COARSE_STEP_RAD))
        around = _grid(_FINE_STEPS * _FINE_STEP_M, _FINE_STEPS * _FINE_STEP_RAD)
        candidates: list[tuple[float, float, Pose]] = []  # worth, fit and pose of the best places around each start
        for T in starts:
            fits, scores, heights = self._score(few, T, places)
            if fits.max() < 0.0:
                continue
            for k in _best_apart(places, scores - _distance_cost(places, heights), _REFINED_PER_START):
                near = places[k] + around
                fits, scores, heights = self._score(points, T, near)
                best = int(np.argmax(scores))
                pose = _moved(T, near[best])
                pose[2, 3] += heights[best]
                candidates.append((float(scores[best]), float(fits[best]), pose))
        if not candidates:
            return RelocalizationResult(None, "lost: none of the visible ground is in the map")
        candidates.sort(key=lambda candidate: -candidate[0])
        _, fit, T = candidates[0]
        if fit < _MIN_FIT_ANYWHERE:
            return RelocalizationResult(
                None, f"lost: the best pose in the map fits {100 * max(fit, 0.0):.0f} % of the visible ground"
            )
        rivals = [other for _, other, at in candidates[1:] if _are_distinct(at, T)]
        if rivals and max(rivals) > fit - _MIN_GAIN:
            return RelocalizationResult(None, "lost: several poses in the map fit equally well")
        return RelocalizationResult(T, "")

    def _score(self, points: Array, T: Pose, places: Array) -> tuple[Array, Array, Array]:
        """Return the share of fitting points (k,), the score (k,) and the height (k,) [m] of places (k, 3).

        The share refers to points on known cells; a point on an unknown cell is no evidence. In the score, a point that does
        not fit weighs much more against a place than a fitting point weighs for it, because on level ground points fit
        anywhere. Share and score are -1 and minus infinity if too few points are on known cells.
        """
        out = np.empty((len(places), 3))
        _score_places(points, T, places, self._cells, self._noise, out)
        known, fitting, heights = out.T
        enough = known >= _MIN_KNOWN * len(points)
        score = (fitting - _MISFIT_WEIGHT * (known - fitting)) / len(points)
        return np.where(enough, fitting / np.maximum(known, 1.0), -1.0), np.where(enough, score, -np.inf), heights


def _sample(points: Array, count: int) -> Array:
    """Return an even sample of points in an irregular order.

    A regular stride that divides the image width would read only a few columns.
    """
    if len(points) <= count:
        return points
    return np.asarray(points[(np.arange(count) * _GOLDEN % 1.0 * len(points)).astype(np.intp)])


def _grid(shifts: Array, angles: Array) -> Array:
    """Return places (k, 3): shifts in x and y [m], and a turn [rad]."""
    return np.stack(np.meshgrid(shifts, shifts, angles, indexing="ij"), axis=-1).reshape(-1, 3)


def _distance_cost(places: Array, heights: Array) -> Array:
    """Return the cost (k,) of places (k, 3) by their distance from the expected pose."""
    way = (
        np.hypot(places[:, 0], places[:, 1]) / _SEARCH_RANGE_M
        + np.abs(places[:, 2]) / _SEARCH_TURN_RAD
        + np.abs(heights) / _COST_HEIGHT_M
    )
    return np.asarray(_DISTANCE_COST * way)


def _is_apart(places: Array, place: Array) -> NDArray[np.bool_]:
    way = places - place
    return np.asarray((np.hypot(way[..., 0], way[..., 1]) > _SAME_PLACE_M) | (np.abs(way[..., 2]) > _SAME_TURN_RAD))


def _best_apart(places: Array, score: Array, count: int) -> NDArray[np.intp]:
    """Return the indices of the best places that are apart from each other, best first."""
    chosen: list[int] = []
    left = np.ones(len(places), dtype=bool)
    while len(chosen) < count and left.any():
        k = int(np.argmax(np.where(left, score, -np.inf)))
        chosen.append(k)
        left &= _is_apart(places, places[k])
    return np.array(chosen)


def _are_distinct(T: Pose, other: Pose) -> bool:
    """Return whether two poses are too far apart for their fine searches to overlap."""
    far = np.linalg.norm(T[:2, 3] - other[:2, 3]) > 2.0 * _SAME_PLACE_M
    cosine = (np.trace(T[:3, :3].T @ other[:3, :3]) - 1.0) / 2.0
    return bool(far or cosine < math.cos(2.0 * _SAME_TURN_RAD))


def _moved(T: Pose, place: Array) -> Pose:
    """Return a pose (4, 4), shifted in the plane and turned about its own vertical axis by a place (3,)."""
    c, s = math.cos(place[2]), math.sin(place[2])
    out = T.copy()
    out[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ T[:3, :3]
    out[:2, 3] += place[:2]
    return out


@compiled
def _tag(i: int, j: int) -> int:
    """Return a unique number for a world cell."""
    return (i + 1048576) * 2097152 + (j + 1048576)


@compiled
def _fill_between(w: Array, x: Array, y: Array, out: Array) -> int:
    """Write the points of `surface_points`, and return their number; `w` is the inverse depth."""
    n = 0
    rows, columns = w.shape
    for i in range(rows):
        for j in range(columns):
            if w[i, j] == 0.0:
                continue
            z = 1.0 / w[i, j]
            out[n, 0], out[n, 1], out[n, 2] = x[j] * z, y[i] * z, z
            here = n
            n += 1
            for direction in range(2):
                a, b = i + direction, j + 1 - direction
                if a >= rows or b >= columns or w[a, b] == 0.0:
                    continue
                z = 1.0 / w[a, b]
                dx, dy, dz = x[b] * z - out[here, 0], y[a] * z - out[here, 1], z - out[here, 2]
                gap = math.sqrt(dx * dx + dy * dy + dz * dz)
                if gap > _MAX_GAP_M:
                    continue
                steps = math.ceil(gap / (0.7 * _RESOLUTION_M))
                for k in range(1, steps):
                    s = k / steps
                    out[n, 0], out[n, 1], out[n, 2] = out[here, 0] + s * dx, out[here, 1] + s * dy, out[here, 2] + s * dz
                    n += 1
    return n


@compiled
def _claim(i: int, j: int, cells: Any) -> tuple[int, int]:
    """Return the buffer index of a world cell, and clear it if it held another cell."""
    a, b, tag = i & (_SIDE - 1), j & (_SIDE - 1), _tag(i, j)
    cell = cells[a, b]
    if cell.tag != tag:
        cell.tag, cell.seen_around = tag, 0
        cell.low = cell.low_around = np.inf
        cell.high = cell.high_around = cell.clear = -np.inf
    return a, b


@compiled
def _add(points: Array, T: Array, cells: Any) -> None:
    """Extend the height ranges of cells by points (n, 3) [m] {camera}, and the free heights along their rays."""
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        u = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / _RESOLUTION_M
        v = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / _RESOLUTION_M
        height = np.float32(T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])
        row, column = math.floor(u), math.floor(v)
        # 1. The cell and its neighbours.
        here = cells[_claim(row, column, cells)]
        if not here.low <= height <= here.high:
            newly_seen = here.low > here.high
            for i in range(row - 1, row + 2):
                for j in range(column - 1, column + 2):
                    cell = cells[_claim(i, j, cells)]
                    cell.seen_around += newly_seen
                    cell.low_around, cell.high_around = min(cell.low_around, height), max(cell.high_around, height)
            here.low, here.high = min(here.low, height), max(here.high, height)
        # 2. The cells that its ray crosses. A fraction of the rays is dense enough.
        if n % _RAY_STRIDE:
            continue
        du, dv, dz = T[0, 3] / _RESOLUTION_M - u, T[1, 3] / _RESOLUTION_M - v, T[2, 3] - height
        way = max(abs(du), abs(dv))
        for step in range(2, int(min(way, 0.5 * _SIDE))):
            s = step / way
            cell = cells[_claim(math.floor(u + s * du), math.floor(v + s * dv), cells)]
            cell.clear = max(cell.clear, np.float32(height + s * dz))


@compiled
def _count_points(points: Array, T: Array, cells: Any, noise: float, outside: Array) -> tuple[int, int, int]:
    """Return how many points (n, 3) [m] {camera} are on known cells, contradict the map, and fit.

    A point fits within the height range of its cell. The module's docstring states when it contradicts the map.
    Contradicting points are marked in `outside` (n,).
    """
    known = contradicting = fitting = 0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i = math.floor((T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / _RESOLUTION_M)
        j = math.floor((T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / _RESOLUTION_M)
        cell = cells[i & (_SIDE - 1), j & (_SIDE - 1)]
        if cell.tag != _tag(i, j) or cell.seen_around < 9:
            continue
        known += 1
        height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        tolerance = _TOLERANCE_M + noise * z * z
        fitting += cell.low - tolerance <= height <= cell.high + tolerance
        through = cell.high_around + tolerance < height < cell.clear - tolerance
        outside[n] = height < cell.low_around - tolerance or through
        contradicting += outside[n]
    return known, contradicting, fitting


@compiled
def _copy_window(cells: Any, row0: int, column0: int, out: Array) -> None:
    """Copy the lowest and highest point [levels] of known cells from a world cell on; in others the lowest is above."""
    rows, columns, _ = out.shape
    for i in range(rows):
        for j in range(columns):
            cell = cells[(row0 + i) & (_SIDE - 1), (column0 + j) & (_SIDE - 1)]
            known = cell.tag == _tag(row0 + i, column0 + j) and cell.seen_around >= 9
            out[i, j, 0] = cell.low * np.float32(1.0 / _TOLERANCE_M) if known else np.float32(1e9)
            out[i, j, 1] = cell.high * np.float32(1.0 / _TOLERANCE_M) if known else np.float32(-1e9)


@compiled
def _score_places(points: Array, T: Array, places: Array, cells: Any, noise: float, out: Array) -> None:
    """Write for each place (k, 3) the points on known cells, the fitting points, and the height [m], to `out` (k, 3).

    The height is the one at which the most points fit. The cells around are copied first, because they are read many times.
    """
    m = len(points)
    # Points relative to the camera in world axes [cells]; what is taken from the ends of a cell's range [levels].
    x, y, under, over = np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32)
    reach, shift = 0.0, 0.0
    for n in range(m):
        p = points[n]
        x[n] = (T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2]) / _RESOLUTION_M
        y[n] = (T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2]) / _RESOLUTION_M
        height = (T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]) / _TOLERANCE_M - _HEIGHT_STEPS
        slack = 1.0 + noise * p[2] * p[2] / _TOLERANCE_M
        under[n], over[n] = height + slack, height - slack
        reach = max(reach, math.hypot(x[n], y[n]))
    for place in places:
        shift = max(shift, abs(place[0]), abs(place[1]))
    half = math.ceil(reach + shift / _RESOLUTION_M) + 2
    row0, column0 = math.floor(T[0, 3] / _RESOLUTION_M) - half, math.floor(T[1, 3] / _RESOLUTION_M) - half
    side = np.int32(2 * half)
    window = np.empty((side, side, 2), np.float32)
    _copy_window(cells, row0, column0, window)
    heights = window.reshape(window.size)
    zero, one, end = np.float32(0.0), np.float32(1.0), np.float32(2 * _HEIGHT_STEPS + 1)
    levels = 2 * _HEIGHT_STEPS + 1
    begins, ends = np.empty(levels + 1, np.int32), np.empty(levels + 1, np.int32)
    at, begin, stop = np.empty(m, np.int32), np.empty(m, np.int32), np.empty(m, np.int32)
    low, high = np.empty(m, np.float32), np.empty(m, np.float32)
    for k in range(len(places)):
        c, s = np.float32(math.cos(places[k, 2])), np.float32(math.sin(places[k, 2]))
        x0 = np.float32((T[0, 3] + places[k, 0]) / _RESOLUTION_M - row0)
        y0 = np.float32((T[1, 3] + places[k, 1]) / _RESOLUTION_M - column0)
        for n in range(m):  # positive, so that int() rounds down
            at[n] = np.int32(x0 + c * x[n] - s * y[n]) * side + np.int32(y0 + s * x[n] + c * y[n])
        begins[:], ends[:] = 0, 0
        known = 0
        for n in range(m):
            cell = np.uint64(2 * at[n])
            low[n], high[n] = heights[cell], heights[cell + np.uint64(1)]
        for n in range(m):
            # The point fits if it is raised by a number of levels between these two.
            first, last = np.ceil(low[n] - under[n]), np.floor(high[n] - over[n])
            known += int(low[n] <= high[n])
            fits = (last >= zero) & (first < end) & (low[n] <= high[n])
            begin[n] = np.int32(max(first, zero)) if fits else np.int32(levels)
            stop[n] = np.int32(min(last + one, end)) if fits else np.int32(levels)
        for n in range(m):
            begins[np.uint64(begin[n])] += 1
            ends[np.uint64(stop[n])] += 1
        fitting, most, height = 0, -1.0, 0
        for level in range(levels):
            fitting += begins[level] - ends[level]
            # Among equally good heights, prefer the expected one.
            score = fitting - 1e-3 * abs(level - _HEIGHT_STEPS)
            if score > most:
                most, height = score, level
        out[k, 0] = known
        out[k, 1] = max(round(most), 0)
        out[k, 2] = (height - _HEIGHT_STEPS) * _TOLERANCE_M
