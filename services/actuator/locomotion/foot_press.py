"""Press of feet that do not prove that they stand, before they count as feet without ground. Pure.

Stiff legs of a light robot take up no height: of six feet, the load of some is too small to be felt, or a foot is a millimetre
over the ground. A foot that presses down takes up load then, and the step goes on.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.ground_search import GroundSearch
from sextant.shared.geometry import Array

PRESS_M = 0.006  # [m] depth of a press, about the compliance of a loaded leg; deeper, ground is missing
_LATE_M = 0.0025  # [m] by which a foot has moved on when its load is felt, after two readings
_RELEASE_M_S = 0.04  # [m/s] at which the rest of a press is taken back


class FootPress:
    """Feet that are commanded lower for a moment."""

    def __init__(self) -> None:
        """Begin without a press."""
        self._depth = np.zeros(6)  # (6,) [m] by which feet are commanded lower
        self._search: GroundSearch | None = None

    @property
    def legs(self) -> NDArray[np.bool_]:
        """(6,) legs that press."""
        return np.zeros(6, dtype=np.bool_) if self._search is None else self._search.legs

    @property
    def is_in_vain(self) -> bool:
        """Whether feet have pressed as deep as they may."""
        return self._search is not None and bool(self._search.legs.any()) and self._search.depth > PRESS_M - 1e-9

    def begin(self, legs: NDArray[np.bool_]) -> None:
        """Let legs (6,) press."""
        self._search = GroundSearch(legs, np.zeros(6))

    def stop(self) -> None:
        """End the press, for example because the robot does not step any more."""
        self._search = None

    def update(self, dt: float, felt: FootContact) -> tuple[NDArray[np.bool_], Array]:
        """Press for `dt` [s]; return the feet (6,) that stand, and by how much lower (6,) [m] than expected they do."""
        assert self._search is not None
        found = self._search.update(felt)
        lower = np.where(found, np.maximum(self._depth - _LATE_M, 0.0), 0.0)
        self._depth -= lower
        if self._search.legs.any():
            self._depth[self._search.legs] += self._search.deepen(dt, felt)
        else:
            self._search = None
        return found, lower

    def hand_over(self, legs: NDArray[np.bool_]) -> Array:
        """End the press; return the depths (6,) [m] of legs that search from there."""
        depth = np.where(legs, self._depth, 0.0)
        self._depth -= depth
        self._search = None
        return depth

    def lowered(self, feet: Array, dt: float) -> Array:
        """Return feet (6, 3) [m] with their presses; those of feet that no longer press are taken back within time."""
        if not np.count_nonzero(self._depth):
            return feet
        self._depth = np.where(self.legs, self._depth, np.maximum(self._depth - _RELEASE_M_S * dt, 0.0))
        lower = feet.copy()
        lower[:, 2] -= self._depth
        return lower
