"""Watchdog pulses from this process and from another, on a test clock."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy.launch.watchdog_listener import WatchdogListener, unwatched
from sextant.shared.runtime.watchdog import Watchdog

ME = os.getpid()
SEND = "import socket; socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(b'WATCHDOG=1', {!r})"


@pytest.fixture
def listener() -> Iterator[WatchdogListener]:
    made = WatchdogListener(0.0)
    yield made
    made.close()


def beat(listener: WatchdogListener, at_s: float) -> None:
    with Watchdog(listener.environment(10.0)) as watchdog:
        watchdog.beat(round(at_s * 1e9))


def test_silence_is_counted_from_first_pulse_to_next(listener: WatchdogListener) -> None:
    listener.watch(ME)
    listener.look(0.3)
    assert listener.silent_s(ME) == -inf, "what starts is not late"
    beat(listener, 0.4)
    listener.look(0.5)
    assert listener.silent_s(ME) == 0.0
    for k in range(1, 11):
        listener.look(0.5 + 0.1 * k)
        assert listener.silent_s(ME) == pytest.approx(0.1 * k)
    beat(listener, 1.6)
    listener.look(1.7)
    assert listener.silent_s(ME) == 0.0
    listener.forget(ME)
    assert listener.silent_s(ME) == -inf


@given(away_s=st.lists(st.floats(0.0, 1e4), min_size=1, max_size=3))
def test_listener_absence_is_not_counted_as_silence(away_s: list[float]) -> None:
    listener, now = WatchdogListener(0.0), 0.0
    listener.watch(ME)
    beat(listener, now)
    listener.look(now)
    for away in away_s:
        now += away
        listener.look(now)
    assert listener.silent_s(ME) <= 0.5 * len(away_s)
    assert listener.silent_s(ME) <= now
    listener.close()


def test_pulse_counts_only_for_sending_process(listener: WatchdogListener) -> None:
    """Count a pulse for its sending process only.

    The socket's name is no secret. Pulses of an unknown process do not count.
    """
    name = "\0" + listener.environment(10.0)["NOTIFY_SOCKET"][1:]
    listener.watch(ME)
    subprocess.run([sys.executable, "-c", SEND.format(name)], check=True)
    listener.look(0.1)
    assert listener.silent_s(ME) == -inf
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as mine:
        mine.sendto(b"", name)
    listener.look(0.2)
    assert listener.silent_s(ME) == 0.0


def test_two_listeners_are_independent(listener: WatchdogListener) -> None:
    other = WatchdogListener(0.0)
    listener.watch(ME)
    other.watch(ME)
    beat(other, 0.0)
    listener.look(0.1)
    other.look(0.1)
    assert (listener.silent_s(ME), other.silent_s(ME)) == (-inf, 0.0)
    other.close()


def test_child_environment_drops_parent_watchdog(listener: WatchdogListener) -> None:
    watched = {"PATH": "/bin", "WATCHDOG_PID": "1", **listener.environment(1.5)}
    assert watched["WATCHDOG_USEC"] == "1500000"
    assert unwatched(watched) == {"PATH": "/bin"}
