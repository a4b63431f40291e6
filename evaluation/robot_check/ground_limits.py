"""Ground that a robot can walk over: its step planner plans walks on ideal maps, without physics.

Each walk is straight ahead, at the stance's body height, in the tripod gait. Obstacles grow until the planner finds no step. A
real walk also depends on what the camera sees and on the servos, so the limits are upper bounds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sextant.evaluation.whole_maps.terrain_map import RESOLUTION_M, terrain_of
from sextant.services.planner.locomotion.gait import directions, gait_of, swing_order
from sextant.services.planner.locomotion.step_planner import NoStep, StepPlanner, StepStart
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import VelocityCommand

_AROUND_M = 0.4  # [m] from the resting feet to the edges of the maps, more for a robot that searches footholds farther away
_DEPTH_M = 0.5  # [m] of a gap
_MAX_STEPS = 80
_LIFT_M = 0.025  # [m] commanded clearance, the default of scenarios


@dataclass(frozen=True, slots=True)
class GroundLimit:
    """Largest obstacle of one kind that the planner passes."""

    passed: float  # the largest value passed; 0 if none is
    refused: float | None  # the smallest value that is not; None: all values that were tried are passed
    reason: str  # why not


@dataclass(frozen=True, slots=True)
class GroundLimits:
    """Ground that a robot can walk over."""

    riser: GroundLimit  # [m] height of a single step up
    drop: GroundLimit  # [m] depth of a single step down
    gap: GroundLimit  # [m] width of a gap across the way
    slope: GroundLimit  # [rad] of a ramp up


def find_ground_limits(profile: RobotProfile) -> GroundLimits:
    """Return the largest obstacles that the step planner of a robot passes."""
    walker = _Walker(profile)
    start = 3.0 * walker.half_length  # [m] from the start to the obstacle

    def riser(x: Array, height: float) -> Array:
        return np.where(x < start, 0.0, height)

    def gap(x: Array, width: float) -> Array:
        return np.where((x > start) & (x < start + width), -_DEPTH_M, 0.0)

    def slope(x: Array, angle: float) -> Array:
        return np.asarray(np.tan(angle) * np.maximum(x - start, 0.0))

    centimetres = np.arange(1, 21) / 100
    return GroundLimits(
        riser=walker.largest(riser, centimetres, start),
        drop=walker.largest(lambda x, depth: riser(x, -depth), centimetres, start),
        gap=walker.largest(gap, 2.0 * centimetres, start),
        slope=walker.largest(slope, np.radians(np.arange(3, 46, 3)), start),
    )


class _Walker:
    """A robot that walks by its step planner alone."""

    def __init__(self, profile: RobotProfile):
        self._profile, self._planner = profile, StepPlanner(profile)
        self._height = profile.stance.body_height
        self._rest = profile.rest_feet()
        self.half_length = float(np.abs(self._rest[:, 0]).max())  # [m] of the stance
        around = max(_AROUND_M, 2.0 * profile.stance.search_radius)
        self._behind, self._aside = (np.abs(self._rest[:, :2]).max(axis=0) + around).tolist()  # [m] size of the maps
        speed = np.array([profile.stance.max_speed, 0.0])
        self._command = VelocityCommand(0, speed, 0.0, self._height, min(_LIFT_M, profile.stance.max_lift))

    def largest(self, ground: Callable[[Array, float], Array], values: Array, start: float) -> GroundLimit:
        """Return the limit among rising values of an obstacle.

        Args:
            ground: Returns heights [m] of the ground at x [m], given a value of the obstacle.
            values: Values to try.
            start: [m] where the obstacle begins.
        """
        passed = 0.0
        for value in values.tolist():
            goal = start + 3.0 * self.half_length + 2.0 * RESOLUTION_M
            goal += value if np.isclose(ground(np.array([goal + 9.0]), value)[0], 0.0) else 0.0  # beyond a gap
            reason = self._walk(ground, value, goal)
            if reason:
                return GroundLimit(passed, value, reason)
            passed = value
        return GroundLimit(passed, None, "")

    def _walk(self, ground: Callable[[Array, float], Array], value: float, goal: float) -> str:
        """Return why a walk to x = `goal` [m] ends early, or ""."""
        terrain = self._terrain(lambda x: ground(x, value), goal + 2.0 * self.half_length)
        body = from_xyz_rpy((0.0, 0.0, self._height), np.zeros(3))
        feet = apply(body, self._rest)
        gait = gait_of(self._command.gait)
        along = directions(self._command.velocity, 0.0, self._rest)
        for _ in range(_MAX_STEPS):
            if body[0, 3] > goal:
                return ""
            order = swing_order(gait, along, apply(inverse(body), feet), self._rest)
            found, _ = self._planner.choose([StepStart(body, feet, swing, self._command) for swing in order], terrain)
            if isinstance(found, NoStep):
                return found.reason
            body, feet = found.body_goal, found.touchdown
        return f"the robot does not get further than {body[0, 3]:.2f} m"

    def _terrain(self, height: Callable[[Array], Array], length: float) -> Terrain:
        """Return the map of a ground whose height depends on x alone."""
        nx, ny = (round(size / RESOLUTION_M) for size in (self._behind + length, 2 * self._aside))
        x = np.asarray(RESOLUTION_M * np.arange(nx) - self._behind, dtype=np.float64)
        elevation = np.repeat(height(x)[:, None], ny, axis=1).astype(np.float32)
        return Terrain(terrain_of(self._profile, elevation, RESOLUTION_M, (-self._behind, -self._aside)))
