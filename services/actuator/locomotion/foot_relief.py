"""Relief of standing feet that are held far from their goals. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.shared.geometry import Array

# [m] [s] distance of a standing foot from its servo goals, and its duration, from which something holds the foot. Others
# are off by 21 mm at most, on rubble with the softest servos.
_HELD_M, _HELD_S = 0.03, 0.3
_RELIEVED_M = 0.015  # [m] distance at which the relief ends
_RATE_M_S = 0.1  # [m/s] by which the distance falls


class FootRelief:
    """Moves the goals of standing feet that something holds to where the feet are.

    A foot that was dragged over the ground, or hooks behind a stone, stays where it is at the full torque of its servos, and
    they shut down within seconds.
    """

    def __init__(self) -> None:
        """Begin with feet at their goals."""
        self._held_s = np.zeros(6)  # (6,) [s] for which feet have been farther than `_HELD_M` from their goals
        self._gives_way: NDArray[np.bool_] = np.zeros(6, dtype=bool)  # legs whose goals move

    def update(self, standing: NDArray[np.bool_], goals: Array, felt: FootContact, dt: float) -> Array | None:
        """Return by how much (6, 3) [m] {odom} the goals move in this cycle; None if all stay.

        Args:
            standing: (6,) legs that stand.
            goals: (6, 3) [m] {odom} feet by the servo goals.
            felt: Measured contacts.
            dt: [s] since the last cycle.
        """
        gap = felt.feet - goals
        far = np.array([math.sqrt(x * x + y * y + z * z) for x, y, z in gap.tolist()])
        stands = standing & felt.known
        self._held_s = np.where(stands & (far > _HELD_M), self._held_s + dt, 0.0)
        self._gives_way = stands & (far > _RELIEVED_M) & (self._gives_way | (self._held_s > _HELD_S - 1e-9))
        if not np.count_nonzero(self._gives_way):
            return None
        share = np.minimum(_RATE_M_S * dt, far - _RELIEVED_M) / np.maximum(far, _RELIEVED_M)
        return np.asarray(np.where(self._gives_way, share, 0.0)[:, None] * gap)
