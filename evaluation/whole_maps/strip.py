"""Strips of known ground for the search of gap crossings, as the mapper makes them."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.footholds.layers import FootholdLayers, Margin
from sextant.services.planner.gap_crossing.strip_survey import BEHIND, STRIP
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.wire.messages import TerrainMap

RESOLUTION = 0.01  # [m]


def strip_ahead(map_: TerrainMap, xy: Array, heading: float, body_height: float, width: float = STRIP[1]) -> StripMap:
    """Return the strip of a map in a direction; it begins `BEHIND` [m] behind a place.

    Args:
        map_: The map.
        xy: (2,) [m] {map} the place, such as that of the body.
        heading: [rad] direction of the strip.
        body_height: [m] of the robot, see `strip_of`.
        width: [m] of the strip.
    """
    T = from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, heading))
    T[:2, 3] = xy - BEHIND * T[:2, 0]
    n = [round(length / RESOLUTION) for length in (STRIP[0], width)]
    x, y = RESOLUTION * (np.arange(n[0]) + 0.5), RESOLUTION * (np.arange(n[1]) + 0.5 - 0.5 * n[1])
    centres = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros(n)], axis=-1).reshape(-1, 3)
    i, j = np.rint((apply(T, centres)[:, :2] - map_.origin) / map_.resolution).astype(np.int64).T
    inside = (i >= 0) & (j >= 0) & (i < map_.elevation.shape[0]) & (j < map_.elevation.shape[1])
    heights = np.full(len(centres), np.nan, dtype=np.float32)
    heights[inside] = map_.elevation[i[inside], j[inside]]
    return strip_of(heights.reshape(n), body_height, T)


def strip_of(elevation: NDArray[np.float32], body_height: float = 0.11, T_map_strip: Array | None = None) -> StripMap:
    """Return the strip with the evaluation function that the mapper computes from heights.

    Args:
        elevation: (nx, ny) [m] heights, NaN where unknown.
        body_height: [m] of the robot, above which ground is an obstacle.
        T_map_strip: (4, 4) place of the strip; None: its frame is that of the map.
    """
    layers = FootholdLayers(elevation.shape, RESOLUTION, Margin(0.01))
    F = layers.update(elevation, np.zeros_like(elevation), np.zeros(2, dtype=np.int64), body_height, 0.0).evaluation
    return StripMap(elevation, F, RESOLUTION, np.eye(4) if T_map_strip is None else T_map_strip)
