"""Fault state of servos and battery.

The bus faults set it, and the servo bank applies it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SLIP_RAD_S = np.radians(100.0)  # [rad/s] speed at which a horn slips under load, and at which a fault of an encoder ends


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
    slips: NDArray[np.float64]  # (n,) [rad] by which encoders are ahead of their links in the end
    slip_rate: NDArray[np.float64]  # (n,) [rad/s] with which they get there
    stuck_ones: NDArray[np.uint16]  # (n,) bits of the goal registers that are stuck at 1
    stuck_zeros: NDArray[np.uint16]  # (n,) the same at 0
    wrong_sign: NDArray[np.bool_]  # (n,) load registers with the wrong sign
    strength: NDArray[np.float64]  # (n,) [1] torque of the motors, as a share of that without a fault
    sag: float = 0.0  # [V] reduction of the voltage
    drain: float = 0.0  # [1/s] additional discharge, as a share of the battery's capacity

    @classmethod
    def none(cls, n: int) -> "ServoFaults":
        """Return the state of n servos without faults."""
        no, ticks = np.zeros((4, n), dtype=np.bool_), np.zeros(n, dtype=np.int64)
        slips, rates, bits = np.zeros(n), np.full(n, SLIP_RAD_S), np.zeros((2, n), dtype=np.uint16)
        errors, heating, strength = np.zeros(n, dtype=np.uint8), np.zeros(n), np.ones(n)
        return cls(
            no[0], no[1], no[2], errors, ticks, heating, ticks - 1, slips, rates, bits[0], bits[1], no[3], strength
        )  # fmt: skip
