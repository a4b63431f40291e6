"""A foothold rule: the ground under and around the foot is nearly level."""

import numpy as np

from sextant.plugins import ElevationMap

FLAT = 0.012  # [m] largest difference of heights around a foothold
AROUND = 0.02  # [m] to either side


def relief(ground: ElevationMap):
    """Return the difference of heights around each cell (nx, ny), as a share of the largest that is allowed."""
    n = max(1, round(AROUND / ground.resolution))
    padded = np.pad(ground.elevation, n, constant_values=np.nan)  # unknown ground is no foothold
    patches = np.lib.stride_tricks.sliding_window_view(padded, (2 * n + 1, 2 * n + 1))
    return (patches.max(axis=(2, 3)) - patches.min(axis=(2, 3))) / FLAT
