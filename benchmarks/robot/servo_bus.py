"""Robustness of the servo bus driver on a faulty bus.

The benchmark counts losses, rejections and accepted errors. Eighteen emulated servos swing as in a walk while their replies, or
the bytes in both directions, are corrupted. The driver reads and writes in cycles of 20 ms, in memory, in simulated time. Each
accepted reading is compared with the servo's measurement.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import kept
from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus.bus_driver import Lost, ServoBus, ServoReading
from sextant.services.actuator.servo_bus.reading_validation import Implausibility
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.dynamixel import PRESENT_STATE, Instruction
from sextant.shared.wire.messages import BrokenPart

_N = 18
_ACTUATOR = Settings()  # the number of servos read in a cycle follows from its time budget
_CYCLE_NS, _BUDGET_NS = round(1e9 / _ACTUATOR.rate_hz), round(1e6 * _ACTUATOR.read_budget_ms)
_FOREVER_S = 1e6  # maximum duration of a fault
_STEP_S = 0.8  # [s] period of a leg's swing
_SWING = 0.35  # [rad] amplitude of a joint
_LOAD_NM = 0.3  # [N m] amplitude: 95 % of the changes between two readings are below 0.25 of the stall torque, as in a walk
_REMEMBERED = 50  # cycles whose goals may still be in a servo that has missed all later ones
_GOALS_BROKEN = 0.00107  # share of bytes: at least one of the 98 with the goals is broken in 10 % of the cycles


def _answers(share: float, part: BrokenPart) -> BusFault:
    return BusFault("packets", "wrong", 0.0, _FOREVER_S, share=share, part=part)


CASES: dict[str, BusFault | None] = {
    "nothing": None,
    "1 % of the answers are lost": BusFault("packets", "silent", 0.0, _FOREVER_S, share=0.01),
    "10 % of the answers are lost": BusFault("packets", "silent", 0.0, _FOREVER_S, share=0.1),
    "10 % come 16 ms late": BusFault("packets", "slow", 0.0, _FOREVER_S, share=0.1),
    "noise comes in front of 10 %": BusFault("packets", "garbage", 0.0, _FOREVER_S, share=0.1),
    "1 % have two bits flipped": _answers(0.01, "two bits"),
    "10 % have two bits flipped": _answers(0.1, "two bits"),
    "10 % have two bytes replaced": _answers(0.1, "two bytes"),
    "10 % have another id": _answers(0.1, "id"),
    "10 % have another length": _answers(0.1, "length"),
    "10 % have another error byte, the checksum right": _answers(0.1, "error"),
    "10 % have any other values, the checksum right": _answers(0.1, "value"),
    "10 % are the servo's answer before": BusFault("packets", "stuck", 0.0, _FOREVER_S, share=0.1),
    "bytes both ways have a bit flipped, in 10 % of the goals' packets": BusFault(
        "bytes", "wrong", 0.0, _FOREVER_S, share=_GOALS_BROKEN
    ),
    "bytes both ways are lost, in 10 % of the goals' packets": BusFault(
        "bytes", "silent", 0.0, _FOREVER_S, share=_GOALS_BROKEN
    ),
    "all bytes are replaced in bursts, a tenth of the time": BusFault(
        "bytes", "intermittent", 0.0, _FOREVER_S, on_ms=63.0, off_ms=7.0
    ),
}
HEADINGS = (
    *("fault", "questions", "lost or broken, %", "refused as implausible", "believed", "of these wrong"),
    *("position error, max, deg", "load error, max, % of stall", "oldest reading p99, ms", "cycles ended with a wrong goal"),
)


@dataclass(slots=True)
class Found:
    """Results of one case."""

    case: str
    questions: int = 0
    unanswered: int = 0  # requests without a valid reply
    implausible: int = 0  # replies rejected by the plausibility check
    believed: int = 0
    wrong: int = 0  # accepted readings that differ from the servo's measurement
    position_off_deg: float = 0.0  # the largest error
    load_off: float = 0.0  # the largest error as a share of the stall torque
    oldest_p99_ms: float | None = None  # age of the oldest servo reading, after each servo was read
    wrong_goals: int = 0  # cycles after which a servo has a goal that was not sent to it
    cycles: int = 0
    by_reason: dict[str, int] = field(default_factory=dict)  # everything lost, dropped and rejected


class _CountingPort(MemoryPort):
    """Port that counts the requests."""

    questions = 0

    def write(self, data: bytes) -> int:
        self.questions += data[4] == Instruction.READ
        return super().write(data)


class _Walk:
    """Servos, their bus and a driver.

    Joints follow their goals. Loads change as legs stand and swing.
    """

    def __init__(self, fault: BusFault | None, seed: int):
        self.now_ns = 0
        self.bank = ServoBank(range(1, _N + 1))
        self.bus = BusFaults(ServoBusEmulator(self.bank), self.bank, seed)
        self.port = _CountingPort(self.bus, lambda: self.now_ns)
        self.driver = ServoBus(self.port, range(1, _N + 1), self.port.now_ns)
        self.driver.setup()
        self.driver.set_torque(True)
        self.port.questions = 0
        self.now_ns = self.port.now_ns() + _CYCLE_NS
        if fault is not None:
            self.bus.inject(fault, self.now_ns)
        self._q = np.zeros(_N)
        self._phase = np.arange(_N) * (math.pi / 3.0)
        self._goals: deque[NDArray[np.int64]] = deque([np.full(_N, dxl.TICK_CENTRE)], maxlen=_REMEMBERED)

    def cycle(self) -> list[tuple[ServoReading, bytes]]:
        """Run one control cycle; return readings with the true registers."""
        turn = self._phase + self.now_ns * 1e-9 * 2.0 * math.pi / _STEP_S
        qd, load = _SWING * 2.0 * math.pi / _STEP_S * np.cos(turn), _LOAD_NM * np.tanh(3.0 * np.cos(turn))
        self.bus.advance(self.now_ns)
        self.bank.step(self._q, qd, load, _CYCLE_NS * 1e-9)
        start, size = dxl.PRESENT_POSITION.address, PRESENT_STATE.size
        readings = self.driver.poll(_BUDGET_NS)
        found = [(reading, self.bank.read(reading.index, start, size)) for reading in readings]
        self._q = _SWING * np.sin(turn)  # positions in the next cycle
        self._goals.append(np.rint(dxl.TICK_CENTRE + self._q / dxl.TICK_RAD).astype(np.int64))
        self.driver.sync_write_goals(self._goals[-1])
        self.now_ns = max(self.now_ns + _CYCLE_NS, self.port.now_ns())
        return found

    def goals_are_wrong(self) -> bool:
        """Return whether a servo has a goal that was not sent to it, after a cycle."""
        self.bus.advance(self.now_ns)
        held = self.bank.tables.view("<u2")[:, dxl.GOAL_POSITION.address // 2]
        return not bool((np.array(self._goals) == held).any(axis=0).all())


def measure(questions: int, seed: int, only: str = "", say: Callable[[str], None] = lambda _: None) -> list[Found]:
    """Send requests under each kind of fault.

    Args:
        questions: Minimum number of requests per case.
        seed: Random seed of the faults.
        only: Run only the cases whose names contain this.
        say: Called with the progress.
    """
    found = []
    for case, fault in CASES.items():
        if only in case:
            say(f"{case}: {questions} questions")
            found.append(_run(case, fault, questions, seed))
    return found


def _run(case: str, fault: BusFault | None, questions: int, seed: int) -> Found:
    walk, found, ages = _Walk(fault, seed), Found(case), []
    while walk.port.questions < questions:
        for reading, truth in walk.cycle():
            _compare(found, reading, truth)
        found.cycles += 1
        found.wrong_goals += walk.goals_are_wrong()
        ages.append(float(walk.driver.ages().max()))
    lost = walk.driver.lost
    found.questions = walk.port.questions
    found.unanswered = lost[Lost.TIMEOUT] + lost[Lost.REFUSED]
    found.implausible = sum(lost[doubt] for doubt in Implausibility)
    found.oldest_p99_ms = 1e3 * float(np.percentile(ages[_N:], 99)) if len(ages) > _N else None
    found.by_reason = {str(reason): count for reason, count in sorted(lost.items())}
    return found


def _compare(found: Found, reading: ServoReading, truth: bytes) -> None:
    """Count an accepted reading, and its error."""
    position, speed, load, voltage, temperature = PRESENT_STATE.unpack(truth)
    found.believed += 1
    right = (dxl.angle_from_ticks(position), dxl.speed_from_register(speed), dxl.load_from_register(load))
    said = (reading.position, reading.speed, reading.load)
    rest = (reading.voltage == voltage * dxl.VOLT_UNIT, reading.temperature == temperature, not reading.error)
    if said == right and all(rest):
        return
    found.wrong += 1
    found.position_off_deg = max(found.position_off_deg, abs(math.degrees(said[0] - right[0])))
    found.load_off = max(found.load_off, abs(said[2] - right[2]))


def in_words(found: list[Found]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(HEADINGS) + " |", "|---" * len(HEADINGS) + "|"]
    for one in found:
        cells = (
            one.case,
            one.questions,
            f"{100.0 * one.unanswered / one.questions:.2f}",
            one.implausible,
            one.believed,
            one.wrong,
            f"{one.position_off_deg:.1f}" if one.wrong else "-",
            f"{100.0 * one.load_off:.0f}" if one.wrong else "-",
            "-" if one.oldest_p99_ms is None else f"{one.oldest_p99_ms:.0f}",
            f"{one.wrong_goals} of {one.cycles}",
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def to_json(found: list[Found]) -> str:
    """Return the results as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[Found]:
    """Read results written by `to_json`."""
    return kept.rows_from_json(text, Found)
