"""Compiles what plans over a passage, which no walk comes to but before one: no time of planning is to hold compiling."""

from functools import cache

import numpy as np

from deploy.bench.passage_fields import BEYOND, NEAR, START, field_of, heights, stance_at, thesis_blocks
from services.planner.passage.field import Field
from services.planner.passage.roadmap import Roadmap
from services.planner.passage.settings import PassageSettings
from shared import codec
from shared.messages import PassageMap
from shared.robot import load_profile

_EXPANSIONS = 200


@cache
def plan_passage(robot: str) -> None:
    """Plan across a short gap with a robot by its name, once in this process."""
    profile = load_profile(robot)
    height = profile.stance.body_height
    field = as_told(field_of(heights(thesis_blocks(1, 0.4, 0.15, 0.10, 0.0, 0.0), 0.4), height))
    roadmap = Roadmap(profile, PassageSettings(body_height=height))
    roadmap.begin(field, stance_at(profile, START, height), NEAR + 0.4 + BEYOND, seed=0)
    roadmap.grow(_EXPANSIONS)


def as_told(field: Field) -> Field:
    """The same ground as the planner comes by it, from a message: arrays that cannot be written are of another type."""
    shape, origin = field.elevation.shape, np.array(field.corner)
    nothing, none = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.bool_)
    normals = np.zeros((*shape, 3), dtype=np.int16)
    layers = (field.elevation, normals, nothing, none, field.evaluation)
    told = PassageMap(0, field.resolution, origin, 0.0, *layers, 0.0, "", np.eye(4), none)
    return Field.of(codec.decode(codec.encode(told), PassageMap)[0])
