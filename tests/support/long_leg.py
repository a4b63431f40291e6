"""A leg without a body, which reaches all places beyond a line."""

import numpy as np

from sextant.services.planner.compiled_terrain import FootholdRules
from sextant.services.planner.locomotion.foothold_search import Foothold, NoFoothold, nearest_foothold
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array

_LIMITS = [-np.pi / 2, np.pi / 2, -9.0, 9.0, -9.0, 9.0]  # [rad] the coxa turns to the places beyond the line
_LEG = np.array([*_LIMITS, 0.0, 20.0, 0.0, 10.0, 10.0])  # see `leg_numbers`
NO_OTHER_FEET = np.full((6, 3), np.nan)


def search(
    terrain: Terrain,
    nominal: Array,
    offsets: Array,
    others: Array = NO_OTHER_FEET,
    distance: float = 0.06,
    beyond: float = -9.0,
) -> Foothold | NoFoothold:
    """Return the nearest foothold with x > `beyond` [m] {world} that keeps a distance [m] from others (n, 3) [m] {world}."""
    rules = FootholdRules(distance, foot_radius=0.0, descent=0.0, leg_margin=-np.inf, sink_margin=0.0)
    coxa = np.eye(4)
    coxa[:3, 3] = beyond, nominal[1], 5.0
    return nearest_foothold(terrain, nominal, offsets, _LEG, rules, others, np.stack([coxa] * 3))
