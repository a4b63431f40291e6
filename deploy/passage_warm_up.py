"""Compiles what plans over a passage, which no walk comes to but before one: no time of planning is to hold compiling."""

from functools import cache

from deploy.bench.passage_fields import BEYOND, NEAR, START, field_of, heights, stance_at, thesis_blocks
from services.planner.passage.roadmap import Roadmap
from services.planner.passage.settings import PassageSettings
from shared.robot import load_profile

_EXPANSIONS = 200


@cache
def plan_passage(robot: str) -> None:
    """Plan across a short gap with a robot by its name, once in this process."""
    profile = load_profile(robot)
    height = profile.stance.body_height
    field = field_of(heights(thesis_blocks(1, 0.4, 0.15, 0.10, 0.0, 0.0), 0.4), height)
    roadmap = Roadmap(profile, PassageSettings(body_height=height))
    roadmap.begin(field, stance_at(profile, START, height), NEAR + 0.4 + BEYOND, seed=0)
    roadmap.grow(_EXPANSIONS)
