"""Proposed servo data of a profile, by the model of the servos."""

import math
from dataclasses import replace
from types import MappingProxyType

from sextant.shared.robot.servo import Battery, Servo
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.spelling import hint

# [N m] stall torque of each model at its usual voltage: 14.8 V for the RX-64, 11.1 V for XL430 and HX-35H, 7.4 V for XL-320 and
# LX-16A, and 12 V for the others.
STALL_TORQUES = MappingProxyType(
    {
        "AX-12A": 1.5,
        "AX-18A": 1.8,
        "AX-12W": 0.2,
        "RX-28": 2.5,
        "RX-64": 4.24,
        "MX-28": 2.5,
        "MX-64": 6.0,
        "XL-320": 0.39,
        "XL430-W250": 1.4,
        "XC430-W150": 1.6,
        "XC430-W240": 1.9,
        "XM430-W350": 4.1,
        "STS3215": 2.94,
        "LX-16A": 1.67,
        "HX-35H": 3.43,
    }
)
_BATTERIES = MappingProxyType(
    dict.fromkeys(("XL-320", "LX-16A"), Battery(7.0, 6.6))
)  # two lithium polymer cells instead of three
_RX_64_SPEED = 5.36  # [rad/s] at 14.8 V; its model has the speed at 18.5 V
_COMPLIANCE_SLOPE = 32  # the factory's
_ARMATURE_PER_NM, _FRICTION_PER_NM = 0.002, 0.02  # [kg m^2] and [N m] per N m of stall torque, assumed: those of the AX-12A
# [kg m^2] armature and [N m] friction of servos that were identified: the STS3215 for Open Duck Mini
_IDENTIFIED = MappingProxyType({"STS3215": (0.028, 0.052)})
_DIGITS = 4


def nearest_servo(stall_torque: float | None) -> str:
    """Return the servo model whose stall torque [N m] is nearest in proportion; the AX-12A if it is unknown."""
    if stall_torque is None:
        return "AX-12A"
    return min(STALL_TORQUES, key=lambda model: abs(math.log(stall_torque / STALL_TORQUES[model])))


def proposed_servo(name: str, stall_torque: float | None = None) -> Servo:
    """Return a servo with the data sheet of a model, the gain of its factory, friction and armature.

    These two are assumed in proportion to the torque, unless they were identified.

    The stall torque [N m] is that at the model's usual voltage, unless it is given.
    """
    model, torque = MODEL_NAMED[name], STALL_TORQUES[name] if stall_torque is None else stall_torque
    gain = model.table.position_gain
    armature, friction = _IDENTIFIED.get(name, (_ARMATURE_PER_NM * torque, _FRICTION_PER_NM * torque))
    servo = Servo(
        model=name,
        stall_torque=torque,
        no_load_speed=_RX_64_SPEED if name == "RX-64" else round(model.no_load_speed, _DIGITS),
        stiffness=1.0,
        armature=round(armature, _DIGITS),
        friction=round(friction, _DIGITS),
        compliance_slope=_COMPLIANCE_SLOPE if model.table.compliance else 0,
        position_gain=0 if gain is None else model.default(gain),
        temperature_limit=float(model.default(model.table.temperature_limit)),
    )
    has_setting = gain is not None or model.table.compliance
    stiffness = servo.nominal_stiffness if has_setting else torque * model.gain_stiffness
    return replace(servo, stiffness=round(stiffness, _DIGITS))


def proposed_battery(name: str) -> Battery:
    """Return the voltage limits of the usual battery for servos of a model."""
    return _BATTERIES.get(name, Battery())


def unknown_model(name: str) -> str:
    """Return what to do about a servo model that is not known."""
    another = "for another servo, name the most similar model, then state the numbers that differ: docs/servos.md"
    return f"no servo model {name!r}; {hint(name, MODEL_NAMED)} ({another})"
