"""Fault injection for the emulated bus.

Faults affect bytes, responses, single servos, the adapter and the supply. The result is deterministic: equal seeds, faults,
bytes and times give equal responses. Without an active fault, all calls pass through to the bus.
`sextant.shared.servo.bus_fault.GRID` describes each fault.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random

from sextant.services.simulator.servo_bus.host_link import AdapterPort, AnswersOnly, EmulatedBus, Reply
from sextant.services.simulator.servo_bus.servo_banks import AnyBank
from sextant.services.simulator.servo_bus.servo_faults import ServoFaults
from sextant.shared.servo import dynamixel2, pwm
from sextant.shared.servo.bus_fault import WITHOUT_FEEDBACK, BusFault
from sextant.shared.servo.servo_model import BusProtocol, ServoError, ServoModel
from sextant.shared.wire.messages import FaultTarget

_SEC, _MS = 1e9, 1_000_000
_STREAM_BYTES = 100  # bytes per millisecond of an endless stream
_STREAM_MS = 8  # [ms] length of a stream after a request; longer than a host waits for a response
_MOST_NOISE = 20  # [bytes] maximum noise in front of a response
_ON_JOINTS = ("servo", "supply")  # targets whose faults the servo bank applies
_NO_ROWS: frozenset[int] = frozenset()


@dataclass(slots=True)
class _Running:
    """Injected fault with its random generator and state."""

    number: int  # index in order of injection
    fault: BusFault
    begin_ns: int  # [ns] simulated time, as are all times of this class
    end_ns: int
    row: int  # row of its servo in the bank, -1 without a servo
    rng: Random
    until_hit: int = 0  # number of bytes before the next corrupted one
    streamed_ns: int = 0  # time up to which an endless stream has sent
    drain: float = 0.0  # [1/s] discharge, as a share of the battery's capacity
    earlier: dict[int, bytes] = field(default_factory=dict)  # servo id -> its last response; -1 -> last response of any servo

    def __post_init__(self) -> None:
        self.until_hit = self._gap()

    @property
    def cell(self) -> tuple[str, str]:
        return self.fault.target, self.fault.kind

    def on(self, t_ns: int) -> bool:
        """Return whether a time is within the duration of the fault.

        The pauses of an intermittent fault belong to its duration.
        """
        return self.begin_ns <= t_ns < self.end_ns

    def away(self, t_ns: int) -> bool:
        """Return whether a silent or intermittent fault interrupts communication now."""
        fault = self.fault
        if fault.kind != "intermittent":
            return fault.kind == "silent"
        return (t_ns - self.begin_ns) / _MS % (fault.on_ms + fault.off_ms) >= fault.on_ms

    def strikes(self) -> bool:
        """Draw whether the fault affects the next response."""
        return self.rng.random() < self.fault.share

    def hits(self, count: int) -> list[int]:
        """Draw the indices of the affected bytes among the next `count` bytes."""
        found = []
        while self.until_hit < count:
            found.append(self.until_hit)
            self.until_hit += 1 + self._gap()
        self.until_hit -= count
        return found

    def _gap(self) -> int:
        """Draw the number of bytes between two affected ones.

        Each byte is affected independently.
        """
        share = self.fault.share
        return 0 if share >= 1.0 else int(math.log(1.0 - self.rng.random()) / math.log(1.0 - share))


def row_of(fault: BusFault, models: Mapping[int, ServoModel]) -> int:
    """Return the index of a fault's servo among all servos, with their models by id; -1 without a servo.

    Raises:
        ValueError: The servo does not exist, or it does not have the fault, or the bit of the fault.
    """
    ids = list(models)
    if fault.servo >= 0 and fault.servo not in ids:
        raise ValueError(f"{fault}: one of the servos {', '.join(map(str, sorted(ids)))} expected, found {fault.servo}")
    table = models.get(fault.servo, models[ids[0]]).table
    if table is pwm.TABLE and (
        (fault.target, fault.kind) not in WITHOUT_FEEDBACK or (fault.target == "packets" and fault.servo >= 0)
    ):
        raise ValueError(f"{fault}: a fault that is possible without feedback expected; hobby servos report nothing")
    last_bit = table.goal_position.max.bit_length() - 1
    if (fault.target, fault.kind) == ("servo", "bit") and fault.bit > last_bit:
        raise ValueError(f"{fault}: a bit from 0 to {last_bit} of the goal register expected, found {fault.bit}")
    return ids.index(fault.servo) if fault.servo >= 0 else -1


class BusFaults(AnswersOnly):
    """Bus with faults, which has the interface of `ServoBusEmulator`."""

    def __init__(self, bus: EmulatedBus, bank: AnyBank, seed: int = 0, faults: Iterable[BusFault] = ()) -> None:
        """Wrap a bus.

        Args:
            bus: The bus without faults.
            bank: Its servos.
            seed: Random seed.
            faults: Faults with their times.

        Raises:
            ValueError: A fault names a servo or a bit that does not exist.
        """
        self.origin_ns: int | None = 0  # bus time at which simulated time is 0; None before simulated time has started
        self._overhear: Callable[[bytes, int], object] | None = None
        self._bus = bus
        self._bank = bank
        self._seed = seed
        self._running: list[_Running] = []
        self._injected = 0
        self._gone: list[_Running] = []  # running faults that remove the port
        self._adapter_port = AdapterPort()  # identity of the port after all faults that have been removed
        self._suffered: list[tuple[int, bool]] = []  # number and `away` of each fault that the bank applies
        for fault in faults:
            self.inject(fault, 0)

    def inject(self, fault: BusFault, now_ns: int) -> None:
        """Schedule a fault at its time, or from now [ns] on if that time has passed.

        Raises:
            ValueError: The fault names a servo or a bit that does not exist.
        """
        ids = self._bank.column(self._bank.table.id).tolist()
        row = row_of(fault, {servo: self._bank.model_of(row) for row, servo in enumerate(ids)})
        begin_ns = max(round(fault.at_s * _SEC), self._simulated(now_ns))
        end_ns = begin_ns + round(fault.for_s * _SEC)
        rng = Random(f"{self._seed} {self._injected}")
        self._running.append(_Running(self._injected, fault, begin_ns, end_ns, row, rng))
        if (fault.target, fault.kind) == ("bus", "gone"):
            self._gone.append(self._running[-1])
        self._injected += 1

    def overhear(self, sent: Callable[[bytes, int], object], arrived: Callable[[bytes, int], object]) -> None:
        """Set callbacks that receive bytes and their time [ns].

        The first receives the bytes that the host sends, the second those that reach the servos.
        """
        self._overhear, self._bus.overhear = sent, arrived

    def words(self, now_ns: int) -> str:
        """Return the active faults as text, "" without faults."""
        t_ns = self._simulated(now_ns)
        return "; ".join(str(running.fault) for running in self._running if running.on(t_ns))

    def adapter_port(self, now_ns: int) -> AdapterPort | None:
        """Return the identity of the port at a time [ns], None while the port is gone."""
        if not self._gone:
            return self._adapter_port
        t_ns = self._simulated(now_ns)
        if any(running.on(t_ns) for running in self._gone):
            return None
        return _after(self._adapter_port, [running for running in self._gone if running.end_ns <= t_ns])

    def _simulated(self, now_ns: int) -> int:
        return 0 if self.origin_ns is None else now_ns - self.origin_ns

    # ------------------------------------------------------------------------------------------- methods for the host

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes that the host sends at a time [ns], and return the replies."""
        t_ns = self._simulated(now_ns)
        if self._overhear is not None:
            self._overhear(data, now_ns)
        active = [running for running in self._running if running.on(t_ns)]
        if not active:
            self._bus.cut_off(_NO_ROWS)
            return self._bus.receive(data, now_ns)
        self._bus.cut_off(frozenset(r.row for r in active if r.fault.target == "servo" and r.away(t_ns)))
        for running in _of("bus", active):
            if running.away(t_ns) or running.fault.kind == "gone":
                return []
            if running.fault.kind in ("stuck", "garbage"):
                return _stream(running, now_ns)
        spoilers = _of("bytes", active)
        for running in spoilers:
            data = _spoil(running, data, t_ns)
        replies = self._bus.receive(data, now_ns)
        for running in (*_of("servo", active), *_of("packets", active), *_of("bus", active)):
            replies = [reply for answer in replies for reply in _garble(running, answer, t_ns, self._bank.model.protocol)]
        for running in spoilers:
            replies = [reply for answer in replies for reply in _spoil_reply(running, answer, t_ns)]
        return replies

    # ---------------------------------------------------------------------------------------- methods for the physics

    def advance(self, now_ns: int) -> None:
        """Apply the faults of servos and supply, and the due writes of the bus.

        Call it before each physics step.
        """
        if self._running:
            t_ns = self._simulated(now_ns)
            self._suffer(t_ns)
            self._forget(t_ns)
        self._bus.advance(now_ns)

    def _suffer(self, t_ns: int) -> None:
        active = [r for r in self._running if r.fault.target in _ON_JOINTS and r.on(t_ns)]
        suffered = [(running.number, running.away(t_ns)) for running in active]
        if suffered == self._suffered:
            return
        self._suffered = suffered
        servo_faults = ServoFaults.none(len(self._bank))
        for running in active:
            self._add_servo_fault(servo_faults, running, running.away(t_ns))
        self._bank.set_faults(servo_faults if active else None)

    def _add_servo_fault(self, servo_faults: ServoFaults, running: _Running, away: bool) -> None:
        """Add one fault to the fault state of servos and supply."""
        fault, row = running.fault, running.row
        match running.cell:
            case "servo", ("silent" | "intermittent"):
                servo_faults.unpowered[row] |= fault.cable and away
            case "servo", "stuck":
                servo_faults.frozen[row] = True
            case "servo", "jammed":
                servo_faults.jammed[row] = True
            case "servo", "wrong":
                servo_faults.offset[row] += fault.offset_ticks
            case "servo", "overload":
                servo_faults.tripped[row] |= int(ServoError.OVERLOAD)
            case "servo", "heat":
                servo_faults.heating[row] += fault.kelvin_per_s
            case "servo", "hot":
                servo_faults.reads_hot[row] = fault.celsius
            case "servo", "slipped":
                servo_faults.slips[row] += math.radians(fault.degrees)
            case "servo", "jump":
                servo_faults.slips[row] += math.radians(fault.degrees)
                servo_faults.slip_rate[row] = math.inf
            case "servo", "drift":
                servo_faults.slips[row] += math.copysign(math.pi, fault.deg_per_s)
                servo_faults.slip_rate[row] = math.radians(abs(fault.deg_per_s))
            case "servo", "bit":
                bits = servo_faults.stuck_ones if fault.value else servo_faults.stuck_zeros
                bits[row] |= 1 << fault.bit
            case "servo", "sign":
                servo_faults.wrong_sign[row] = True
            case "servo", "weak":
                servo_faults.strength[row] *= fault.share
            case "supply", "sag":
                servo_faults.sag += fault.volts
            case "supply", "drain":
                running.drain = running.drain or self._bank.charge / fault.for_s
                servo_faults.drain += running.drain

    def _forget(self, t_ns: int) -> None:
        """Remove faults that are over."""
        if all(running.end_ns > t_ns for running in self._running):
            return
        self._adapter_port = _after(self._adapter_port, [running for running in self._gone if running.end_ns <= t_ns])
        self._gone = [running for running in self._gone if running.end_ns > t_ns]
        self._running = [running for running in self._running if running.end_ns > t_ns]


