"""Start-up time of the actuator on a standing robot.

Its process is started repeatedly on emulated servos with torque on. Events are measured on the servo bus. The servos are
emulated in this process, on a network port.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.peers import kept
from sextant.deploy.launch.launcher import Launcher, host_router
from sextant.deploy.launch.process_table import TABLE, Choices, commands
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Mode
from sextant.shared.wire.transport import Endpoints, TransportError, ZenohLink

WITHIN_MS = 1000.0  # limit for the actuator
_PATIENCE_NS = 30_000_000_000  # [ns] timeout on a busy machine
_STEP_S = 0.01
_GOALS = dxl.GOAL_POSITION.address


class Watched(BenchEmulator):
    """Emulated servos that record the times of the first request and the first goals."""

    def __init__(self, profile: RobotProfile) -> None:
        """Connect all servos, with torque on and the legs bent as in standing.

        A previous walk ends in this state.
        """
        super().__init__(profile, np.random.default_rng(3))
        self._ids = list(profile.servo_names)
        for leg, pose in enumerate(body_inverse(profile, profile.rest_feet())):
            self.bend(leg, pose)
        there = [(i, self._value(self._with_id(i)[0], dxl.PRESENT_POSITION).to_bytes(2, "little")) for i in self._ids]
        self.look()
        self.receive(dxl.sync_write(_GOALS, dxl.GOAL_POSITION.size, there), time.monotonic_ns())
        on = [(i, b"\x01") for i in self._ids]
        self.receive(dxl.sync_write(dxl.TORQUE_ENABLE.address, dxl.TORQUE_ENABLE.size, on), time.monotonic_ns())

    def look(self) -> None:
        """Prepare for the next host."""
        self.asked_ns = self.told_ns = -1
        self.goals: dict[int, int] = {}  # first goals [ticks] by ID
        self._packets = dxl.PacketParser()

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Receive bytes from the host, and record their content."""
        for packet in self._packets.feed(data):
            self.asked_ns = now_ns if self.asked_ns < 0 else self.asked_ns
            if self.told_ns < 0 and packet.code == dxl.Instruction.SYNC_WRITE and packet.parameters[0] == _GOALS:
                self.told_ns = now_ns
                self.goals = _goals_in(packet.parameters)
        return super().receive(data, now_ns)

    @property
    def standing(self) -> dict[int, int]:
        """Return the goals [ticks] in the servos, by ID."""
        return {i: self._value(self._with_id(i)[0], dxl.GOAL_POSITION) for i in self._ids}


@dataclass(frozen=True, slots=True)
class Start:
    """One start of the process; all times [ms] are from the request to start."""

    asked_ms: float  # until the first request to a servo: includes Python, libraries, profile and router
    told_ms: float  # until the first goals on the bus
    heard_ms: float  # until its first published state
    mode: str  # in that state
    reason: str  # in that state
    moved_deg: float  # maximum difference between those goals and the previous ones in the servos


def measure(rounds: int, say: Callable[[str], None]) -> list[Start]:
    """Start the actuator's process repeatedly.

    Args:
        rounds: Number of starts.
        say: Called with the progress.

    Raises:
        TransportError: The actuator did not start.
    """
    profile = load_profile("phantomx_mk2")
    watched = Watched(profile)
    found = []
    with TcpBusServer(watched) as server, host_router() as endpoints:
        Latch.of_port(server.url).open()  # left by another robot on the same port
        for k in range(rounds):
            found.append(_start(watched, server, endpoints))
            say(f"start {k + 1} of {rounds}: goals after {found[-1].told_ms:.0f} ms")
    return found


def _start(watched: Watched, server: TcpBusServer, endpoints: Endpoints) -> Start:
    heard: list[tuple[int, ActuatorState]] = []
    spoken = threading.Event()

    def hear(topic: AnyTopic, frame: bytes) -> None:
        heard.append((time.monotonic_ns(), codec.decode(frame, ActuatorState, topic.max_bytes)[0]))
        spoken.set()

    with server.lock:
        watched.look()
        before = watched.standing
    rows = [row for row in TABLE if row.name == "actuator"]
    command = commands(rows, Choices(), endpoints, {"actuator": (f"port={server.url}",)})
    with ZenohLink(endpoints) as link:
        link.subscribe(topics.ACTUATOR_STATE, hear)
        began = time.monotonic_ns()
        with Launcher(command) as launcher:
            while not spoken.wait(_STEP_S):
                if time.monotonic_ns() - began > _PATIENCE_NS:
                    said = "; ".join(map(str, launcher.poll())) or f"no message within {_PATIENCE_NS * 1e-9:g} s"
                    raise TransportError(f"the actuator did not start: {said}; `sextant doctor` checks what it needs")
                with server.lock:  # servos behind their schedule would reply late
                    watched.receive(b"", time.monotonic_ns())
    asked, told, word = (1e-6 * (at - began) for at in (watched.asked_ns, watched.told_ns, heard[0][0]))
    moved = max(abs(watched.goals[i] - ticks) for i, ticks in before.items())
    state = heard[0][1]
    return Start(asked, told, word, state.mode, state.reason, math.degrees(moved * dxl.TICK_RAD))


def _goals_in(parameters: bytes) -> dict[int, int]:
    """Return the goals [ticks] by ID of a sync write that begins with them."""
    size = parameters[1]
    rows = (parameters[k : k + 1 + size] for k in range(2, len(parameters), 1 + size))
    return {row[0]: int.from_bytes(row[1:3], "little") for row in rows}


def in_words(found: Sequence[Start]) -> str:
    """Return the results as Markdown."""
    lines = ["| from the start of the process until its | p50, ms | max, ms |", "|---|---|---|"]
    for words, ms in (
        ("first request to a servo", [one.asked_ms for one in found]),
        ("first goals on the wire", [one.told_ms for one in found]),
        ("first published message", [one.heard_ms for one in found]),
    ):
        lines.append(f"| {words} | {np.median(ms):.0f} | {max(ms):.0f} |")
    holding, late = (sum(one.mode == Mode.HOLD for one in found), sum(one.told_ms > WITHIN_MS for one in found))
    moved = max(one.moved_deg for one in found)
    lines += [
        "",
        f"{len(found)} starts: {holding} held by their first message, {late} sent their first goals later than "
        f"{WITHIN_MS:g} ms. The first goals were at most {moved:.1f} deg off the goals held in the servos.",
    ]
    lines += [f"Not holding: {one.mode}, {one.reason}." for one in found if one.mode != Mode.HOLD]
    return "\n".join(lines)


def to_json(found: Sequence[Start]) -> str:
    """Return the results as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[Start]:
    """Read results written by `to_json`."""
    return kept.rows_from_json(text, Start)
