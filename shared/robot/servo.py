"""Servos of a robot profile: data sheet, settings of the position controller, and battery."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

from sextant.shared.files import config
from sextant.shared.servo import pwm
from sextant.shared.servo.custom_model import ModelNumbers, custom_model
from sextant.shared.servo.dynamixel import full_torque_ticks
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import Register, ServoModel

_FULL_CELL_V, _WARN_CELL_V, _EMPTY_CELL_V = 4.2, 3.5, 3.3  # [V] of a lithium polymer cell, open circuit
WARM_K = 12.0  # [K] below the temperature limit of the servos, from where the robot walks slower


def known_model(name: str | None, numbers: ModelNumbers | None, pulses: pwm.Pulses | None) -> ServoModel | None:
    """Return the servo model with a name; None if it is unknown, and neither its numbers nor its pulses are stated."""
    if isinstance(pulses, pwm.Pulses):
        return pwm.model_of(pulses)
    return MODEL_NAMED.get(name or "") if numbers is None else custom_model(name or "", numbers)


def _unknown_model(model: str, numbers: ModelNumbers | None, pulses: pwm.Pulses | None) -> Iterator[config.Misfit]:
    """Yield a model that is not known and has no numbers, or one that is known and has some; hobby servos have pulses."""
    if (model == pwm.NAME) != (pulses is not None):
        expected = f"a table [servo.pulses] with the model {pwm.NAME}, and with no other,"
        yield config.Misfit("model", expected, repr(model))
        return
    if pulses is not None:
        return
    if numbers is None and model not in MODEL_NAMED:
        known = ", ".join(MODEL_NAMED)
        yield config.Misfit(
            "model",
            f"one of {known}, or another with its numbers in [servo.numbers], or {pwm.NAME} for hobby servos,",
            repr(model),
        )
    elif numbers is not None and model in MODEL_NAMED:
        yield config.Misfit("model", "a name that no known model has, since [servo.numbers] is stated,", repr(model))


def _wrong_controller(
    model: str, numbers: ModelNumbers | None, pulses: pwm.Pulses | None, compliance_slope: int, position_gain: int
) -> Iterator[config.Misfit]:
    """Yield the setting of the position controller that a servo of this model lacks, or does not have."""
    found = known_model(model, numbers, pulses)
    if pulses is not None and (compliance_slope or position_gain):
        yield config.Misfit("model", f"no compliance slope and no position gain for {model} servos", "one")
    if found is None or pulses is not None:
        return
    table = found.table
    has_slope = bool(table.compliance)
    needed, other = ("compliance_slope", "position_gain") if has_slope else ("position_gain", "compliance_slope")
    values = {"compliance_slope": compliance_slope, "position_gain": position_gain}
    needed_words, other_words = (name.replace("_", " ") for name in (needed, other))
    if not has_slope and table.position_gain is None:
        for name, value in values.items():
            if value:
                yield config.Misfit(name, f"no {name.replace('_', ' ')} for {model} servos, which have none,", str(value))
        return
    if not values[needed]:
        factory = found.default(table.compliance[-1] if has_slope else cast(Register, table.position_gain))
        yield config.Misfit(needed, f"a {needed_words} for {model} servos ({factory} from the factory)", "none")
    if values[other]:
        expected = f"no {other_words} for {model} servos, which have a {needed_words},"
        yield config.Misfit(other, expected, str(values[other]))


@dataclass(frozen=True, slots=True)
class Servo:
    """Data sheet of the servos of all joints that are in none of the `servo_groups`."""

    model: str  # of these servos, one of `sextant.shared.servo.models`, or another with its `numbers`
    stall_torque: float  # [N m] torque at standstill
    no_load_speed: float  # [rad/s] speed without torque
    stiffness: float  # [N m/rad] torque per position error at the profile's compliance slope or position gain
    armature: float  # [kg m^2] reflected rotor inertia; unknown for most servos, so tests vary it
    friction: float  # [N m] dry friction
    compliance_slope: int = 0  # of AX and RX servos, registers 28 and 29; 0 for others
    position_gain: int = 0  # proportional gain of the position controller of other servos
    pulses: pwm.Pulses | None = None  # of hobby servos, model "PWM", and the board that sends them
    temperature_limit: float = 70.0  # [deg C] at which a servo shuts itself down
    lock_eeprom: bool = True  # after setup, id, baud rate and limits are read-only until the servo loses power
    numbers: ModelNumbers | None = None  # of a model that is not known

    checks = (
        *config.each("stall_torque no_load_speed stiffness", lambda value: 0 < value <= 1e4, "more than 0 and at most 10000"),
        *config.each("armature friction", lambda value: 0 <= value <= 100, "0 to 100"),
        *config.each("temperature_limit", lambda limit: 40 <= limit <= 99, "40 to 99 deg C"),
        config.Check(("model", "numbers", "pulses"), _unknown_model),
        *config.each("compliance_slope", lambda slope: 0 <= slope <= 254, "a compliance slope from 1 to 254"),
        *config.each("position_gain", lambda gain: 0 <= gain <= 16383, "a position gain from 1 to 16383"),
        config.Check(("model", "numbers", "pulses", "compliance_slope", "position_gain"), _wrong_controller),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def servo_model(self) -> ServoModel:
        """Registers and units of the servos."""
        found = known_model(self.model, self.numbers, self.pulses)
        assert found is not None
        return found

    def usual_port(self, *, bridge: bool = False) -> str:
        """Return the device at which these servos usually are, or at which a microcontroller is that drives hobby servos."""
        if self.pulses is None:
            return "/dev/ttyUSB0"
        return pwm.USUAL_PORTS["maestro" if bridge else self.pulses.board]

    @property
    def controller_settings(self) -> dict[Register, int]:
        """Settings of the servo's position controller, by register."""
        table = self.servo_model.table
        if table.position_gain is not None:
            return {table.position_gain: self.position_gain}
        return dict.fromkeys(table.compliance[2:], self.compliance_slope)

    @property
    def nominal_stiffness(self) -> float:
        """Stiffness [N m/rad] of the model's position controller at these settings, by its data sheet."""
        model = self.servo_model
        if model.table.position_gain is not None:
            return self.stall_torque * self.position_gain * model.gain_stiffness
        if not model.table.compliance:
            return self.stiffness
        return self.stall_torque / (full_torque_ticks(self.compliance_slope) * model.units.tick_rad)

    @property
    def warm_temperature(self) -> float:
        """Temperature [deg C] from which the robot walks slower."""
        return self.temperature_limit - WARM_K

    @property
    def damping(self) -> float:
        """Joint damping [N m s/rad] of a linear torque-speed curve.

        The curve goes from the stall torque to the no-load speed.
        """
        return self.stall_torque / self.no_load_speed


@dataclass(frozen=True, slots=True)
class Battery:
    """Voltage limits of the servo battery.

    The defaults are for three lithium polymer cells.
    """

    warn_voltage: float = 10.5  # [V] below this the walk should end
    empty_voltage: float = 9.9  # [V] below this the robot sits down and turns torque off

    checks = (
        config.together(
            "warn_voltage empty_voltage",
            lambda warn, empty: 0 < empty <= warn <= 100,
            "an empty_voltage of more than 0 V and at most warn_voltage, which is at most 100 V,",
        ),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @staticmethod
    def of_volts(volts: float) -> "Battery":
        """Return the limits for the lithium polymer cells in series that supply a voltage [V]."""
        cells = math.ceil(volts / _FULL_CELL_V)
        return Battery(round(cells * _WARN_CELL_V, 1), round(cells * _EMPTY_CELL_V, 1))

    @property
    def full_voltage(self) -> float:
        """Voltage [V] of the full battery, if it consists of lithium polymer cells."""
        return round(self.empty_voltage * _FULL_CELL_V / _EMPTY_CELL_V, 2)
