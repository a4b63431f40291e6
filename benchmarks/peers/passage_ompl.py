"""OMPL planner for the body alone.

Each leg must have a foothold. It plans no footsteps, so it has less work.
"""

from typing import Any

import numpy as np

from sextant.services.planner.roadmap.roadmap import Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import leg_inverse
from sextant.shared.robot.profile import RobotProfile

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
        self._base, self._geometric, self._profile = base, geometric, profile

    def plan(self, field: StripMap, stance: Stance, goal_x: float) -> bool:
        """Return whether the body can get from a stance to x [m] along the strip."""
        i, j = np.nonzero(field.evaluation <= _STRONG)
        places = np.column_stack([i, j]) * field.resolution + field.first_cell
        footholds = np.column_stack([places, field.elevation[i, j] + self._profile.foot.radius])
        space = self._base.RealVectorStateSpace(2)
        bounds = self._base.RealVectorBounds(2)
        for axis, (low, high) in enumerate(((stance.body[0] - 0.1, goal_x + 0.1), (-_DRIFT, _DRIFT))):
            bounds.setLow(axis, float(low))
            bounds.setHigh(axis, float(high))
        space.setBounds(bounds)
        setup = self._geometric.SimpleSetup(space)
        setup.setStateValidityChecker(lambda state: self._stands(np.array([state[0], state[1], stance.body[2]]), footholds))
        begin, end = space.allocState(), space.allocState()
        begin[0], begin[1] = float(stance.body[0]), float(stance.body[1])
        end[0], end[1] = float(goal_x), 0.0
        setup.setStartAndGoalStates(begin, end)
        setup.setPlanner(self._geometric.RRTConnect(setup.getSpaceInformation()))
        solved: Any = setup.solve(_LONGEST_S)
        return bool(solved) and bool(setup.haveExactSolutionPath())

    def _stands(self, body: Array, footholds: Array) -> bool:
        """Return whether each leg has a foothold within its limits."""
        near = footholds[np.abs(footholds[:, 0] - body[0]) < _REACH] - body
        T, limits = self._profile.T_coxa_body, self._profile.joint_limits
        for leg in range(6):
            q = leg_inverse(near @ T[leg, :3, :3].T + T[leg, :3, 3], self._profile.links)
            if not ((q >= limits[leg, :, 0]) & (q <= limits[leg, :, 1])).all(axis=1).any():
                return False
        return True
