"""Search for ground below footholds that carry no load. Pure."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.shared.geometry import Array

SEARCH_DEPTH_M = 0.04  # [m] by which a foot searches below its target
_SPEED_M_S = 0.04  # [m/s] at which searching feet move down ...
_CYCLE_M = 0.001  # [m] ... but not further from one reading to the next, as in a slow control cycle
_PATIENCE_S = 0.1  # [s] for which they wait for a reading of each of them
_PUSHED_DOWN_M = 0.005  # [m] of search after which the load of all joints of the leg shows that the foot stood all the time


class GroundSearch:
    """Feet that move down until they meet ground."""

    def __init__(self, legs: NDArray[np.bool_], stop_height: Array, depth: float = 0.0):
        """Begin with legs (6,) that were stopped at heights (6,) [m] over their targets, at a depth [m]."""
        self.legs = legs.copy()  # (6,) legs that still search
        self.depth = depth  # [m] below the heights at which the feet stood
        self._reach = SEARCH_DEPTH_M + stop_height  # (6,) [m] largest depth of each
        self._unheard = legs.copy()  # (6,) legs without a reading since the last increase in depth
        self._waited_s = 0.0  # [s] for which there have been such legs

    def update(self, felt: FootContact) -> NDArray[np.bool_]:
        """Return legs (6,) that have found ground; they no longer search."""
        # A foot below its femur's axis hardly turns the femur, so touchdown detection may miss that it stands.
        pushes = felt.pushes & (self.depth > _PUSHED_DOWN_M)
        found = self.legs & (felt.touches | pushes | felt.lifts_body)
        self.legs &= ~found
        return np.asarray(found)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(6,) legs that have reached their largest depth without ground."""
        return np.asarray(self.legs & (self.depth > self._reach - 1e-9))

    def deepen(self, dt: float, felt: FootContact) -> float:
        """Search deeper for `dt` [s], unless a reading is still to come; return the increase in depth [m]."""
        self._unheard &= self.legs & felt.known & ~felt.heard
        waits = bool(np.count_nonzero(self._unheard))
        self._waited_s = self._waited_s + dt if waits else 0.0
        if 0.0 < self._waited_s <= _PATIENCE_S:
            return 0.0
        if not waits:
            self._unheard = self.legs.copy()
        step = min(_SPEED_M_S * dt, _CYCLE_M)
        self.depth += step
        return step