def _after(adapter_port: AdapterPort, over: Sequence[_Running]) -> AdapterPort:
    """Return the identity of the port after faults that removed it are over."""
    return AdapterPort(adapter_port.name + sum(running.fault.renamed for running in over), adapter_port.times + len(over))


def _of(target: FaultTarget, active: Sequence[_Running]) -> list[_Running]:
    return [running for running in active if running.fault.target == target]


def _stream(running: _Running, now_ns: int) -> list[Reply]:
    """Return the endless stream of a stuck or noisy bus after a request.

    It ends after the longest time that a host waits.
    """
    start_ns, end_ns = max(now_ns, running.streamed_ns), now_ns + _STREAM_MS * _MS
    running.streamed_ns = max(start_ns, end_ns)
    held = running.fault.kind == "stuck"

    def heard() -> bytes:
        return bytes([running.fault.value] * _STREAM_BYTES) if held else running.rng.randbytes(_STREAM_BYTES)

    return [Reply(due_ns, heard()) for due_ns in range(start_ns + _MS, end_ns + 1, _MS)]


def _spoil(running: _Running, data: bytes, t_ns: int) -> bytes:
    """Return bytes after corruption by a fault.

    Faults that only delay bytes do not change them.
    """
    fault, rng = running.fault, running.rng
    if fault.kind == "intermittent":
        return rng.randbytes(len(data)) if running.away(t_ns) else data
    if fault.kind == "slow":
        return data
    spoilt = bytearray(data)
    for i in reversed(running.hits(len(data))):
        match fault.kind:
            case "silent":
                del spoilt[i]
            case "stuck":
                spoilt[i] = fault.value
            case "garbage":
                spoilt[i] = (spoilt[i] + rng.randrange(1, 256)) & 0xFF
            case _:
                spoilt[i] ^= 1 << rng.randrange(8)
    return bytes(spoilt)


