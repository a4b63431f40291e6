"""The robot's clock on another machine: late by the least delay, monotonic.

It is never ahead of the robot's time.
"""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.runtime import clock
from sextant.shared.runtime.clock import ClockError, RobotClock, SuspendedTime

MS = 1_000_000
SEC = 1000 * MS


class Own:
    """A machine's monotonic clock."""

    def __init__(self, now_ns: int = 5 * SEC):
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns


@given(
    ahead_ns=st.integers(-(10**15), 10**15).filter(lambda ahead: ahead > -4 * SEC or ahead < -6 * SEC),
    ways_ms=st.lists(st.integers(1, 400), min_size=1, max_size=200),
)
def test_robot_clock_lags_by_shortest_delay_and_is_monotonic(ahead_ns: int, ways_ms: list[int]) -> None:
    own = Own(10**16)
    robot, told = RobotClock(own), []
    for way_ms in ways_ms:
        robot.heard(own.now_ns + ahead_ns - way_ms * MS)
        told.append(robot())
        late_ns = own.now_ns + ahead_ns - told[-1]
        assert late_ns >= 0
        own.now_ns += 40 * MS
    assert told == sorted(told)
    assert own.now_ns + ahead_ns - robot() == min(ways_ms) * MS, "all within one window"
    assert robot.ahead_s * SEC == pytest.approx(ahead_ns - min(ways_ms) * MS, rel=1e-9)


def test_robot_clock_follows_drift() -> None:
    own, drift = Own(0), 1e-4
    robot, late = RobotClock(own), []
    for k in range(25 * 120):
        true_ns = round(own.now_ns * (1.0 - drift))
        robot.heard(true_ns - (3 + k % 7) * MS)
        late.append((true_ns - robot()) * 1e-6)
        own.now_ns += 40 * MS
    assert -2.1 < min(late) <= max(late) < 5.0, "[ms]; 100 ppm are 2 ms in two windows"


def test_robot_clock_is_unknown_before_first_message() -> None:
    own = Own()
    robot = RobotClock(own)
    assert not robot.known
    assert robot.ahead_s == 0.0
    assert robot() == own.now_ns
    robot.heard(77 * SEC)
    assert robot.known
    assert robot() == 77 * SEC


def test_restarted_robot_sets_new_time() -> None:
    own = Own(1000 * SEC)
    robot = RobotClock(own)
    robot.heard(5000 * SEC)
    robot.heard(4995 * SEC)  # delayed by 5 s
    robot()
    robot.heard(3 * SEC)
    own.now_ns += 1960 * MS
    robot.heard(5 * SEC)
    robot()  # the new time is still a claim
    own.now_ns += 40 * MS
    robot.heard(5 * SEC)
    with pytest.raises(ClockError, match="has restarted"):
        robot()


@pytest.mark.parametrize("claim_ns", [0, -(1 << 62), 1 << 62, 5000 * SEC + 3600 * SEC])
def test_false_time_is_ignored_while_robot_publishes_its_time(claim_ns: int) -> None:
    own = Own(1000 * SEC)
    robot = RobotClock(own)
    for _ in range(500):
        robot.heard(own.now_ns + 4000 * SEC)
        robot.heard(claim_ns)
        robot.heard(claim_ns + own.now_ns)
        assert robot() == own.now_ns + 4000 * SEC
        own.now_ns += 40 * MS


def test_robot_clock_is_ahead_after_suspend() -> None:
    own = Own(1000 * SEC)
    robot = RobotClock(own)
    for lost_s in (0, 3600):
        for _ in range(60):
            robot.heard(own.now_ns + (4000 + lost_s) * SEC)
            own.now_ns += 40 * MS
        assert robot() == own.now_ns + (4000 + lost_s) * SEC


def test_process_uses_machine_clock_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "_clock", clock._clock.copy())
    before = clock.now_ns()
    assert clock.now_ns() >= before
    clock.go_by(lambda: 42)
    assert clock.now_ns() == 42


class TwoClocks:
    """A monotonic clock and one that counts suspended time.

    A reading takes 1 us; `torn` readings take much longer.
    """

    def __init__(self, suspended_ns: int = 0) -> None:
        self.ns, self.suspended_ns, self.torn = 0, suspended_ns, 0

    def monotonic(self) -> int:
        self.ns += 1_000
        return self.ns

    def boot(self) -> int:
        read_ns = self.monotonic() + self.suspended_ns
        if self.torn:
            self.torn -= 1
            self.ns += SEC // 5  # preempted right after the reading
        return read_ns


def test_suspended_time_is_difference_of_clocks() -> None:
    clocks = TwoClocks(7 * SEC)
    suspended = SuspendedTime(clocks.monotonic, clocks.boot)
    assert abs(suspended() - 7 * SEC) < 1_000_000
    clocks.suspended_ns += 3600 * SEC
    assert abs(suspended() - 3607 * SEC) < 1_000_000


def test_reading_torn_by_preemption_is_discarded() -> None:
    clocks = TwoClocks()
    suspended = SuspendedTime(clocks.monotonic, clocks.boot)
    before = suspended()
    clocks.torn = 1
    assert abs(suspended() - before) < 1_000_000, "read again"
    clocks.torn = 100
    assert suspended() == before, "every reading was torn"
    clocks.torn, clocks.suspended_ns = 0, 60 * SEC
    assert abs(suspended() - 60 * SEC) < 1_000_000


def test_suspended_time_never_decreases() -> None:
    clocks = TwoClocks(5 * SEC)
    suspended = SuspendedTime(clocks.monotonic, clocks.boot)
    first = suspended()
    clocks.suspended_ns = 0
    assert suspended() == first


def test_suspended_time_is_constant_while_awake() -> None:
    suspended = SuspendedTime()
    readings = [suspended() for _ in range(1000)]
    assert readings == sorted(readings)
    assert readings[-1] - readings[0] < 1_000_000
