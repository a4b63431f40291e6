"""Watchdog pulses by systemd's protocol, received on local sockets."""

import contextlib
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.runtime.watchdog import Watchdog

S = 1_000_000_000
LONG = "60000000"
Watch = Callable[..., Watchdog]


@pytest.fixture
def ear() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.setblocking(False)
        yield made


@pytest.fixture
def watch() -> Iterator[Watch]:
    """Yield a function that makes watchdogs; close them at the end."""
    with contextlib.ExitStack() as stack:
        yield lambda **environment: stack.enter_context(Watchdog(environment))


def heard(ear: socket.socket) -> list[bytes]:
    """Return the datagrams that have arrived, without waiting.

    A local datagram arrives as soon as it is sent.
    """
    found: list[bytes] = []
    while True:
        try:
            found.append(ear.recv(4096))
        except BlockingIOError:
            return found


def test_ready_is_sent_once_then_watchdog_pulses_periodically(ear: socket.socket, watch: Watch, tmp_path: Path) -> None:
    ear.bind(str(tmp_path / "notify"))
    watchdog = watch(NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC=LONG)
    assert heard(ear) == [], "it is the loop's to begin"
    watchdog.beat(7 * S)
    assert heard(ear) == [b"READY=1\nWATCHDOG=1"]
    said: list[bytes] = []
    for k in range(1, 101):  # four seconds in steps of 40 ms
        watchdog.beat(7 * S + k * S // 25)
        said += heard(ear)
    assert set(said) == {b"WATCHDOG=1"}
    assert 12 <= len(said) <= 16


@given(patience_ms=st.integers(1, 5000), looks_ms=st.integers(1, 50))
def test_pulses_arrive_well_within_timeout(patience_ms: int, looks_ms: int) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.setblocking(False)
        ear.bind("")  # a free abstract name
        name = ear.getsockname()[1:].decode()
        last_ms = 0
        with Watchdog({"NOTIFY_SOCKET": f"@{name}", "WATCHDOG_USEC": str(patience_ms * 1000)}) as watchdog:
            for now_ms in range(0, 2000, looks_ms):
                watchdog.beat(now_ms * 1_000_000)
                last_ms = now_ms if heard(ear) else last_ms
                assert now_ms - last_ms < min(250, patience_ms / 3) + looks_ms


def test_only_ready_is_sent_without_watchdog_timeout(ear: socket.socket, watch: Watch, tmp_path: Path) -> None:
    ear.bind(str(tmp_path / "notify"))
    another = {"WATCHDOG_USEC": LONG, "WATCHDOG_PID": str(os.getpid() + 1)}
    asked: dict[str, str]
    for asked in ({}, {"WATCHDOG_USEC": "0"}, another):
        watchdog = watch(NOTIFY_SOCKET=str(tmp_path / "notify"), **asked)
        for at in range(10):
            watchdog.beat(at * S)
        assert heard(ear) == [b"READY=1"]


@pytest.mark.parametrize("address", ["", "vsock:2:1234", "relative"])
def test_nothing_is_opened_without_notify_socket(address: str, watch: Watch) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    watchdog = watch(**({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": LONG} if address else {}))
    for at in range(10):
        watchdog.beat(at * S)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_late_listener_receives_ready_and_lost_listener_is_tolerated(watch: Watch, tmp_path: Path) -> None:
    path = tmp_path / "notify"
    watchdog = watch(NOTIFY_SOCKET=str(path), WATCHDOG_USEC=LONG)
    watchdog.beat(0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.setblocking(False)
        ear.bind(str(path))
        watchdog.beat(1 * S)
        watchdog.beat(2 * S)
        assert heard(ear) == [b"READY=1\nWATCHDOG=1", b"WATCHDOG=1"]
    watchdog.beat(3 * S)
    path.unlink()
    watchdog.beat(4 * S)


def test_hung_listener_does_not_block_service(ear: socket.socket, watch: Watch, tmp_path: Path) -> None:
    ear.bind(str(tmp_path / "notify"))
    watchdog = watch(NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC=LONG)
    for at in range(5000):  # more than any queue holds
        watchdog.beat(at * S)
    assert 0 < len(heard(ear)) < 5000
    watchdog.beat(6000 * S)
    assert heard(ear) == [b"WATCHDOG=1"], "it goes on once the mail is read"


@pytest.mark.parametrize("asked", ["soon", "-1", "1.5"])
def test_invalid_timeout_is_refused(asked: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"microseconds as a whole number expected, found '{asked}'"):
        Watchdog({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": asked})
