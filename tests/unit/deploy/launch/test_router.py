"""The router as a separate process; it announces its machine without a launcher."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from sextant.deploy.launch import peer_handshake
from sextant.evaluation.provenance import version
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health, Presence
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, ZenohLink

ROOT = Path(__file__).parents[4]
PATIENCE_S = 60.0


@contextmanager
def router(*words: str, port: int | None = None) -> Iterator[tuple[subprocess.Popen[str], ZenohLink]]:
    """Run a router, at a free or a given port, with a link of its machine."""
    endpoint = f"tcp/127.0.0.1:{port or free_port()}"
    arguments = ("--listen", endpoint, *words, "--parent", str(os.getpid()))
    process = subprocess.Popen(
        [sys.executable, "-m", "sextant.deploy.launch.router", *arguments], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    with process.stderr:
        try:
            assert "listening on" in process.stderr.readline()
            with ZenohLink(Endpoints((endpoint,))) as link:
                yield process, link
        finally:
            process.terminate()
            process.wait(PATIENCE_S)


def test_router_publishes_presence_of_its_machine() -> None:
    with router("--role", "offboard", "--starts", "mapper,planner") as (_, link):
        heard = link.collect(topics.PRESENCE_OF["base"])
        found: list[bytes] = []
        until, never = time.monotonic() + PATIENCE_S, threading.Event()
        while not found:
            assert time.monotonic() < until
            found += heard()
            never.wait(0.02)
        word, _ = codec.decode(found[0], Presence)
        assert (word.role, word.services, word.version) == ("offboard", ("mapper", "planner"), version())


def test_router_reports_conflicting_presences_and_continues() -> None:
    """Report a robot of another version or an older start of the same role, and go on."""
    robot = peer_handshake.presence("hexapod-1", "onboard", "0.0.1", ["actuator", "stop"], 5.0, 1)
    robot = replace(robot, schemas=("another", *robot.schemas[1:]))
    older = peer_handshake.presence("another", "offboard", version(), ["mapper"], 1e6, 1)
    with router("--role", "offboard", "--starts", "mapper,planner") as (process, link):
        heard = link.collect(topics.HEALTH_OF["base"])
        doing, until, never = "", time.monotonic() + PATIENCE_S, threading.Event()
        while not ("hexapod-1 (onboard) runs Sextant 0.0.1" in doing and "already runs mapper" in doing):
            assert time.monotonic() < until, doing
            for topic, claim in ((topics.PRESENCE_OF["robot"], robot), (topics.PRESENCE_OF["base"], older)):
                link.send(topic, codec.encode(replace(claim, stamp_ns=time.monotonic_ns())))
            for frame in heard():
                doing = codec.decode(frame, Health)[0].status
            never.wait(0.05)
        assert f"with different messages for {robot.keys[0]}; install the same version on both" in doing
        assert process.poll() is None


def suspend_router(process: subprocess.Popen[str], port: int, for_s: float) -> None:
    """Stop a router for some time, in which a caller receives nothing."""
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED)
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as caller:
        caller.settimeout(for_s)
        with pytest.raises(TimeoutError):
            caller.recv(1)
    process.send_signal(signal.SIGCONT)


def test_briefly_suspended_router_continues_and_ends_on_sigterm() -> None:
    port = free_port()
    with router(port=port) as (process, _):
        suspend_router(process, port, 0.25)
        with ZenohLink(Endpoints((f"tcp/127.0.0.1:{port}",))):
            assert process.poll() is None, "it was not told to end"
        process.terminate()
        assert process.wait(PATIENCE_S) == 0


def test_router_suspended_beyond_link_timeout_exits_for_restart() -> None:
    port = free_port()
    with router(port=port) as (process, _):
        suspend_router(process, port, 1.5)
        assert process.wait(PATIENCE_S) == 75
        assert process.stderr is not None
        assert "router: suspended for 1." in process.stderr.read()
