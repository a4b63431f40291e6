"""Whether the true ground of a run has a way across, where the seed decides.

Only the scorer may use this.
"""

import numpy as np

from sextant.evaluation.trace.course import Course
from sextant.evaluation.whole_maps.strip import RESOLUTION, strip_of
from sextant.services.planner.gap_crossing.params import GapApproachParams
from sextant.services.planner.gap_crossing.strip_survey import BEHIND, STRIP, TURNING_WIDTH
from sextant.services.planner.roadmap.exhaustive import passable
from sextant.services.planner.roadmap.params import BareGroundParams, PassageSettings
from sextant.services.planner.roadmap.roadmap import Stance
from sextant.services.planner.roadmap.sections import goal_behind
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.scenario.terrain import PillarField

# Half width [m] of a band, tolerance in height [m], and the share [1] of supporting ground below which the gap begins.
_HALF_WIDTH, _LEVEL, _CARRYING = 0.2, 0.02, 0.8
_CYCLES = 30  # cycles of the gait: enough for the whole way in one section


def decided_by_seed(scenario: Scenario) -> bool:
    """Return whether it depends on the seed if there is a way across."""
    return (
        scenario.goal.passage and scenario.goal.expect == "either" and any(isinstance(p, PillarField) for p in scenario.terrain)
    )


def way_exists(profile: RobotProfile, scenario: Scenario, course: Course) -> bool | None:
    """Return whether a robot in front of the first gap can get behind it.

    None where `passable` cannot tell. The strip lies along x of {start}. Heights are the true ones, evaluated as the mapper
    does.

    Args:
        profile: The robot.
        scenario: The scenario of the run.
        course: Its true ground, placed under its start.
    """
    height = profile.stance.height_or_own(scenario.walk.body_height)
    near = gap_begins(course, scenario.goal.distance) - GapApproachParams().start_distance_m - BEHIND
    field = strip_from(course, near, height, TURNING_WIDTH)
    goal_x = goal_behind(field, BEHIND, scenario.goal.distance - near, BareGroundParams())
    if goal_x is None:
        return True
    settings = PassageSettings(body_height=height, cycles=_CYCLES)
    return passable(profile, settings, field, stance_at(profile, BEHIND, height), goal_x)


def gap_begins(course: Course, until: float) -> float:
    """Return x [m] {start} where the ground ahead stops carrying at the start's level.

    Return `until` [m] if it carries everywhere.
    """
    x, y = np.arange(0.0, until, RESOLUTION), np.arange(-_HALF_WIDTH, _HALF_WIDTH, RESOLUTION)
    heights = course.carrying_at(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)).reshape(len(x), len(y))
    bare = (np.abs(heights) < _LEVEL).mean(axis=1) < _CARRYING
    return float(x[int(np.argmax(bare))]) if bare.any() else until


def strip_from(course: Course, near: float, body_height: float, width: float = STRIP[1]) -> StripMap:
    """Return the strip of a width [m] whose near side is at x = `near` [m] {start}.

    The robot's body height is `body_height` [m].
    """
    n = [round(length / RESOLUTION) for length in (STRIP[0], width)]
    x, y = near + RESOLUTION * (np.arange(n[0]) + 0.5), RESOLUTION * (np.arange(n[1]) + 0.5 - 0.5 * n[1])
    heights = course.carrying_at(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)).reshape(n)
    return strip_of(np.ascontiguousarray(heights, dtype=np.float32), body_height)


def stance_at(profile: RobotProfile, x: float, body_height: float) -> Stance:
    """Return the resting stance with the body at x [m] on the strip's centre line."""
    body: Array = np.array([x, 0.0, body_height])
    return Stance(body, profile.rest_feet(body_height) + body)
