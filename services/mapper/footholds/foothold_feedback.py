"""Touchdown feedback from the first stance of each foot after a swing.

A stance is evaluated once, after the other legs have swung and the foot had to carry load.
"""

from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import ActuatorState, BodyPose

_FROM_PHASE, _UNTIL_PHASE = 0.2, 0.8  # phases of a step between which the stance feet carry the whole robot


@dataclass(frozen=True, slots=True)
class StanceResult:
    """Result of one stance of a foot."""

    p_world: Array  # (3,) [m] lowest position of the underside of the foot
    carries: bool  # whether it carried load at any time; a foot that shares the load may carry too little to detect


class FirstStanceDetector:
    """Detector of completed first stances of the feet."""

    def __init__(self, foot_radius: float):
        """Create a detector for feet of a radius [m]."""
        self._radius = foot_radius
        self._step = -1
        self._watched = np.zeros(6, dtype=bool)  # legs in their first stance after a swing, in this step
        self._swung = np.zeros(6, dtype=bool)  # legs that have swung since they were evaluated
        self._carried = np.zeros(6, dtype=bool)
        self._lowest = np.full((6, 3), np.inf)

    def update(self, state: ActuatorState, pose: BodyPose) -> list[StanceResult]:
        """Return the feet whose first stance has ended, from the newest state and pose."""
        found = []
        if state.step != self._step or state.phase > _UNTIL_PHASE:
            found = [StanceResult(self._lowest[leg].copy(), bool(self._carried[leg])) for leg in np.flatnonzero(self._watched)]
            self._swung &= ~self._watched
            self._watched[:] = self._carried[:] = False
            self._lowest[:] = np.inf
            self._step = state.step
        self._swung |= state.swing
        if state.swing.any() and _FROM_PHASE <= state.phase <= _UNTIL_PHASE:
            standing = self._swung & ~state.swing
            feet = apply(pose.T_world_odom @ state.T_odom_body, state.feet) - [0.0, 0.0, self._radius]
            lower = standing & (feet[:, 2] < self._lowest[:, 2])
            self._lowest[lower] = feet[lower]
            self._watched |= standing
            self._carried |= standing & state.contact
        return found
