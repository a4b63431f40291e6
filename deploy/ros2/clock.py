"""Conversion of the robot's monotonic stamps to time of day, as ROS uses it."""

_WINDOW_NS = 5_000_000_000  # [ns] window of the least delay; a minimum is kept for two windows
_JUMP_NS = 10_000_000_000  # [ns] no message takes this long: one of the clocks restarted or was set


class TimeOfDay:
    """Estimates the offset of two clocks from the message with the least delay."""

    def __init__(self) -> None:
        self._offsets_ns: list[int] = []  # least offset of this window, and of the previous one
        self._until_ns = 0

    def learn(self, stamp_ns: int, now_ns: int) -> None:
        """Update with a message of this stamp [ns, robot] received now [ns, time of day]."""
        offset = now_ns - stamp_ns
        if self._offsets_ns and abs(offset - min(self._offsets_ns)) > _JUMP_NS:
            self._offsets_ns = []
        if not self._offsets_ns or now_ns >= self._until_ns:
            self._offsets_ns = [offset, *self._offsets_ns[:1]]
            self._until_ns = now_ns + _WINDOW_NS
        self._offsets_ns[0] = min(self._offsets_ns[0], offset)

    def robot_ns(self, at_ns: int) -> int | None:
        """Convert a time of day [ns] to the robot's clock [ns]; None before a message of the robot."""
        return at_ns - min(self._offsets_ns) if self._offsets_ns else None

    def of(self, stamp_ns: int) -> int:
        """Convert a stamp [ns, robot] to time of day [ns]; call `learn` first."""
        return stamp_ns + min(self._offsets_ns)
