"""OMPL planner for the body alone.

Each leg must have a foothold. It plans no footsteps, so it has less work. Its validity test is compiled, as are the tests of
Sextant's search.
"""

import math
from typing import Any

import numpy as np

from sextant.services.planner.roadmap.roadmap import Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.compiled import compiled

_DRIFT = 0.12  # [m] to either side
_STRONG = -2  # [cells] of the evaluation function
_REACH = 0.35  # [m] around the body in which footholds are searched
_LONGEST_S = 1.0  # [s] wall-clock time limit


class BodyPlanner:
    """RRT-Connect for the position of the body."""

    def __init__(self, profile: RobotProfile):
        """Prepare for a robot.

        Raises:
            ImportError: OMPL is not installed, or not available for this machine.
        """
        from ompl import base, geometric, util

        util.setLogLevel(util.LogLevel.LOG_ERROR)
        self._base, self._geometric = base, geometric
        self._T_coxa_body, self._limits = profile.T_coxa_body, profile.joint_limits
        self._links = profile.links.coxa, profile.links.femur, profile.links.tibia
        self._foot_radius = profile.foot.radius
        each_leg_reaches(np.zeros(3), np.zeros((0, 3)), self._T_coxa_body, self._links, self._limits)  # compile it

    def plan(self, field: StripMap, stance: Stance, goal_x: float) -> bool:
        """Return whether the body can get from a stance to x [m] along the strip."""
        i, j = np.nonzero(field.evaluation <= _STRONG)
        places = np.column_stack([i, j]) * field.resolution + field.first_cell
        footholds = np.column_stack([places, field.elevation[i, j] + self._foot_radius])
        space = self._base.RealVectorStateSpace(2)
        bounds = self._base.RealVectorBounds(2)
        for axis, (low, high) in enumerate(((stance.body[0] - 0.1, goal_x + 0.1), (-_DRIFT, _DRIFT))):
            bounds.setLow(axis, float(low))
            bounds.setHigh(axis, float(high))
        space.setBounds(bounds)
        setup = self._geometric.SimpleSetup(space)
        body = np.array(stance.body)

        def is_valid(state: Any) -> bool:
            body[0], body[1] = state[0], state[1]
            return each_leg_reaches(body, footholds, self._T_coxa_body, self._links, self._limits)

        setup.setStateValidityChecker(is_valid)
        begin, end = space.allocState(), space.allocState()
        begin[0], begin[1] = float(stance.body[0]), float(stance.body[1])
        end[0], end[1] = float(goal_x), 0.0
        setup.setStartAndGoalStates(begin, end)
        setup.setPlanner(self._geometric.RRTConnect(setup.getSpaceInformation()))
        solved: Any = setup.solve(_LONGEST_S)
        return bool(solved) and bool(setup.haveExactSolutionPath())


@compiled
def each_leg_reaches(
    body: Array,
    footholds: Array,
    T_coxa_body: Array,
    links: tuple[float, float, float],
    limits: Array,
) -> bool:
    """Return whether each leg has a foothold within its joint limits.

    Args:
        body: (3,) [m] {strip}, level.
        footholds: (n, 3) [m] {strip} centres of feet.
        T_coxa_body: (6, 4, 4) body to coxa.
        links: Coxa, femur and tibia lengths [m].
        limits: (6, 3, 2) [rad] lowest and highest joint angles.

    Source: `sextant.shared.robot.kinematics.leg_inverse`.
    """
    coxa, femur, tibia = links
    for leg in range(6):
        T = T_coxa_body[leg]
        reaches = False
        for k in range(len(footholds)):
            if abs(footholds[k, 0] - body[0]) >= _REACH:
                continue
            dx, dy, dz = footholds[k, 0] - body[0], footholds[k, 1] - body[1], footholds[k, 2] - body[2]
            x = T[0, 0] * dx + T[0, 1] * dy + T[0, 2] * dz + T[0, 3]
            y = T[1, 0] * dx + T[1, 1] * dy + T[1, 2] * dz + T[1, 3]
            z = T[2, 0] * dx + T[2, 1] * dy + T[2, 2] * dz + T[2, 3]
            out = math.sqrt(x * x + y * y) - coxa
            cosine = (out * out + z * z - (femur * femur + tibia * tibia)) / (2.0 * femur * tibia)
            if abs(cosine) > 1.0:
                continue
            sine = -math.sqrt(1.0 - cosine * cosine)
            along, across = femur + tibia * cosine, tibia * sine
            q0, q2 = math.atan2(y, x), math.atan2(sine, cosine)
            q1 = math.atan2(z * along - out * across, out * along + z * across)
            if (
                limits[leg, 0, 0] <= q0 <= limits[leg, 0, 1]
                and limits[leg, 1, 0] <= q1 <= limits[leg, 1, 1]
                and limits[leg, 2, 0] <= q2 <= limits[leg, 2, 1]
            ):
                reaches = True
                break
        if not reaches:
            return False
    return True
