"""Hobby servos that are moved by pulses and report nothing.

A board such as a Pololu Maestro sends the pulses. The width of a pulse is the goal, and without pulses a servo has no torque.
So the driver keeps what servos on a bus have in their control tables: goal, torque and the speed towards the goal. `TABLE`
gives these settings the form of registers, which no servo has.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Literal, NamedTuple, cast

from sextant.shared.files import config
from sextant.shared.servo import pca9685
from sextant.shared.servo.servo_model import (
    BusProtocol,
    ControlTable,
    Feedback,
    ServoError,
    ServoModel,
    Sign,
    Units,
    measured,
    setting,
)

NAME = "PWM"  # of the model in a profile
TICKS_PER_US = 4  # position ticks in a microsecond, the resolution of a Maestro
SPEED_TICKS_S = 100.0  # [ticks/s] unit of the goal speed: 0.25 us in 10 ms, that of a Maestro
_WIDEST_RAD = math.pi  # largest angle of any servo, either way
_RATES = MappingProxyType({"maestro": 115_200, "pca9685": 1_000_000})  # [bit/s] of the board's serial line, or emulated port

Board = Literal["maestro", "pca9685"]
USUAL_PORTS = MappingProxyType({"maestro": "/dev/ttyACM0", "pca9685": "/dev/i2c-1"})


@dataclass(frozen=True, slots=True)
class Pulses:
    """Pulses for hobby servos, and the board that sends them. The ids of the servos are the channels of the board."""

    board: Board  # two PCA9685 have the channels 0 to 15 and 16 to 31
    us_per_rad: float  # [us/rad] change of the pulse width per servo angle
    centre_us: float = 1500.0  # [us] pulse width at servo angle 0
    range_us: float = 1000.0  # [us] largest change of the pulse width, either way from the centre
    dead_band_us: float = 3.0  # [us] change of the pulse width that a servo ignores, by its data sheet
    rate_hz: float = 50.0  # [Hz] of the pulses; analog servos need 50 Hz. That of a Maestro is set in its Control Center
    device: int = 0  # device number of a Maestro, 0: compact protocol; address of the first PCA9685, 0: 0x40
    oscillator_mhz: float = 25.0  # of a PCA9685; it is some percent off, and the pulses with it

    checks = (
        *config.each("us_per_rad", lambda width: 50 <= width <= 5000, "50 to 5000 us/rad"),
        *config.each("centre_us", lambda width: 500 <= width <= 2500, "500 to 2500 us"),
        *config.each("range_us", lambda width: 100 <= width <= 1500, "100 to 1500 us"),
        *config.each("dead_band_us", lambda width: 0 <= width <= 50, "0 to 50 us"),
        *config.each("rate_hz", lambda rate: 40 <= rate <= 333, "40 to 333 Hz"),
        *config.each("device", lambda device: 0 <= device <= 0x7E, "a device number or I2C address of at most 0x7e"),
        *config.each("oscillator_mhz", lambda rate: 20 <= rate <= 30, "20 to 30 MHz"),
        config.together("centre_us range_us", lambda centre, most: centre - most >= 64, "pulses of at least 64 us"),
        config.together(
            "range_us us_per_rad", lambda most, per_rad: most / per_rad <= _WIDEST_RAD, "a range of at most 180 deg either way"
        ),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def of_board(self) -> tuple[str | int, ...]:
        """Setting `PULSES` of a microcontroller behind which the board sends these pulses."""
        whole = (round(1000 * self.us_per_rad), round(self.centre_us), round(self.range_us), round(self.rate_hz))
        if self.board == "maestro":
            return ("Maestro", *whole, self.device)
        return ("PCA9685", *whole, round(1000 * self.oscillator_mhz), self.device or pca9685.ADDRESS)

    @property
    def shortest_us(self) -> float:
        """Shortest pulse [us], that of position 0."""
        return self.centre_us - self.range_us

    def width_us(self, ticks: float) -> float:
        """Return the pulse width [us] of a position [ticks]."""
        return self.shortest_us + ticks / TICKS_PER_US

    def ticks(self, width_us: float) -> int:
        """Return the nearest position [ticks] of a pulse width [us]; the inverse of `width_us`."""
        return round((width_us - self.shortest_us) * TICKS_PER_US)


class _Channels(NamedTuple):
    """Properties that a board shares with a bus. It carries no packets."""

    NAME: str
    MAX_ID: int  # last channel


_CHANNELS = {"maestro": _Channels("Pololu Maestro", 23), "pca9685": _Channels("PCA9685", 31)}
_MOST_TICKS = 2 * 1500 * TICKS_PER_US

_MODEL = measured("model number", 0, 2)
_FIRMWARE = measured("firmware", 2, 1)
_ID = setting("channel", 3, 1, 0, 0, 253, eeprom=True)
_BAUD_RATE = setting("baud rate", 4, 1, 0, 0, 0, eeprom=True)
_RETURN_DELAY = setting("return delay", 5, 1, 0, 0, 0, eeprom=True)
_RETURN_LEVEL = setting("status return level", 6, 1, 2, 2, 2, eeprom=True)
_LOW_LIMIT = setting("low limit", 7, 2, 0, 0, _MOST_TICKS, eeprom=True)
_HIGH_LIMIT = setting("high limit", 9, 2, _MOST_TICKS, 0, _MOST_TICKS, eeprom=True)
_TEMPERATURE_LIMIT = setting("temperature limit", 11, 1, 255, 0, 255, eeprom=True)
_MIN_VOLTAGE = setting("min voltage", 12, 1, 0, 0, 255, eeprom=True)
_MAX_VOLTAGE = setting("max voltage", 13, 1, 255, 0, 255, eeprom=True)
_MAX_TORQUE = setting("max torque", 14, 1, 1, 0, 1, eeprom=True)
_SHUTDOWN = setting("shutdown", 15, 1, 0, 0, 0, eeprom=True)
_TORQUE_ENABLE = setting("pulses", 16, 1, 0, 0, 1)
_GOAL = setting("goal", 17, 2, 0, 0, _MOST_TICKS)
_GOAL_SPEED = setting("goal speed", 19, 2, 0, 0, 0xFFFF)
_TORQUE_LIMIT = setting("torque limit", 21, 1, 1, 0, 1)
_POSITION = measured("position", 22, 2)
_SPEED = measured("speed", 24, 2)
_LOAD = measured("load", 26, 2)
_VOLTAGE = measured("voltage", 28, 1)
_TEMPERATURE = measured("temperature", 29, 1)
_MOVING = measured("moving", 30, 1)
_REGISTERED = measured("registered", 31, 1)

TABLE = ControlTable(
    size=32,
    registers=(
        *(_MODEL, _FIRMWARE, _ID, _BAUD_RATE, _RETURN_DELAY, _RETURN_LEVEL, _LOW_LIMIT, _HIGH_LIMIT, _TEMPERATURE_LIMIT),
        *(_MIN_VOLTAGE, _MAX_VOLTAGE, _MAX_TORQUE, _SHUTDOWN, _TORQUE_ENABLE, _GOAL, _GOAL_SPEED, _TORQUE_LIMIT),
        *(_POSITION, _SPEED, _LOAD, _VOLTAGE, _TEMPERATURE, _MOVING, _REGISTERED),
    ),
    eeprom=range(16),
    ram=range(16, 32),
    model_number=_MODEL,
    firmware=_FIRMWARE,
    id=_ID,
    baud_rate=_BAUD_RATE,
    return_delay=_RETURN_DELAY,
    status_return_level=_RETURN_LEVEL,
    low_limit=_LOW_LIMIT,
    high_limit=_HIGH_LIMIT,
    temperature_limit=_TEMPERATURE_LIMIT,
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
)


@lru_cache(maxsize=16)
def model_of(pulses: Pulses) -> ServoModel:
    """Return the model of servos that receive these pulses."""
    tick_rad = 1.0 / (TICKS_PER_US * pulses.us_per_rad)
    centre = round(pulses.range_us * TICKS_PER_US)
    units = Units(
        centre=centre,
        max_position=2 * centre,
        tick_rad=tick_rad,
        speed_rad_s=tick_rad * SPEED_TICKS_S,
        load=1.0 / 1000.0,
        volt=0.1,
        speed_sign=Sign.COMPLEMENT,
        load_sign=Sign.COMPLEMENT,
        torque=1.0,
    )
    return ServoModel(
        NAME,
        0,
        cast(BusProtocol, _CHANNELS[pulses.board]),
        TABLE,
        units,
        MappingProxyType({0: _RATES[pulses.board]}),
        MappingProxyType({}),
        no_load_rpm=0.0,  # that of the profile counts
        overrides=MappingProxyType({_GOAL.name: centre, _HIGH_LIMIT.name: 2 * centre}),
        errors=ServoError.NONE,
        feedback=Feedback.NONE,
        bus_rate=_RATES[pulses.board],
    )
