"""Connection times of authorized clients while strangers open connections.

The clients are a base station after each outage of its radio, and an actuator.

A robot's router runs in a separate process. The router of a base station is connected to it through a relay that emulates the
radio. Strangers (`benchmarks.access.stranger_load`) connect to the robot's endpoint directly, half of them from the base
station's address. Each outage lasts longer than a link's lease, so the base station needs a new connection. It is back when a
message has arrived in both directions. Then a simulated robot's actuator is killed, with and without silent connections at both
endpoints of the router. The next actuator is back when its state is received.
"""

import json
import math
import os
import random
import selectors
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from benchmarks.access.guarded_robot import GuardedRobot
from benchmarks.access.stranger_load import HERE
from benchmarks.net_testbed.testbed import OneMachine
from benchmarks.peers.timing import machine
from sextant.deploy.launch.launcher import Launcher
from sextant.deploy.launch.process_table import router_command
from sextant.deploy.security.authority import Authority
from sextant.deploy.security.router_security import Gate
from sextant.shared.runtime.process_priority import go_first
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.scenario import Link
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, ROLES
from sextant.shared.wire.messages import Health, Mode
from sextant.shared.wire.ports import free_port, port_taken
from sextant.shared.wire.transport import Endpoints, ZenohLink

BACK_S = 2.0  # [s] limit for the base station
RADIO = Link(20.0, 20.0, 0.0)
_CUT_S = (1.2, 2.5)  # [s] longer than a link's lease
_BETWEEN_S = (0.2, 1.0)
_PATIENCE_S = 30.0
_PERIOD_S = 0.01  # [s] between two messages in each direction
_PROBE_S = 0.5  # [s] between two timed handshakes
_NAMESPACE = "strangers"


@dataclass(frozen=True, slots=True)
class Found:
    """Results; times [s]."""

    rate_hz: float  # requested rate of the strangers
    strangers: dict[str, int]  # connected during the outages and reconnections, by kind
    strangers_s: float  # duration of their connections
    back_s: tuple[float, ...]  # after each outage
    handshake_s: tuple[float, ...]  # of authorized clients meanwhile, without the radio
    refused: str  # refusals of the robot's router, from its health
    shared: str  # why the processes had no real-time priority, or empty
    silent: int  # silent connections at each endpoint
    alone_s: tuple[float, ...]  # from killing an actuator to the next one's state, without silent connections
    joined_s: tuple[float, ...]  # the same with them

    @property
    def late(self) -> int:
        """Number of outages after which the base station was not back in time."""
        return sum(seconds > BACK_S for seconds in self.back_s)


def measure(cuts: int, rate_hz: float, restarts: int, silent: int, seed: int, say: Callable[[str], object]) -> Found:
    """Measure `cuts` outages among strangers, then `restarts` of an actuator.

    The actuator restarts with and without silent connections.

    Raises:
        TimeoutError: Something did not come back at all.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _make_keys(folder)
        with _real_time() as shared:
            back, handshakes, load, refused = _cuts(folder, cuts, rate_hz, seed, say)
        alone, joined = _restarts(folder / "robot keys", restarts, silent, say)
    return Found(
        rate_hz=rate_hz,
        strangers={str(kind): int(number) for kind, number in load["count"].items()},
        strangers_s=load["seconds"],
        back_s=tuple(back),
        handshake_s=tuple(handshakes),
        refused=refused,
        shared=shared,
        silent=silent,
        alone_s=tuple(alone),
        joined_s=tuple(joined),
    )


@contextmanager
def _real_time() -> Iterator[str]:
    """Give this thread and its children real-time priority, as on separate machines.

    Yield why this is not possible, or an empty string.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    refused = go_first()
    try:
        yield refused
    finally:
        os.sched_setscheduler(0, policy, parameters)


def _make_keys(folder: Path) -> None:
    authority = Authority(days=1)
    for role in ROLES:
        authority.issue(folder / role.name, role.name)
    Authority(days=1).issue(folder / "foreign", "console")


