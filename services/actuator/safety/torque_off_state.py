"""An order to let go, as the actuator keeps it: by the latch, until torque is ordered on by one that was given later."""

from sextant.services.actuator.safety.torque_off_latch import Latch


class OffOrder:
    """Whether torque is to be off by an order that may be older than this process, and what is in the way of its latch."""

    def __init__(self, latch: Latch | None):
        """Take what is latched for an order; without a latch there is none that outlives this process."""
        self.unkept = ""  # why a restart would not know that torque is to be off, in words
        self.stuck = ""  # why it cannot be taken back, in words
        self.unseen = ""  # why nobody can say whether it was given past this process, in words
        self._latch = latch
        self._taken_back_ns = -1  # when the order was given that turned torque on
        self._closed = self._held = False  # the latch, and whether such an order held, when that was last seen or ordered

    @property
    def holds(self) -> bool:
        """Whether torque is to be off; not for what was ordered before the order that turned it on.

        Where the latch cannot be looked at that is as it was when it could, or has been ordered since: the robot neither falls
        for a broken disk, nor does torque come on.
        """
        if self._latch is None:
            return False
        self.unseen = ""
        try:
            self._closed = self._latch.closed
        except OSError as error:
            self.unseen = f"whether torque is ordered off past this process cannot be seen: {error}"
            return self._held
        since_ns = self._latch.since_ns if self._closed else -1
        self._held = since_ns == 0 or since_ns > self._taken_back_ns
        return self._held

    def since_ns(self, now_ns: int) -> int:
        """When that was ordered [ns]; now, where the latch does not know, or tells of another start of the machine."""
        since_ns = 0 if self._latch is None else self._latch.since_ns
        return since_ns if 0 < since_ns <= now_ns else now_ns

    def keep(self, at_ns: int) -> None:
        """See to it that a restart knows of an order of that time [ns]; what is in the way is said."""
        self.unkept, self._held = "", True
        try:
            if self._latch is not None:
                self._latch.close(at_ns)
        except OSError as error:
            self.unkept = f"torque is off, but a restarted actuator would not know of that order: {error}"

    def take_back(self, given_ns: int, now_ns: int) -> bool:
        """Take it back by an order that was given at a time [ns]; whether that could be, or else why not is said."""
        if self._open(given_ns, now_ns):
            self._taken_back_ns, self._held = min(given_ns, now_ns), False
        return not self.stuck

    def drop_old(self, now_ns: int) -> None:
        """Open a latch that was closed late, for an order that was taken back since."""
        if self._latch is not None and not self.holds and self._closed:
            self._open(self._taken_back_ns, now_ns)

    def _open(self, given_ns: int, now_ns: int) -> bool:
        self.unkept = self.stuck = ""
        try:
            if self._latch is not None and not self._latch.open(given_ns, now_ns):
                self.stuck = "torque stays off, for that was ordered meanwhile; order it anew"
        except OSError as error:
            self.stuck = f"torque stays off, for that order cannot be taken back: {error}; remove that file"
        return not self.stuck
