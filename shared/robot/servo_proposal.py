"""Proposed servo data of a profile: by the model of the servos and their voltage, by a file, or by another profile."""

import math
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast, get_args

from sextant.shared.files import config
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.servo import Battery, Servo, known_model
from sextant.shared.servo import pwm
from sextant.shared.servo.custom_model import ModelNumbers
from sextant.shared.servo.dynamixel import full_torque_ticks
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import ServoModel
from sextant.shared.spelling import hint

# [N m] stall torque of each model at its usual voltage: 14.8 V for the RX-64, 11.1 V for XL430 and HX-35H, 7.4 V for XL-320 and
# LX-16A, 6 V for SCS0009, and 12 V for the others.
STALL_TORQUES = MappingProxyType(
    {
        "AX-12A": 1.5,
        "AX-18A": 1.8,
        "AX-12W": 0.2,
        "RX-28": 2.96,
        "RX-64": 4.24,
        "MX-28": 2.5,
        "MX-64": 6.0,
        "XL-320": 0.39,
        "XL430-W250": 1.4,
        "XC430-W150": 1.6,
        "XC430-W240": 1.9,
        "XM430-W350": 4.1,
        "XM540-W270": 10.6,
        "STS3215": 2.94,
        "SCS0009": 0.226,
        "LX-16A": 1.67,
        "HX-35H": 3.43,
    }
)
# [V] -> stall torque [N m] and no-load speed [rpm] of servos with several voltages, or sold for several, the usual one first.
# ROBOTIS e-manual; of the RX servos it states 18.5 V, and 14.8 V is in proportion, as for a DC motor. Feetech sells the STS3215
# for 12 V (30 kg cm, 0.222 s for 60 deg) and for 7.4 V (19.5 kg cm, 0.192 s).
AT_VOLTS = MappingProxyType(
    {
        "RX-28": {14.8: (2.96, 68.0)},
        "RX-64": {14.8: (4.24, 51.2)},
        "MX-28": {12.0: (2.5, 55.0), 11.1: (2.3, 50.0), 14.8: (3.1, 67.0)},
        "MX-64": {12.0: (6.0, 63.0), 11.1: (5.5, 58.0), 14.8: (7.3, 78.0)},
        "XL430-W250": {11.1: (1.4, 57.0), 9.0: (1.0, 47.0), 12.0: (1.5, 61.0)},
        "XC430-W150": {12.0: (1.6, 106.0), 11.1: (1.4, 99.0), 9.0: (1.2, 80.0)},
        "XC430-W240": {12.0: (1.9, 70.0), 11.1: (1.7, 65.0), 9.0: (1.4, 52.0)},
        "XM430-W350": {12.0: (4.1, 46.0), 11.1: (3.8, 43.0), 14.8: (4.8, 57.0)},
        "XM540-W270": {12.0: (10.6, 30.0), 11.1: (10.0, 28.0), 14.8: (12.9, 37.0)},
        "STS3215": {12.0: (2.94, 45.0), 7.4: (1.91, 52.0)},
    }
)
_USUAL_VOLTS = MappingProxyType({"XL-320": 7.4, "LX-16A": 7.4, "SCS0009": 6.0})  # without entry above; for others 12 V
_ARMATURE_PER_NM, _FRICTION_PER_NM = 0.002, 0.02  # [kg m^2] and [N m] per N m of stall torque, assumed: those of the AX-12A
# [kg m^2] armature and [N m] friction of servos that were identified: the STS3215 for Open Duck Mini
_IDENTIFIED = MappingProxyType({"STS3215": (0.028, 0.052)})
_DIGITS = 4
BOARDS = get_args(pwm.Board)  # of hobby servos
_HOBBY = "printed_ds3218"  # profile with hobby servos
_LIKENESS = 0.65  # [1] of a model to suggest: an STS3215 is no suggestion for a DS3218, a hobby servo


def nearest_servo(stall_torque: float | None) -> str:
    """Return the servo model whose stall torque [N m] is nearest in proportion; the AX-12A if it is unknown."""
    if stall_torque is None:
        return "AX-12A"
    return min(STALL_TORQUES, key=lambda model: abs(math.log(stall_torque / STALL_TORQUES[model])))


def proposed_servo(name: str, stall_torque: float | None = None, volts: float | None = None) -> Servo:
    """Return a servo with the data sheet of a model, the gain of its factory, friction and armature.

    These two are assumed in proportion to the torque, unless they were identified.

    Args:
        name: The model.
        stall_torque: [N m] that at the model's usual voltage, or at `volts`, unless it is given.
        volts: [V] voltage for which the maker states torque and speed, see `AT_VOLTS`; None is the usual one.

    Raises:
        ConfigError: The maker states no torque for the voltage.
    """
    model, torque, speed = MODEL_NAMED[name], STALL_TORQUES[name], MODEL_NAMED[name].no_load_speed
    known = AT_VOLTS.get(name, {})
    if volts is not None and volts not in known:
        stated = ", ".join(f"{volt:g}" for volt in known)
        expected = f"a voltage of the {name} ({stated}) expected" if known else f"no voltage for the {name} expected"
        raise config.ConfigError(
            "--volts", [f"{expected}, found {volts:g}; for another, give a file with --servo: docs/servos.md"]
        )
    if known:
        torque, rpm = next(iter(known.values())) if volts is None else known[volts]
        speed = rpm * 2.0 * math.pi / 60.0
    proposal = _proposal(model, torque if stall_torque is None else stall_torque, speed)
    return config.build({"model": name, **proposal}, Servo)


