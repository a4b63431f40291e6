"""Servo models that a profile may name.

Sources: ROBOTIS e-manual, pages of the models.
"""

from types import MappingProxyType

from sextant.shared.servo import dynamixel
from sextant.shared.servo.servo_model import ServoModel

_NONE: MappingProxyType[str, int] = MappingProxyType({})
_ANSWER_ALL = 2  # status return level
_AX_RATES = MappingProxyType({code: dynamixel.baud_rate(code) for code in range(255)})
_AX_SETTINGS = MappingProxyType({dynamixel.STATUS_RETURN_LEVEL.name: _ANSWER_ALL, dynamixel.RETURN_DELAY.name: 0})


def _ax(name: str, number: int, no_load_rpm: float, **overrides: int) -> ServoModel:
    """Return a model with the control table of the AX-12A."""
    factory = MappingProxyType({register.replace("_", " "): value for register, value in overrides.items()})
    table, units = dynamixel.TABLE, dynamixel.UNITS
    return ServoModel(name, number, dynamixel, table, units, _AX_RATES, _AX_SETTINGS, no_load_rpm, factory)


AX_12A = _ax("AX-12A", 12, 59.0)
AX_18A = _ax("AX-18A", 18, 97.0, temperature_limit=75, max_torque=983)
AX_12W = _ax("AX-12W", 300, 54.0)
RX_64 = _ax("RX-64", 64, 64.0, baud_rate=34, temperature_limit=80, max_voltage=190)
MODELS = (AX_12A, AX_18A, AX_12W, RX_64)
MODEL_NAMED = MappingProxyType({model.name: model for model in MODELS})