def _cuts(
    folder: Path, cuts: int, rate_hz: float, seed: int, say: Callable[[str], object]
) -> tuple[list[float], list[float], dict[str, Any], str]:
    """Measure the outages.

    Return the base station's times, the times of handshakes, the strangers' numbers, and the refusals.
    """
    chooser, back = random.Random(seed), list[float]()
    secure, plain, far = free_port(), f"tcp/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    robot = Gate((plain, f"tls/127.0.0.1:{secure}"), _NAMESPACE, folder / "robot")
    with ExitStack() as stack:
        _start(stack, robot)
        radio = stack.enter_context(OneMachine(RADIO, seed, behind=(secure,)))
        _start(stack, Gate((far,), _NAMESPACE, folder / "base", upstream=(f"tls/{radio.seen(secure)}",)))
        near_link, far_link = (stack.enter_context(ZenohLink(Endpoints((at,), namespace=_NAMESPACE))) for at in (plain, far))
        meeting = stack.enter_context(_Meeting(near_link, far_link))
        words = list[str]()
        near_link.subscribe(topics.HEALTH_OF["robot"], lambda _, frame: words.append(_refusals(frame)))
        meeting.after(time.monotonic())
        strangers = stack.enter_context(_strangers(secure, rate_hz, folder / "foreign"))
        probes = stack.enter_context(_Probes(secure, folder / "viewer"))
        for number in range(1, cuts + 1):
            time.sleep(chooser.uniform(*_BETWEEN_S))
            radio.cut()
            time.sleep(chooser.uniform(*_CUT_S))
            mended_s = radio.mend().at_ns * 1e-9
            back.append(meeting.after(mended_s) - mended_s)
            say(f"cut {number} of {cuts}: back after {back[-1]:.2f} s")
        assert strangers.stdin is not None
        strangers.stdin.close()
        assert strangers.stdout is not None
        load = json.loads(strangers.stdout.readline())
        return back, probes.took_s, load, words[-1] if words else ""


def _start(stack: ExitStack, gate: Gate) -> None:
    """Start a router in a separate process.

    Raises:
        TimeoutError: It does not start.
    """
    launcher = stack.enter_context(Launcher((router_command(gate.own, gate.words()),)))
    until, port = time.monotonic() + _PATIENCE_S, int(gate.own.rpartition(":")[2])
    while not port_taken(port):
        ended = [str(one) for one in launcher.wait(0.02)]
        if ended or time.monotonic() > until:
            raise TimeoutError("; ".join(ended) or f"the router did not start within {_PATIENCE_S:.0f} s")