def _spoil_reply(running: _Running, reply: Reply, t_ns: int) -> Iterator[Reply]:
    if running.fault.kind != "slow":
        yield reply._replace(data=_spoil(running, reply.data, t_ns))
        return
    start, due_ns = 0, reply.due_ns
    for i in running.hits(len(reply.data)):
        yield Reply(due_ns, reply.data[start:i], reply.servo_id)
        start, due_ns = i, due_ns + round(running.fault.delay_ms * _MS)
    yield Reply(due_ns, reply.data[start:], reply.servo_id)


def _garble(running: _Running, reply: Reply, t_ns: int, protocol: BusProtocol) -> Iterator[Reply]:
    """Yield the replies that replace one response under a fault.

    The fault is one of responses, a servo or the bus. Echoes pass unchanged.
    """
    fault = running.fault
    if reply.servo_id < 0 or fault.servo not in (-1, reply.servo_id, *reply.parts):
        yield reply
        return
    match running.cell:
        case "servo", "garbage" if reply.parts:
            yield reply._replace(data=_with_garbage(running, reply))
        case _, "slow" if fault.target != "packets" or running.strikes():
            yield reply._replace(due_ns=reply.due_ns + round(fault.delay_ms * _MS))
        case "packets", "silent" if running.strikes():
            return
        case "packets", "intermittent" if running.away(t_ns):
            return
        case "packets", "stuck":
            before = running.earlier.get(reply.servo_id, reply.data)
            running.earlier[reply.servo_id] = reply.data
            yield reply._replace(data=before if running.strikes() else reply.data)
        case "packets", "garbage" if running.strikes():
            noise = running.rng.randbytes(running.rng.randint(1, _MOST_NOISE))
            yield reply._replace(data=noise + reply.data)
        case "packets", "wrong" if running.strikes():
            yield reply._replace(data=_misspoken(running, reply, protocol))
        case "servo", "garbage":
            yield reply._replace(data=running.rng.randbytes(len(reply.data)))
        case "bus", "wrong":
            before = running.earlier.get(-1, b"")
            running.earlier[-1] = reply.data
            yield reply._replace(data=before)
        case _:
            yield reply


