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
def pulses() -> Iterator[WatchdogListener]:
    made = WatchdogListener(0.0)
    yield made
    made.close()


def beat(pulses: WatchdogListener, at_s: float) -> None:
    with Watchdog(pulses.environment(10.0)) as watchdog:
        watchdog.beat(round(at_s * 1e9))


def test_silence_counts_from_the_first_sign_and_ends_with_the_next(pulses: WatchdogListener) -> None:
    pulses.watch(ME)
    pulses.look(0.3)
    assert pulses.silent_s(ME) == -inf, "what starts is not late"
    beat(pulses, 0.4)
    pulses.look(0.5)
    assert pulses.silent_s(ME) == 0.0
    for k in range(1, 11):
        pulses.look(0.5 + 0.1 * k)
        assert pulses.silent_s(ME) == pytest.approx(0.1 * k)
    beat(pulses, 1.6)
    pulses.look(1.7)
    assert pulses.silent_s(ME) == 0.0
    pulses.forget(ME)
    assert pulses.silent_s(ME) == -inf


@given(away_s=st.lists(st.floats(0.0, 1e4), min_size=1, max_size=3))
def test_who_watches_again_after_an_absence_blames_nobody_for_it(away_s: list[float]) -> None:
    pulses, now = WatchdogListener(0.0), 0.0
    pulses.watch(ME)
    beat(pulses, now)
    pulses.look(now)
    for away in away_s:
        now += away
        pulses.look(now)
    assert pulses.silent_s(ME) <= 0.5 * len(away_s)
    assert pulses.silent_s(ME) <= now
    pulses.close()


def test_nobody_speaks_for_another(pulses: WatchdogListener) -> None:
    """Count a pulse for its sending process only.

    The socket's name is no secret. Pulses of an unknown process do not count.
    """
    name = "\0" + pulses.environment(10.0)["NOTIFY_SOCKET"][1:]
    pulses.watch(ME)
    subprocess.run([sys.executable, "-c", SEND.format(name)], check=True)
    pulses.look(0.1)
    assert pulses.silent_s(ME) == -inf
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as mine:
        mine.sendto(b"", name)
    pulses.look(0.2)
    assert pulses.silent_s(ME) == 0.0


def test_two_watchers_are_two(pulses: WatchdogListener) -> None:
    other = WatchdogListener(0.0)
    pulses.watch(ME)
    other.watch(ME)
    beat(other, 0.0)
    pulses.look(0.1)
    other.look(0.1)
    assert (pulses.silent_s(ME), other.silent_s(ME)) == (-inf, 0.0)
    other.close()


def test_a_process_does_not_take_its_parent_s_watcher_for_its_own(pulses: WatchdogListener) -> None:
    watched = {"PATH": "/bin", "WATCHDOG_PID": "1", **pulses.environment(1.5)}
    assert watched["WATCHDOG_USEC"] == "1500000"
    assert unwatched(watched) == {"PATH": "/bin"}
