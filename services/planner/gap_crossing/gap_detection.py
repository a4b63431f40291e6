"""Gap detection: the near edge of a gap on the straight line to a goal.

Ground that carries a foot everywhere may still be too narrow for a path, such as a bridge about as wide as the feet are apart.
It counts as a gap if there is no other one.
"""

from dataclasses import dataclass

import numpy as np

from sextant.services.planner.gap_crossing.params import GapDetectionParams
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE


@dataclass(frozen=True, slots=True)
class GapEdge:
    """The near edge of a gap."""

    distance: float  # [m] from the robot to the edge
    heading: float  # [rad] {world} of the line across


def detect_gap(
    terrain: Terrain, xy: Array, target: Array, ground: float, max_step_m: float, params: GapDetectionParams
) -> GapEdge | str:
    """Return the first gap on a straight line, or why there is none.

    Args:
        terrain: The newest map.
        xy: (2,) [m] {world} position of the robot.
        target: (2,) [m] {world} goal.
        ground: [m] {world} ground height under the robot.
        max_step_m: [m] height above that ground, from which an obstacle is a wall.
        params: Parameters of the detection.
    """
    way = target - xy
    length = float(np.linalg.norm(way))
    if length < terrain.map.resolution:
        return "the robot is at the goal"
    heading = float(np.arctan2(way[1], way[0]))
    reach = float(np.hypot(*terrain.map.elevation.shape)) * terrain.map.resolution  # nothing is known beyond
    along = np.arange(0.0, min(length, reach), terrain.map.resolution)
    across = np.arange(-params.half_width_m, params.half_width_m + 1e-9, terrain.map.resolution)
    ahead = way / length
    places = xy + along[:, None, None] * ahead + across[:, None] * np.array([-ahead[1], ahead[0]])
    heights = terrain.heights(places)
    wall = (heights > ground + max_step_m).mean(axis=1) > params.wall_share
    known = np.isfinite(heights).mean(axis=1) > params.known_share
    carries = terrain.scores(places) <= MAX_FOOTHOLD_SCORE
    missing = ~carries & ~(heights >= ground - max_step_m)  # also where the height is unknown
    cells = round(params.min_length_m / terrain.map.resolution)
    bare = _wide(carries.mean(axis=1) < params.carrying_share, cells) & known
    if not bare.any():
        bare = _wide(missing.mean(axis=1) > 1.0 - params.narrow().carrying_share, cells) & known
    if not bare.any():
        return "no gap on the straight line to the goal"
    verge = float(along[bare][0])
    walls = along[wall]
    if walls.size and walls[0] < verge + params.wall_base_m:
        return f"an obstacle blocks the straight line to the goal after {walls[0]:.1f} m"
    return GapEdge(verge, heading)


def _wide(flags: Array, cells: int) -> Array:
    """Return flags (n,) of runs of at least `cells` cells, or runs at the end."""
    out = flags.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin < cells and end < len(flags):
            out[begin:end] = False
    return out
