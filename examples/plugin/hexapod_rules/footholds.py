"""A foothold rule: the ground under and around the foot is nearly level."""

from functools import reduce

import numpy as np

from sextant.plugins import ElevationMap

FLAT = 0.012  # [m] largest difference of heights around a foothold
AROUND = 0.02  # [m] to either side


def relief(ground: ElevationMap):
    """Return the difference of heights around each cell (nx, ny), as a share of the largest that is allowed."""
    n = max(1, round(AROUND / ground.resolution))
    padded = np.pad(ground.elevation, n, constant_values=np.nan)  # unknown ground is no foothold
    return (over_square(np.maximum, padded, 2 * n + 1) - over_square(np.minimum, padded, 2 * n + 1)) / FLAT


def over_square(of_two, cells, n: int):
    """Combine the cells of each n x n square, first along one axis, then along the other."""
    for axis in (0, 1):
        rows = np.moveaxis(cells, axis, 0)
        shifted = [rows[k : len(rows) - n + 1 + k] for k in range(n)]
        cells = np.moveaxis(reduce(of_two, shifted), 0, axis)
    return cells
