"""The ground that keyframes have seen, coarse: whether a frame lies where it should, and where it lies instead.

Registration finds the nearest pose that fits. On mostly level ground the floor alone fits anywhere, so a robot that has been
carried off, or has slid further than a gate, agrees with almost everything it sees. Here the rest is asked: each cell of
a grid keeps the lowest and the highest point seen in it, and a frame's points are looked up there. What a cell shows of an
edge depends on where it is seen from, so cells count only once all their neighbours have been seen, too, and a frame is doubted
only for what lies below all of those, where it would be seen through the ground, or above them where an earlier frame has
looked through: other things above may be faces that come into view. To find a lost frame, places around the expected one
are tried, each with the height that suits it best.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array as Pose
from sextant.shared.runtime.compiled import compiled

Array = NDArray[Any]

_RESOLUTION = 0.02  # [m] cell edge
_SIDE = 512  # cells along an edge; further on, the grid begins anew over itself
_GAP = 0.08  # [m] between neighbours of an image that are taken for one surface
_MOST_BETWEEN = 1 + 2 * math.ceil(_GAP / (0.7 * _RESOLUTION))
_TOLERANCE = 0.015  # [m] outside of what a cell has shown
_NOISE = 2.0  # [sigma] of a pixel's depth on top
_REACH, _TURN = 0.36, math.radians(18.0)  # [m] [rad] searched around the expected place
_STEP, _ANGLE = 0.04, math.radians(3.0)  # of the coarse search
_FINE_STEP, _FINE_ANGLE = 0.01, math.radians(1.0)
_FINE = np.arange(-3, 4)
_AGAINST = 18.0  # points that fit make up for one that does not
_WAY = 0.4  # of the worth that reaching so far, turning so much, or rising by
_RISE = 0.10  # [m] costs
_LEVELS = 12  # heights tried to each side, a tolerance apart
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_TRIED, _TRIED_FINELY = 300, 1000  # points looked up at each place
_SIGHTS = 4  # every how many lines of sight are followed
_REFINED = 6  # best places of the coarse search that are refined
_REFINED_FEW = 2  # likewise around each of many poses
_STARTS_APART = 0.24  # [m] searched around each of them
_MIN_FIT_ANYWHERE = 0.9  # share of the points that must suit a place that may be anywhere
_MIN_KNOWN = 0.4  # share of the points that must fall on known cells
_MIN_FIT = 0.85  # share of those that must suit the place found
_BETTER = 0.03  # by which its fit must at least exceed that of the expected place
_SIGMAS = 3.0  # of the counts, on top
_APART, _TURNED, _RISEN = 0.05, math.radians(4.0), 0.04  # [m] [rad] [m] from where on a place is another one

_CELL = np.dtype(
    [
        ("tag", np.int64),  # which cell of the world is kept here
        ("low", np.float32),  # [m] lowest and highest point seen in it, reversed where none was
        ("high", np.float32),
        ("low_around", np.float32),  # [m] the same, neighbours included
        ("high_around", np.float32),
        ("clear", np.float32),  # [m] up to where it has been looked through
        ("seen_around", np.int32),  # how many of it and its eight neighbours have been seen
    ]
)


def surface_points(inverse_depth: Array, x: Array, y: Array) -> Array:
    """Points (n, 3) [m] {camera} of an image (rows, columns) of inverse depth [1/m], 0 for none, and between its neighbours.

    The floor ahead is sampled more thinly than the grid has cells; what lies between two neighbours that are near each other
    is taken for straight. x and y are the rays of columns and rows at unit depth.
    """
    out = np.empty((_MOST_BETWEEN * inverse_depth.size, 3))
    return out[: _fill_between(inverse_depth, x, y, out)]


@dataclass(frozen=True, slots=True)
class Found:
    """Where a lost frame lies, or why that cannot be told."""

    T_world_camera: Pose | None  # (4, 4)
    reason: str  # in words, empty when it was found


@dataclass(frozen=True, slots=True)
class Misfit:
    """What of a frame contradicts the map."""

    share: float  # of the points on known cells
    xy: NDArray[np.float64]  # (n, 2) [m] {world} where those points are


class AnchorMap:
    """Lowest and highest point of each cell, in a circular buffer."""

    def __init__(self, sigma: float) -> None:
        """Begin with nothing known.

        Args:
            sigma: [1/m] of a depth over its square: one-sigma noise of a pixel.
        """
        self._noise = _NOISE * sigma
        self._cells = np.zeros((_SIDE, _SIDE), dtype=_CELL)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._cells["tag"] = -1

    def add(self, points: Array, T_world_camera: Pose) -> None:
        """Take in points (n, 3) [m] {camera} seen from a pose (4, 4)."""
        _add(points, T_world_camera, self._cells)

    def misfit(self, points: Array, T_world_camera: Pose) -> Misfit:
        """Which points (n, 3) [m] {camera} on known cells lie outside of what those and their neighbours have shown.

        What lies above counts only where something has been seen through it. None where few are known.
        """
        points = _some(points, _TRIED_FINELY)
        outside = np.zeros(len(points), dtype=np.bool_)
        known, misfit, _ = _look_up(points, T_world_camera, self._cells, self._noise, outside)
        if known < _MIN_KNOWN * len(points):
            return Misfit(0.0, np.zeros((0, 2)))
        return Misfit(misfit / known, points[outside] @ T_world_camera[:2, :3].T + T_world_camera[:2, 3])

    def find(self, points: Array, T_world_camera: Pose) -> Found:
        """Where points (n, 3) [m] {camera} fit best, around the expected pose (4, 4), whose roll and pitch are believed."""
        few, points = _some(points, _TRIED), _some(points, _TRIED_FINELY)
        n = len(points)
        known, _, fitting = _look_up(points, T_world_camera, self._cells, self._noise, np.zeros(n, dtype=np.bool_))
        # 1. All places, coarsely.
        shifts = np.arange(-_REACH, _REACH + _STEP / 2, _STEP)
        angles = np.arange(-_TURN, _TURN + _ANGLE / 2, _ANGLE)
        places = _grid(shifts, angles)
        fits, worths, heights = self._judge(few, T_world_camera, places)
        if fits.max() < 0.0:
            return Found(None, "lost: nothing within reach has been seen before")
        # 2. The best of them, finely. Of places that look alike the nearest is taken: what the ground does not show stays
        # as expected.
        around = _grid(_FINE * _FINE_STEP, _FINE * _FINE_ANGLE)
        near = (places[_apart(places, worths - _far(places, heights), _REFINED), None] + around).reshape(-1, 3)
        fits, worths, heights = self._judge(points, T_world_camera, near)
        best = int(np.argmax(worths - _far(near, heights)))
        fit = float(fits[best])
        # 3. It must be good, and another one, and better than here, where ground that was never seen speaks against nothing.
        if fit < _MIN_FIT:
            return Found(None, f"lost: the best place within {_REACH:g} m fits {100 * max(fit, 0.0):.0f} % of the ground seen")
        another = _is_other(near[best], np.zeros(3)) or abs(heights[best]) > _RISEN
        fit_here = (fitting + fit * (n - known)) / n
        if not another or fit < fit_here + _BETTER + _SIGMAS * math.sqrt(fit * (1.0 - fit) / n):
            return Found(None, "no place nearby fits better than the expected one")
        T = _placed(T_world_camera, near[best])
        T[2, 3] += heights[best]
        return Found(T, "")

    def relocalize(self, points: Array, starts: Array) -> Found:
        """Where points (n, 3) [m] {camera} fit, around any of some poses (k, 4, 4), whose roll and pitch are believed.

        A place counts only if no other place fits as well.
        """
        few, points = _some(points, _TRIED), _some(points, _TRIED_FINELY)
        shifts = np.arange(-_STARTS_APART, _STARTS_APART + _STEP / 2, _STEP)
        places = _grid(shifts, np.arange(-_TURN, _TURN + _ANGLE / 2, _ANGLE))
        around = _grid(_FINE * _FINE_STEP, _FINE * _FINE_ANGLE)
        candidates: list[tuple[float, float, Pose]] = []  # worth, fit and pose of the best places around each start
        for T in starts:
            fits, worths, heights = self._judge(few, T, places)
            if fits.max() < 0.0:
                continue
            for k in _apart(places, worths - _far(places, heights), _REFINED_FEW):
                near = places[k] + around
                fits, worths, heights = self._judge(points, T, near)
                best = int(np.argmax(worths))
                pose = _placed(T, near[best])
                pose[2, 3] += heights[best]
                candidates.append((float(worths[best]), float(fits[best]), pose))
        if not candidates:
            return Found(None, "lost: nothing in view has been seen before")
        candidates.sort(key=lambda candidate: -candidate[0])
        _, fit, T = candidates[0]
        if fit < _MIN_FIT_ANYWHERE:
            return Found(None, f"lost: the best place in the map fits {100 * max(fit, 0.0):.0f} % of the ground seen")
        rivals = [other for _, other, at in candidates[1:] if _differs(at, T)]
        if rivals and max(rivals) > fit - _BETTER:
            return Found(None, "lost: several places in the map look alike")
        return Found(T, "")

    def _judge(self, points: Array, T: Pose, places: Array) -> tuple[Array, Array, Array]:
        """For each place (k, 3) the share of points that fit of those on known cells, its worth, and its height [m].

        A point that does not fit tells far more against a place than one that does, on level ground say, tells for it; one that
        falls where nothing is known tells nothing. Both are -1 and minus infinity where too few cells are known.
        """
        out = np.empty((len(places), 3))
        _score_places(points, T, places, self._cells, self._noise, out)
        known, fitting, heights = out.T
        enough = known >= _MIN_KNOWN * len(points)
        worth = (fitting - _AGAINST * (known - fitting)) / len(points)
        return np.where(enough, fitting / np.maximum(known, 1.0), -1.0), np.where(enough, worth, -np.inf), heights


def _some(points: Array, count: int) -> Array:
    """Some of many points, evenly, but in no step: one that goes evenly into the image's width would read few columns."""
    if len(points) <= count:
        return points
    return np.asarray(points[(np.arange(count) * _GOLDEN % 1.0 * len(points)).astype(np.intp)])


