"""Robot time: the time [ns] of the robot's monotonic clock, on any machine.

Every stamp is in robot time. On the robot this is the machine's monotonic clock. On other machines a process estimates the
robot's clock from the sending times in the robot's messages. The message with the shortest delay within the last seconds gives
the best estimate. The estimate therefore lags by that delay (some milliseconds) and is never ahead. Plans seem older to the
robot by this lag, and never newer than they are.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_WINDOW_NS = 10_000_000_000  # [ns] one or two windows are searched for the shortest delay; clocks drift by 0.1 ms per window
_BRACKET_NS = 1_000_000  # [ns] widest bracket of a reading of the boot clock
_READINGS = 3  # attempts of one call
_REBOOT_NS = 10_000_000_000  # [ns] a larger jump means that the robot's clock restarted or this machine was suspended
_SURE_NS = 2_000_000_000  # [ns] for which all messages must agree on such a jump


class ClockError(RuntimeError):
    """The robot's clock restarted.

    Stored times are invalid, so the process must restart.
    """


class RobotClock:
    """Estimate of the robot's monotonic clock on another machine.

    It is thread-safe and monotonic.
    """

    def __init__(self, own: Callable[[], int] = time.monotonic_ns):
        """Start without any received message.

        Args:
            own: This machine's monotonic clock [ns].
        """
        self._own = own
        self._lock = threading.Lock()
        self._ahead_ns: list[int] = []  # maximum lead of the robot's clock, in this window and the last
        self._window_ends_ns = 0
        self._newest_ns = 0  # newest sending time from the robot
        self._jump: tuple[int, int] | None = None  # unconfirmed jump: lead [ns] and time of its first message [ns]
        self._told_ns = 0  # last time that this clock returned
        self._began_anew = False

    def heard(self, sent_ns: int) -> None:
        """Record that a message arrives now, sent at `sent_ns` of the robot's clock.

        A time far from the estimate is accepted only after all messages have agreed with it for two seconds.
        """
        with self._lock:
            own_ns = self._own()
            if not self._believes(sent_ns, own_ns):
                return
            self._newest_ns = max(self._newest_ns, sent_ns)
            ahead_ns = sent_ns - own_ns
            if not self._ahead_ns:
                self._ahead_ns, self._window_ends_ns = [ahead_ns], own_ns + _WINDOW_NS
            elif own_ns >= self._window_ends_ns:
                self._ahead_ns, self._window_ends_ns = [ahead_ns, self._ahead_ns[0]], own_ns + _WINDOW_NS
            else:
                self._ahead_ns[0] = max(self._ahead_ns[0], ahead_ns)

    def _believes(self, sent_ns: int, own_ns: int) -> bool:
        """Return whether to use a time.

        A confirmed jump backward invalidates this clock; a confirmed jump ahead restarts the estimate.
        """
        if not self._ahead_ns or sent_ns == self._newest_ns:
            return True
        back, ahead_ns = sent_ns < self._newest_ns - _REBOOT_NS, sent_ns - own_ns
        if not back and ahead_ns <= max(self._ahead_ns) + _REBOOT_NS:
            self._jump = None
            return True
        if self._jump is None or abs(ahead_ns - self._jump[0]) > _REBOOT_NS:
            self._jump = ahead_ns, own_ns
        if own_ns - self._jump[1] < _SURE_NS:
            return False
        self._began_anew |= back
        self._ahead_ns, self._jump = [], None
        return True

    @property
    def in_doubt(self) -> bool:
        """Whether the newest message indicates a jump that is not confirmed yet."""
        return self._jump is not None

    @property
    def known(self) -> bool:
        """Whether any message of the robot has arrived."""
        return bool(self._ahead_ns)

    @property
    def ahead_s(self) -> float:
        """Offset [s] of the robot's clock from this machine's; 0 before the first message."""
        with self._lock:
            return max(self._ahead_ns, default=0) * 1e-9

    def __call__(self) -> int:
        """Return the robot time [ns].

        Raises:
            ClockError: The robot's clock restarted, as after a reboot.
        """
        with self._lock:
            if self._began_anew:
                raise ClockError("the robot's clock has restarted: the robot was switched off, or another robot uses its name")
            self._told_ns = max(self._told_ns, self._own() + max(self._ahead_ns, default=0))
            return self._told_ns


_clock: list[Callable[[], int]] = [time.monotonic_ns]


def now_ns() -> int:
    """Return the robot time [ns], by the clock that this process uses."""
    return _clock[0]()


def _boot_ns() -> int:
    """Read the clock [ns] that also counts suspended time.

    Systems without one use the monotonic clock.
    """
    counted = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic_ns() if counted is None else time.clock_gettime_ns(counted)


class SuspendedTime:
    """Time that this machine has spent suspended since it booted.

    Its monotonic clock stands still during suspension.

    A process may be preempted between the readings of two clocks. So the boot clock is read between two readings of the
    monotonic clock, and a reading whose bracket is wider than 1 ms is discarded. The result never decreases.
    """

    def __init__(self, monotonic: Callable[[], int] = time.monotonic_ns, boot: Callable[[], int] = _boot_ns):
        """Store two clocks [ns].

        During suspension `monotonic` stands still and `boot` does not.
        """
        self._monotonic, self._boot = monotonic, boot
        self._suspended_ns = 0

    def __call__(self) -> int:
        """Return the suspended time [ns], to 1 ms.

        It is the last value if all readings were discarded.
        """
        for _ in range(_READINGS):
            before_ns, boot_ns, after_ns = self._monotonic(), self._boot(), self._monotonic()
            if after_ns - before_ns <= _BRACKET_NS:
                self._suspended_ns = max(self._suspended_ns, boot_ns - after_ns)
                break
        return self._suspended_ns


def go_by(clock: Callable[[], int]) -> None:
    """Set the clock of this process; call it once, before anything reads the time."""
    _clock[0] = clock


def in_use() -> Callable[[], int]:
    """Return the clock of this process."""
    return _clock[0]


@contextmanager
def going_by(clock: Callable[[], int]) -> Iterator[None]:
    """Use a clock within a block, and restore the previous one afterwards."""
    before = _clock[0]
    _clock[0] = clock
    try:
        yield
    finally:
        _clock[0] = before
