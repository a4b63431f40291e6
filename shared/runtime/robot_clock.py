"""The robot's time, for clients with another clock.

The robot checks the stamps of orders against its own clock.
"""

from sextant.shared.runtime.clock import ClockError, RobotClock


class RobotClockEstimate:
    """Estimate of the robot's clock from its newest stamp.

    Before the first stamp it is this machine's clock.
    """

    def __init__(self) -> None:
        self._now_ns = 0
        self._clock = RobotClock(lambda: self._now_ns)

    @property
    def known(self) -> bool:
        """Whether a stamp of the robot was received."""
        return self._clock.known

    @property
    def in_doubt(self) -> bool:
        """Whether the newest stamp is of another time and not accepted yet."""
        return self._clock.in_doubt

    def see(self, now_ns: int, stamp_ns: int | None) -> str:
        """Update this machine's time, and a stamp of the robot received by then.

        Returns:
            Text that the robot's clock restarted, so that earlier orders are void; or an empty string.
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
        """Return the current time [ns]."""
        return self._clock() if self.known else self._now_ns
