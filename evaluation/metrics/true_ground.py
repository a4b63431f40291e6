"""The true ground under a map's cells: heights, edges, and errors of mapped edges.

Frame: that of the given heights.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array

EDGE = 0.03  # [m] minimum height difference of an edge
INTERIOR = 0.02  # [m] minimum distance from an edge of interior cells
_STEEP = 0.01  # [m] minimum jump over `_HALF_CELL` at which a surface does not count as even
_HALF_CELL = 0.005  # [m] distance for that jump
_BESIDE = 3  # cells on either side of a true edge that must be known for a comparison
_LOST = 0.05  # [m] an edge further off counts as not found


class TrueGround:
    """The ground under the cells of a map, sampled at every half cell."""

    def __init__(self, fine: Array, resolution: float, edge: float = EDGE):
        """Find the edges.

        Args:
            fine: (2 nx - 1, 2 ny - 1) [m] heights at the cells' centres and midway between them; not finite: no ground.
            resolution: [m] of the map's cells.
            edge: [m] minimum height difference of an edge.
        """
        fine = np.where(np.isfinite(fine), fine, np.nan)
        self.resolution = resolution
        self.heights: Array = fine[::2, ::2]  # (nx, ny) [m]
        self._edge = edge
        self.edges = edge_points(fine, edge)  # (k, 2) in half cells
        steep = np.zeros(fine.shape, dtype=np.uint8)
        points = edge_points(fine, _STEEP * max(1.0, resolution / 2 / _HALF_CELL))
        for rounded in (np.floor(points), np.ceil(points)):
            i, j = rounded.astype(int).T
            steep[i, j] = 1
        distance = (
            cv2.distanceTransform(1 - steep, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) if steep.any() else np.full(fine.shape, 9e9)
        )
        self.edge_distance = np.asarray(distance[::2, ::2] * resolution / 2)  # (nx, ny) [m]

    @classmethod
    def under(
        cls,
        height_at: Callable[[Array], Array],
        origin: Array,
        shape: tuple[int, int],
        resolution: float,
        edge: float = EDGE,
    ) -> "TrueGround":
        """Sample the ground under nx x ny cells.

        The centre of the first cell is at the origin (2,) [m]; `height_at` maps (n, 2) to (n,) [m].
        """
        x, y = (origin[k] + resolution / 2 * np.arange(2 * shape[k] - 1) for k in (0, 1))
        points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        return cls(height_at(points).reshape(len(x), len(y)), resolution, edge)

    def edge_error(self, elevation: NDArray[np.floating]) -> float:
        """Return the median distance [m] from true edges to the nearest mapped edge.

        Only edges whose two sides are mapped count. NaN without edges.

        Args:
            elevation: (nx, ny) [m] the map, NaN where unknown.
        """
        mapped = 2.0 * edge_points(np.asarray(elevation, dtype=np.float64), self._edge)
        if not len(self.edges):
            return float("nan")
        known = np.isfinite(elevation).astype(np.uint8)
        whole = cv2.erode(known, np.ones((2 * _BESIDE + 1,) * 2))
        cells = np.clip(np.round(self.edges / 2).astype(int), 0, np.array(elevation.shape) - 1)
        edges = self.edges[whole[cells[:, 0], cells[:, 1]] > 0]
        if not len(edges) or not len(mapped):
            return float("nan") if not len(edges) else _LOST
        # use a grid twice as fine, on which midpoints of cells and half cells have integer indices
        canvas = np.ones((4 * elevation.shape[0], 4 * elevation.shape[1]), dtype=np.uint8)
        i, j = (2 * mapped).astype(int).T
        canvas[i, j] = 0
        distance = cv2.distanceTransform(canvas, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        i, j = (2 * edges).astype(int).T
        return float(np.median(np.minimum(distance[i, j] * self.resolution / 4, _LOST)))


def edge_points(z: Array, jump: float) -> Array:
    """Return the points (k, 2), in grid steps, between neighbours of different height.

    Their heights differ by more than `jump` [m].
    """
    found = []
    for axis in (0, 1):
        at = np.argwhere(np.abs(np.diff(z, axis=axis)) > jump).astype(np.float64)
        at[:, axis] += 0.5
        found.append(at)
    return np.concatenate(found)


def rms(values: Array) -> float:
    """Return the root mean square, NaN for an empty array."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
