"""Warm-up: plan a short gap crossing, so that the search is compiled in advance."""

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import Roadmap, Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire import codec
from sextant.shared.wire.messages import PassageMap

_CELL, _CELLS = 0.01, (150, 120)  # [m], and number of cells along and across
_START, _GOAL = 0.44, 0.80  # [m] start and goal of the body along the strip
_EXPANSIONS = 200


def compile_functions(profile: RobotProfile, _settings: Settings) -> None:
    """Compile all functions that gap crossing calls."""
    height = profile.stance.body_height
    elevation, nothing = np.zeros(_CELLS, dtype=np.float32), np.zeros(_CELLS, dtype=np.bool_)
    layers = (elevation, np.zeros((*_CELLS, 3), dtype=np.int16), elevation, nothing, np.full(_CELLS, -1, dtype=np.int8))
    told = PassageMap(0, _CELL, np.full(2, _CELL / 2), 0.0, *layers, 0.0, "", np.eye(4), nothing)
    # Arrays of a received message are read-only, which makes them another type for the compiler.
    field = StripMap.of(codec.decode(codec.encode(told), PassageMap)[0])
    body = np.array([_START, 0.0, height])
    roadmap = Roadmap(profile, PassageSettings(body_height=height))
    roadmap.begin(field, Stance(body, profile.rest_feet(height) + body), _GOAL, seed=0)
    roadmap.grow(_EXPANSIONS)
