"""Feetech SCS bus: packets and error bits of the STS bus, another control table, and numbers with the high byte first.

These servos measure their position with a potentiometer. They answer no read of several servos, and have no torque limit
besides that in their EEPROM.

Sources: Feetech's memory table of the SCS series (FD1.9.8), the register tables of LeRobot (huggingface/lerobot), which cite it
and give the model number, and the header SCSCL.h of Feetech's library for the signs.
"""

import math
from dataclasses import replace

from sextant.shared.servo import feetech
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
    request,
    status,
    sync_write,
    sync_write_rows,
    write,
)
from sextant.shared.servo.feetech import ERRORS, error_code
from sextant.shared.servo.servo_model import ControlTable, Register, Sign, Units, measured, setting

__all__ = [
    "ALERT",
    "BROADCAST_ID",
    "ERRORS",
    "MAX_ID",
    "NAME",
    "OVERHEAD",
    "PING_SIZE",
    "RATES",
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
    "sync_write",
    "sync_write_rows",
    "write",
]

NAME = "Feetech SCS"
RATES = feetech.RATES
_TICK_RAD = math.radians(300.0) / 1024
UNITS = Units(
    centre=512,
    max_position=1023,
    tick_rad=_TICK_RAD,
    speed_rad_s=_TICK_RAD,  # ticks per second
    load=0.001,  # share of the duty cycle
    volt=0.1,
    speed_sign=Sign.BIT_15,
    load_sign=Sign.BIT_10,
    torque=0.001,
)


def _word(register: Register) -> Register:
    """Return a register whose high byte is first."""
    return replace(register, order="big")


_FIRMWARE = measured("firmware version", 1, 1, 1, eeprom=True)
_MODEL_NUMBER = _word(measured("model number", 3, 2, 1284, eeprom=True))
_ID = setting("id", 5, 1, 1, 0, MAX_ID, eeprom=True)
_BAUD_RATE = setting("baud rate", 6, 1, 0, 0, 7, eeprom=True)
_RETURN_DELAY = setting("return delay", 7, 1, 0, 0, 254, eeprom=True)
_RETURN_LEVEL = setting("status return level", 8, 1, 1, 0, 1, eeprom=True)
_MIN_ANGLE = _word(setting("min angle", 9, 2, 20, 0, 1023, eeprom=True))
_MAX_ANGLE = _word(setting("max angle", 11, 2, 1003, 0, 1023, eeprom=True))
_MAX_TEMPERATURE = setting("max temperature", 13, 1, 80, 0, 100, eeprom=True)
_MAX_VOLTAGE = setting("max voltage", 14, 1, 90, 0, 254, eeprom=True)
_MIN_VOLTAGE = setting("min voltage", 15, 1, 45, 0, 254, eeprom=True)
_MAX_TORQUE = _word(setting("max torque", 16, 2, 1000, 0, 1000, eeprom=True))
_PHASE = setting("phase", 18, 1, 0, 0, 254, eeprom=True)
_UNLOADING = setting("unloading condition", 19, 1, 0x24, 0, 254, eeprom=True)
_LED_ALARM = setting("led alarm condition", 20, 1, 0x25, 0, 254, eeprom=True)
_P = setting("position p gain", 21, 1, 15, 0, 254, eeprom=True)
_D = setting("position d gain", 22, 1, 15, 0, 254, eeprom=True)
_I = setting("position i gain", 23, 1, 0, 0, 254, eeprom=True)
_MIN_FORCE = _word(setting("minimum startup force", 24, 2, 30, 0, 1000, eeprom=True))
_CW_DEAD_ZONE = setting("cw dead zone", 26, 1, 1, 0, 32, eeprom=True)
_CCW_DEAD_ZONE = setting("ccw dead zone", 27, 1, 1, 0, 32, eeprom=True)
_PROTECTIVE_TORQUE = setting("protective torque", 37, 1, 20, 0, 100, eeprom=True)
_PROTECTION_TIME = setting("protection time", 38, 1, 100, 0, 254, eeprom=True)
_OVERLOAD_TORQUE = setting("overload torque", 39, 1, 80, 0, 100, eeprom=True)
_TORQUE_ENABLE = setting("torque enable", 40, 1, 0, 0, 2)
_GOAL_POSITION = _word(setting("goal position", 42, 2, 512, 0, 1023))
_GOAL_TIME = _word(setting("goal time", 44, 2, 0, 0, 1000))
_GOAL_SPEED = _word(setting("goal speed", 46, 2, 0, 0, 32766))
_LOCK = setting("lock", 48, 1, 0, 0, 1)
_POSITION = _word(measured("present position", 56, 2))
_SPEED = _word(measured("present speed", 58, 2))
_LOAD = _word(measured("present load", 60, 2))
_VOLTAGE = measured("present voltage", 62, 1)
_TEMPERATURE = measured("present temperature", 63, 1)
_REGISTERED = measured("registered", 64, 1)
_STATUS = measured("status", 65, 1)
_MOVING = measured("moving", 66, 1)
_TORQUE_LIMIT = replace(_MAX_TORQUE, name="torque limit")  # there is no other one
LACKS = frozenset((_TORQUE_LIMIT,))

# fmt: off
TABLE = ControlTable(
    size=70,
    registers=(
        _FIRMWARE, _MODEL_NUMBER, _ID, _BAUD_RATE, _RETURN_DELAY, _RETURN_LEVEL, _MIN_ANGLE, _MAX_ANGLE, _MAX_TEMPERATURE,
        _MAX_VOLTAGE, _MIN_VOLTAGE, _MAX_TORQUE, _PHASE, _UNLOADING, _LED_ALARM, _P, _D, _I, _MIN_FORCE, _CW_DEAD_ZONE,
        _CCW_DEAD_ZONE, _PROTECTIVE_TORQUE, _PROTECTION_TIME, _OVERLOAD_TORQUE, _TORQUE_ENABLE, _GOAL_POSITION, _GOAL_TIME,
        _GOAL_SPEED, _LOCK, _POSITION, _SPEED, _LOAD, _VOLTAGE, _TEMPERATURE, _REGISTERED, _STATUS, _MOVING,
    ),
    eeprom=range(40),
    ram=range(40, 67),
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
