"""Torque-off state of the actuator, latched until a later torque-on order."""

from sextant.services.actuator.safety.torque_off_latch import Latch


class TorqueOffState:
    """Whether an order requires torque off, and problems of its latch.

    The order may be older than this process.
    """

    def __init__(self, latch: Latch | None):
        """Read the latch; without a latch no order outlives this process."""
        self.unkept = ""  # why a restart would not know that torque must be off
        self.stuck = ""  # why the order cannot be taken back
        self.unseen = ""  # why an order from outside this process cannot be detected
        self._latch = latch
        self._taken_back_ns = -1  # time of the order that turned torque on
        self._closed = False  # whether the latch requires torque off, when last read
        self._held = False  # whether torque must be off, when last read or ordered

    @property
    def holds(self) -> bool:
        """Whether torque must be off; orders before the torque-on order do not count.

        If the latch cannot be read, the last known or ordered state stays. Thus a broken disk neither makes the robot fall nor
        turns torque on.
        """
        if self._latch is None:
            return False
        self.unseen = ""
        try:
            self._closed = self._latch.closed
        except OSError as error:
            self.unseen = f"cannot read the torque-off latch: {error}"
            return self._held
        since_ns = self._latch.since_ns if self._closed else -1
        # 0: the time of the order is unknown, or before a reboot, so the order counts.
        self._held = since_ns == 0 or since_ns > self._taken_back_ns
        return self._held

    def since_ns(self, now_ns: int) -> int:
        """Return the time of the order [ns]; now, if unknown or from before a reboot."""
        since_ns = 0 if self._latch is None else self._latch.since_ns
        return since_ns if 0 < since_ns <= now_ns else now_ns

    def keep(self, at_ns: int) -> None:
        """Latch an order of a given time [ns] for a restart; `unkept` reports a failure."""
        self.unkept, self._held = "", True
        try:
            if self._latch is not None:
                self._latch.close(at_ns)
        except OSError as error:
            self.unkept = f"torque is off, but the order cannot be stored for a restarted actuator: {error}"

    def take_back(self, given_ns: int, now_ns: int) -> bool:
        """Take the order back by one given at `given_ns` [ns]; on failure set `stuck`.

        Return whether it succeeded.
        """
        if self._open(given_ns, now_ns):
            self._taken_back_ns, self._held = min(given_ns, now_ns), False
        return not self.stuck

    def drop_old(self, now_ns: int) -> None:
        """Open a latch that was closed late, for an order that has been taken back since."""
        if self._latch is not None and not self.holds and self._closed:
            self._open(self._taken_back_ns, now_ns)

    def _open(self, given_ns: int, now_ns: int) -> bool:
        self.unkept = self.stuck = ""
        try:
            if self._latch is not None and not self._latch.open(given_ns, now_ns):
                self.stuck = "torque stays off, because it was ordered off in the meantime; order it again"
        except OSError as error:
            self.stuck = f"torque stays off, because the torque-off latch cannot be opened: {error}; remove that file"
        return not self.stuck
