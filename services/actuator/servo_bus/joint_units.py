"""Goal registers of 18 servos, in the units of their models."""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile


class JointUnits:
    """Units of the servos of a robot, as arrays (18,)."""

    def __init__(self, profile: RobotProfile) -> None:
        """Store the units of each servo's model."""
        models = profile.servos.models
        units = [model.units for model in models]
        self._centre = np.array([float(one.centre) for one in units])
        self._tick_rad = np.array([one.tick_rad for one in units])
        self._max_position = np.array([float(one.max_position) for one in units])
        self._speed_rad_s = np.array([one.speed_rad_s for one in units])
        self._max_speed = np.array([model.table.goal_speed.max for model in models])

    def goal_ticks(self, angles: Array) -> NDArray[np.int64]:
        """Return goal position registers (18,) of servo angles (18,) [rad]."""
        ticks = np.rint(self._centre + angles / self._tick_rad)
        return np.asarray(np.minimum(np.maximum(ticks, 0.0), self._max_position).astype(np.int64))

    def speed_ticks(self, limits: Array) -> NDArray[np.int64]:
        """Return goal speed registers (18,) of speed limits (18,) [rad/s]; 0 means no limit in both."""
        if not limits.any():
            return np.zeros(len(limits), dtype=np.int64)
        ticks = np.clip(np.rint(limits / self._speed_rad_s), 1, self._max_speed)
        return np.where(limits > 0.0, ticks, 0).astype(np.int64)
