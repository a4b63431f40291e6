"""Dynamixel X series, models X430 and XM540: control table of Protocol 2.0 and its units.

The XM430 and the XM540 measure and limit their current: `CURRENT_TABLE`. The others have a limit of the duty cycle only.

Sources: ROBOTIS e-manual, pages XL430-W250, XC430-W150, XC430-W240, XM430-W350 and XM540-W270.
"""

import math
from dataclasses import replace

from sextant.shared.servo.servo_model import ControlTable, Sign, Units, measured, setting

MAX_PWM = 885  # [ticks] of the goal PWM, all of the voltage
FAST_FIRMWARE = 45  # from which servos answer a fast sync read; older ones are read with a sync read
CURRENT_A = 0.00269  # [A] per tick of the present current, the goal current and the current limit
MOST_CURRENT = 2047  # [ticks] of the current limit
POSITION_MODE, CURRENT_MODE = 3, 5  # operating modes: position control, current-based position control
UNITS = Units(
    centre=2048,
    max_position=4095,
    tick_rad=2.0 * math.pi / 4096,
    speed_rad_s=0.229 * 2.0 * math.pi / 60.0,
    load=0.001,
    volt=0.1,
    speed_sign=Sign.COMPLEMENT,
    load_sign=Sign.COMPLEMENT,
    torque=1.0 / MAX_PWM,
    position_sign=Sign.COMPLEMENT,
)

_MODEL_NUMBER = measured("model number", 0, 2, 1060, eeprom=True)
_FIRMWARE = measured("firmware version", 6, 1, 47, eeprom=True)
_ID = setting("id", 7, 1, 1, 0, 252, eeprom=True)
_BAUD_RATE = setting("baud rate", 8, 1, 1, 0, 7, eeprom=True)
_RETURN_DELAY = setting("return delay", 9, 1, 250, 0, 254, eeprom=True)
_DRIVE_MODE = setting("drive mode", 10, 1, 0, 0, 13, eeprom=True)
_OPERATING_MODE = setting("operating mode", 11, 1, 3, 0, 16, eeprom=True)
_HOMING_OFFSET = setting("homing offset", 20, 4, 0, 0, 0xFFFF_FFFF, eeprom=True)
_TEMPERATURE_LIMIT = setting("temperature limit", 31, 1, 72, 0, 100, eeprom=True)
_MAX_VOLTAGE = setting("max voltage", 32, 2, 140, 60, 160, eeprom=True)
_MIN_VOLTAGE = setting("min voltage", 34, 2, 60, 60, 160, eeprom=True)
_PWM_LIMIT = setting("pwm limit", 36, 2, MAX_PWM, 0, MAX_PWM, eeprom=True)
_VELOCITY_LIMIT = setting("velocity limit", 44, 4, 265, 0, 1023, eeprom=True)
_MAX_POSITION = setting("max position limit", 48, 4, 4095, 0, 4095, eeprom=True)
_MIN_POSITION = setting("min position limit", 52, 4, 0, 0, 4095, eeprom=True)
_STARTUP = setting("startup configuration", 60, 1, 0, 0, 3, eeprom=True)  # bit 0: torque on by itself
_SHUTDOWN = setting("shutdown", 63, 1, 0x34, 0, 0x3D, eeprom=True)
_TORQUE_ENABLE = setting("torque enable", 64, 1, 0, 0, 1)
_RETURN_LEVEL = setting("status return level", 68, 1, 2, 0, 2)
_REGISTERED = measured("registered instruction", 69, 1)
_HARDWARE_ERROR = measured("hardware error status", 70, 1)
_POSITION_D = setting("position d gain", 80, 2, 0, 0, 16383)
_POSITION_I = setting("position i gain", 82, 2, 0, 0, 16383)
_POSITION_P = setting("position p gain", 84, 2, 800, 0, 16383)
_WATCHDOG = setting("bus watchdog", 98, 1, 0, 0, 127)
_GOAL_PWM = setting("goal pwm", 100, 2, MAX_PWM, 0, MAX_PWM)
_PROFILE_ACCELERATION = setting("profile acceleration", 108, 4, 0, 0, 32767)
_PROFILE_VELOCITY = setting("profile velocity", 112, 4, 0, 0, 32767)
_GOAL_POSITION = setting("goal position", 116, 4, 2048, 0, 4095)
_MOVING = measured("moving", 122, 1)
_LOAD = measured("present load", 126, 2)  # of the XM430 and XM540: present current
_VELOCITY = measured("present velocity", 128, 4)
_POSITION = measured("present position", 132, 4)
_VOLTAGE = measured("present input voltage", 144, 2)
_TEMPERATURE = measured("present temperature", 146, 1)

