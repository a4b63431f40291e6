"""Where the ground ends before a gap on the straight way to a goal, and where it begins again behind it."""

from dataclasses import dataclass

import numpy as np

from sextant.services.planner.navigation.traversability import MAX_STEP
from sextant.services.planner.terrain import ACCEPTABLE, Terrain
from sextant.shared.geometry import Array

_HALF_WIDTH = 0.20  # [m] of the band ahead that is looked at: about where the feet go
_CARRYING = 0.8  # [1] share of the band across from which ground carries the robot as anywhere
_KNOWN = 0.5  # [1] share of it that must be known
_HIGHER = 0.1  # [1] share of the band that stands higher than legs step, from which it is a wall
_BASE = 0.10  # [m] before a wall in which its foot carries nothing, either
_WIDE = 0.06  # [m] along the way that must carry so little: what is narrower is stepped over


@dataclass(frozen=True, slots=True)
class Verge:
    """The near side of a gap."""

    distance: float  # [m] to it from where the robot is
    heading: float  # [rad] {world} of the way across


def gap_ahead(terrain: Terrain, xy: Array, target: Array, ground: float) -> Verge | str:
    """The first gap on the straight way between two places, or why there is none that could be crossed.

    Args:
        terrain: The newest map.
        xy: (2,) [m] {world} where the robot is.
        target: (2,) [m] {world} where it is to go.
        ground: [m] {world} height of what it stands on.
    """
    way = target - xy
    length = float(np.linalg.norm(way))
    if length < terrain.map.resolution:
        return "the goal is here"
    heading = float(np.arctan2(way[1], way[0]))
    reach = float(np.hypot(*terrain.map.elevation.shape)) * terrain.map.resolution  # no further is anything known
    along = np.arange(0.0, min(length, reach), terrain.map.resolution)
    across = np.arange(-_HALF_WIDTH, _HALF_WIDTH + 1e-9, terrain.map.resolution)
    ahead = way / length
    places = xy + along[:, None, None] * ahead + across[:, None] * np.array([-ahead[1], ahead[0]])
    heights = terrain.heights(places)
    wall = (heights > ground + MAX_STEP).mean(axis=1) > _HIGHER
    bare = _wide((terrain.scores(places) <= ACCEPTABLE).mean(axis=1) < _CARRYING, round(_WIDE / terrain.map.resolution))
    known = np.isfinite(heights).mean(axis=1) > _KNOWN
    if not (bare & known).any():
        return "no gap on the straight way to it"
    verge = float(along[bare & known][0])
    walls = along[wall]
    if walls.size and walls[0] < verge + _BASE:
        return f"the straight way to it ends at something high after {walls[0]:.1f} m"
    return Verge(verge, heading)


def _wide(flags: Array, cells: int) -> Array:
    """Flags (n,) of runs of at least so many cells; those that reach to the end count."""
    out = flags.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin < cells and end < len(flags):
            out[begin:end] = False
    return out