def _grid(shifts: Array, angles: Array) -> Array:
    """Places (k, 3): shifts in x and y [m], and a turn [rad]."""
    return np.stack(np.meshgrid(shifts, shifts, angles, indexing="ij"), axis=-1).reshape(-1, 3)


def _far(places: Array, heights: Array) -> Array:
    """What the way from the expected place takes from its worth."""
    way = np.hypot(places[:, 0], places[:, 1]) / _REACH + np.abs(places[:, 2]) / _TURN + np.abs(heights) / _RISE
    return np.asarray(_WAY * way)


def _is_other(places: Array, place: Array) -> NDArray[np.bool_]:
    way = places - place
    return np.asarray((np.hypot(way[..., 0], way[..., 1]) > _APART) | (np.abs(way[..., 2]) > _TURNED))


def _apart(places: Array, worth: Array, count: int) -> NDArray[np.intp]:
    """The most worthy places that are apart from each other, best first."""
    chosen: list[int] = []
    left = np.ones(len(places), dtype=bool)
    while len(chosen) < count and left.any():
        k = int(np.argmax(np.where(left, worth, -np.inf)))
        chosen.append(k)
        left &= _is_other(places, places[k])
    return np.array(chosen)


def _differs(T: Pose, other: Pose) -> bool:
    """Whether two poses are so far apart that fine searches around them do not meet."""
    far = np.linalg.norm(T[:2, 3] - other[:2, 3]) > 2.0 * _APART
    cosine = (np.trace(T[:3, :3].T @ other[:3, :3]) - 1.0) / 2.0
    return bool(far or cosine < math.cos(2.0 * _TURNED))


