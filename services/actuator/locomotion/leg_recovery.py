"""Recovery of legs that were uncontrolled and hang or lie anywhere. Pure."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.joint_rate_limits import FETCHED, GENTLE

_Flags = NDArray[np.bool_]


class LegRecovery:
    """Legs that lost torque, or were silent in the air, and their recovery."""

    def __init__(self) -> None:
        """Begin with all legs under control."""
        self.unrecovered: _Flags = np.zeros(6, dtype=np.bool_)  # (6,) not recovered yet
        self.dangling: _Flags = np.zeros(6, dtype=np.bool_)  # (6,) those of them that were in the air
        self._recovering: _Flags = np.zeros(6, dtype=np.bool_)  # (6,) in recovery
        self._torque_lost: _Flags = np.zeros((6, 3), dtype=np.bool_)  # joints of hanging legs that have been without torque
        self._failed: _Flags = np.zeros((6, 3), dtype=np.bool_)  # (6, 3) joints for which their legs need recovery
        self._lost: _Flags = np.zeros(6, dtype=np.bool_)  # (6,) legs that cannot be controlled now
        self._idle = True  # whether all of these flags are False

    def update(self, torque_disabled: _Flags, unsure: _Flags, flying: _Flags) -> _Flags:
        """Update with the state of the legs.

        Args:
            torque_disabled: (6, 3) joints whose servo has no torque.
            unsure: (6, 3) the same, and joints whose servo is silent or has not reached its goal since.
            flying: (6,) legs in the air.

        Returns:
            (6,) hanging legs that can be controlled again. A leg that was silent while it stood keeps its foothold.
        """
        if self._idle and not np.count_nonzero(unsure):
            return self._lost  # none
        self._lost = torque_disabled.any(axis=1) | (unsure.any(axis=1) & (flying | self.unrecovered))
        back = self.unrecovered & ~self._lost
        self.dangling = self.dangling | (self._lost & ~self.unrecovered & flying)
        self.unrecovered = self.unrecovered | self._lost
        self._recovering = self._recovering & flying & ~self._lost
        self._failed = (self._failed | unsure) & (self.unrecovered | self._recovering)[:, None]
        self._torque_lost = (self._torque_lost | torque_disabled) & self.unrecovered[:, None]
        self._idle = not (self._lost | self.unrecovered | self._recovering).any()
        return back

    def start(self) -> float:
        """Start recovery of controllable legs; return their speed limit [rad/s]."""
        self._idle = False
        self._recovering = self.unrecovered & ~self._lost
        top = GENTLE if self._torque_lost[self._recovering].any() else FETCHED
        self.unrecovered, self.dangling = self._lost.copy(), self.dangling & self._lost
        return float(top)

    @property
    def waiting(self) -> _Flags:
        """(6, 3) joints with torque whose leg is in recovery or waits for it."""
        if self._idle:
            return self._failed  # none
        return np.asarray(self._failed & ((self.unrecovered & ~self._lost) | self._recovering)[:, None])
