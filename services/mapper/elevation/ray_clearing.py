"""Things that are gone, cleared by lines of sight that pass where they stood."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import Cells
from sextant.services.mapper.elevation.validated_scan import CheckedScan
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled

FOLLOWED = 8  # every how many points of a scan have their line of sight followed, other ones each time
SHORT = 3  # cells before its end at which a line of sight stops: what it meets is thick, and not quite where it is mapped
WELL_BELOW = 0.02  # [m] beyond three sigma of a cell, by which a line of sight must pass below its height
SIGHTS_NEEDED = 8  # scans that look through a cell until it is cleared, without one that measures it
MAX_SIGMA_M = 0.01  # of a cell's height; what is more is the spread of what stood there, and says nothing of what is free
FELL_AROUND = 3  # neighbours that have fallen, from which on a cell at the rim of what stood there may fall, too
SETTLED = 2 * FOLLOWED * SIGHTS_NEEDED  # scans that measure a fallen cell, until what stands beside it is no remnant
_REFRESHED = 16  # scans after which the highest cell is looked for anew


class SightLines:
    """Looks through the cells of a map."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """Begin with a map (nx, ny) of which nothing is known."""
        self._highest, self._scans = -math.inf, 0
        self._marked = np.full(shape[0] * shape[1], -1, dtype=np.int32)  # a cell counts once a scan; -1 between scans

    def raised(self, z: float) -> None:
        """Hear of a height [m] that a cell may have."""
        self._highest = max(self._highest, z)

    def look(
        self,
        cells: Cells,
        low: NDArray[np.int64],
        resolution: float,
        drift: float,
        scan: CheckedScan,
        points: NDArray[Any],
        *,
        every: int = 1,
        nearest: float = 0.0,
    ) -> int:
        """Let every few lines of sight of a scan clear what stands in their way.

        Args:
            cells: Of the map.
            low: (2,) world index of the lowest cell of its window.
            resolution: [m] cell edge.
            drift: [m] by which the scan lies higher than what the map keeps.
            scan: Whose camera the lines begin at.
            points: (n, 3) where they end, in its unit from its origin.
            every: How many of them are passed over for one that is followed; other ones each scan.
            nearest: [m] from the camera up to which they say nothing.

        Returns:
            How many cells are unseen again.
        """
        if self._scans % _REFRESHED == 0:
            self._highest = float(np.fmax.reduce(cells.height, axis=None))
        if not len(points):
            return 0
        lowest = float(scan.origin[2]) + scan.unit * float(points[:, 2].min()) - drift
        if not self._highest - WELL_BELOW > lowest:
            return 0  # nothing stands above what is seen, as on level ground
        c = cells
        cleared = _clear_along_sights(
            points, scan.origin, scan.unit, self._scans % every, every, scan.p_world_camera, drift, nearest,
            int(low[0]), int(low[1]), resolution, self._highest,
            c.height, c.variance, c.support, c.assumed, c.votes, c.first, c.through, c.fell, self._marked,
        )  # fmt: skip
        return int(cleared)

    def scanned(self) -> None:
        """The lines of one scan have been followed."""
        self._scans += 1


@compiled
def _clear_along_sights(
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
    assumed: NDArray[np.uint8],
    votes: NDArray[np.uint8],
    first: NDArray[np.float32],
    through: NDArray[np.uint8],
    fell: NDArray[np.uint8],
    slot: NDArray[np.int32],
) -> int:
    """Count, once a scan, the cells that stand well above a line of sight, and clear those that have been so often.

    A cell counts within a body: none of its eight neighbours is known to lie lower than the line but such as have
    fallen already, and at most two are unknown; so what is narrower than three cells, a rim that fills its cells in part,
    and a wall seen along its face are left to measurement. A body is eaten from within: a rim falls after what it was the
    rim of. Outside of a body a cell counts that fewer scans have measured than must look through it: so something
    thin that has passed by does not stay.

    Returns the number of cells cleared.
    """
    rows, columns = height.shape
    heights = height.ravel()
    marked = np.empty(rows * columns, dtype=np.int64)
    m = 0
    wrap_i, wrap_j = low_i % rows, low_j % columns
    for k in range(begin, len(ends), every):
        x, y, z = origin[0] + unit * ends[k, 0], origin[1] + unit * ends[k, 1], origin[2] + unit * ends[k, 2] - drift
        u, v = x / resolution - low_i, y / resolution - low_j
        du, dv, dz = camera[0] / resolution - low_i - u, camera[1] / resolution - low_j - v, camera[2] - drift - z
        way = max(abs(du), abs(dv))
        length = resolution * math.sqrt(du * du + dv * dv)
        if way <= SHORT or length <= nearest or dz <= 0.0:
            continue
        rise = 0.75 * dz / way  # from the middle of a cell to where the line is highest in it
        # Only the steps within the window: a line may be far longer than that.
        enters, leaves = SHORT / way, 1.0 - nearest / length
        for at, along, end in ((u, du, rows - 1.0), (v, dv, columns - 1.0)):
            if along != 0.0:
                near, far = (1.0 - at) / along, (end - at) / along
                enters, leaves = max(enters, min(near, far)), min(leaves, max(near, far))
            elif not 1.0 <= at < end:
                leaves = -1.0
        if enters >= leaves:
            continue
        start = max(SHORT, int(way * enters) - 1)  # rounding may take a step on either side
        # Nothing is as high as the line from where on it is above everything. A float: it is infinite for a level line.
        above = (highest - z - rise - WELL_BELOW) / dz * way + 2.0
        last = int(max(min(way * leaves + 2.0, way * (1.0 - nearest / length), above), 0.0))
        step_x, step_y, step_z = du / way, dv / way, dz / way
        x, y, over = u + (start - 1) * step_x, v + (start - 1) * step_y, z + (start - 1) * step_z + rise + WELL_BELOW
        for _ in range(start, last):
            x, y, over = x + step_x, y + step_y, over + step_z
            i, j = int(x), int(y)  # what rounding lets out of the window, on the lower side comes to 0
            if i < 1 or j < 1 or i >= rows - 1 or j >= columns - 1:
                continue
            a, b = i + wrap_i, j + wrap_j
            a, b = (a if a < rows else a - rows), (b if b < columns else b - columns)
            c = a * columns + b
            if not heights[np.uint64(c)] > over:
                continue
            if not height[a, b] > over + 3.0 * min(math.sqrt(variance[a, b]), MAX_SIGMA_M):
                continue
            if slot[c] >= 0:
                continue
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
            within = (low == 0 and standing + fallen >= 6) or fallen >= FELL_AROUND
            if within or support[a, b] < SIGHTS_NEEDED:
                slot[c] = 0
                marked[m] = c
                m += 1
    cleared = 0
    for k in range(m):
        c = marked[k]
        slot[c] = -1
        a, b = c // columns, c % columns
        through[a, b] += 1
        if through[a, b] < SIGHTS_NEEDED:
            continue
        height[a, b] = variance[a, b] = first[a, b] = np.nan
        support[a, b] = assumed[a, b] = votes[a, b] = through[a, b] = 0
        fell[a, b] = 1
        cleared += 1
    return cleared
