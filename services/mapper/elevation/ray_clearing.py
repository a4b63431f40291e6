"""Clearing of objects that have gone, by rays that pass through their cells."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import CellLayers
from sextant.services.mapper.elevation.params import RayClearingParams
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled

_REFRESHED = 16  # [scans] between searches for the highest cell
_MOST_SCANS = 255  # scans that a layer of bytes counts


class _Thresholds(NamedTuple):
    """Values of `RayClearingParams` for compiled functions."""

    short_cells: int
    well_below_m: float
    scans_inside: int
    scans_per_measurement: int
    max_sigma_m: float
    cleared_neighbours: int


class RayClearing:
    """Clearing of map cells by rays."""

    def __init__(self, shape: tuple[int, int], params: RayClearingParams) -> None:
        """Create for an unseen map of shape (nx, ny)."""
        self._thresholds = _Thresholds(**{name: getattr(params, name) for name in _Thresholds._fields})
        self._highest, self._scans = -math.inf, 0
        cells = shape[0] * shape[1]
        self._counted = np.empty(cells, dtype=np.int32)  # flat indices of the cells that the rays of a scan pass through
        self._number = 0  # of counted cells
        self._marked = np.full(cells, -1, dtype=np.int8)  # -1 not counted in this scan, 1 counted inside an object, else 0

    def note_height(self, z: float) -> None:
        """Register a new height [m] of a cell."""
        self._highest = max(self._highest, z)

    def count_along_rays(
        self,
        cells: CellLayers,
        low: NDArray[np.int64],
        resolution: float,
        drift: float,
        scan: ValidatedScan,
        points: NDArray[Any],
        *,
        every: int = 1,
        nearest: float = 0.0,
    ) -> None:
        """Count the cells that rays of a scan pass through, each at most once until `end_scan`.

        Args:
            cells: Cells of the map.
            low: (2,) world index of the lowest cell of its window.
            resolution: [m] cell edge.
            drift: [m] height of the scan above the heights stored in the map.
            scan: Scan from whose camera the rays start.
            points: (n, 3) ends of the rays, in the scan's unit from its origin.
            every: Every n-th ray is traced, different ones in each scan.
            nearest: [m] from the camera, up to which the rays prove nothing.
        """
        if self._scans % _REFRESHED == 0:
            self._highest = float(np.fmax.reduce(cells.height, axis=None))
        if not len(points):
            return
        lowest = float(scan.origin[2]) + scan.unit * float(points[:, 2].min()) - drift
        if not self._highest - self._thresholds.well_below_m > lowest:
            return  # no cell is higher than the ray ends, as on level ground
        self._number = _count_along_sights(
            points, scan.origin, scan.unit, self._scans % every, every, scan.p_world_camera, drift, nearest,
            int(low[0]), int(low[1]), resolution, self._highest,
            cells.height, cells.variance, cells.support, cells.fell, self._marked, self._counted, self._number,
            self._thresholds,
        )  # fmt: skip

    def end_scan(self, cells: CellLayers) -> int:
        """End a scan: clear the cells that rays of enough scans have passed through.

        Returns:
            The number of cells that are unseen again.
        """
        self._scans += 1
        number, self._number = self._number, 0
        if not number:
            return 0
        c = cells
        cleared = _clear_counted(
            self._counted[:number], self._marked, c.height, c.variance, c.support, c.assumed, c.votes, c.first, c.through,
            c.fell, self._thresholds,
        )  # fmt: skip
        return int(cleared)


@compiled
def _is_inside(
    height: NDArray[np.float32], fell: NDArray[np.uint8], a: int, b: int, over: float, cleared_neighbours: int
) -> bool:
    """Return whether the cell at (a, b) of the buffer is inside an object that a ray at the height `over` [m] crosses.

    It is if none of its eight neighbours is known to be lower than the ray, except those already cleared, and at most two are
    unknown; or if enough neighbours are cleared. Objects narrower than three cells, rims that fill their cells partly, and
    walls seen along their face have no inside.
    """
    rows, columns = height.shape
    standing = fallen = low = 0
    for p in range(-1, 2):
        for q in range(-1, 2):
            if p == 0 and q == 0:
                continue
            e, f = a + p, b + q
            e = e - rows if e >= rows else (e + rows if e < 0 else e)
            f = f - columns if f >= columns else (f + columns if f < 0 else f)
            if height[e, f] > over:
                standing += 1
            elif fell[e, f] != 0:
                fallen += 1
            elif height[e, f] == height[e, f]:
                low += 1
    return (low == 0 and standing + fallen >= 6) or fallen >= cleared_neighbours


@compiled
def _scans_needed(within: bool, support: int, thresholds: _Thresholds) -> int:
    """Return the number of scans through a cell that clear it, if `support` scans have measured it."""
    needed = thresholds.scans_per_measurement * max(int(support), 1)
    return min(needed, thresholds.scans_inside) if within else needed


@compiled
def _count_along_sights(
    ends: NDArray[Any],
    origin: Array,
    unit: float,
    begin: int,
    every: int,
    camera: NDArray[np.float64],
    drift: float,
    nearest: float,
    low_i: int,
    low_j: int,
    resolution: float,
    highest: float,
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    support: NDArray[np.uint8],
    fell: NDArray[np.uint8],
    marked: NDArray[np.int8],
    counted: NDArray[np.int32],
    m: int,
    thresholds: _Thresholds,
) -> int:
    """Add cells that stand well above a ray to the `m` cells counted in this scan, and return their new number.

    The arguments are plain, because unpacking tuples of arrays in each call would be slow.
    """
    rows, columns = height.shape
    heights = height.ravel()
    wrap_i, wrap_j = low_i % rows, low_j % columns
    for k in range(begin, len(ends), every):
        x, y, z = origin[0] + unit * ends[k, 0], origin[1] + unit * ends[k, 1], origin[2] + unit * ends[k, 2] - drift
        u, v = x / resolution - low_i, y / resolution - low_j
        du, dv, dz = camera[0] / resolution - low_i - u, camera[1] / resolution - low_j - v, camera[2] - drift - z
        way = max(abs(du), abs(dv))
        length = resolution * math.sqrt(du * du + dv * dv)
        if way <= thresholds.short_cells or length <= nearest or dz <= 0.0:
            continue
        rise = 0.75 * dz / way  # from the middle of a cell to the highest point of the ray in it
        # Only the steps within the window: a ray may be far longer.
        enters, leaves = thresholds.short_cells / way, 1.0 - nearest / length
        for at, along, end in ((u, du, rows - 1.0), (v, dv, columns - 1.0)):
            if along != 0.0:
                near, far = (1.0 - at) / along, (end - at) / along
                enters, leaves = max(enters, min(near, far)), min(leaves, max(near, far))
            elif not 1.0 <= at < end:
                leaves = -1.0
        if enters >= leaves:
            continue
        start = max(thresholds.short_cells, int(way * enters) - 1)  # rounding may need one more step on either side
        # The ray can stop where it is above all cells. The value is a float, because it is infinite for a level ray.
        above = (highest - z - rise - thresholds.well_below_m) / dz * way + 2.0
        last = int(max(min(way * leaves + 2.0, way * (1.0 - nearest / length), above), 0.0))
        step_x, step_y, step_z = du / way, dv / way, dz / way
        x, y, over = (
            u + (start - 1) * step_x,
            v + (start - 1) * step_y,
            z + (start - 1) * step_z + rise + thresholds.well_below_m,
        )
        for _ in range(start, last):
            x, y, over = x + step_x, y + step_y, over + step_z
            i, j = int(x), int(y)  # an index that rounding moves out of the window is 0 on the lower side
            if i < 1 or j < 1 or i >= rows - 1 or j >= columns - 1:
                continue
            a, b = i + wrap_i, j + wrap_j
            a, b = (a if a < rows else a - rows), (b if b < columns else b - columns)
            c = a * columns + b
            if not heights[np.uint64(c)] > over:
                continue
            if not height[a, b] > over + 3.0 * min(math.sqrt(variance[a, b]), thresholds.max_sigma_m):
                continue
            if marked[c] >= 0:
                continue
            within = _is_inside(height, fell, a, b, over, thresholds.cleared_neighbours)
            if _scans_needed(within, support[a, b], thresholds) <= _MOST_SCANS:
                marked[c] = np.int8(within)
                counted[m] = c
                m += 1
    return m


@compiled
def _clear_counted(
    counted: NDArray[np.int32],
    marked: NDArray[np.int8],
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    support: NDArray[np.uint8],
    assumed: NDArray[np.uint8],
    votes: NDArray[np.uint8],
    first: NDArray[np.float32],
    through: NDArray[np.uint8],
    fell: NDArray[np.uint8],
    thresholds: _Thresholds,
) -> int:
    """Clear those of the counted cells that enough scans have counted, and return their number.

    An object is cleared from the inside (`_is_inside`): a rim follows after its inside. A cell that is not inside an object
    needs several times as many scans through it as have measured it. A thin object that passed is thus cleared, and one that
    stands remains.
    """
    columns = height.shape[1]
    cleared = 0
    for k in range(len(counted)):
        c = counted[k]
        within, marked[c] = marked[c] == 1, -1
        a, b = c // columns, c % columns
        through[a, b] = min(through[a, b] + 1, _MOST_SCANS)
        if through[a, b] < _scans_needed(within, support[a, b], thresholds):
            continue
        height[a, b] = variance[a, b] = first[a, b] = np.nan
        support[a, b] = assumed[a, b] = votes[a, b] = through[a, b] = 0
        fell[a, b] = 1
        cleared += 1
    return cleared
