"""Walls in a height map: a cell that holds a face is as high as what has been seen of it.

A scan tells of a face how high it rises within the picture, and the nearer the camera comes the less of it that is; in the
end it sees the ground before it, in the very cell that holds its foot. None of that says that the face is lower than it was
seen to be from afar. Only ground seen on all eight sides of the cell, and in it, since the face was last seen says that it is
gone; not in one scan, as the rows of a coarse camera lie cells apart. A face beside ground that is known to be as high needs
no such care, and is left as narrow as it was measured.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import Cells
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled

TALL = 0.06  # [m] of a cell's spread in a scan, beyond what the pose may be wrong by, from which it is a face
RIM = 0.02  # [m] by which what is seen must lie above or below what is known, to be another height
RIM_VARIANCE = (RIM / 3.0) ** 2  # [m^2] by which it is, at a gate of three sigma
REACH = 8  # cells to a side of a face, of which the nearest that a scan measures tells of that side
_ALL_SIDES = 0xFF


def heed_faces(
    cells: Cells,
    touched: NDArray[np.int64],
    z: Array,
    random: Array,
    systematic: Array,
    slot: NDArray[np.int32],
    sigma: float,
    low: NDArray[np.int64],
) -> int:
    """Let the measurements of a scan say of faces no more than they can, before they go into the filters.

    1. A face that rises above what is known of it raises the cell at once. One that shows less says that the cell is right.
    2. A face where flat ground was known disputes that, however wide its spread.
    3. Where ground as high as the face is known beside it, it is not the face that holds the wall up: all is as anywhere.
    4. Ground below a known face says nothing, unless it was seen on all eight sides, too, since the face last was: then the
       face is none.

    Measurements that say nothing are taken out, in place; returns how many are left.

    Args:
        cells: Of the map.
        touched: (m,) flat indices of the cells that the scan measures, each once.
        z: (m,) [m] their heights in it.
        random: (m,) [m^2] variance that averages away.
        systematic: (m,) [m^2] variance that does not average away, of which the spread is a part.
        slot: Of every cell -1, before and after.
        sigma: [m] of a height by the pose.
        low: (2,) world index of the lowest cell of the map's window, beyond which nothing is known.
    """
    rows, columns = cells.height.shape
    wrap = int(low[0] % rows), int(low[1] % columns)
    left = _heed(
        touched, z, random, systematic, TALL**2 + 9.0 * sigma**2, cells.height, cells.height.ravel(), cells.variance.ravel(),
        cells.assumed.ravel(), cells.face.ravel(), cells.below.ravel(), slot, wrap,
    )  # fmt: skip
    return int(left)


@compiled
def _heed(
    touched: NDArray[np.int64],
    z: Array,
    random: Array,
    systematic: Array,
    tall: float,
    grid: NDArray[np.float32],
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    assumed: NDArray[np.uint8],
    face: NDArray[np.uint8],
    below: NDArray[np.uint8],
    slot: NDArray[np.int32],
    wrap: tuple[int, int],
) -> int:
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
    """Whether ground as high as that [m] is known well beside a cell; beyond the window nothing is."""
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
    """On which sides of a cell a scan, or before it others, saw ground below a height [m]: a bit for each of eight.

    Of a side the nearest cell tells that the scan measures, one cell farther at most than on the opposite side, or next to the
    cell where nothing is measured there: as far as the scan's rows lie apart, but not behind what hides the ground. A side
    loses its bit where something higher is measured, or a face. Beyond the window nothing is seen.
    """
    rows, columns = shape
    i, j = (cell // columns - wrap[0]) % rows, (cell % columns - wrap[1]) % columns
    far, entry = np.zeros(8, dtype=np.int64), np.full(8, -1, dtype=np.int64)
    for side in range(8):
        p, q = (side + side // 4) // 3 - 1, (side + side // 4) % 3 - 1  # in pairs: the opposite of side is 7 - side
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
