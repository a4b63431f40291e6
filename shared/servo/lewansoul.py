"""Servos of LewanSoul (Hiwonder) with the packets of the LX-16A, as servos with a control table.

Such a servo has commands instead of registers. Each value gets an address of ours here, and a read or a write of all bytes of
one command becomes that command. What no command reads or writes belongs to the model, not to the servo: `LACKS` names it.

Published: packets, commands, ranges, and that a servo that is too hot has no torque until it has cooled. Assumed: the same for
a voltage outside its limits. Not published: whether a stalled servo keeps its torque, whether a goal turns torque on, and the
law of the position controller. Source: LewanSoul (Hiwonder) Bus Servo Communication Protocol.
"""

import math
from collections.abc import Iterable
from types import MappingProxyType

from sextant.shared.servo import lx16a
from sextant.shared.servo.lx16a import BROADCAST_ID, MAX_ID, OVERHEAD, READS, Command, PacketParser
from sextant.shared.servo.servo_model import (
    ControlTable,
    Kind,
    Packet,
    Register,
    Request,
    ServoError,
    Sign,
    Units,
    measured,
    setting,
)

__all__ = [
    "ALERT",
    "BAUD_RATE",
    "BROADCAST_ID",
    "ERRORS",
    "LACKS",
    "MASKS",
    "MAX_ID",
    "NAME",
    "OVERHEAD",
    "PING_SIZE",
    "RATES",
    "SETTINGS",
    "TABLE",
    "UNITS",
    "answer_code",
    "answer_parser",
    "answer_start",
    "command_at",
    "commands_in",
    "error_code",
    "instruction_parser",
    "ping",
    "read",
    "request",
    "status",
    "sync_write",
    "sync_write_rows",
    "write",
]

NAME = "LewanSoul"
PING_SIZE = 1  # [bytes] the id
ERRORS = tuple(ServoError.NONE for _ in range(256))  # the code of an answer is its command
ALERT = 0
BAUD_RATE = lx16a.BAUD_RATE

_FIRST: dict[Command, int] = {
    Command.ID_READ: 0,
    Command.ANGLE_OFFSET_READ: 1,
    Command.ANGLE_LIMIT_READ: 2,
    Command.VIN_LIMIT_READ: 6,
    Command.TEMP_MAX_LIMIT_READ: 10,
    Command.LED_CTRL_READ: 11,
    Command.LED_ERROR_READ: 12,
    Command.LOAD_OR_UNLOAD_READ: 24,
    Command.MOVE_TIME_READ: 25,
    Command.POS_READ: 31,
    Command.VIN_READ: 39,
    Command.TEMP_READ: 41,
    Command.MOVE_TIME_WAIT_READ: 42,
    Command.MODE_READ: 46,
}  # address of the first byte of what each command reads
_COMMAND_AT = MappingProxyType({(first, READS[command].struct.size): command for command, first in _FIRST.items()})
_WRITTEN_BY = MappingProxyType(
    {
        Command.ID_READ: Command.ID_WRITE,
        Command.ANGLE_OFFSET_READ: Command.ANGLE_OFFSET_ADJUST,
        Command.ANGLE_LIMIT_READ: Command.ANGLE_LIMIT_WRITE,
        Command.VIN_LIMIT_READ: Command.VIN_LIMIT_WRITE,
        Command.TEMP_MAX_LIMIT_READ: Command.TEMP_MAX_LIMIT_WRITE,
        Command.LED_CTRL_READ: Command.LED_CTRL_WRITE,
        Command.LED_ERROR_READ: Command.LED_ERROR_WRITE,
        Command.LOAD_OR_UNLOAD_READ: Command.LOAD_OR_UNLOAD_WRITE,
        Command.MOVE_TIME_READ: Command.MOVE_TIME_WRITE,
        Command.MODE_READ: Command.MODE_WRITE,
    }
)
_WRITES_AT = MappingProxyType({int(write): _FIRST[read] for read, write in _WRITTEN_BY.items()})
_CODE_AT = 4  # place of the command in a packet


def commands_in(address: int, size: int) -> list[tuple[int, int]]:
    """Return address and size [bytes] of what each command reads that shares bytes with a range of addresses."""
    return [(first, count) for first, count in _COMMAND_AT if first < address + size and address < first + count]


def command_at(address: int, size: int) -> int:
    """Return the command that reads these bytes.

    Raises:
        ValueError: No command reads exactly these.
    """
    command = _COMMAND_AT.get((address, size))
    if command is None:
        raise ValueError(f"the bytes of one command expected, found {size} at address {address}")
    return int(command)


