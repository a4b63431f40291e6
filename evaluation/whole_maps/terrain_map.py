"""Terrain map of known heights, with the foothold layers that the mapper computes."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.footholds.layers import FootholdLayers
from sextant.services.mapper.footholds.params import FootholdLayersParams
from sextant.shared.errors import SextantError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import TerrainMap

RESOLUTION_M = 0.01  # [m] of the cells of the mapper, for which the scores of footholds are made
_SAME = 0.05  # [1] relative difference of cells that are not resampled
_SIGMA_M = 0.001  # [m] of the heights
_MOST_CELLS = 4_000_000


class MapPlanError(SextantError, ValueError):
    """A map, a start or a goal with which nothing can be planned."""


def terrain_of(
    profile: RobotProfile, heights: NDArray[np.float32], resolution: float, origin: tuple[float, float]
) -> TerrainMap:
    """Return the terrain map of heights.

    Args:
        profile: The robot, whose foot the layers are for.
        heights: (nx, ny) [m] heights, NaN where unknown.
        resolution: [m] of the cells; if it is not 1 cm, they are interpolated to that.
        origin: [m] centre of cell (0, 0).

    Raises:
        MapPlanError: There are too few or too many cells, or no height.
    """
    if heights.ndim != 2 or min(heights.shape) < 3:
        raise MapPlanError(f"heights (nx, ny) of at least 3 x 3 cells expected, found an array of shape {heights.shape}")
    if not 0.001 <= resolution <= 0.2:
        raise MapPlanError(f"a resolution from 0.001 to 0.2 m expected, found {resolution:g}")
    heights = np.where(np.isfinite(heights), heights, np.float32(np.nan))
    if not np.isfinite(heights).any():
        raise MapPlanError("a map with known heights expected, found none")
    if abs(resolution / RESOLUTION_M - 1.0) > _SAME:
        shape = [max(3, round((n - 1) * resolution / RESOLUTION_M) + 1) for n in heights.shape]
        _expect_cells(shape[0] * shape[1])
        i, j = (np.arange(n, dtype=np.float32) * np.float32(RESOLUTION_M / resolution) for n in shape)
        jj, ii = np.meshgrid(j, i)
        heights = np.asarray(cv2.remap(heights, jj, ii, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32)
        resolution = RESOLUTION_M
    _expect_cells(heights.size)
    elevation = np.ascontiguousarray(heights, dtype=np.float32)
    layers = FootholdLayers.of(elevation.shape, resolution, profile.foot.radius, FootholdLayersParams())
    variance = np.where(np.isfinite(elevation), np.float32(_SIGMA_M**2), np.float32(np.nan))
    found = layers.update(elevation, variance, np.zeros(2, dtype=np.int64))
    return TerrainMap(
        stamp_ns=0,
        resolution=resolution,
        origin=np.array(origin, dtype=np.float64),
        elevation=elevation,
        variance=variance,
        score=found.score,
        assumed=np.zeros(elevation.shape, dtype=np.bool_),
        evaluation=found.evaluation,
    )


def _expect_cells(count: int) -> None:
    if count > _MOST_CELLS:
        raise MapPlanError(f"at most {_MOST_CELLS} cells of 1 cm expected, found {count}: cut the map")
