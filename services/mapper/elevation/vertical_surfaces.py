"""Vertical surfaces in the elevation map, which keep the largest height seen.

A scan shows a face only as high as it rises within the image, and less of it as the camera approaches. In the end the camera
sees the ground in front of it, in the same cell as the foot of the face. None of these measurements means that the face is
lower than seen from afar. The face is gone only if ground was seen in its cell and on all eight sides since the face was last
seen. This may take several scans, because the rows of a coarse camera are cells apart. A face next to ground of known, equal
height needs no such protection, and keeps its measured width.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import CellLayers
from sextant.services.mapper.elevation.fusion import Measurements
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import as_plain, compiled

TALL = 0.06  # [m] of a cell's spread in a scan, beyond the pose's error, from which the cell holds a face
RIM = 0.02  # [m] between a measurement and the map, beyond which they are different heights
RIM_VARIANCE = (RIM / 3.0) ** 2  # [m^2] variance for which RIM is at a gate of three sigma
REACH = 8  # [cells] searched to a side of a face; the nearest measured cell represents that side
_ALL_SIDES = 0xFF


class _Surface(NamedTuple):
    """Layers of the map that hold vertical surfaces, see `CellLayers`; flat but for the grid."""

    grid: NDArray[np.float32]  # (nx, ny) the heights
    height: NDArray[np.float32]
    variance: NDArray[np.float32]
    assumed: NDArray[np.uint8]
    face: NDArray[np.uint8]
    below: NDArray[np.uint8]


def limit_surface_updates(
    cells: CellLayers,
    touched: NDArray[np.int64],
    z: Array,
    random: Array,
    systematic: Array,
    slot: NDArray[np.int32],
    sigma: float,
    low: NDArray[np.int64],
) -> int:
    """Limit the effect of a scan's measurements on vertical surfaces.

    This precedes the filters.

    1. A face that rises above the known one raises the cell at once. A face that shows less confirms the cell.
    2. A face where flat ground was known disputes it, even if its spread is wide.
    3. If ground as high as the face is known next to it, the cell is treated as any other.
    4. Ground below a known face is ignored until it was seen on all eight sides since the face was last seen. Then the face
       is removed.

    Ignored measurements are removed in place.

    Returns the number of measurements left.

    Args:
        cells: Cells of the map.
        touched: (m,) flat indices of the cells that the scan measures, each once.
        z: (m,) [m] heights of the scan there.
        random: (m,) [m^2] variance that averages out.
        systematic: (m,) [m^2] variance that does not average out, which includes the spread.
        slot: -1 for every cell, before and after.
        sigma: [m] one-sigma height error due to the pose.
        low: (2,) world index of the lowest cell of the map's window; cells outside are unknown.
    """
    rows, columns = cells.height.shape
    wrap = int(low[0] % rows), int(low[1] % columns)
    surface = _Surface(
        cells.height,
        cells.height.ravel(),
        cells.variance.ravel(),
        cells.assumed.ravel(),
        cells.face.ravel(),
        cells.below.ravel(),
    )
    measured = Measurements(touched, z, random, systematic)
    return int(_limit_updates(as_plain(measured), TALL**2 + 9.0 * sigma**2, as_plain(surface), slot, wrap))


@compiled
def _limit_updates(
    measured: Measurements, tall: float, surface: _Surface, slot: NDArray[np.int32], wrap: tuple[int, int]
) -> int:
    touched, z, random, systematic = measured
    grid, height, variance, assumed, face, below = surface
    n = len(touched)
    known = np.flatnonzero(face)
    if not len(known) and not (systematic > tall).any():
        return n
    for k in range(n):
        slot[np.uint64(touched[k])] = k
    for cell in known:
        top = height[cell] - RIM
        if not np.isnan(top):
            below[cell] = _sides_below(int(cell), top, below[cell], z, systematic, tall, slot, grid.shape, wrap)
    silent = np.zeros(n, dtype=np.bool_)
    for k in range(n):
        c = np.uint64(touched[k])
        rises = systematic[k] > tall
        if assumed[c] or np.isnan(height[c]):
            face[c], below[c] = np.uint8(rises), np.uint8(0)
            continue
        if not (rises or face[c]):
            continue
        above = z[k] - height[c]
        if rises or above > -RIM:
            below[c] = 0
        if _held(touched[k], height[c] + max(above, 0.0) - RIM, grid, variance, assumed, face, wrap):
            face[c] = 0
        elif rises and above > RIM and not face[c]:
            systematic[k] = RIM_VARIANCE
        elif rises:
            if above > 0.0 and face[c]:
                height[c], variance[c] = z[k], systematic[k]
            face[c] |= np.uint8(above > -RIM)
            z[k], systematic[k] = height[c], max(systematic[k], np.float64(variance[c]))
        elif above < -RIM:
            if below[c] == _ALL_SIDES:
                face[c], variance[c] = np.uint8(0), min(variance[c], np.float32(RIM_VARIANCE))
            else:
                silent[k] = True
    m = 0
    for k in range(n):
        slot[np.uint64(touched[k])] = -1
        touched[m], z[m], random[m], systematic[m] = touched[k], z[k], random[k], systematic[k]
        m += int(not silent[k])
    return m


@compiled
def _held(
    cell: int,
    top: float,
    grid: NDArray[np.float32],
    variance: NDArray[np.float32],
    assumed: NDArray[np.uint8],
    face: NDArray[np.uint8],
    wrap: tuple[int, int],
) -> bool:
    """Return whether well-known ground above a height [m] is next to a cell."""
    rows, columns = grid.shape
    i, j = (cell // columns - wrap[0]) % rows, (cell % columns - wrap[1]) % columns
    for a in range(max(i - 1, 0), min(i + 2, rows)):
        for b in range(max(j - 1, 0), min(j + 2, columns)):
            u, v = (a + wrap[0]) % rows, (b + wrap[1]) % columns
            n = u * columns + v
            if grid[u, v] > top and variance[n] < RIM_VARIANCE and not (face[n] or assumed[n] or n == cell):
                return True
    return False


@compiled
def _sides_below(
    cell: int,
    top: float,
    before: int,
    z: Array,
    systematic: Array,
    tall: float,
    slot: NDArray[np.int32],
    shape: tuple[int, int],
    wrap: tuple[int, int],
) -> np.uint8:
    """Return one bit for each side of a cell on which ground below a height was seen.

    The height `top` is in metres. `before` holds the sides of earlier scans. A side is represented by the nearest cell that
    the scan measures there. It may be one cell farther than that of the opposite side, or next to the cell if nothing is
    measured on the opposite side. This allows for the distance of the scan's rows, but not for cells behind an object that
    hides the ground. A side loses its bit if a greater height or a face is measured. Nothing is seen outside the window.
    """
    rows, columns = shape
    i, j = (cell // columns - wrap[0]) % rows, (cell % columns - wrap[1]) % columns
    far, entry = np.zeros(8, dtype=np.int64), np.full(8, -1, dtype=np.int64)
    for side in range(8):
        p, q = (side + side // 4) // 3 - 1, (side + side // 4) % 3 - 1  # numbered in pairs: the opposite of side is 7 - side
        for step in range(1, REACH + 1):
            a, b = i + step * p, j + step * q
            if not (0 <= a < rows and 0 <= b < columns):
                break
            k = slot[(a + wrap[0]) % rows * columns + (b + wrap[1]) % columns]
            if k >= 0:
                far[side], entry[side] = step, k
                break
    sides = before
    for side in range(8):
        k, bit = entry[side], 1 << side
        if k >= 0 and far[side] <= far[7 - side] + 1:
            sides = sides | bit if z[k] < top and systematic[k] <= tall else sides & ~bit
    return np.uint8(sides)
