"""Model that a servo tells by its number, which other models have in other registers."""

from functools import partial
from typing import NamedTuple, Protocol

from sextant.services.actuator.servo_bus.attempts import retry
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import Register, ServoModel


class Bus(Protocol):
    """Part of `ServoBus` that is used here."""

    def read(self, servo_id: int, register: Register) -> int | None:
        """Return the value of a register."""


class Told(NamedTuple):
    """What a servo tells about its model."""

    model: ServoModel | None  # None for an unknown number
    number: int | None  # None from a servo that tells none


def models_alike(model: ServoModel) -> list[ServoModel]:
    """Return the known models with the packets of a model."""
    return [one for one in MODELS if one.protocol.answer_start is model.protocol.answer_start]


def told_model(bus: Bus, servo_id: int, expected: ServoModel) -> Told:
    """Ask a servo for its number in the register of the expected model, then in those of others with the same packets."""
    tell = [one for one in (expected, *models_alike(expected)) if one.has(one.table.model_number)]
    first: int | None = None
    for register in dict.fromkeys(one.table.model_number for one in tell):
        number = retry(partial(bus.read, servo_id, register))
        found = next((one for one in tell if one.table.model_number == register and one.number == number), None)
        if found is not None:
            return Told(found, number)
        first = number if first is None else first
    return Told(None, first)
