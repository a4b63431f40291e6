"""Fuzz targets of the servo buses: parsers of each protocol, emulated servos of each family, and the driver."""

from collections.abc import Callable
from functools import partial
from random import Random

from benchmarks.fuzz.mutators import broken
from benchmarks.fuzz.target import Target
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo import dynamixel2, lx16a
from sextant.shared.servo.models import LX_16A, MX_28, STS3215, XL430_W250
from sextant.shared.servo.servo_model import BusProtocol, ServoModel

_IDS = (1, 2)
_CYCLE_NS = 20_000_000
_BUDGET_NS = 5_000_000
_MODELS = (MX_28, XL430_W250, STS3215, LX_16A)  # with other control tables than the AX-12A


def servo_targets() -> tuple[Target, ...]:
    """Return the targets: the buses of other servos than the AX-12A, and a combined status."""
    return (
        *(
            Target(f"servo bus, {model.name}", _packets(model), partial(_with_checksum, model.protocol), _taker(model))
            for model in _MODELS
        ),
        Target("servo bus, combined answers", (_combined(),), partial(_with_checksum, dynamixel2), _take_combined),
    )


def _packets(model: ServoModel) -> tuple[bytes, ...]:
    """Return instructions of the host, and answers of servos."""
    protocol, table = model.protocol, model.table
    if model.commands is not None:
        return _lx16a_packets()
    state, goals = table.state, table.goals
    row = bytes(goals.size)
    return (
        protocol.ping(1),
        protocol.read(2, state.address, state.size),
        protocol.write(1, table.goal_position.address, table.goal_position.encode(model.units.centre)),
        protocol.write(protocol.BROADCAST_ID, table.torque_enable.address, b"\x00"),
        protocol.sync_write(goals.address, goals.size, [(i, row) for i in _IDS]),
        *((model.sync_read(state.address, state.size, _IDS),) if model.sync_read else ()),
        protocol.status(1, 0, bytes(state.size)),
        protocol.status(1, 0, b"\xff\xff\xfd\x00".ljust(state.size, b"\x07")) + protocol.status(2, 0x80, bytes(state.size)),
    )


def _with_checksum(protocol: object, data: bytes, rng: Random) -> bytes:
    """Mutate the bytes between header and checksum, and compute the checksum again."""
    if protocol is dynamixel2:
        body = dynamixel2.HEADER + broken(data[4:-2], (data,), rng)
        return body + dynamixel2.crc16(body).to_bytes(2, "little")
    body = broken(data[2:-1], (data,), rng)
    return data[:2] + body + bytes((~sum(body) & 0xFF,))


class _Port:
    """Port on which the same bytes arrive after each request."""

    timeout: float | None = 0.006

    def __init__(self) -> None:
        self.now_ns, self.given, self._left = 0, b"", b""

    @property
    def in_waiting(self) -> int:
        return len(self._left)

    def write(self, data: bytes) -> int:
        self._left = self.given
        return len(data)

    def read(self, size: int = 1) -> bytes:
        self.now_ns += 1_000_000
        found, self._left = self._left[:size], self._left[size:]
        return found

    def reset_input_buffer(self) -> None:
        self._left = b""

    def close(self) -> None: ...


def _taker(model: ServoModel) -> Callable[[bytes], bool]:
    """Return a function that gives bytes to both parsers, to emulated servos, and to the driver as answers."""
    protocol, table = model.protocol, model.table
    bank, port = ServoBank(_IDS, model), _Port()
    bank.column(table.baud_rate)[:] = model.rate_code(model.bus_rate)
    driver, start = bus_of(model)(port, _IDS, lambda: port.now_ns, model=model), bank.tables.copy()

    def take(data: bytes) -> bool:
        bank.tables[:] = start
        bus = ServoBusEmulator(bank)
        replies = [reply.data for half in _halves(data) for reply in bus.receive(half, _CYCLE_NS)]
        bus.advance(10 * _CYCLE_NS)
        bank.advance(1e-3)
        port.given = data
        heard = _parse(protocol, data, table.size)
        for reply in replies:
            _parse(protocol, reply, table.size)
        return bool(driver.poll(_BUDGET_NS)) or bool(replies) or heard

    return take


def _parse(protocol: BusProtocol, data: bytes, size: int) -> bool:
    """Give bytes to the parsers of answers and of instructions; return whether there was a packet."""
    answers, instructions = protocol.answer_parser(size), protocol.instruction_parser()
    found = [packet for half in _halves(data) for packet in answers.feed(half)]
    most = 2 * (protocol.OVERHEAD + size)
    if answers.pending > most:
        raise AssertionError(f"{answers.pending} bytes are held back, at most {most} expected")
    found += answers.flush()
    asked = [packet for half in _halves(data) for packet in instructions.feed(half)] + instructions.flush()
    for packet in asked:
        protocol.request(packet)
    return bool(found) or any(packet.intact for packet in asked)


def _halves(data: bytes) -> tuple[bytes, bytes]:
    return data[: len(data) // 2], data[len(data) // 2 :]


_SIZES = (4, 7, 4)


def _combined() -> bytes:
    return dynamixel2.combined_status([(i, 0, bytes(range(size))) for i, size in enumerate(_SIZES, 1)])


def _take_combined(data: bytes) -> bool:
    parser = dynamixel2.PacketParser(keep_broken=True)
    found = [packet for half in _halves(data) for packet in parser.feed(half)] + parser.flush()
    parts = [part for packet in found for part in dynamixel2.split_status(packet, _SIZES)]
    if any(len(part.parameters) not in _SIZES for part in parts):
        raise AssertionError(f"parts of {_SIZES} bytes expected, found {parts}")
    return bool(parts)


def _lx16a_packets() -> tuple[bytes, ...]:
    return (
        lx16a.write(1, lx16a.Command.MOVE_TIME_WRITE, 500, 20),
        lx16a.write(254, lx16a.Command.LOAD_OR_UNLOAD_WRITE, 1),
        lx16a.write(2, lx16a.Command.MOVE_TIME_WAIT_WRITE, 400, 100) + lx16a.write(254, lx16a.Command.MOVE_START),
        lx16a.write(1, lx16a.Command.ANGLE_LIMIT_WRITE, 100, 900),
        lx16a.read(2, lx16a.Command.POS_READ),
        lx16a.response(2, lx16a.Command.POS_READ, -3),
        lx16a.response(1, lx16a.Command.VIN_READ, 7400) + lx16a.response(1, lx16a.Command.TEMP_READ, 31),
    )
