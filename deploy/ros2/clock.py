"""Stamps of the robot's monotonic clock as times of day, which ROS goes by."""

_WINDOW_NS = 5_000_000_000  # [ns] over which the least delay is looked for, and half of what it is kept for
_JUMP_NS = 10_000_000_000  # [ns] no message takes so long: one of the clocks has begun anew, or was set


class TimeOfDay:
    """Learns by how much two clocks differ, from messages as they come: the one that took the shortest is the nearest to it."""

    def __init__(self) -> None:
        self._offsets_ns: list[int] = []  # the least of this window, and of the one before
        self._until_ns = 0

    def learn(self, stamp_ns: int, now_ns: int) -> None:
        """Take in that a message stamped so [ns, robot] is here now [ns, time of day]."""
        offset = now_ns - stamp_ns
        if self._offsets_ns and abs(offset - min(self._offsets_ns)) > _JUMP_NS:
            self._offsets_ns = []
        if not self._offsets_ns or now_ns >= self._until_ns:
            self._offsets_ns = [offset, *self._offsets_ns[:1]]
            self._until_ns = now_ns + _WINDOW_NS
        self._offsets_ns[0] = min(self._offsets_ns[0], offset)

    def of(self, stamp_ns: int) -> int:
        """A stamp [ns, robot] as time of day [ns], once something has been learnt."""
        return stamp_ns + min(self._offsets_ns)
