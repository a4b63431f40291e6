"""Odds of the checksum of each servo family, and wrong values that the driver accepts.

Emulated servos move at random while a share of their answers is spoilt. The driver reads them in cycles of 20 ms, in memory, in
simulated time, and each accepted reading is compared with the state of its servo. A checksum of one byte accepts one of 256
random errors, a CRC of two bytes one of 65 536 and no error of two bits.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from random import Random

import numpy as np

from benchmarks.peers import kept
from sextant.services.actuator.servo_bus.bus_driver import ServoReading
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.motors import MOTOR_AND_SUPPLY
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo import dynamixel2
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import BusProtocol, ServoModel

_N = 6
_CYCLE_NS, _BUDGET_NS = 20_000_000, 12_000_000
_SHARE = 0.25  # of the answers
_STEP_RAD = 0.04  # [rad] largest motion of a joint in a cycle, 2 rad/s
_REACH_RAD = 1.2
_MOST_NOISE = 12  # [bytes]
_SIGMAS = 4.0  # standard deviations above the expected number that pass
_FAMILIES = {id(model.table): model.name for model in reversed(MODELS)}  # one model for each control table
MODEL_NAMES = tuple(reversed(_FAMILIES.values()))


@dataclass(frozen=True, slots=True)
class Way:
    """A way to spoil an answer, and the odds that a checksum of one byte and a CRC do not show it."""

    spoil: Callable[[bytes, bytes, Random], bytes]  # from the answer and the one before, of the same or another servo
    odds: tuple[float, float] | None  # None: the answer is intact, but an old one
    of_same: bool = False  # whether the answer before is one of the same servo


def _one_bit(data: bytes, before: bytes, rng: Random) -> bytes:
    return _flipped(data, rng, 1)


def _two_bits(data: bytes, before: bytes, rng: Random) -> bytes:
    return _flipped(data, rng, 2)


def _flipped(data: bytes, rng: Random, count: int) -> bytes:
    spoilt = bytearray(data)
    for bit in rng.sample(range(8 * len(data)), count):
        spoilt[bit // 8] ^= 1 << bit % 8
    return bytes(spoilt)


def _replaced(data: bytes, before: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + rng.randbytes(len(data) - at)


def _cut(data: bytes, before: bytes, rng: Random) -> bytes:
    start, end = sorted(rng.sample(range(len(data) + 1), 2))
    return data[:start] + data[end:]


def _noisy(data: bytes, before: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.randint(1, _MOST_NOISE)) + data[at:]


def _before(data: bytes, before: bytes, rng: Random) -> bytes:
    return before


# Two flipped bits leave a sum of bytes unchanged if they have the same place in two bytes, and differ or are the highest ones.
_SAME_SUM = (7 / 8 * 1 / 2 + 1 / 8) / 8
_RANDOM = (1 / 256, 1 / 65_536)
WAYS: Mapping[str, Way] = {
    "one bit flipped": Way(_one_bit, (0.0, 0.0)),
    "two bits flipped": Way(_two_bits, (_SAME_SUM, 0.0)),
    "random bytes from some byte on": Way(_replaced, _RANDOM),
    "some bytes lost": Way(_cut, _RANDOM),
    "noise inserted": Way(_noisy, _RANDOM),
    "answer of another servo": Way(_before, (0.0, 0.0)),
    "answer before of the same servo": Way(_before, None, of_same=True),
}


@dataclass(slots=True)
class Found:
    """Results of one way with the servos of one family."""

    model: str
    way: str
    answers: int = 0
    spoilt: int = 0
    intact: int = 0  # spoilt answers that contain a whole packet of the servo with a correct checksum and other values
    expected: float | None = None  # of these, by the odds; None for old answers, which every checksum accepts
    readings: int = 0  # accepted ones
    wrong_positions: int = 0
    wrong_errors: int = 0
    position_off_deg: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the checksum and the driver accept no more than the odds allow; any number of old answers."""
        if self.expected is None:
            return self.wrong_errors == 0
        most = self.expected + _SIGMAS * math.sqrt(self.expected)
        return max(self.intact, self.wrong_positions + self.wrong_errors) <= most


