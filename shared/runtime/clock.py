"""What time it is: [ns] of the robot's monotonic clock, on whichever machine a process runs.

Every stamp is in the robot's time. On the robot that is this machine's monotonic clock; elsewhere a process follows the
robot's, by what the robot's own messages say of when they were sent. Of what has come within the last seconds, the one that was
under way for the shortest time says it best, so what is followed is late by that way (some milliseconds) and never early: a
plan seems older by it to the robot, and none seems newer than it is.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_WINDOW_NS = 10_000_000_000  # over which the shortest way is looked for, and up to twice that: clocks drift by 0.1 ms in it
_BRACKET_NS = 1_000_000  # widest bracket of a reading of the boot clock
_READINGS = 3  # attempts of one call
_REBOOT_NS = 10_000_000_000  # by which the robot's time jumps only where its clock began anew, or this machine was suspended
_SURE_NS = 2_000_000_000  # for which all that comes has to agree on such a jump


class ClockError(RuntimeError):
    """The robot's clock began anew: whatever remembers times of it must begin anew, too."""


class RobotClock:
    """The robot's monotonic clock as another machine knows it; safe for threads, and it never goes back."""

    def __init__(self, own: Callable[[], int] = time.monotonic_ns):
        """Begin with nothing heard.

        Args:
            own: [ns] this machine's monotonic clock.
        """
        self._own = own
        self._lock = threading.Lock()
        self._ahead_ns: list[int] = []  # the most by which the robot's was ahead, in this window and the last
        self._window_ends_ns = 0
        self._newest_ns = 0  # that the robot has said
        self._jump: tuple[int, int] | None = None  # another time that is claimed: ahead by [ns], first at [ns]
        self._told_ns = 0  # that this clock has told
        self._began_anew = False

    def heard(self, sent_ns: int) -> None:
        """Something came just now that the robot sent at a time [ns] of its clock.

        A time that is far from what is known is a claim, and believed once all that has come for a while agrees with it.
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
        """Whether a time counts; a jump back that is believed ends this clock, one ahead begins it anew."""
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
        """Whether the newest time that came is another one, and not believed yet."""
        return self._jump is not None

    @property
    def known(self) -> bool:
        """Whether the robot has been heard."""
        return bool(self._ahead_ns)

    @property
    def ahead_s(self) -> float:
        """[s] by which the robot's clock is ahead of this machine's; 0 where nothing was heard."""
        with self._lock:
            return max(self._ahead_ns, default=0) * 1e-9

    def __call__(self) -> int:
        """[ns] now.

        Raises:
            ClockError: The robot's clock began anew, as after a reboot.
        """
        with self._lock:
            if self._began_anew:
                raise ClockError("the robot's clock began anew: it was switched off, or another robot answers by its name")
            self._told_ns = max(self._told_ns, self._own() + max(self._ahead_ns, default=0))
            return self._told_ns


_clock: list[Callable[[], int]] = [time.monotonic_ns]


def now_ns() -> int:
    """The robot's time [ns], by the clock that this process goes by."""
    return _clock[0]()


def _boot_ns() -> int:
    """Read [ns] the clock that counts time in suspend, too; the monotonic clock where there is none."""
    counted = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic_ns() if counted is None else time.clock_gettime_ns(counted)


class SuspendedTime:
    """Time that this machine has spent suspended since it booted, while its monotonic clock stood still.

    A process may be preempted between the readings of two clocks. So the boot clock is read between two readings of the
    monotonic clock, and a reading whose bracket is wider than 1 ms is discarded. The result never falls.
    """

    def __init__(self, monotonic: Callable[[], int] = time.monotonic_ns, boot: Callable[[], int] = _boot_ns):
        """Take the two clocks [ns]: `monotonic` stands still in suspend, `boot` does not."""
        self._monotonic, self._boot = monotonic, boot
        self._suspended_ns = 0

    def __call__(self) -> int:
        """[ns] suspended, to 1 ms; the last value where every reading of this call was torn."""
        for _ in range(_READINGS):
            before_ns, boot_ns, after_ns = self._monotonic(), self._boot(), self._monotonic()
            if after_ns - before_ns <= _BRACKET_NS:
                self._suspended_ns = max(self._suspended_ns, boot_ns - after_ns)
                break
        return self._suspended_ns


def go_by(clock: Callable[[], int]) -> None:
    """Let this process go by a clock; done once, before anything asks for the time."""
    _clock[0] = clock


def in_use() -> Callable[[], int]:
    """The clock that this process goes by."""
    return _clock[0]


@contextmanager
def going_by(clock: Callable[[], int]) -> Iterator[None]:
    """Go by a clock within a block, and then by the one before."""
    before = _clock[0]
    _clock[0] = clock
    try:
        yield
    finally:
        _clock[0] = before
