"""What feet find: each stance of each leg, judged once, after the other legs have swung and this one had to carry."""

from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import ActuatorState, BodyPose

_FROM, _UNTIL = 0.2, 0.8  # phases of a step between which standing feet bear the whole robot


@dataclass(frozen=True, slots=True)
class Touch:
    """One foot in its stance."""

    p_world: Array  # (3,) [m] underside of the foot, the lowest it came
    carries: bool  # at any time: a foot that shares its load with others may bear too little to be noticed


class TouchWatch:
    """Tells new stances from old ones."""

    def __init__(self, foot_radius: float):
        """Take the radius [m] of the feet."""
        self._radius = foot_radius
        self._step = -1
        self._watched = np.zeros(6, dtype=bool)  # legs in their first stance after a swing, since the step began
        self._swung = np.zeros(6, dtype=bool)  # legs that have swung since they were judged
        self._carried = np.zeros(6, dtype=bool)
        self._lowest = np.full((6, 3), np.inf)

    def update(self, state: ActuatorState, pose: BodyPose) -> list[Touch]:
        """The feet whose first stance is over, by the newest word of the legs and of where the body is."""
        found = []
        if state.step != self._step or state.phase > _UNTIL:
            found = [Touch(self._lowest[leg].copy(), bool(self._carried[leg])) for leg in np.flatnonzero(self._watched)]
            self._swung &= ~self._watched
            self._watched[:] = self._carried[:] = False
            self._lowest[:] = np.inf
            self._step = state.step
        self._swung |= state.swing
        if state.swing.any() and _FROM <= state.phase <= _UNTIL:
            standing = self._swung & ~state.swing
            feet = apply(pose.T_world_odom @ state.T_odom_body, state.feet) - [0.0, 0.0, self._radius]
            lower = standing & (feet[:, 2] < self._lowest[:, 2])
            self._lowest[lower] = feet[lower]
            self._watched |= standing
            self._carried |= standing & state.contact
        return found
