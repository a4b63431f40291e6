"""Joint angles of servos that report none: what they are told, at the speed that they have. Pure."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.stand_sit import sit_pose
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile

WORDS = "no feedback: the angles of the joints are assumed"


class AssumedMotion:
    """Assumed angles (6, 3) [rad]; a joint without torque is assumed in the sit pose, into which an operator lays the robot."""

    def __init__(self, profile: RobotProfile) -> None:
        """Compute the sit pose."""
        self.sit_pose = sit_pose(profile)
        self._most_rad_s = profile.servo.no_load_speed

    def start(self, goals: Array, torque: NDArray[np.bool_]) -> Array:
        """Return the angles (6, 3) [rad] for goals that joints (6, 3) with torque have had for a while."""
        return np.where(torque, goals, self.sit_pose)

    def follow(self, q: Array, wanted: Array, torque: NDArray[np.bool_], limits: Array, dt: float) -> Array:
        """Return the angles (6, 3) [rad] after `dt` [s].

        Args:
            q: (6, 3) [rad] assumed angles.
            wanted: (6, 3) [rad] angles at which joints should come to rest; goals contain the sag, which the load takes back.
            torque: (6, 3) joints with torque.
            limits: (6, 3) [rad/s] speed limits of the goals, 0 for none.
            dt: [s] since then.
        """
        most = np.where(limits > 0.0, np.minimum(limits, self._most_rad_s), self._most_rad_s) * dt
        return np.where(torque, q + np.clip(wanted - q, -most, most), self.sit_pose)
