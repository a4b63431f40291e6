"""Detection of feet in the air that an obstacle holds. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.shared.geometry import Array

# [m] [s] lag of a foot in the air, and its duration, from which it counts as held. A free foot lags by 16 mm at most,
# with the softest servos. A held one soon pulls with the full torque of its servos.
_LAG_M, _LAG_S = 0.03, 0.16


class HeldFeet:
    """Time for which each foot in the air has lagged far behind its servo goals."""

    def __init__(self) -> None:
        """Begin with feet that follow."""
        self._lag_s = np.zeros(6)  # (6,) [s] for which feet have lagged by more than `_LAG_M`

    def reset(self, legs: NDArray[np.bool_]) -> None:
        """Discard the lag of legs (6,)."""
        self._lag_s[legs] = 0.0

    def update(self, flying: NDArray[np.bool_], goals: Array, felt: FootContact, dt: float) -> NDArray[np.bool_]:
        """Return legs (6,) whose feet are held.

        A folded leg at a joint limit lags behind the plan, but not behind its goals.

        Args:
            flying: (6,) legs in the air.
            goals: (6, 3) [m] {odom} feet by the servo goals.
            felt: Measured contacts.
            dt: [s] since the last cycle.
        """
        behind = [math.sqrt(x * x + y * y + z * z) > _LAG_M for x, y, z in (goals - felt.feet).tolist()]
        self._lag_s = np.where(flying & felt.known & behind, self._lag_s + dt, 0.0)
        return np.asarray(self._lag_s > _LAG_S - 1e-9)
