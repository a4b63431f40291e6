"""Filling of small holes in an elevation map for its readers."""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.runtime.compiled import compiled


def fill_small_holes(elevation: NDArray[np.float32], max_relief: float = 0.015) -> NDArray[np.float32]:
    """Return a copy of a map with its small holes filled, as the scorer needs it.

    The map itself keeps unknown cells unknown. An unseen cell is filled if at least seven of its eight neighbours are seen
    and all are within max_relief of each other. It gets the mean over the opposite pairs of which both are seen. This is an
    interpolation, exact on a plane, and never an extrapolation. Single cells and pairs are filled. Lines stay NaN, however
    narrow, because a trench between two blocks that the camera does not see into looks the same. Wider holes, the frontier
    and holes across an edge also stay NaN.

    Args:
        elevation: (nx, ny) [m], NaN where unseen.
        max_relief: [m] largest difference between the seen neighbours.

    Raises:
        ValueError: The map is not two-dimensional or max_relief is negative.
    """
    if elevation.ndim != 2:
        raise ValueError(f"map (nx, ny) expected, found shape {elevation.shape}")
    if not max_relief >= 0:
        raise ValueError(f"max_relief of at least 0 expected, found {max_relief}")
    filled = np.array(elevation, dtype=np.float32, order="C")
    _bridge_holes(np.ascontiguousarray(elevation, dtype=np.float32), max_relief, filled)
    return filled


@compiled
def _bridge_holes(elevation: NDArray[np.float32], max_relief: float, filled: NDArray[np.float32]) -> None:
    """Write the interpolated heights of small holes into filled."""
    nx, ny = elevation.shape
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            if not np.isnan(elevation[i, j]):
                continue
            row_unseen = np.isnan(elevation[i, j - 1]) and np.isnan(elevation[i, j + 1])
            if row_unseen and np.isnan(elevation[i - 1, j]) and np.isnan(elevation[i + 1, j]):
                continue  # only the four diagonal neighbours may be seen
            seen, pairs = 0, 0
            total, lowest, highest = 0.0, np.inf, -np.inf
            for di, dj in ((0, 1), (1, -1), (1, 0), (1, 1)):
                a, b = elevation[i + di, j + dj], elevation[i - di, j - dj]
                if not np.isnan(a):
                    seen += 1
                    lowest, highest = min(lowest, a), max(highest, a)
                if not np.isnan(b):
                    seen += 1
                    lowest, highest = min(lowest, b), max(highest, b)
                if not (np.isnan(a) or np.isnan(b)):
                    pairs += 1
                    total += 0.5 * (a + b)
            if seen >= 7 and highest - lowest <= max_relief:
                filled[i, j] = total / pairs
