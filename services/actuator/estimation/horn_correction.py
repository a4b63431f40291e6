"""Correction of horns that differ from the profile, while the robot walks.

`JointOffsets` estimates the differences from the stances. A leg is corrected only while its foot rises in a swing: a standing
foot is not dragged, and no touchdown is mistaken. Corrections are slow, so stances can contradict a wrong one before it grows.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.stance_fit import JointOffsets
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import HornErrors

_LARGEST_RAD = math.radians(4.0)  # bound of each offset, either way
_RATE_RAD_S = math.radians(1.0)  # of the offsets of a leg whose foot rises


class HornCorrection:
    """Offsets (6, 3) [rad] by which links are assumed to be ahead of their encoders; they start at zero."""

    def __init__(self, corrects: bool = True):
        """Begin without offsets; they stay at zero unless it `corrects`."""
        self.offsets: Array = np.zeros((6, 3))
        self._corrects = corrects
        self._pairs = 0  # number of measurements behind the last message

    def follow(self, estimate: Array | None, rising: NDArray[np.bool_], dt: float) -> bool:
        """Move the offsets of legs towards an estimate; return whether they have changed.

        Args:
            estimate: (18,) [rad] offsets of all joints; None: unknown or in doubt, the offsets stay.
            rising: (6,) legs whose feet rise.
            dt: [s] since the last call.
        """
        if estimate is None or not self._corrects or not np.count_nonzero(rising):
            return False
        most = np.where(rising, _RATE_RAD_S * dt, 0.0)[:, None]
        wanted = np.clip(estimate.reshape(6, 3), -_LARGEST_RAD, _LARGEST_RAD)
        change = np.clip(wanted - self.offsets, -most, most)
        self.offsets = self.offsets + change
        return bool(change.any())

    def news(self, stamp_ns: int, found: JointOffsets) -> HornErrors | None:
        """Return estimate and correction once the estimate has changed since the last call, else None."""
        if found.pairs == self._pairs:
            return None
        self._pairs = found.pairs
        # A link that is ahead of its encoder has a smaller horn offset.
        return HornErrors(stamp_ns, -found.mean.reshape(6, 3), found.sigma.reshape(6, 3), -self.offsets)
