"""Servos that missed goals and move slowly until they have caught up. Pure: time is an input."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE
from sextant.shared.geometry import Array

_CAUGHT_UP_RAD = np.radians(5.0)  # [rad] between a joint and its goal, below which it has caught up
# Under load a joint stays some degrees off its goal, so it has also caught up if it is slow some time after its first reading.
_STILL_RAD_S = np.radians(10.0)  # [rad/s]
_MIN_MOTION_NS = 100_000_000  # [ns]
_SILENT_TIMEOUT_NS = 1_000_000_000  # [ns] for silent servos to answer after the first one has answered again
_UNLIMITED = np.zeros(18)


class CatchingUp:
    """Servos whose position is unknown or away from their goal, after they missed goals."""

    def __init__(self) -> None:
        """Begin with servos that have received all goals."""
        self.behind: NDArray[np.bool_] = np.zeros(18, dtype=np.bool_)  # servos that missed goals
        self.all_behind = False  # whether all servos missed goals, and have not yet answered and caught up
        self._max_speed: Array = np.full(18, GENTLE)  # [rad/s] speed limit of servos that are behind
        self._back_ns = np.zeros(18, dtype=np.int64)  # [ns] when they first answered again, 0 before
        self._returned_ns = 0  # [ns] when the first of all servos answered again, 0 before
        self._moves: NDArray[np.bool_] = np.zeros(18, dtype=np.bool_)  # servos that move by their newest readings, or may

    @property
    def answering(self) -> NDArray[np.bool_]:
        """(18,) servos that have answered again, and have not caught up yet."""
        return np.asarray(self.behind & (self._back_ns > 0))

    @property
    def speed_limits(self) -> Array:
        """(18,) [rad/s] maximum speeds on the way to the goals, 0 without a limit."""
        if not any(self.behind.tolist()):
            return _UNLIMITED
        return np.where(self.behind, self._max_speed, 0.0)

    def leave_behind(self, servos: NDArray[np.bool_], max_speed: float) -> None:
        """Limit the speed of servos (18,) that miss goals to `max_speed` [rad/s]."""
        self._max_speed[servos & ~self.behind] = max_speed
        self._max_speed[servos] = np.minimum(self._max_speed[servos], max_speed)
        self.behind |= servos
        self._back_ns[servos] = 0

    def leave_all_behind(self) -> None:
        """Treat the positions of all servos as unknown."""
        self.all_behind = True
        self._returned_ns, self._moves[:] = 0, True
        self.leave_behind(np.ones(18, dtype=np.bool_), GENTLE)

    def note_reading(self, index: int, stamp_ns: int, off: float, speed: float) -> None:
        """End the limit of a servo once it has reached its goal.

        Args:
            index: The servo, 0 to 17.
            stamp_ns: [ns] time of its reading.
            off: [rad] between joint and goal.
            speed: [rad/s] of the servo.
        """
        self._returned_ns = self._returned_ns or stamp_ns
        still = abs(speed) < _STILL_RAD_S
        self._moves[index] = not still
        if not self.behind[index]:
            return
        self._back_ns[index] = self._back_ns[index] or stamp_ns
        arrived = still and stamp_ns - self._back_ns[index] > _MIN_MOTION_NS
        if arrived or abs(off) < _CAUGHT_UP_RAD:
            self.behind[index] = False

    def update_all_behind(self, now_ns: int) -> None:
        """End `all_behind` once all servos have caught up and rest, or 1 s after the first one has answered again.

        The load of a moving leg does not show whether it stands.
        """
        if self.all_behind:
            waited = 0 < self._returned_ns < now_ns - _SILENT_TIMEOUT_NS
            self.all_behind = bool((self.behind | self._moves).any()) and not waited

    def readopt(self, off: Array, now_ns: int) -> None:
        """Continue with goals that were adopted from the servos, all of which have just answered.

        A joint on its way to its goal continues slowly.

        Args:
            off: (18,) [rad] between joints and goals.
            now_ns: [ns] time of their answers.
        """
        self.behind &= np.abs(off) >= _CAUGHT_UP_RAD
        self._returned_ns, self._moves[:] = now_ns, True
        self._back_ns = np.where(self.behind, now_ns, 0)
