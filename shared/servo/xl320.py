"""Dynamixel XL-320: control table. It has Protocol 2.0, with positions and speeds like those of an AX-12A.

Source: ROBOTIS e-manual, page XL-320.
"""

from sextant.shared.servo.servo_model import ControlTable, ServoError, measured, setting

_MODEL_NUMBER = measured("model number", 0, 2, 350, eeprom=True)
_FIRMWARE = measured("firmware version", 2, 1, 42, eeprom=True)
_ID = setting("id", 3, 1, 1, 0, 252, eeprom=True)
_BAUD_RATE = setting("baud rate", 4, 1, 3, 0, 3, eeprom=True)
_RETURN_DELAY = setting("return delay", 5, 1, 250, 0, 254, eeprom=True)
_CW_LIMIT = setting("cw angle limit", 6, 2, 0, 0, 1023, eeprom=True)
_CCW_LIMIT = setting("ccw angle limit", 8, 2, 1023, 0, 1023, eeprom=True)
_CONTROL_MODE = setting("control mode", 11, 1, 2, 1, 2, eeprom=True)
_TEMPERATURE_LIMIT = setting("temperature limit", 12, 1, 65, 0, 150, eeprom=True)
_MIN_VOLTAGE = setting("min voltage", 13, 1, 60, 50, 250, eeprom=True)
_MAX_VOLTAGE = setting("max voltage", 14, 1, 90, 50, 250, eeprom=True)
_MAX_TORQUE = setting("max torque", 15, 2, 1023, 0, 1023, eeprom=True)
_RETURN_LEVEL = setting("status return level", 17, 1, 2, 0, 2, eeprom=True)
_SHUTDOWN = setting("shutdown", 18, 1, 3, 0, 7, eeprom=True)
_TORQUE_ENABLE = setting("torque enable", 24, 1, 0, 0, 1)
_D = setting("d gain", 27, 1, 0, 0, 254)
_I = setting("i gain", 28, 1, 0, 0, 254)
_P = setting("p gain", 29, 1, 32, 0, 254)
_GOAL_POSITION = setting("goal position", 30, 2, 512, 0, 1023)
_GOAL_SPEED = setting("goal speed", 32, 2, 0, 0, 1023)
_TORQUE_LIMIT = setting("torque limit", 35, 2, 1023, 0, 1023)
_POSITION = measured("present position", 37, 2)
_SPEED = measured("present speed", 39, 2)
_LOAD = measured("present load", 41, 2)
_VOLTAGE = measured("present voltage", 45, 1)
_TEMPERATURE = measured("present temperature", 46, 1)
_REGISTERED = measured("registered instruction", 47, 1)
_MOVING = measured("moving", 49, 1)
_HARDWARE_ERROR = measured("hardware error status", 50, 1)

# fmt: off
TABLE = ControlTable(
    size=53,
    registers=(
        _MODEL_NUMBER, _FIRMWARE, _ID, _BAUD_RATE, _RETURN_DELAY, _CW_LIMIT, _CCW_LIMIT, _CONTROL_MODE, _TEMPERATURE_LIMIT,
        _MIN_VOLTAGE, _MAX_VOLTAGE, _MAX_TORQUE, _RETURN_LEVEL, _SHUTDOWN, _TORQUE_ENABLE, _D, _I, _P, _GOAL_POSITION,
        _GOAL_SPEED, _TORQUE_LIMIT, _POSITION, _SPEED, _LOAD, _VOLTAGE, _TEMPERATURE, _REGISTERED, _MOVING, _HARDWARE_ERROR,
    ),
    eeprom=range(19),
    ram=range(24, 51),
    model_number=_MODEL_NUMBER,
    firmware=_FIRMWARE,
    id=_ID,
    baud_rate=_BAUD_RATE,
    return_delay=_RETURN_DELAY,
    status_return_level=_RETURN_LEVEL,
    low_limit=_CW_LIMIT,
    high_limit=_CCW_LIMIT,
    temperature_limit=_TEMPERATURE_LIMIT,
    min_voltage=_MIN_VOLTAGE,
    max_voltage=_MAX_VOLTAGE,
    max_torque=_MAX_TORQUE,
    shutdown=_SHUTDOWN,
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
    hardware_error=_HARDWARE_ERROR,
    position_gain=_P,
)
# fmt: on
RATES = {0: 9_600, 1: 57_600, 2: 115_200, 3: 1_000_000}  # [bit/s]
SETTINGS = {_CONTROL_MODE.name: 2, _RETURN_LEVEL.name: 2, _RETURN_DELAY.name: 0}
ERROR_BITS = {1 << 0: ServoError.OVERLOAD, 1 << 1: ServoError.OVERHEATING, 1 << 2: ServoError.INPUT_VOLTAGE}
