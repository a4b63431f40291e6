"""Ground that a robot can walk over: its step planner plans walks on ideal maps, without physics.

Each walk is straight ahead, at the stance's body height, in the tripod gait. Obstacles grow until the planner finds no step. A
real walk also depends on what the camera sees and on the servos, so the limits are upper bounds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

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


Obstacle = Literal["riser", "drop", "gap", "slope"]
_CENTIMETRES = np.arange(1, 21) / 100
_TRIED: dict[Obstacle, Array] = {  # rising values of each obstacle
    "riser": _CENTIMETRES,
    "drop": _CENTIMETRES,
    "gap": 2.0 * _CENTIMETRES,
    "slope": np.radians(np.arange(3, 46, 3)),
}


def find_ground_limits(profile: RobotProfile) -> GroundLimits:
    """Return the largest obstacles that the step planner of a robot passes."""
    walker = _Walker(profile)
    return GroundLimits(**{obstacle: walker.largest(obstacle, values) for obstacle, values in _TRIED.items()})


def refusal(profile: RobotProfile, obstacle: Obstacle, value: float) -> str:
    """Return why the step planner of a robot does not pass an obstacle [m, rad], or an empty string if it does."""
    return _Walker(profile).refusal(obstacle, value)


def _height(obstacle: Obstacle, value: float, x: Array) -> Array:
    """Return the height [m] of the ground at x [m] from the beginning of an obstacle."""
    if obstacle == "slope":
        return np.asarray(np.tan(value) * np.maximum(x, 0.0))
    if obstacle == "gap":
        return np.where((x > 0.0) & (x < value), -_DEPTH_M, 0.0)
    return np.where(x < 0.0, 0.0, value if obstacle == "riser" else -value)


class _Walker:
    """A robot that walks by its step planner alone."""

    def __init__(self, profile: RobotProfile):
        self._profile, self._planner = profile, StepPlanner(profile)
        self._height = profile.stance.body_height
        self._rest = profile.rest_feet()
        self._half_length = float(np.abs(self._rest[:, 0]).max())  # [m] of the stance
        around = max(_AROUND_M, 2.0 * profile.stance.search_radius)
        self._behind, self._aside = (np.abs(self._rest[:, :2]).max(axis=0) + around).tolist()  # [m] size of the maps
        speed = np.array([profile.stance.max_speed, 0.0])
        self._command = VelocityCommand(0, speed, 0.0, self._height, min(_LIFT_M, profile.stance.max_lift))

    def largest(self, obstacle: Obstacle, values: Array) -> GroundLimit:
        """Return the limit among rising values of an obstacle."""
        passed = 0.0
        for value in values.tolist():
            if reason := self.refusal(obstacle, value):
                return GroundLimit(passed, value, reason)
            passed = value
        return GroundLimit(passed, None, "")

    def refusal(self, obstacle: Obstacle, value: float) -> str:
        """Return why a walk over an obstacle ends early, or ""."""
        start = 3.0 * self._half_length  # [m] from the start to the obstacle
        goal = start + 3.0 * self._half_length + 2.0 * RESOLUTION_M + (value if obstacle == "gap" else 0.0)
        terrain = self._terrain(lambda x: _height(obstacle, value, x - start), goal + 2.0 * self._half_length)
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
