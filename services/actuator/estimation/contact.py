"""Which feet carry, by the load that their servos feel; no force sensor."""

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import leg_jacobian
from sextant.shared.robot.profile import RobotProfile

_TOUCH_N = 1.5  # [N] and more is contact
_LIFT_N = 0.8  # [N] and less is none
_FIRM_N = 3.0  # [N] and more is contact beyond what friction and the legs' own links can feign in legs that hardly move
_SMOOTHING_S = 0.08  # [s] time constant
_MIN_LEGS = 3
_LIFTED = 0.006  # [m] over the feet that bear the body from which one that does not push firmly is in the air
_MIDDLE = np.array([[0.0], [0.0], [1.0]])  # the body's, as a row x, y, 1
_THREES = np.array(list(combinations(range(6), 3)))
_ASIDE = 0.05  # share of the body's weight by which its middle may lie outside of three feet
_LEAST_AREA = 1e-3  # [m^2] of a triangle of feet that tells how its plane lies


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

    def lifted(self, feet: Array) -> Array:
        """Heights (6,) [m] by which feet (6, 3) [m] {body} are in the air, 0 for those that stand.

        It is for a robot that nobody has led for a while. Friction holds a leg in the air as the ground would, so its load
        alone does not tell. The body rests on three feet that carry around its middle, with none that carries below their
        plane; what is over that is in the air by as much, unless it pushes firmly. Where there are no such three those that
        carry stand; where there are not even three of these, all.
        """
        rows = np.concatenate([feet[:, :2], np.ones((6, 1))], axis=1)  # x, y, 1
        corners = rows[_THREES]
        plane = np.abs(np.linalg.det(corners)) > 2.0 * _LEAST_AREA
        corners = np.where(plane[:, None, None], corners, np.eye(3))
        shares = np.linalg.solve(corners.swapaxes(1, 2), _MIDDLE)[..., 0]  # of the body's weight
        around = (shares >= -_ASIDE).all(axis=1) & self.legs[_THREES].all(axis=1) & plane
        if not around.any():
            carrying = self.legs if self.legs.sum() >= _MIN_LEGS else np.ones(6, dtype=np.bool_)
            over = feet[:, 2] - feet[carrying, 2].mean()
            return np.where((over < _LIFTED) | carrying, 0.0, over)
        over = feet[:, 2] - np.linalg.solve(corners, feet[_THREES, 2:])[..., 0] @ rows.T  # (20, 6) each foot over each plane
        below = np.maximum(-over.min(axis=1, where=self.legs, initial=0.0), 0.0)
        bearing = np.argmin(np.where(around, below - _LIFTED * shares.min(axis=1), np.inf))  # of equals, the widest around it
        return np.where((over[bearing] < _LIFTED) | self.firm, 0.0, over[bearing])
