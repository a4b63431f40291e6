"""Servo bus through Sextant's driver and through dynamixel-sdk.

The times of a request and of a cycle are measured, with their processor times. Both use one pyserial port to the same emulated
servos, which run in a separate process, and take turns. The emulator replies with the timing of a bus of 1 Mbps behind an
adapter with a latency timer of 1 ms.
"""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.peers import kept
from benchmarks.peers.timing import Spread, installed
from sextant.services.actuator.servo_bus.bus_driver import REPLY_TIMEOUT_NS, ServoBus, open_port
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl

ABSENT = 200  # an unused ID
READS = 6  # reads in a cycle, as many as the actuator has time for
_QUESTIONS = {"read 8 bytes": 1, "cycle": READS, "no answer": 0}  # requests with a reply, by job
JOBS = tuple(_QUESTIONS)
_ROUNDS_SILENT = 20  # fewer repetitions, because a servo without a reply takes a timeout
_STATE = dxl.PRESENT_POSITION.address, dxl.PRESENT_STATE.size


@dataclass(frozen=True, slots=True)
class Row:
    """Results of one library for one job."""

    job: str
    method: str
    wall_ms: Spread
    core_ms: Spread  # processor time of the requesting thread
    lost: int  # requests to existing servos that were given up
    asked: int  # requests to existing servos


@dataclass(frozen=True, slots=True)
class Comparison:
    """Results of both libraries."""

    rows: tuple[Row, ...]
    missing: tuple[str, ...]  # which library is missing, as text


class Ours:
    """The actuator's driver."""

    def __init__(self, port: Any, ids: Sequence[int]):
        """Use an open port."""
        self._bus, self._ids, self._turn = ServoBus(port, ids, time.monotonic_ns), ids, 0
        self._port = port

    def begin(self) -> None:
        """Configure the port for this library."""
        self._port.timeout = REPLY_TIMEOUT_NS * 1e-9

    def read(self, servo_id: int) -> bool:
        """Read position, speed, load, voltage and temperature of a servo.

        Return whether a reply came.
        """
        return self._bus.read_bytes(servo_id, *_STATE) is not None

    def write(self, goals: Sequence[int]) -> None:
        """Write the goals of all servos in one packet."""
        self._bus.sync_write_goals(goals, 100)


class Sdk:
    """dynamixel-sdk of ROBOTIS, on a port that may be a network port."""

    def __init__(self, port: Any, ids: Sequence[int]):
        """Use an open port.

        Raises:
            ModuleNotFoundError: The library is not installed.
        """
        from dynamixel_sdk import GroupSyncWrite, PacketHandler, PortHandler

        self._port, self._ids = PortHandler(port.port), ids
        self._port.ser, self._port.is_open = port, True
        self._port.tx_time_per_byte = 1e3 * dxl.BITS_PER_BYTE / self._port.baudrate  # [ms], as set by its openPort
        self._packets = PacketHandler(1.0)
        size = dxl.GOAL_POSITION.size + dxl.MOVING_SPEED.size
        self._group = GroupSyncWrite(self._port, self._packets, dxl.GOAL_POSITION.address, size)

    def begin(self) -> None:
        """Configure the port for this library: a read never waits."""
        self._port.ser.timeout = 0

    def read(self, servo_id: int) -> bool:
        """Read as in `Ours.read`."""
        _, result, _ = self._packets.readTxRx(self._port, servo_id, *_STATE)
        return bool(result == 0)

    def write(self, goals: Sequence[int]) -> None:
        """Write as in `Ours.write`."""
        self._group.clearParam()
        for servo_id, goal in zip(self._ids, goals, strict=True):
            self._group.addParam(servo_id, [*goal.to_bytes(2, "little"), 100, 0])
        self._group.txPacket()


def measure(rounds: int, say: Callable[[str], None]) -> Comparison:
    """Measure both libraries at each job, in turns.

    Args:
        rounds: Repetitions of each job.
        say: Called with the progress.
    """
    ids = list(load_profile("phantomx_mk2").servo_names)
    with _emulated() as url:
        port = open_port(url)
        methods, missing = installed({"sextant": Ours, "dynamixel-sdk": Sdk}, port, ids)
        rows: list[Row] = []
        for job in JOBS:
            say(f"{job}: {', '.join(methods)}")
            rows += _race(job, methods, ids, _ROUNDS_SILENT if job == "no answer" else rounds)
        port.close()
    return Comparison(tuple(rows), tuple(missing))


def _race(job: str, methods: Mapping[str, Any], ids: Sequence[int], rounds: int) -> list[Row]:
    wall: dict[str, list[float]] = {name: [] for name in methods}
    core: dict[str, list[float]] = {name: [] for name in methods}
    lost, asked = dict.fromkeys(methods, 0), rounds * _QUESTIONS[job]
    names = list(methods)
    for k in range(rounds):
        for name in names if k % 2 else names[::-1]:
            methods[name].begin()
            began, began_core = time.perf_counter_ns(), time.thread_time_ns()
            lost[name] += _do(job, methods[name], ids, k)
            wall[name].append(1e-6 * (time.perf_counter_ns() - began))
            core[name].append(1e-6 * (time.thread_time_ns() - began_core))
    return [
        Row(job, name, Spread.of(np.array(wall[name])), Spread.of(np.array(core[name])), lost[name], asked) for name in names
    ]


def _do(job: str, method: Any, ids: Sequence[int], k: int) -> int:
    """Do a job for the kth time; return the number of missing replies."""
    if job == "no answer":
        method.read(ABSENT)
        return 0
    if job == "cycle":
        method.write([dxl.TICK_CENTRE + k % 2] * len(ids))
    asked = [ids[(READS * k + i) % len(ids)] for i in range(_QUESTIONS[job])]
    return sum(not method.read(servo_id) for servo_id in asked)


@contextmanager
def _emulated() -> Iterator[str]:
    """Yield the address of emulated servos in another process."""
    command = [sys.executable, "-m", "sextant.deploy.cli", "servos", "emulate"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("pipes to the emulator expected, found none")
        yield process.stdout.readline().split(";")[0].removeprefix("servos on ")
        process.stdin.write("quit\n")
        process.stdin.close()
        process.wait(10)


def in_words(found: Comparison) -> str:
    """Return the results as Markdown."""
    lines = [
        "| job | library | time ms, median (10th to 90th percentile) | of the core ms | answers given up |",
        "|---|---|---|---|---|",
    ]
    for row in found.rows:
        wall, core = (f"{s.median:.2f} ({s.p10:.2f} to {s.p90:.2f})" for s in (row.wall_ms, row.core_ms))
        lost = f"{row.lost} of {row.asked}" if row.asked else ""
        lines.append(f"| {row.job} | {row.method} | {wall} | {core} | {lost} |")
    return "\n".join([*lines, *(f"\nNot measured: {words}" for words in found.missing)])


def to_json(found: Comparison) -> str:
    """Return the results as JSON."""
    return kept.to_json(found)


def from_json(text: str) -> Comparison:
    """Read results written by `to_json`."""
    return kept.from_json(text, Comparison)