# fmt: off
TABLE = ControlTable(
    size=148,
    registers=(
        _MODEL_NUMBER, _FIRMWARE, _ID, _BAUD_RATE, _RETURN_DELAY, _DRIVE_MODE, _OPERATING_MODE, _HOMING_OFFSET,
        _TEMPERATURE_LIMIT, _MAX_VOLTAGE, _MIN_VOLTAGE, _PWM_LIMIT, _VELOCITY_LIMIT, _MAX_POSITION, _MIN_POSITION, _STARTUP,
        _SHUTDOWN, _TORQUE_ENABLE, _RETURN_LEVEL, _REGISTERED, _HARDWARE_ERROR, _POSITION_D, _POSITION_I, _POSITION_P,
        _WATCHDOG, _GOAL_PWM, _PROFILE_ACCELERATION, _PROFILE_VELOCITY, _GOAL_POSITION, _MOVING, _LOAD, _VELOCITY, _POSITION,
        _VOLTAGE, _TEMPERATURE,
    ),
    eeprom=range(64),
    ram=range(64, 147),
    model_number=_MODEL_NUMBER,
    firmware=_FIRMWARE,
    id=_ID,
    baud_rate=_BAUD_RATE,
    return_delay=_RETURN_DELAY,
    status_return_level=_RETURN_LEVEL,
    low_limit=_MIN_POSITION,
    high_limit=_MAX_POSITION,
    temperature_limit=_TEMPERATURE_LIMIT,
    min_voltage=_MIN_VOLTAGE,
    max_voltage=_MAX_VOLTAGE,
    max_torque=_PWM_LIMIT,
    shutdown=_SHUTDOWN,
    torque_enable=_TORQUE_ENABLE,
    goal_position=_GOAL_POSITION,
    goal_speed=_PROFILE_VELOCITY,
    torque_limit=_GOAL_PWM,
    present_position=_POSITION,
    present_speed=_VELOCITY,
    present_load=_LOAD,
    present_voltage=_VOLTAGE,
    present_temperature=_TEMPERATURE,
    moving=_MOVING,
    registered=_REGISTERED,
    hardware_error=_HARDWARE_ERROR,
    operating_mode=_OPERATING_MODE,
    position_gain=_POSITION_P,
)
# fmt: on
# In current-based position control the goal current limits the torque, and the position limits have no effect.
_CURRENT_LIMIT = setting("current limit", 38, 2, 1193, 0, MOST_CURRENT, eeprom=True)
_GOAL_CURRENT = setting("goal current", 102, 2, 1193, 0, MOST_CURRENT)
CURRENT_TABLE = replace(
    TABLE, registers=(*TABLE.registers, _CURRENT_LIMIT, _GOAL_CURRENT), max_torque=_CURRENT_LIMIT, torque_limit=_GOAL_CURRENT
)
RATES = {
    0: 9_600,
    1: 57_600,
    2: 115_200,
    3: 1_000_000,
    4: 2_000_000,
    5: 3_000_000,
    6: 4_000_000,
    7: 4_500_000,
}  # fmt: skip  # [bit/s]
GOAL_PWM, PWM_LIMIT = _GOAL_PWM, _PWM_LIMIT
SETTINGS = {
    _OPERATING_MODE.name: POSITION_MODE,
    _DRIVE_MODE.name: 0,
    _STARTUP.name: 0,
    _RETURN_LEVEL.name: 2,
    _RETURN_DELAY.name: 0,
}
CURRENT_SETTINGS = {**SETTINGS, _OPERATING_MODE.name: CURRENT_MODE}