def answer_code(request: bytes) -> int:
    """Return the command of the right answer to a request."""
    return request[_CODE_AT]


def answer_start(servo_id: int) -> bytes:
    """Return the bytes with which an answer of a servo begins."""
    return lx16a.HEADER + bytes((servo_id,))


def ping(servo_id: int) -> bytes:
    """Encode a request that every servo answers: that of its id."""
    return lx16a.read(servo_id, Command.ID_READ)


def read(servo_id: int, address: int, size: int) -> bytes:
    """Encode a read of what one command reads; raises ValueError for other bytes."""
    return lx16a.encode(servo_id, command_at(address, size))


def write(servo_id: int, address: int, data: bytes) -> bytes:
    """Encode a write of what one command writes; raises ValueError for other bytes."""
    command = _WRITTEN_BY.get(Command(command_at(address, len(data))))
    if command is None:
        raise ValueError(f"bytes that a command writes expected, found {len(data)} at address {address}")
    return lx16a.encode(servo_id, command, data)


def sync_write(address: int, size: int, rows: Iterable[tuple[int, bytes]]) -> bytes:
    """Encode one write after the other: there is none of several servos."""
    return b"".join(write(servo_id, address, data) for servo_id, data in rows)


def sync_write_rows(address: int, size: int, rows: bytes) -> bytes:
    """Encode the same from rows of an id and `size` bytes each."""
    starts = range(0, len(rows), 1 + size)
    return sync_write(address, size, ((rows[at], rows[at + 1 : at + 1 + size]) for at in starts))


def answer_parser(max_parameters: int) -> PacketParser:
    """Return a parser of answers; the largest number of parameters is that of the commands."""
    return PacketParser()


def instruction_parser() -> PacketParser:
    """Return a parser of instructions, which also returns those with a wrong checksum."""
    return PacketParser(keep_broken=True, instructions=True)


def request(packet: Packet) -> Request | None:
    """Return what an instruction asks; None if an emulated servo does not execute it."""
    code, data = packet.code, packet.parameters
    if code in _FIRST:
        command = Command(code)
        return Request(Kind.READ, _FIRST[command], READS[command].struct.size)
    if code in _WRITES_AT:
        return Request(Kind.WRITE, _WRITES_AT[code], data=data)
    if code == Command.MOVE_TIME_WAIT_WRITE:
        return Request(Kind.REGISTER, _FIRST[Command.MOVE_TIME_READ], data=data)
    return Request(Kind.ACTION) if code == Command.MOVE_START else None