class _SpoiltBus(ServoBusEmulator):
    """Bus with servos whose answers are spoilt in one way."""

    def __init__(self, bank: ServoBank, way: Way, rng: Random, found: Found):
        super().__init__(bank)
        self.spoils = False
        self._way, self._rng, self._found = way, rng, found
        self._said: dict[int, bytes] = {}  # servo -> its last answer

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes of the host, and return the replies, some of them spoilt."""
        return [self._changed(reply) for reply in super().receive(data, now_ns)]

    def _changed(self, reply: Reply) -> Reply:
        found, rng = self._found, self._rng
        if reply.servo_id < 0 or not self.spoils:
            return reply
        found.answers += 1
        others = [said for servo, said in self._said.items() if (servo == reply.servo_id) == self._way.of_same]
        self._said[reply.servo_id] = reply.data
        if rng.random() >= _SHARE or not others:
            return reply
        spoilt = self._way.spoil(reply.data, rng.choice(others), rng)
        found.spoilt += 1
        found.intact += contains_other(self._model.protocol, reply.servo_id, reply.data, spoilt)
        return reply._replace(data=spoilt)


def contains_other(protocol: BusProtocol, servo_id: int, answer: bytes, spoilt: bytes) -> bool:
    """Return whether spoilt bytes contain a correct packet of a servo, as long as its answer, with other values.

    The packet is encoded again from its content, so that no parser is trusted.
    """
    start, size = protocol.answer_start(servo_id), len(answer)
    (parsed,) = protocol.answer_parser(size).feed(answer)
    before = answer.index(parsed.parameters, len(start)) if parsed.parameters else size
    for at in range(len(spoilt) - size + 1):
        window = spoilt[at : at + size]
        if window == answer or not window.startswith(start):
            continue
        body = window[before : before + len(parsed.parameters)]
        if protocol.status(servo_id, window[before - 1], body) == window:
            return True
    return False


def measure(answers: int, seed: int, models: tuple[str, ...] = (), say: Callable[[str], None] = lambda _: None) -> list[Found]:
    """Read servos of each family while their answers are spoilt in each way.

    Args:
        answers: Minimum number of answers of each family in each way.
        seed: Random seed.
        models: Servo models; empty for one of each family.
        say: Called with the progress.
    """
    found = []
    for model in (model for model in MODELS if model.name in (models or MODEL_NAMES)):
        say(f"{model.name}: {answers} answers in each of {len(WAYS)} ways")
        found += [_run(model, way, answers, Random(f"{seed} {model.name} {way}")) for way in WAYS]
    return found


def _run(model: ServoModel, name: str, answers: int, rng: Random) -> Found:
    way, found, now_ns = WAYS[name], Found(model.name, name), 0
    motor, supply = MOTOR_AND_SUPPLY[model.name]
    bank = ServoBank(range(1, _N + 1), model, motor, supply=supply)
    bank.column(model.table.baud_rate)[:] = model.rate_code(model.bus_rate)
    if model.fast_firmware is not None:  # answers of single servos, not a combined one
        bank.column(model.table.firmware)[:] = model.fast_firmware - 1
    bus = _SpoiltBus(bank, way, rng, found)
    port = MemoryPort(bus, lambda: now_ns)
    driver = bus_of(model)(port, range(1, _N + 1), port.now_ns, model=model)
    driver.setup()
    driver.set_torque(True)
    bus.spoils, q, rest = True, np.zeros(_N), np.zeros(_N)
    while found.answers < answers:
        now_ns = max(now_ns + _CYCLE_NS, port.now_ns())
        moves = [rng.uniform(-_STEP_RAD, _STEP_RAD) for _ in range(_N)]
        q = np.clip(q + moves, -_REACH_RAD, _REACH_RAD)
        bus.advance(now_ns)
        bank.step(q, rest, rest, _CYCLE_NS * 1e-9)
        for reading in driver.poll(_BUDGET_NS):
            _compare(found, reading, float(q[reading.index]), model.units.tick_rad)
        driver.sync_write_goals([model.units.ticks(float(angle)) for angle in q])
    # Old answers of two servos in one exchange may look in order.
    if way.odds is not None and not (model.sync_read is not None and way.spoil is _before):
        found.expected = found.spoilt * way.odds[model.protocol is dynamixel2]
    return found


def _compare(found: Found, reading: ServoReading, truth: float, tick_rad: float) -> None:
    """Count an accepted reading, and its error."""
    off = abs(reading.position - truth)
    found.readings += 1
    found.wrong_errors += bool(reading.error)
    if off > tick_rad:
        found.wrong_positions += 1
        found.position_off_deg = max(found.position_off_deg, math.degrees(off))


def in_words(found: Sequence[Found]) -> str:
    """Return a table in Markdown, a row for each servo, and what exceeds the odds."""
    ways = list(dict.fromkeys(one.way for one in found))
    lines = [f"| servo | {' | '.join(ways)} |", "|---" * (1 + len(ways)) + "|"]
    for model in dict.fromkeys(one.model for one in found):
        cells = {one.way: _cell(one) for one in found if one.model == model}
        lines.append(f"| {model} | {' | '.join(cells.get(way, '') for way in ways)} |")
    believed = [one for one in found if one.wrong_positions and one.expected is not None]
    lines += [
        "",
        f"Intact by their checksum, of the spoilt answers; in parentheses wrong positions that were believed, at most "
        f"{max((one.position_off_deg for one in believed), default=0.0):.1f} deg off but for old answers; "
        f"{sum(one.wrong_errors for one in found)} wrong errors were believed. At least {min(one.answers for one in found)} "
        f"answers of each servo each way.",
    ]
    for one in found:
        if not one.passed:
            lines.append(
                f"More than the odds allow: {one.model}, {one.way}, {one.intact} intact, {one.expected} expected at most."
            )
    return "\n".join(lines)


def _cell(one: Found) -> str:
    return f"{one.intact} of {one.spoilt}" + (f" ({one.wrong_positions})" if one.wrong_positions else "")


def to_json(found: Sequence[Found]) -> str:
    """Return the results as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[Found]:
    """Read results written by `to_json`."""
    return kept.rows_from_json(text, Found)