def _proposal(model: ServoModel, torque: float, speed: float) -> dict[str, Any]:
    """Return what a profile says of a servo with a stall torque [N m] and a no-load speed [rad/s], without its model."""
    table = model.table
    gain, slope = table.position_gain, model.default(table.compliance[-1]) if table.compliance else 0
    armature, friction = _IDENTIFIED.get(model.name, (_ARMATURE_PER_NM * torque, _FRICTION_PER_NM * torque))
    p_gain = 0 if gain is None else model.default(gain)
    if gain is not None:
        stiffness = torque * p_gain * model.gain_stiffness
    elif slope:
        stiffness = torque / (full_torque_ticks(slope) * model.units.tick_rad)
    else:
        stiffness = torque * model.gain_stiffness
    return {
        "stall_torque": torque,
        "no_load_speed": round(speed, _DIGITS),
        "stiffness": round(stiffness, _DIGITS),
        "armature": round(armature, _DIGITS),
        "friction": round(friction, _DIGITS),
        "compliance_slope": slope,
        "position_gain": p_gain,
        "temperature_limit": float(model.default(table.temperature_limit)),
    }


def proposed_battery(name: str, volts: float | None = None) -> Battery:
    """Return the voltage limits of the usual battery for servos of a model, or for a voltage [V]."""
    usual = next(iter(AT_VOLTS[name])) if name in AT_VOLTS else _USUAL_VOLTS.get(name, 12.0)
    return Battery.of_volts(usual if volts is None else volts)


def chosen_servo(word: str, volts: float | None = None) -> tuple[Servo, Battery]:
    """Return servo and battery by the name of a model, by a file, or by a profile to take them from.

    A file that is no profile has a table [servo], and a table [battery] unless that is of three lithium polymer cells. Of
    servos on a bus only model and stall torque are needed, with [servo.numbers]; the rest is proposed.

    Args:
        word: The model, a board of `BOARDS`, whose servos are those of `printed_ds3218`, a profile by name, or the path of a
            TOML file.
        volts: [V] voltage of a known model, see `proposed_servo`.

    Raises:
        ConfigError: The model is not known, or the file is invalid.
    """
    if word in MODEL_NAMED:
        return proposed_servo(word, volts=volts), proposed_battery(word, volts)
    if not word.endswith(".toml") and word not in (*profile_names(), *BOARDS):
        hobby = f"for hobby servos {' or '.join(BOARDS)}, their board, see docs/hobby_servos.md"
        raise config.ConfigError(
            "--servo", [f"{unknown_model(word)}; {hobby}; a file with its [servo] table, or a profile, is taken, too"]
        )
    if volts is not None:
        raise config.ConfigError("--volts", [f"a model with --servo expected, since {word} states its servos' torque itself"])
    table = config.read(Path(word)) if word.endswith(".toml") else {}
    if "servo" in table and not table.keys() - {"servo", "battery"}:
        battery = config.build(table.get("battery", {}), Battery, f"{word}: battery")
        return _servo_of_table(table["servo"], word), battery
    if word in BOARDS:
        profile = load_profile(_HOBBY)
        assert profile.servo.pulses is not None
        pulses = replace(profile.servo.pulses, board=cast(pwm.Board, word))
        return replace(profile.servo, pulses=pulses), profile.battery
    profile = load_profile(word)
    return profile.servo, profile.battery


def _servo_of_table(table: object, path: str) -> Servo:
    """Return the servo of a table [servo], with proposals for what it does not state."""
    source = f"{path}: servo"
    if not isinstance(table, dict):
        raise config.ConfigError(source, ["a table expected"])
    stated = dict(table)
    numbers = stated.get("numbers")
    stated_numbers = config.build(numbers, ModelNumbers, f"{source}.numbers") if isinstance(numbers, dict) else None
    model = None if "pulses" in stated else known_model(stated.get("model"), stated_numbers, None)
    torque = stated.get("stall_torque")
    if model is None or not isinstance(torque, float | int):
        return config.build(stated, Servo, source)  # that of hobby servos; or an error that names what is missing
    return config.build({**_proposal(model, float(torque), model.no_load_speed), **stated}, Servo, source)


def unknown_model(name: str) -> str:
    """Return what to do about a servo model that is not known."""
    another = "for another servo, name the most similar model, then state the numbers that differ: docs/servos.md"
    return f"no servo model {name!r}; {hint(name, MODEL_NAMED, likeness=_LIKENESS)} ({another})"