def _placed(T: Pose, place: Array) -> Pose:
    """A pose (4, 4) shifted in the plane and turned about the vertical through it."""
    c, s = math.cos(place[2]), math.sin(place[2])
    out = T.copy()
    out[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ T[:3, :3]
    out[:2, 3] += place[:2]
    return out


@compiled
def _tag(i: int, j: int) -> int:
    """A number for each cell of the world."""
    return (i + 1048576) * 2097152 + (j + 1048576)


@compiled
def _fill_between(w: Array, x: Array, y: Array, out: Array) -> int:
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
                if gap > _GAP:
                    continue
                steps = math.ceil(gap / (0.7 * _RESOLUTION))
                for k in range(1, steps):
                    s = k / steps
                    out[n, 0], out[n, 1], out[n, 2] = out[here, 0] + s * dx, out[here, 1] + s * dy, out[here, 2] + s * dz
                    n += 1
    return n


@compiled
def _claim(i: int, j: int, cells: Any) -> tuple[int, int]:
    """Where a cell of the world is kept, emptied if it was another's."""
    a, b, tag = i & (_SIDE - 1), j & (_SIDE - 1), _tag(i, j)
    cell = cells[a, b]
    if cell.tag != tag:
        cell.tag, cell.seen_around = tag, 0
        cell.low = cell.low_around = np.inf
        cell.high = cell.high_around = cell.clear = -np.inf
    return a, b


@compiled
def _add(points: Array, T: Array, cells: Any) -> None:
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        u = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / _RESOLUTION
        v = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / _RESOLUTION
        height = np.float32(T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])
        row, column = math.floor(u), math.floor(v)
        # 1. The cell and its neighbours.
        here = cells[_claim(row, column, cells)]
        if not here.low <= height <= here.high:
            news = here.low > here.high
            for i in range(row - 1, row + 2):
                for j in range(column - 1, column + 2):
                    cell = cells[_claim(i, j, cells)]
                    cell.seen_around += news
                    cell.low_around, cell.high_around = min(cell.low_around, height), max(cell.high_around, height)
            here.low, here.high = min(here.low, height), max(here.high, height)
        # 2. What the line of sight to it crosses; every few of them make a dense fan.
        if n % _SIGHTS:
            continue
        du, dv, dz = T[0, 3] / _RESOLUTION - u, T[1, 3] / _RESOLUTION - v, T[2, 3] - height
        way = max(abs(du), abs(dv))
        for step in range(2, int(min(way, 0.5 * _SIDE))):
            s = step / way
            cell = cells[_claim(math.floor(u + s * du), math.floor(v + s * dv), cells)]
            cell.clear = max(cell.clear, np.float32(height + s * dz))


