"""The robot's time, for who beats by another clock and gives orders, which the robot judges by its own."""

from sextant.shared.runtime.clock import ClockError, RobotClock


class RobotTime:
    """What the robot's clock says, by the newest of its stamps that has come; before that this machine's own."""

    def __init__(self) -> None:
        self._now_ns = 0
        self._clock = RobotClock(lambda: self._now_ns)

    @property
    def known(self) -> bool:
        """Whether the robot has been heard."""
        return self._clock.known

    @property
    def in_doubt(self) -> bool:
        """Whether the newest stamp is of another time, and not believed yet."""
        return self._clock.in_doubt

    def see(self, now_ns: int, stamp_ns: int | None) -> str:
        """Take in this machine's time, and a stamp of the robot's that has come by then.

        Returns:
            That the robot's clock began anew, so that whatever was said by it before is void, in words; or nothing.
        """
        self._now_ns = now_ns
        if stamp_ns is None:
            return ""
        self._clock.heard(stamp_ns)
        try:
            self._clock()
        except ClockError as error:
            self._clock = RobotClock(lambda: self._now_ns)
            self._clock.heard(stamp_ns)
            return str(error)
        return ""

    def __call__(self) -> int:
        """Now [ns]."""
        return self._clock() if self.known else self._now_ns
