"""Foothold search: Lotriet's semi-radial search with limits of reach and distance.

The thesis searches squares of growing size, so a corner cell may win over a nearer one. Here cells are tried in the order of
their true distance (Lotriet 2024, section 6.3).
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from sextant.services.planner.compiled_terrain import (
    CROWDED,
    NONE,
    OUT_OF_REACH,
    ROUGH,
    UNSEEN,
    FootholdRules,
    best_foothold,
    leg_numbers,
)
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import HAZARDS


@dataclass(frozen=True, slots=True)
class Foothold:
    """A place for a foot."""

    p_world: Array  # (3,) [m] ground under the foot
    moved: float  # [m] from its nominal place
    room: float  # suitability, see `Terrain.suitability`


@dataclass(frozen=True, slots=True)
class NoFoothold:
    """Reason why there is no foothold."""

    reason: str
    unseen: bool = False  # most of the candidate cells are unseen


class FootholdFinder:
    """Finds footholds that one robot can use, in reach and with room for foot and shank; it keeps only lookup tables."""

    def __init__(self, profile: RobotProfile, params: StepParams):
        """Initialize for a robot."""
        self.widths = (1.0, params.wide_search_ratio)  # factors of the search radius
        self._profile, self._legs = profile, leg_numbers(profile)
        self._rules = FootholdRules(
            foot_distance=profile.stance.foot_distance,
            foot_radius=profile.foot.radius,
            descent=params.descent_m,
            leg_margin=params.leg_margin_m,
            sink_margin=params.sink_margin_m,
        )
        self._offsets: dict[float, Array] = {}  # [m] offsets of the cells to try by `widths`, for the current map resolution
        self._offsets_resolution = 0.0  # [m]

    def find(
        self, leg: int, nominal: Array, feet: Array, T_end: Array, T_after: Array, terrain: Terrain, width: float = 1.0
    ) -> Foothold | NoFoothold:
        """Return the best foothold of one leg near its nominal place.

        Args:
            leg: The leg.
            nominal: (2,) [m] {world} touchdown on unobstructed ground.
            feet: (6, 3) [m] {world} centres of the other feet, NaN where not known yet.
            T_end: (4, 4) {world} body pose at the end of the step.
            T_after: (4, 4) {world} body pose when the foot will leave its foothold.
            terrain: The map.
            width: Factor of the robot's search radius, one of `widths`.
        """
        if terrain.map.resolution != self._offsets_resolution:
            self._offsets_resolution = terrain.map.resolution
            radius = self._profile.stance.search_radius
            self._offsets = {w: offsets_by_distance(w * radius, terrain.map.resolution) for w in self.widths}
        others = np.where(np.arange(6)[:, None] == leg, np.nan, feet)
        frames = np.stack([T_end, (T_end + T_after) / 2.0, T_after]) @ self._profile.T_body_coxa[leg]
        return nearest_foothold(terrain, nominal, self._offsets[width], self._legs[leg], self._rules, others, frames)


def offsets_by_distance(radius: float, resolution: float) -> Array:
    """Return offsets (n, 2) [m] of all cells within a radius, the nearest first.

    Equal distances have a fixed order.
    """
    n = int(np.ceil(radius / resolution))
    i, j = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij")
    offsets = np.stack([i.ravel(), j.ravel()], axis=1)
    squared = (offsets**2).sum(axis=1)
    order = np.lexsort((offsets[:, 1], offsets[:, 0], squared))
    near = order[squared[order] * resolution**2 <= radius**2 + 1e-12]
    return np.asarray(offsets[near] * resolution)


def nearest_foothold(
    terrain: Terrain, nominal: Array, offsets: Array, leg: Array, rules: FootholdRules, others: Array, frames: Array
) -> Foothold | NoFoothold:
    """Find the most suitable foothold near a nominal one; of equals, the nearest.

    `Terrain.suitability` rates the places.

    Args:
        terrain: The map.
        nominal: (2,) [m] {world} where the foot would land on unobstructed ground.
        offsets: (n, 2) [m] of the cells to try, in order; the first is (0, 0).
        leg: The leg, a row of `leg_numbers`.
        rules: Distances to keep.
        others: (n, 3) [m] {world} centres of other feet, NaN where not known yet.
        frames: (3, 4, 4) {world} coxa poses of the leg when the foot lands, half-way, and when it leaves.

    Returns:
        The foothold, or the number of cells that failed each test.
    """
    x, y = nominal.tolist()
    place, moved, room, tests = best_foothold(terrain.ground, leg, rules, (x, y), others, frames, offsets)
    if room > NONE:
        return Foothold(np.array(place), moved, room)
    xy = terrain.centres(nominal) + offsets
    hazards = terrain.hazards(xy[tests == ROUGH])
    unseen = int((tests == UNSEEN).sum())
    counts = Counter(
        {
            "not seen": unseen,
            "too steep or too near an edge": int((hazards == 0).sum()),
            **{name: int((hazards == number).sum()) for number, name in enumerate(HAZARDS) if number},
            "too near another foot": int((tests == CROWDED).sum()),
            "out of reach or too tight for the leg": int((tests == OUT_OF_REACH).sum()),
        }
    )
    words = ", ".join(f"{n} {what}" for what, n in counts.most_common() if n)
    radius = float(np.linalg.norm(xy[-1] - nominal))
    reason = f"no foothold within {radius * 100:.0f} cm of its nominal place ({len(xy)} cells: {words})"
    return NoFoothold(reason, unseen=2 * unseen > len(xy))