class _Meeting:
    """Sends messages in both directions all the time; a context manager."""

    def __init__(self, robot: ZenohLink, base: ZenohLink):
        self._ways: tuple[tuple[ZenohLink, AnyTopic], ...] = ((robot, topics.ACTUATOR_STATE), (base, topics.MODE))
        self._sent_s = {topic.key: 0.0 for _, topic in self._ways}  # [s] send time of the newest received message
        self._came_s = dict(self._sent_s)
        self._news = threading.Condition()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send, name="send both ways", daemon=True)
        base.subscribe(topics.ACTUATOR_STATE, self._hear)
        robot.subscribe(topics.MODE, self._hear)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()

    def after(self, since_s: float) -> float:
        """Wait until a message sent after a time has arrived in each direction.

        Return the arrival time [s] of the later one.

        Raises:
            TimeoutError: It did not arrive.
        """
        first: dict[str, float] = {}
        until = time.monotonic() + _PATIENCE_S
        with self._news:
            while len(first) < len(self._ways):
                first |= {key: self._came_s[key] for key, sent in self._sent_s.items() if sent > since_s and key not in first}
                if time.monotonic() > until:
                    missing = ", ".join(key for key in self._sent_s if key not in first)
                    raise TimeoutError(f"the base is not back {_PATIENCE_S:.0f} s after the radio is: no message on {missing}")
                self._news.wait(_PERIOD_S)
        return max(first.values())

    def _hear(self, topic: AnyTopic, frame: bytes) -> None:
        with self._news:
            self._sent_s[topic.key], self._came_s[topic.key] = float(frame), time.monotonic()
            self._news.notify_all()

    def _send(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            for link, topic in self._ways:
                link.send(topic, str(time.monotonic()).encode())


class _Probes:
    """Times the handshakes of an authorized client repeatedly; a context manager."""

    def __init__(self, port: int, folder: Path):
        self.took_s: list[float] = []  # of each handshake, from the connection to its end; infinite for a failed one
        self._port = port
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._context.load_verify_locations(folder / AUTHORITY)
        self._context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._probe, name="probe", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()

    def _probe(self) -> None:
        while not self._ended.wait(_PROBE_S):
            began_s = time.monotonic()
            try:
                plain = socket.create_connection((HERE, self._port), _PATIENCE_S)
                with plain, self._context.wrap_socket(plain, server_hostname=HERE):
                    self.took_s.append(time.monotonic() - began_s)
            except OSError:
                self.took_s.append(math.inf)


@contextmanager
def _strangers(port: int, rate_hz: float, folder: Path) -> Iterator["subprocess.Popen[str]"]:
    """Run strangers in a separate process, until its standard input is closed."""
    words = ("-m", "benchmarks.access.stranger_load", "--port", str(port), "--rate", str(rate_hz), "--keys", str(folder))
    with subprocess.Popen([sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


class Silent:
    """Keeps a number of silent connections open, and replaces dropped ones.

    This is a context manager.
    """

    def __init__(self, ports: Sequence[int], count: int):
        self._ports, self._count = ports, count
        self._open: dict[socket.socket, int] = {}
        self._selector = selectors.DefaultSelector()
        self._ended, self._full = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._keep, name="silent", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self._full.wait()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()
        for connection in self._open:
            connection.close()
        self._selector.close()

    def _keep(self) -> None:
        while not self._ended.is_set():
            for port in self._ports:
                for _ in range(self._count - sum(one == port for one in self._open.values())):
                    self._open_one(port)
            self._full.set()
            for key, _ in self._selector.select(0.05):
                dropped = key.fileobj
                assert isinstance(dropped, socket.socket)
                self._selector.unregister(dropped)
                del self._open[dropped]
                dropped.close()

    def _open_one(self, port: int) -> None:
        try:
            connection = socket.create_connection((HERE, port), _PATIENCE_S)
        except OSError:  # the backlog is full
            return
        self._open[connection] = port
        self._selector.register(connection, selectors.EVENT_READ)


def _restarts(folder: Path, restarts: int, silent: int, say: Callable[[str], object]) -> tuple[list[float], list[float]]:
    """Return the times [s] of killed actuators until their successors' first states.

    The first list is without silent connections, the second with them.
    """
    alone, joined = list[float](), list[float]()
    if not restarts:
        return alone, joined
    with GuardedRobot(folder) as robot:
        robot.until(lambda state: state.mode is Mode.WALK, "a walk")
        for number in range(1, restarts + 1):
            alone.append(robot.restart_actuator())
            with Silent(robot.ports, silent):
                joined.append(robot.restart_actuator())
            say(f"restart {number} of {restarts}: {alone[-1]:.2f} s alone, {joined[-1]:.2f} s with silent connections")
    return alone, joined


def in_words(found: Found) -> str:
    """Return the results as Markdown."""
    rows = [
        _row(f"the radio's return, {found.rate_hz:.0f} strangers a second: the base is back", found.back_s, f"{BACK_S:.1f}"),
        _row("connecting without the radio meanwhile: handshake done", found.handshake_s, ""),
        _row("the end of an actuator: state of the next", found.alone_s, ""),
        _row(f"the same with {found.silent} silent connections at each endpoint", found.joined_s, ""),
    ]
    kinds = ", ".join(f"{number} {kind}" for kind, number in found.strangers.items())
    rate = sum(found.strangers.values()) / found.strangers_s if found.strangers_s else 0.0
    return "\n".join(
        [
            "| time from | n | p50, s | p90, s | worst, s | wanted, s |",
            "|---|---|---|---|---|---|",
            *filter(None, rows),
            "",
            f"Strangers: {kinds}; {rate:.0f} a second for {found.strangers_s:.0f} s.",
            f"Robot, base and strangers are processes of one machine{_priority(found)}.",
            *([f"The router: {found.refused}."] if found.refused else []),
        ]
    )


def _priority(found: Found) -> str:
    return f" without real-time priority ({found.shared})" if found.shared else ", of real-time priority while the radio is cut"


def _row(what: str, seconds: Sequence[float], wanted: str) -> str:
    if not seconds:
        return ""
    p50, p90 = np.percentile(seconds, [50, 90])
    return f"| {what} | {len(seconds)} | {p50:.3f} | {p90:.3f} | {max(seconds):.3f} | {wanted} |"


def to_json(found: Found) -> str:
    """Return the results as JSON."""
    return json.dumps({"machine": machine(), **asdict(found)}, indent=1)


def from_json(text: str) -> Found:
    """Read results written by `to_json`."""
    table = json.loads(text)
    return Found(**{one.name: _tuple(table[one.name]) for one in fields(Found)})


def _tuple(value: object) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _refusals(frame: bytes) -> str:
    return codec.decode(frame, Health)[0].status.partition("; ")[2]
