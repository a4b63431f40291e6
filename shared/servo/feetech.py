"""Feetech STS bus: packets of Dynamixel Protocol 1.0, another control table, and other error bits.

Numbers are little-endian; bit 15 of a position or speed is its sign.

Sources: Feetech's memory table of the STS series, and the register tables of LeRobot (huggingface/lerobot), which cite it.
"""

import math
from collections.abc import Iterable

from sextant.shared.servo import dynamixel
from sextant.shared.servo.dynamixel import (
    ALERT,
    BROADCAST_ID,
    MAX_ID,
    OVERHEAD,
    PING_SIZE,
    answer_parser,
    answer_start,
    instruction_parser,
    ping,
    read,
    status,
    sync_write,
    sync_write_rows,
    write,
)
from sextant.shared.servo.servo_model import ControlTable, Kind, Packet, Request, ServoError, Sign, Units, measured, setting

__all__ = [
    "ALERT",
    "BROADCAST_ID",
    "ERRORS",
    "MAX_ID",
    "NAME",
    "OVERHEAD",
    "PING_SIZE",
    "TABLE",
    "UNITS",
    "answer_parser",
    "answer_start",
    "error_code",
    "instruction_parser",
    "ping",
    "read",
    "request",
    "status",
    "sync_read",
    "sync_write",
    "sync_write_rows",
    "write",
]

NAME = "Feetech STS"
_SYNC_READ = 0x82


def sync_read(address: int, size: int, ids: Iterable[int]) -> bytes:
    """Encode a read of `size` bytes at one address of several servos, which answer in this order."""
    return dynamixel.encode(BROADCAST_ID, _SYNC_READ, bytes((address, size, *ids)))


def request(packet: Packet) -> Request | None:
    """Return what an instruction packet asks; None if no servo can execute it."""
    given = packet.parameters
    if packet.code == _SYNC_READ and packet.servo_id == BROADCAST_ID and len(given) > 2:
        return Request(Kind.SYNC_READ, given[0], given[1], rows=tuple((servo_id, b"") for servo_id in given[2:]))
    return dynamixel.request(packet)


# Bits of an answer and of the status register. A servo does not report a refused instruction.
_BITS = {
    1 << 0: ServoError.INPUT_VOLTAGE,
    1 << 1: ServoError.HARDWARE,  # the position sensor
    1 << 2: ServoError.OVERHEATING,
    1 << 3: ServoError.OVERLOAD,  # too much current
    1 << 5: ServoError.OVERLOAD,
}


def _errors(code: int) -> ServoError:
    error = ServoError.NONE
    for bit, meaning in _BITS.items():
        error |= meaning if code & bit else ServoError.NONE
    return error


ERRORS = tuple(map(_errors, range(256)))


def error_code(refusal: int, state: int) -> int:
    """Return the error bits of an answer, from the errors of the servo's state; those of an instruction are not reported."""
    return sum(bit for bit, meaning in _BITS.items() if bit != 1 << 3 and state & meaning)


UNITS = Units(
    centre=2048,
    max_position=4095,
    tick_rad=2.0 * math.pi / 4096,
    speed_rad_s=2.0 * math.pi / 4096,  # ticks per second
    load=0.001,  # share of the duty cycle
    volt=0.1,
    speed_sign=Sign.BIT_15,
    load_sign=Sign.BIT_10,
    torque=0.001,
    position_sign=Sign.BIT_15,
)