@compiled
def _look_up(points: Array, T: Array, cells: Any, noise: float, outside: Array) -> tuple[int, int, int]:
    """How many points (n, 3) {camera} fall on known cells, how many of them cannot be there, how many have been seen there.

    What cannot be there lies below all that a cell and its neighbours have shown, or above it where it has been looked through:
    those points are marked in `outside` (n,).
    """
    known = misfit = fitting = 0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i = math.floor((T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / _RESOLUTION)
        j = math.floor((T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / _RESOLUTION)
        cell = cells[i & (_SIDE - 1), j & (_SIDE - 1)]
        if cell.tag != _tag(i, j) or cell.seen_around < 9:
            continue
        known += 1
        height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        tolerance = _TOLERANCE + noise * z * z
        fitting += cell.low - tolerance <= height <= cell.high + tolerance
        through = cell.high_around + tolerance < height < cell.clear - tolerance
        outside[n] = height < cell.low_around - tolerance or through
        misfit += outside[n]
    return known, misfit, fitting


@compiled
def _score_places(points: Array, T: Array, places: Array, cells: Any, noise: float, out: Array) -> None:
    """For each place (k, 3): points on known cells, most that fit at one height, and that height [m]."""
    m = len(points)
    flat = np.empty((m, 3))  # from the camera, in world axes
    for n in range(m):
        for a in range(3):
            flat[n, a] = T[a, 0] * points[n, 0] + T[a, 1] * points[n, 1] + T[a, 2] * points[n, 2]
    levels = 2 * _LEVELS + 1
    begins, ends = np.empty(levels + 1, np.int64), np.empty(levels + 1, np.int64)
    for k in range(len(places)):
        c, s = math.cos(places[k, 2]), math.sin(places[k, 2])
        x0, y0 = T[0, 3] + places[k, 0], T[1, 3] + places[k, 1]
        begins[:], ends[:] = 0, 0
        known = 0
        for n in range(m):
            i = math.floor((x0 + c * flat[n, 0] - s * flat[n, 1]) / _RESOLUTION)
            j = math.floor((y0 + s * flat[n, 0] + c * flat[n, 1]) / _RESOLUTION)
            cell = cells[i & (_SIDE - 1), j & (_SIDE - 1)]
            if cell.tag != _tag(i, j) or cell.seen_around < 9:
                continue
            known += 1
            # It fits if raised by what lies between these two.
            height = T[2, 3] + flat[n, 2]
            tolerance = _TOLERANCE + noise * points[n, 2] * points[n, 2]
            first = math.ceil((cell.low - tolerance - height) / _TOLERANCE) + _LEVELS
            last = math.floor((cell.high + tolerance - height) / _TOLERANCE) + _LEVELS
            if last < 0 or first >= levels:
                continue
            begins[max(int(first), 0)] += 1
            ends[min(int(last), levels - 1) + 1] += 1
        fitting, most, at = 0, -1.0, 0
        for level in range(levels):
            fitting += begins[level] - ends[level]
            # Of heights that suit equally, the expected one.
            worth = fitting - 1e-3 * abs(level - _LEVELS)
            if worth > most:
                most, at = worth, level
        out[k, 0] = known
        out[k, 1] = max(round(most), 0)
        out[k, 2] = (at - _LEVELS) * _TOLERANCE
