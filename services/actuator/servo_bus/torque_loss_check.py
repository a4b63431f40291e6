"""Check for lost torque: which servos' Torque Enable to read in this cycle. Pure.

A short power loss turns the torque of a servo off.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

_READS_PER_CYCLE = 3  # maximum number of Torque Enable registers that are read in a cycle
_DOUBTED_EVERY = 5  # [cycles] of 20 ms after which one more servo is to be checked: all of them within 1.8 s


class TorqueLossCheck:
    """Which of the 18 servos may have lost torque since their Torque Enable was last read."""

    def __init__(self) -> None:
        """Begin with no servo to check."""
        self._doubtful: NDArray[np.bool_] = np.zeros(18, dtype=np.bool_)
        self._cycle = 0

    def doubt_all(self) -> None:
        """Check all servos again."""
        self._doubtful[:] = True

    def due(self, answering: Iterable[int], torque: NDArray[np.bool_]) -> list[int]:
        """Return the indices (0 to 17) of servos to check now.

        Args:
            answering: Indices of the servos that answered in this cycle.
            torque: (18,) whether a servo should have torque.
        """
        return [i for i in answering if self._doubtful[i] and torque[i]][:_READS_PER_CYCLE]

    def confirm(self, index: int) -> None:
        """Note that the torque state of a servo has been read."""
        self._doubtful[index] = False

    def end_cycle(self, silent: NDArray[np.bool_]) -> None:
        """Mark servos (18,) that did not answer to be checked, and one other servo in turn.

        The turn is needed because a power loss may be shorter than the time between two requests.
        """
        self._doubtful |= silent
        self._cycle += 1
        if self._cycle % _DOUBTED_EVERY == 0:
            self._doubtful[self._cycle // _DOUBTED_EVERY % 18] = True
