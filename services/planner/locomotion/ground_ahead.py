"""What the map shows of the ground under and ahead of the robot."""

from dataclasses import dataclass

import numpy as np

from sextant.services.planner.locomotion.params import GaitChoiceParams
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array

_SPACING_M = 0.02  # [m] between two samples
_NEXT_PERCENTILE = 99.0  # of the height differences of neighbouring samples: single cells may be wrong


@dataclass(frozen=True, slots=True)
class GroundAhead:
    """Ground under the feet of the next steps."""

    unseen: float  # [1] share of the ground without a measurement
    carrying: float  # [1] share of the seen ground that carries a foot; 0 if none is seen
    step_m: float  # [m] largest height difference of neighbouring samples; 0 if none is seen
    slope_deg: float  # [deg] of the plane through the seen ground


def look_ahead(terrain: Terrain, T_world_body: Array, course: float, params: GaitChoiceParams) -> GroundAhead:
    """Return what the map shows of a rectangle along the course.

    Args:
        terrain: The map. Cells that it assumes count as unseen.
        T_world_body: (4, 4) body pose at the start of the next step.
        course: [rad] {world} direction of motion.
        params: Size of the rectangle.
    """
    along = np.arange(0.0, params.ahead_m, _SPACING_M)
    aside = np.arange(-params.half_width_m, params.half_width_m + 1e-9, _SPACING_M)
    ahead = np.array([np.cos(course), np.sin(course)])
    left = np.array([-ahead[1], ahead[0]])
    places = T_world_body[:2, 3] + along[:, None, None] * ahead + aside[:, None] * left
    ij, inside = terrain.cells(places)
    i, j = ij[..., 0], ij[..., 1]
    height = np.where(inside & ~terrain.map.assumed[i, j], terrain.map.elevation[i, j], np.nan)
    seen = np.isfinite(height)
    if seen.sum() < 3:
        return GroundAhead(1.0, 0.0, 0.0, 0.0)
    steps = np.abs(np.concatenate([np.diff(height, axis=0).ravel(), np.diff(height, axis=1).ravel()]))
    steps = steps[np.isfinite(steps)]
    xy = places[seen] - places[seen].mean(axis=0)
    slope = np.linalg.lstsq(np.column_stack([xy, np.ones(len(xy))]), height[seen], rcond=None)[0][:2]
    return GroundAhead(
        unseen=float(1.0 - seen.mean()),
        carrying=float(terrain.carries(ij)[seen].mean()),
        step_m=float(np.percentile(steps, _NEXT_PERCENTILE)) if len(steps) else 0.0,
        slope_deg=float(np.degrees(np.arctan(np.linalg.norm(slope)))),
    )
