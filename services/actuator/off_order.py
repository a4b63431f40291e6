"""An order to let go, as the actuator keeps it: by the latch, until torque is ordered on by one that was given later."""

from services.actuator.latch import Latch


class OffOrder:
    """Whether torque is to be off by an order that may be older than this process, and what is in the way of its latch."""

    def __init__(self, latch: Latch | None):
        """Take what is latched for an order; without a latch there is none that outlives this process."""
        self.unkept = ""  # why a restart would not know that torque is to be off, in words
        self.stuck = ""  # why it cannot be taken back, in words
        self._latch = latch
        self._taken_back_ns = -1  # when the order was given that turned torque on

    @property
    def holds(self) -> bool:
        """Whether torque is to be off; not for what was ordered before the order that turned it on."""
        if self._latch is None or not self._latch.closed:
            return False
        since_ns = self._latch.since_ns
        return since_ns == 0 or since_ns > self._taken_back_ns

    def since_ns(self, now_ns: int) -> int:
        """When that was ordered [ns]; now, where the latch does not know, or tells of another start of the machine."""
        since_ns = 0 if self._latch is None else self._latch.since_ns
        return since_ns if 0 < since_ns <= now_ns else now_ns

    def keep(self, at_ns: int) -> None:
        """See to it that a restart knows of an order of that time [ns]; what is in the way is said."""
        self.unkept = ""
        try:
            if self._latch is not None:
                self._latch.close(at_ns)
        except OSError as error:
            self.unkept = f"torque is off, but a restarted actuator would not know of that order: {error}"

    def take_back(self, given_ns: int, now_ns: int) -> bool:
        """Take it back by an order that was given at a time [ns]; whether that could be, or else why not is said."""
        if self._open(given_ns, now_ns):
            self._taken_back_ns = min(given_ns, now_ns)
        return not self.stuck

    def drop_old(self, now_ns: int) -> None:
        """Open a latch that was closed late, for an order that was taken back since."""
        if self._latch is not None and self._latch.closed and not self.holds:
            self._open(self._taken_back_ns, now_ns)

    def _open(self, given_ns: int, now_ns: int) -> bool:
        self.unkept = self.stuck = ""
        try:
            if self._latch is not None and not self._latch.open(given_ns, now_ns):
                self.stuck = "torque stays off, for that was ordered meanwhile; order it anew"
        except OSError as error:
            self.stuck = f"torque stays off, for that order cannot be taken back: {error}"
        return not self.stuck
