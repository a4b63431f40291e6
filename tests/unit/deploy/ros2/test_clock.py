"""Conversion of stamps to times of day, by the message with the least delay."""

from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy.ros2.clock import TimeOfDay

MS, S = 1_000_000, 1_000_000_000
OFFSET = 1_700_000_000 * S


@given(st.lists(st.integers(1, 400), min_size=1, max_size=200))
def test_clock_error_is_minimum_delay_within_window(delays_ms: list[int]) -> None:
    clock = TimeOfDay()
    for n, delay in enumerate(delays_ms):
        stamp = 7 * S + n * 20 * MS
        clock.learn(stamp, OFFSET + stamp + delay * MS)
        error = clock.of(stamp) - OFFSET - stamp
        assert error <= delay * MS
        if n < 200:  # the window has not passed
            assert error == min(delays_ms[: n + 1]) * MS


def test_clock_drift_is_tracked() -> None:
    clock = TimeOfDay()
    for n in range(3000):  # a minute in which the time of day gains 30 ms
        stamp = n * 20 * MS
        clock.learn(stamp, OFFSET + stamp + MS + n * 10_000)
    assert clock.of(stamp) - (OFFSET + stamp + MS + 30 * MS) > -6 * MS


def test_clock_reset_is_followed_immediately() -> None:
    clock = TimeOfDay()
    clock.learn(500 * S, OFFSET + 500 * S)
    clock.learn(1 * S, OFFSET + 501 * S)  # the robot's clock was reset
    assert clock.of(1 * S) == OFFSET + 501 * S
    clock.learn(2 * S, 3 * S)  # the time of day was set back
    assert clock.of(2 * S) == 3 * S