def _with_garbage(running: _Running, reply: Reply) -> bytes:
    """Return a combined response in which the part of one servo is garbage."""
    count, index = len(reply.parts), reply.parts.index(running.fault.servo)
    return dynamixel2.with_part(reply.data, count, index, running.rng.randbytes)


def _misspoken(running: _Running, reply: Reply, protocol: BusProtocol) -> bytes:
    """Return a response with one wrong part or with two wrong bits or bytes.

    With one wrong part, the checksum is valid.
    """
    rng, most = running.rng, protocol.MAX_ID
    ((servo_id, error, parameters, *_),) = protocol.answer_parser(len(reply.data)).feed(reply.data)
    match running.fault.part:
        case "id":
            return protocol.status((servo_id + rng.randrange(1, most)) % (most + 1), error, parameters)
        case "length":
            cut = rng.random() < 0.5 and parameters
            return protocol.status(servo_id, error, parameters[:-1] if cut else parameters + b"\x00")
        case "error":
            return protocol.status(servo_id, error ^ 1 << rng.randrange(8), parameters)
        case "value":
            return protocol.status(servo_id, error, rng.randbytes(len(parameters)))
        case part:
            spoilt = bytearray(reply.data)
            for i in rng.sample(range(len(spoilt)), 2):
                spoilt[i] ^= 1 << rng.randrange(8) if part == "two bits" else rng.randrange(1, 256)
            return bytes(spoilt)
