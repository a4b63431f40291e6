"""Computing time of the actuator's cycle while the robot stands and while it walks.

The real actuator walks in lockstep. The time of its emulated servo bus is left out; a real bus makes it wait instead, and that
wait is counted from the emulated delays of the bus.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.peers import kept
from benchmarks.peers.timing import one_core
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lateness import Limited
from sextant.shared.runtime.service import Every, Inbox, Service, Stages
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.wire.messages import ActuatorState, Message, Mode, Tick

_LOOK_NS = 250_000_000  # [ns] simulated time between two looks whether the walk is over
SLOWER = {  # how many times slower published n-body benchmarks in pure Python are than on the server of the documentation
    "Raspberry Pi 5, Orin Nano": (2.0, 3.3),
    "Raspberry Pi 4, Jetson Nano": (4.5, 7.0),
}
_TIMED = {Mode.HOLD: "standing", Mode.WALK: "walking"}


@dataclass(frozen=True, slots=True)
class CycleTime:
    """Computing time of one kind of cycle."""

    kind: str  # what the robot does
    cycles: int
    p50_ms: float
    p99_ms: float
    mean_ms: float
    cores: float  # mean share of a core, at the rate of the cycle
    bus_ms: float  # median wait for the servo bus


class _TimedPort(MemoryPort):
    """Port that measures the computing time of the emulated bus."""

    spent_ns = 0  # of all ports: a run has one at a time
    newest: "_TimedPort"

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        _TimedPort.newest = self

    def write(self, data: bytes) -> int:
        began_ns = time.thread_time_ns()
        sent = super().write(data)
        _TimedPort.spent_ns += time.thread_time_ns() - began_ns
        return sent

    def read(self, size: int = 1) -> bytes:
        began_ns = time.thread_time_ns()
        data = super().read(size)
        _TimedPort.spent_ns += time.thread_time_ns() - began_ns
        return data


class TimedActuator:
    """Actuator whose cycles are timed, with the encoding of its messages."""

    def __init__(self, actuator: Service):
        """Wrap an actuator."""
        self._actuator = actuator
        self._mode = Mode.OFF
        self.name, self.subscribes, self.publishes = actuator.name, actuator.subscribes, actuator.publishes
        self.stages: Stages = actuator.stages
        self.max_age_s = actuator.max_age_s if isinstance(actuator, Limited) else {}
        self.times_ms: dict[str, list[float]] = {kind: [] for kind in _TIMED.values()}
        self.bus_ms: dict[str, list[float]] = {kind: [] for kind in _TIMED.values()}

    @property
    def trigger(self) -> Any:
        """Trigger of the actuator."""
        return self._actuator.trigger

    def status(self) -> str:
        """Return the status of the actuator."""
        return self._actuator.status()

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Run one cycle, and time it."""
        bus_ns, began_ns = _TimedPort.spent_ns, time.thread_time_ns()
        for message in self._actuator.step(tick, inbox):
            if isinstance(message, ActuatorState):
                self._mode = message.mode
            yield message
        took_ns = time.thread_time_ns() - began_ns - (_TimedPort.spent_ns - bus_ns)
        if self._mode in _TIMED:
            kind = _TIMED[self._mode]
            self.times_ms[kind].append(1e-6 * took_ns)
            self.bus_ms[kind].append(1e-6 * (_TimedPort.newest.now_ns() - tick.stamp_ns))


def measure(scenario: Scenario, seeds: Sequence[int], cycles: int) -> list[CycleTime]:
    """Walk over a course with each seed, and time at most `cycles` cycles of the walk.

    Raises:
        ConfigError: The course cannot be built.
        ValueError: The robot did not stand or did not walk.
    """
    walks: list[TimedActuator] = []

    def wrap(actuator: Service) -> Service:
        walks.append(TimedActuator(actuator))
        return walks[-1]

    rate_hz = 50.0
    with one_core():
        for seed in seeds:
            profile = load_profile(scenario.robot)
            run = LockstepRun(scenario, seed, profile, every_frame=False, around={"actuator": wrap}, port=_TimedPort)
            while not run.attendance.over() and run.now_ns() < 1e9 * scenario.time_limit_s:
                run.run(run.now_ns() + _LOOK_NS)
                if len(walks[-1].times_ms["walking"]) >= cycles:
                    break
            pace = walks[-1].trigger
            rate_hz = 1e9 / pace.period_ns if isinstance(pace, Every) else rate_hz
    return [_cycle_time(kind, walks, rate_hz) for kind in _TIMED.values()]


def _cycle_time(kind: str, walks: Sequence[TimedActuator], rate_hz: float) -> CycleTime:
    ms = np.concatenate([walk.times_ms[kind] for walk in walks])
    bus_ms = np.concatenate([walk.bus_ms[kind] for walk in walks])
    if not len(ms):
        raise ValueError(
            f"cycles of a robot that is {kind} expected, found none: the course is too short, or it was not walked"
        )
    p50, p99 = np.percentile(ms, [50.0, 99.0]).tolist()
    mean = float(ms.mean())
    return CycleTime(kind, len(ms), p50, p99, mean, 1e-3 * mean * rate_hz, float(np.median(bus_ms)))


def in_words(found: Sequence[CycleTime], period_ms: float = 20.0) -> str:
    """Return the times as Markdown, next to estimates for slower processors."""
    lines = [
        f"| of a cycle of {period_ms:g} ms | this computer | {' | '.join(SLOWER)} |",
        "|---" * (2 + len(SLOWER)) + "|",
        f"| speed of Python | 1 | {' | '.join(f'{low:g} to {high:g} times slower' for low, high in SLOWER.values())} |",
    ]
    for row in found:
        for what, ms in (("median", row.p50_ms), ("99th percentile", row.p99_ms)):
            lines.append(_row(f"computing, {row.kind}, {what}", ms, 0.0))
        lines.append(f"| waiting for the servo bus, {row.kind} | {' | '.join([f'{row.bus_ms:.1f} ms'] * (1 + len(SLOWER)))} |")
        lines.append(_row(f"together, {row.kind}, median", row.p50_ms, row.bus_ms))
    used = ", ".join(f"{row.cores:.3f} of a core {row.kind} (mean of {row.cycles} cycles)" for row in found)
    return "\n".join([*lines, "", f"A cycle takes {used}."])


def _row(what: str, computing_ms: float, waiting_ms: float) -> str:
    slower = (
        f"{low * computing_ms + waiting_ms:.1f} to {high * computing_ms + waiting_ms:.1f} ms" for low, high in SLOWER.values()
    )
    return f"| {what} | {computing_ms + waiting_ms:.2f} ms | {' | '.join(slower)} |"


def to_json(found: Sequence[CycleTime]) -> str:
    """Return the times as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[CycleTime]:
    """Read times written by `to_json`."""
    return kept.rows_from_json(text, CycleTime)