_FIRMWARE = measured("firmware version", 0, 1, 3, eeprom=True)
_MODEL_NUMBER = measured("model number", 3, 2, 777, eeprom=True)
_ID = setting("id", 5, 1, 1, 0, MAX_ID, eeprom=True)
_BAUD_RATE = setting("baud rate", 6, 1, 0, 0, 7, eeprom=True)
_RETURN_DELAY = setting("return delay", 7, 1, 0, 0, 254, eeprom=True)
_RETURN_LEVEL = setting("status return level", 8, 1, 1, 0, 1, eeprom=True)
_MIN_ANGLE = setting("min angle", 9, 2, 0, 0, 4095, eeprom=True)
_MAX_ANGLE = setting("max angle", 11, 2, 4095, 0, 4095, eeprom=True)
_MAX_TEMPERATURE = setting("max temperature", 13, 1, 70, 0, 100, eeprom=True)
_MAX_VOLTAGE = setting("max voltage", 14, 1, 140, 0, 254, eeprom=True)
_MIN_VOLTAGE = setting("min voltage", 15, 1, 40, 0, 254, eeprom=True)
_MAX_TORQUE = setting("max torque", 16, 2, 1000, 0, 1000, eeprom=True)
_PHASE = setting("phase", 18, 1, 12, 0, 254, eeprom=True)
_UNLOADING = setting("unloading condition", 19, 1, 0x2C, 0, 254, eeprom=True)
_LED_ALARM = setting("led alarm condition", 20, 1, 0x2F, 0, 254, eeprom=True)
_P = setting("position p gain", 21, 1, 32, 0, 254, eeprom=True)
_D = setting("position d gain", 22, 1, 32, 0, 254, eeprom=True)
_I = setting("position i gain", 23, 1, 0, 0, 254, eeprom=True)
_CW_DEAD_ZONE = setting("cw dead zone", 26, 1, 1, 0, 32, eeprom=True)
_CCW_DEAD_ZONE = setting("ccw dead zone", 27, 1, 1, 0, 32, eeprom=True)
_PROTECTION_CURRENT = setting("protection current", 28, 2, 511, 0, 2047, eeprom=True)
_OFFSET = setting("position offset", 31, 2, 0, 0, 4095, eeprom=True)
_MODE = setting("mode", 33, 1, 0, 0, 3, eeprom=True)
_PROTECTIVE_TORQUE = setting("protective torque", 34, 1, 20, 0, 100, eeprom=True)
_PROTECTION_TIME = setting("protection time", 35, 1, 200, 0, 254, eeprom=True)
_OVERLOAD_TORQUE = setting("overload torque", 36, 1, 80, 0, 100, eeprom=True)
_TORQUE_ENABLE = setting("torque enable", 40, 1, 0, 0, 1)
_ACCELERATION = setting("acceleration", 41, 1, 0, 0, 254)
_GOAL_POSITION = setting("goal position", 42, 2, 2048, 0, 4095)
_GOAL_TIME = setting("goal time", 44, 2, 0, 0, 1000)
_GOAL_SPEED = setting("goal speed", 46, 2, 0, 0, 32766)
_TORQUE_LIMIT = setting("torque limit", 48, 2, 1000, 0, 1000)
_LOCK = setting("lock", 55, 1, 1, 0, 1)
_POSITION = measured("present position", 56, 2)
_SPEED = measured("present speed", 58, 2)
_LOAD = measured("present load", 60, 2)
_VOLTAGE = measured("present voltage", 62, 1)
_TEMPERATURE = measured("present temperature", 63, 1)
_REGISTERED = measured("registered", 64, 1)
_STATUS = measured("status", 65, 1)
_MOVING = measured("moving", 66, 1)
_CURRENT = measured("present current", 69, 2)

# fmt: off
TABLE = ControlTable(
    size=72,
    registers=(
        _FIRMWARE, _MODEL_NUMBER, _ID, _BAUD_RATE, _RETURN_DELAY, _RETURN_LEVEL, _MIN_ANGLE, _MAX_ANGLE, _MAX_TEMPERATURE,
        _MAX_VOLTAGE, _MIN_VOLTAGE, _MAX_TORQUE, _PHASE, _UNLOADING, _LED_ALARM, _P, _D, _I, _CW_DEAD_ZONE, _CCW_DEAD_ZONE,
        _PROTECTION_CURRENT, _OFFSET, _MODE, _PROTECTIVE_TORQUE, _PROTECTION_TIME, _OVERLOAD_TORQUE, _TORQUE_ENABLE,
        _ACCELERATION, _GOAL_POSITION, _GOAL_TIME, _GOAL_SPEED, _TORQUE_LIMIT, _LOCK, _POSITION, _SPEED, _LOAD, _VOLTAGE,
        _TEMPERATURE, _REGISTERED, _STATUS, _MOVING, _CURRENT,
    ),
    eeprom=range(40),
    ram=range(40, 71),
    model_number=_MODEL_NUMBER,
    firmware=_FIRMWARE,
    id=_ID,
    baud_rate=_BAUD_RATE,
    return_delay=_RETURN_DELAY,
    status_return_level=_RETURN_LEVEL,
    low_limit=_MIN_ANGLE,
    high_limit=_MAX_ANGLE,
    temperature_limit=_MAX_TEMPERATURE,
    min_voltage=_MIN_VOLTAGE,
    max_voltage=_MAX_VOLTAGE,
    max_torque=_MAX_TORQUE,
    shutdown=_UNLOADING,
    torque_enable=_TORQUE_ENABLE,
    goal_position=_GOAL_POSITION,
    goal_speed=_GOAL_SPEED,
    torque_limit=_TORQUE_LIMIT,
    present_position=_POSITION,
    present_speed=_SPEED,
    present_load=_LOAD,
    present_voltage=_VOLTAGE,
    present_temperature=_TEMPERATURE,
    moving=_MOVING,
    registered=_REGISTERED,
    lock=_LOCK,
    position_gain=_P,
)
# fmt: on
RATES = {0: 1_000_000, 1: 500_000, 2: 250_000, 3: 128_000, 4: 115_200, 5: 76_800, 6: 57_600, 7: 38_400}  # [bit/s]
