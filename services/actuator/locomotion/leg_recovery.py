"""Legs that could not be led for a while, and hang or lie anywhere until they are put back. Pure."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.joint_rate_limits import FETCHED, GENTLE

_Flags = NDArray[np.bool_]


class HungLegs:
    """Which legs went limp, or silent in the air, and may be put back now."""

    def __init__(self) -> None:
        """Begin with all legs led."""
        self.hung: _Flags = np.zeros(6, dtype=np.bool_)  # (6,) not put back yet
        self.dangling: _Flags = np.zeros(6, dtype=np.bool_)  # (6,) those of them that were in the air
        self._coming: _Flags = np.zeros(6, dtype=np.bool_)  # (6,) on their way back
        self._limped: _Flags = np.zeros((6, 3), dtype=np.bool_)
        self._failed: _Flags = np.zeros((6, 3), dtype=np.bool_)  # joints for which they hang
        self._lost: _Flags = np.zeros(6, dtype=np.bool_)

    def update(self, limp: _Flags, unsure: _Flags, flying: _Flags) -> _Flags:
        """Take in how the legs fare.

        Args:
            limp: (6, 3) joints whose servo does not pull.
            unsure: (6, 3) those, and joints whose servo is silent or not yet where it was sent since.
            flying: (6,) legs in the air.

        Returns:
            (6,) legs that hang, and can be led again. One that stood while it was silent stands where it stood.
        """
        self._lost = limp.any(axis=1) | (unsure.any(axis=1) & (flying | self.hung))
        back = self.hung & ~self._lost
        self.dangling = self.dangling | (self._lost & ~self.hung & flying)
        self.hung = self.hung | self._lost
        self._coming = self._coming & flying & ~self._lost
        self._failed = (self._failed | unsure) & (self.hung | self._coming)[:, None]
        self._limped = (self._limped | limp) & self.hung[:, None]
        return back

    def put_back(self) -> float:
        """Those that can be led again are on their way; how fast [rad/s] their joints may go."""
        self._coming = self.hung & ~self._lost
        top = GENTLE if self._limped[self._coming].any() else FETCHED
        self.hung, self.dangling = self._lost.copy(), self.dangling & self._lost
        return float(top)

    @property
    def waiting(self) -> _Flags:
        """(6, 3) joints that pull again, but for which a leg is put back, or waits for that."""
        return np.asarray(self._failed & ((self.hung & ~self._lost) | self._coming)[:, None])
