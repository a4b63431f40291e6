"""Fault state of servos and battery.

The bus faults set it, and the servo bank applies it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class ServoFaults:
    """Active faults of n servos and their battery."""

    unpowered: NDArray[np.bool_]  # (n,) servos without power; when it returns, torque is off and the RAM has factory values
    jammed: NDArray[np.bool_]  # (n,) joints that do not move
    frozen: NDArray[np.bool_]  # (n,) position registers that do not change
    tripped: NDArray[np.uint8]  # (n,) error bits that latch independently of load and heat
    offset: NDArray[np.int64]  # (n,) [ticks] offset of the position registers
    heating: NDArray[np.float64]  # (n,) [K/s] additional heating of the motors
    reads_hot: NDArray[np.int64]  # (n,) [deg C] value of the temperature registers, -1 for the true temperature
    sag: float = 0.0  # [V] reduction of the voltage
    drain: float = 0.0  # [1/s] additional discharge, as a share of the battery's capacity

    @classmethod
    def none(cls, n: int) -> "ServoFaults":
        """Return the state of n servos without faults."""
        no, ticks = np.zeros((3, n), dtype=np.bool_), np.zeros(n, dtype=np.int64)
        return cls(no[0], no[1], no[2], np.zeros(n, dtype=np.uint8), ticks, np.zeros(n), ticks - 1)
