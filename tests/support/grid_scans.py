"""Fuse scans into an elevation grid in tests."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid, FusionCount
from sextant.services.mapper.elevation.validated_scan import ValidatedScan

scan_of = ValidatedScan.of
CAMERA = np.array([0.0, 0.0, 0.25])


def centres(grid: ElevationGrid) -> NDArray[np.float64]:
    """Return the centres (nx * ny, 2) of all cells of the window, in {world} order."""
    i, j = np.mgrid[: grid.shape[0], : grid.shape[1]]
    return np.asarray(grid.origin + grid.resolution * np.stack([i, j], axis=-1).reshape(-1, 2))


def scan(
    grid: ElevationGrid, xy: NDArray[np.float64], z: NDArray[np.float64] | float, count: int = 4, **kwargs: Any
) -> FusionCount:
    """Fuse heights [m] at positions (n, 2) [m], seen from CAMERA."""
    points = np.column_stack([xy, np.broadcast_to(z, len(xy))])
    return grid.fuse(scan_of(points, np.full(len(xy), count), np.zeros(len(xy)), CAMERA, **kwargs))


def take(grid: ElevationGrid, points: NDArray[np.float64], p_camera: NDArray[np.float64], **kwargs: Any) -> FusionCount:
    """Fuse points (n, 3) [m], seen from a camera at (3,) [m]."""
    return grid.fuse(scan_of(points, np.full(len(points), 4), np.zeros(len(points)), p_camera, **kwargs))
