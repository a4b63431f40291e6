"""Walls in a height map: a cell that holds a face is as high as what has been seen of it.

A scan tells of a face how high it rises within the picture, and the nearer the camera comes the less of it that is; in the
end it sees the ground before it, in the very cell that holds its foot. None of that says that the face is lower than it was
seen to be from afar. Only ground seen all around the cell, in one scan, says that it is gone. A face beside ground that is
known to be as high needs no such care, and is left as narrow as it was measured.
"""

import numpy as np
from numpy.typing import NDArray

from services.mapper.cells import Cells
from shared.compiled import compiled
from shared.geometry import Array

TALL = 0.06  # [m] of a cell's spread in a scan, beyond what the pose may be wrong by, from which it is a face
RIM = 0.02  # [m] by which what is seen must lie above or below what is known, to be another height
RIM_VARIANCE = (RIM / 3.0) ** 2  # [m^2] by which it is, at a gate of three sigma


def heed_faces(
    cells: Cells,
    touched: NDArray[np.int64],
    z: Array,
    random: Array,
    systematic: Array,
    slot: NDArray[np.int32],
    sigma: float,
) -> int:
    """Let the measurements of a scan say of faces no more than they can, before they go into the filters.

    1. A face that rises above what is known of it raises the cell at once. One that shows less says that the cell is right.
    2. A face where flat ground was known disputes that, however wide its spread.
    3. Where ground as high as the face is known beside it, it is not the face that holds the wall up: all is as anywhere.
    4. Ground below a known face says nothing, unless the scan sees it in all eight cells around, too: then the face is none.

    Measurements that say nothing are taken out, in place; returns how many are left.

    Args:
        cells: Of the map.
        touched: (m,) flat indices of the cells that the scan measures, each once.
        z: (m,) [m] their heights in it.
        random: (m,) [m^2] variance that averages away.
        systematic: (m,) [m^2] variance that does not average away, of which the spread is a part.
        slot: Of every cell -1, before and after.
        sigma: [m] of a height by the pose.
    """
    left = _heed(
        touched, z, random, systematic, TALL**2 + 9.0 * sigma**2, cells.height, cells.height.ravel(), cells.variance.ravel(),
        cells.assumed.ravel(), cells.face.ravel(), slot,
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
    slot: NDArray[np.int32],
) -> int:
    rows, columns = grid.shape
    n, faces = len(touched), 0
    for k in range(n):
        faces += int((systematic[k] > tall) | (face[np.uint64(touched[k])] != 0))
    if not faces:
        return n
    for k in range(n):
        slot[np.uint64(touched[k])] = k
    silent = np.zeros(n, dtype=np.bool_)
    for k in range(n):
        c = np.uint64(touched[k])
        rises = systematic[k] > tall
        if assumed[c] or np.isnan(height[c]):
            face[c] = np.uint8(rises)
            continue
        if not (rises or face[c]):
            continue
        above = z[k] - height[c]
        if _held(touched[k], height[c] + max(above, 0.0) - RIM, grid, variance, assumed, face):
            face[c] = 0
        elif rises and above > RIM and not face[c]:
            systematic[k] = RIM_VARIANCE
        elif rises:
            if above > 0.0 and face[c]:
                height[c], variance[c] = z[k], systematic[k]
            face[c] |= np.uint8(above > -RIM)
            z[k], systematic[k] = height[c], max(systematic[k], np.float64(variance[c]))
        elif above < -RIM:
            if _all_below(touched[k], height[c] - RIM, z, slot, rows, columns):
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
) -> bool:
    """Whether ground as high as that [m] is known well beside a cell."""
    rows, columns = grid.shape
    i, j = cell // columns, cell % columns
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            u, v = a % rows, b % columns
            n = u * columns + v
            if grid[u, v] > top and variance[n] < RIM_VARIANCE and not (face[n] or assumed[n] or n == cell):
                return True
    return False


@compiled
def _all_below(cell: int, top: float, z: Array, slot: NDArray[np.int32], rows: int, columns: int) -> bool:
    """Whether a scan measures all eight neighbours of a cell, and all of them below a height [m]."""
    i, j = cell // columns, cell % columns
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            k = slot[(a % rows) * columns + b % columns]
            if k < 0 or (z[k] > top and not (a == i and b == j)):
                return False
    return True
