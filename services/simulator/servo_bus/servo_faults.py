"""What ails servos and their battery beyond what they do to themselves; a fault grid says so, the bank of servos suffers it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class Ailments:
    """What ails n servos and their battery from outside; made by a fault grid."""

    unpowered: NDArray[np.bool_]  # (n,) limp; power that comes back finds torque off and the RAM forgotten
    jammed: NDArray[np.bool_]  # (n,) joints that do not move
    frozen: NDArray[np.bool_]  # (n,) position registers that do not change
    tripped: NDArray[np.uint8]  # (n,) error bits that latch, whatever load and heat are
    offset: NDArray[np.int64]  # (n,) [ticks] by which position registers are off
    heating: NDArray[np.float64]  # (n,) [K/s]
    reads_hot: NDArray[np.int64]  # (n,) [deg C] that temperature registers read, -1 for what is true
    sag: float = 0.0  # [V] less
    drain: float = 0.0  # [1/s] of the battery's capacity

    @classmethod
    def none(cls, n: int) -> "Ailments":
        """Of n servos that are well."""
        no, ticks = np.zeros((3, n), dtype=np.bool_), np.zeros(n, dtype=np.int64)
        return cls(no[0], no[1], no[2], np.zeros(n, dtype=np.uint8), ticks, np.zeros(n), ticks - 1)
