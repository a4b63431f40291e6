"""Ways to spoil the answers of emulated servos and boards, and what a checksum misses of each."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from sextant.services.simulator.servo_bus.host_link import AdapterPort, HostLink, Reply
from sextant.shared.servo import bridge_protocol, dynamixel2
from sextant.shared.servo.servo_model import BusProtocol

_SHARE = 0.25  # of the answers
_MOST_NOISE = 12  # [bytes]
_SIGMAS = 4.0  # standard deviations above the expected number that pass


class Odds(NamedTuple):
    """Shares of spoilt answers that a checksum does not notice, at most."""

    one_byte: float  # a sum of bytes
    crc: float  # two bytes or more
    twice: float  # no checksum, but an answer counts if the next one is the same: both are spoilt alike


@dataclass(frozen=True, slots=True)
class Way:
    """A way to spoil an answer, and the odds that a checksum does not show it."""

    spoil: Callable[[bytes, bytes, Random], bytes]  # from the answer and the one before, of the same or another servo
    odds: Odds | None  # None: the answer is intact, but an old one
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
NO_ODDS = Odds(0.0, 0.0, 0.0)
_RANDOM = Odds(1 / 256, 1 / 65_536, _SHARE / 256)
_BITS = 16  # of an answer without a checksum
OF_ANOTHER, OF_BEFORE = "answer of another servo", "answer before of the same servo"
WAYS: Mapping[str, Way] = {
    "one bit flipped": Way(_one_bit, Odds(0.0, 0.0, _SHARE / _BITS)),
    "two bits flipped": Way(_two_bits, Odds(_SAME_SUM, 0.0, _SHARE / math.comb(_BITS, 2))),
    "random bytes from some byte on": Way(_replaced, _RANDOM),
    "some bytes lost": Way(_cut, _RANDOM),
    "noise inserted": Way(_noisy, _RANDOM),
    OF_ANOTHER: Way(_before, NO_ODDS),
    OF_BEFORE: Way(_before, None, of_same=True),
}


@dataclass(slots=True)
class Found:
    """Results of one way with one kind of servos."""

    model: str  # or several models, or a board
    way: str
    answers: int = 0
    spoilt: int = 0
    intact: int = 0  # spoilt answers that contain a whole packet with a correct checksum and other values
    expected: float | None = None  # of these, by the odds; None without a checksum and for old answers, which each accepts
    most_wrong: float | None = None  # readings with wrong values by the odds; None for old answers, which may be believed
    readings: int = 0  # accepted ones
    registers: int = 0  # accepted values of single registers
    wrong_readings: int = 0  # accepted readings with a wrong value, and wrong registers
    wrong: dict[str, int] = field(default_factory=dict)  # wrong values, by their kind
    position_off_deg: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the checksum and the driver accept no more than the odds allow."""
        return _is_within(self.intact, self.expected) and _is_within(self.wrong_readings, self.most_wrong)

    def note(self, kinds: list[str]) -> None:
        """Count a reading with these wrong values, possibly none."""
        self.wrong_readings += bool(kinds)
        for kind in kinds:
            self.wrong[kind] = self.wrong.get(kind, 0) + 1


def _is_within(number: int, expected: float | None) -> bool:
    return expected is None or number <= expected + _SIGMAS * math.sqrt(expected)


IsIntact = Callable[[Reply, bytes], bool]  # whether spoilt bytes contain another whole packet than the reply


class SpoiltLink:
    """Emulated bus or board, a share of whose answers is spoilt in one way."""

    def __init__(self, device: HostLink, way: Way, rng: Random, found: Found, odds: float, intact: IsIntact) -> None:
        """Begin without spoiling.

        Args:
            device: The bus or board.
            way: The way to spoil.
            rng: Random numbers.
            found: Where the answers are counted.
            odds: That the device's checksum misses a spoilt answer.
            intact: Function that recognises a whole packet.
        """
        self.spoils = False
        self.only: int | None = None  # the sender whose answers are counted and spoilt; None for all
        self._device, self._way, self._rng, self._found = device, way, rng, found
        self._odds, self._intact = odds, intact
        self._said: dict[int, bytes] = {}  # sender -> its last answer

    @property
    def due_ns(self) -> int | None:
        """Time [ns] of the next event of the device."""
        return self._device.due_ns

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes of the host, and return the replies, some of them spoilt."""
        return [self._changed(reply) for reply in self._device.receive(data, now_ns)]

    def unsolicited_replies(self, now_ns: int) -> list[Reply]:
        """Return the unsolicited replies up to a time [ns], some of them spoilt."""
        return [self._changed(reply) for reply in self._device.unsolicited_replies(now_ns)]

    def adapter_port(self, now_ns: int) -> AdapterPort | None:
        """Return the identity of the port."""
        return self._device.adapter_port(now_ns)

    def _changed(self, reply: Reply) -> Reply:
        found, rng, sender = self._found, self._rng, reply.servo_id
        if not self.spoils or self.only not in (None, sender):
            return reply
        found.answers += 1
        others = [said for one, said in self._said.items() if (one == sender) == self._way.of_same]
        self._said[sender] = reply.data
        if rng.random() >= _SHARE or not (others or self._way.spoil is not _before):
            return reply
        spoilt = self._way.spoil(reply.data, rng.choice(others) if others else b"", rng)
        found.spoilt += 1
        found.intact += self._intact(reply, spoilt)
        if found.expected is not None:
            found.expected += self._odds
        if found.most_wrong is not None:
            found.most_wrong += self._odds
        return reply._replace(data=spoilt)


def contains_other(protocol: BusProtocol, servo_id: int, answer: bytes, spoilt: bytes) -> bool:
    """Return whether spoilt bytes contain a correct packet of a servo, as long as its answer, with other values.

    A packet that the parser finds is encoded again, so that its checksum is computed here, too.
    """
    start, size = protocol.answer_start(servo_id), len(answer)
    for at in range(len(spoilt) - size + 1):
        window = spoilt[at : at + size]
        if window == answer or not window.startswith(start):
            continue
        packets = protocol.answer_parser(size).feed(window)
        if any(protocol.status(one.servo_id, one.code, one.parameters) == window for one in packets):
            return True
    return False


def contains_other_part(servos: int, answer: bytes, spoilt: bytes) -> bool:
    """Return whether spoilt bytes contain a part of an answer of several servos, with other values and a correct CRC."""
    head = dynamixel2.HEAD + 1  # header, id, length and instruction
    width = (len(answer) - head) // servos  # of a part: error, id, values and CRC
    for at in range(len(spoilt)):
        if not spoilt[at:].startswith(answer[:head]):
            continue
        for end in range(head + width, len(answer) + 1, width):
            window = spoilt[at : at + end]
            crc = dynamixel2.crc16(window[:-2]).to_bytes(2, "little")
            if len(window) == end and window[-2:] == crc and window[-width:-2] != answer[end - width : end - 2]:
                return True
    return False


def contains_other_message(answer: bytes, spoilt: bytes) -> bool:
    """Return whether spoilt bytes contain a message of a bridge that is not in its answer."""
    said, heard = (bridge_protocol.Receiver(bridge_protocol.TO_HOST).feed(data) for data in (answer, spoilt))
    return any(message not in said for message in heard)


def has_other_bytes(answer: bytes, spoilt: bytes) -> bool:
    """Return whether spoilt bytes are long enough for an answer without a checksum, and differ from it."""
    return len(spoilt) >= len(answer) and spoilt[: len(answer)] != answer