def status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Encode an answer, whose code `error` is its command."""
    body = bytes((servo_id, len(parameters) + 3, error & 0xFF)) + parameters
    return lx16a.HEADER + body + bytes((~sum(body) & 0xFF,))


def error_code(refusal: int, state: int) -> int:
    """Return 0: answers carry no errors."""
    return 0


UNITS = Units(
    centre=lx16a.TICK_CENTRE,
    max_position=lx16a.TICK_MAX,
    tick_rad=lx16a.TICK_RAD,
    speed_rad_s=0.001,  # of the model only
    load=0.001,  # of the model only
    volt=0.001,
    speed_sign=Sign.COMPLEMENT,
    load_sign=Sign.COMPLEMENT,
    torque=0.001,
    position_sign=Sign.COMPLEMENT,
    overrun=math.ceil(math.radians(30.0) / lx16a.TICK_RAD),  # the largest angle offset moves the range by 30 deg
)

_ID = setting("id", 0, 1, 1, 0, MAX_ID, eeprom=True)
_OFFSET = setting("angle offset", 1, 1, 0, 0, 255, eeprom=True)
_LOW = setting("lowest position", 2, 2, 0, 0, lx16a.TICK_MAX, eeprom=True)
_HIGH = setting("highest position", 4, 2, lx16a.TICK_MAX, 0, lx16a.TICK_MAX, eeprom=True)
_MIN_VOLTAGE = setting("min voltage", 6, 2, 4500, 4500, 14_000, eeprom=True)
_MAX_VOLTAGE = setting("max voltage", 8, 2, 12_000, 4500, 14_000, eeprom=True)
_MAX_TEMPERATURE = setting("temperature limit", 10, 1, 85, 50, 100, eeprom=True)
_LED_OFF = setting("led off", 11, 1, 0, 0, 1, eeprom=True)
_LED_FAULTS = setting("led faults", 12, 1, 7, 0, 7, eeprom=True)
_MODEL_NUMBER = measured("model number", 13, 2, eeprom=True)
_FIRMWARE = measured("firmware", 15, 1, eeprom=True)
_BAUD_RATE = measured("baud rate", 16, 1, eeprom=True)
_RETURN_DELAY = measured("return delay", 17, 1, 50, eeprom=True)  # 0.1 ms, assumed
_RETURN_LEVEL = Register("return level", 18, 1, _ID.access, 2, 0, 2, eeprom=True)
_MAX_TORQUE = setting("max torque", 19, 2, 1000, 0, 1000, eeprom=True)
_SHUTDOWN = setting(
    "shutdown", 21, 1, int(ServoError.OVERHEATING | ServoError.INPUT_VOLTAGE), 0, 127, eeprom=True
)  # of a stall, only the LED is published
_TORQUE_ENABLE = setting("torque enable", 24, 1, 0, 0, 1)
_GOAL = setting("goal position", 25, 2, lx16a.TICK_CENTRE, 0, lx16a.TICK_MAX)
_GOAL_TIME = setting("goal time", 27, 2, 0, 0, 30_000)
_GOAL_SPEED = setting("goal speed", 29, 2, 0, 0, 65_535)
_POSITION = measured("present position", 31, 2)
_TORQUE_LIMIT = setting("torque limit", 33, 2, 1000, 0, 1000)
_SPEED = measured("present speed", 35, 2)
_LOAD = measured("present load", 37, 2)
_VOLTAGE = measured("present voltage", 39, 2)
_TEMPERATURE = measured("present temperature", 41, 1)
_WAITING_GOAL = setting("waiting goal position", 42, 2, 0, 0, lx16a.TICK_MAX)
_WAITING_TIME = setting("waiting goal time", 44, 2, 0, 0, 30_000)
_MODE = setting("mode", 46, 1, 0, 0, 1)
_MOTOR_SPEED = setting("motor speed", 48, 2, 0, 0, 65_535)
_MOVING = measured("moving", 50, 1)
_REGISTERED = measured("registered", 51, 1)

# fmt: off
TABLE = ControlTable(
    size=52,
    registers=(
        _ID, _OFFSET, _LOW, _HIGH, _MIN_VOLTAGE, _MAX_VOLTAGE, _MAX_TEMPERATURE, _LED_OFF, _LED_FAULTS, _MODEL_NUMBER,
        _FIRMWARE, _BAUD_RATE, _RETURN_DELAY, _RETURN_LEVEL, _MAX_TORQUE, _SHUTDOWN, _TORQUE_ENABLE, _GOAL, _GOAL_TIME,
        _GOAL_SPEED, _POSITION, _TORQUE_LIMIT, _SPEED, _LOAD, _VOLTAGE, _TEMPERATURE, _WAITING_GOAL, _WAITING_TIME,
        _MODE, _MOTOR_SPEED, _MOVING, _REGISTERED,
    ),
    eeprom=range(24),
    ram=range(24, 52),
    model_number=_MODEL_NUMBER,
    firmware=_FIRMWARE,
    id=_ID,
    baud_rate=_BAUD_RATE,
    return_delay=_RETURN_DELAY,
    status_return_level=_RETURN_LEVEL,
    low_limit=_LOW,
    high_limit=_HIGH,
    temperature_limit=_MAX_TEMPERATURE,
    min_voltage=_MIN_VOLTAGE,
    max_voltage=_MAX_VOLTAGE,
    max_torque=_MAX_TORQUE,
    shutdown=_SHUTDOWN,
    torque_enable=_TORQUE_ENABLE,
    goal_position=_GOAL,
    goal_speed=_GOAL_SPEED,
    torque_limit=_TORQUE_LIMIT,
    present_position=_POSITION,
    present_speed=_SPEED,
    present_load=_LOAD,
    present_voltage=_VOLTAGE,
    present_temperature=_TEMPERATURE,
    moving=_MOVING,
    registered=_REGISTERED,
    goal_time=_GOAL_TIME,
)
# fmt: on
LACKS = frozenset(
    (
        *(_MODEL_NUMBER, _FIRMWARE, _BAUD_RATE, _RETURN_DELAY, _RETURN_LEVEL, _MAX_TORQUE, _SHUTDOWN),
        *(_GOAL_SPEED, _TORQUE_LIMIT, _SPEED, _LOAD, _MOVING, _REGISTERED),
    )
)
RATES = {0: BAUD_RATE}  # [bit/s]
# A servo that is set up has another lowest voltage than the factory's, by 10 mV: nothing else tells it from a new one.
SETTINGS = {_MIN_VOLTAGE.name: 4510}
MASKS = {_MODE.name: (0xFF, int(lx16a.Mode.POSITION))}
