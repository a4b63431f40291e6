"""Which feet carry, by the load that their servos feel; no force sensor."""

import math

import numpy as np
from numpy.typing import NDArray

from shared.geometry import Array
from shared.kinematics import leg_jacobian
from shared.robot import RobotProfile

_TOUCH_N = 1.5  # [N] and more is contact
_LIFT_N = 0.8  # [N] and less is none
_FIRM_N = 3.0  # [N] and more is contact beyond what friction and the legs' own links can feign in legs that hardly move
_SMOOTHING_S = 0.08  # [s] time constant


class ContactEstimate:
    """Vertical ground force per foot from the motor torques, with hysteresis against the servos' friction."""

    def __init__(self, profile: RobotProfile):
        """Begin with no contact."""
        self._profile = profile
        self._force = np.zeros(6)
        self.legs: NDArray[np.bool_] = np.zeros(6, dtype=bool)  # (6,) in contact

    def update(self, q: Array, torque: Array, dt: float) -> NDArray[np.bool_]:
        """Take in joint angles (6, 3) [rad] and motor torques (6, 3) [N m]; returns (6,) contact.

        They come dt [s] after those before; an infinite one makes them all that counts.
        """
        # The motors hold against the ground's force f by tau = -J^T f; damped, for a stretched leg feels little.
        Jt = np.swapaxes(leg_jacobian(q, self._profile.links), -1, -2)
        force = -np.linalg.solve(Jt + 1e-5 * np.eye(3), torque[..., None])[:, 2, 0]
        self._force += (1.0 - math.exp(-dt / _SMOOTHING_S)) * (force - self._force)
        self.legs = np.where(self.legs, self._force > _LIFT_N, self._force > _TOUCH_N)
        return self.legs

    @property
    def firm(self) -> NDArray[np.bool_]:
        """(6,) legs that push the ground beyond doubt, by all of their joints; of use while they move slowly or not at all."""
        return np.asarray(self._force > _FIRM_N)
