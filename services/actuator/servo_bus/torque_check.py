"""Selection of the servos whose Torque Enable is read: a short power loss turns torque off. Pure."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

_PER_CYCLE = 3  # doubtful servos per cycle whose Torque Enable is read
_DOUBTED_EVERY = 5  # cycles after which one more servo becomes doubtful: all of them within 1.8 s


class TorqueCheck:
    """Servos that may have lost torque since it was last confirmed."""

    def __init__(self) -> None:
        """Begin without a doubt."""
        self._doubtful: NDArray[np.bool_] = np.zeros(18, dtype=np.bool_)
        self._cycle = 0

    def doubt_all(self) -> None:
        """Check all servos again."""
        self._doubtful[:] = True

    def due(self, answering: Iterable[int], torque: NDArray[np.bool_]) -> list[int]:
        """Return servos (0 to 17) to check now: of those that answer and should have torque (18,)."""
        return [i for i in answering if self._doubtful[i] and torque[i]][:_PER_CYCLE]

    def confirm(self, index: int) -> None:
        """Note that the torque state of a servo has been read."""
        self._doubtful[index] = False

    def end_cycle(self, silent: NDArray[np.bool_]) -> None:
        """Doubt servos (18,) that did not answer, and in turn the others.

        A power loss may be shorter than the time between two requests.
        """
        self._doubtful |= silent
        self._cycle += 1
        if self._cycle % _DOUBTED_EVERY == 0:
            self._doubtful[self._cycle // _DOUBTED_EVERY % 18] = True
