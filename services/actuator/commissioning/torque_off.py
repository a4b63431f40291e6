"""Torque off at the port, without an actuator or after an interrupted motion."""

from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import NamedTuple

from sextant.services.actuator.commissioning.limited_motion import ServoNotRespondingError, took
from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.services.actuator.servo_bus.attempts import retry
from sextant.services.actuator.servo_bus.bus_scan import FACTORY_ID, Problem, named
from sextant.services.actuator.servo_bus.model_identification import told_model
from sextant.services.actuator.servo_bus.other_device import refuse_another_device
from sextant.services.actuator.servo_bus.servo_interface import Servos
from sextant.services.actuator.servo_bus.several_buses import AnyBus
from sextant.services.actuator.servo_bus.triage import HOBBY_ROBOT, Answering, Opener, first_answer, is_maestro, other_families
from sextant.shared.servo import maestro
from sextant.shared.servo.servo_model import ServoModel


def torque_off(bus: Servos, servo_ids: Iterable[int] | None = None) -> dict[int, str]:
    """Turn all torque off; return the servos that do not confirm it, and why.

    A microcontroller executes it even before a session is open. With a session it also forwards each servo's answer.

    Args:
        bus: The servos.
        servo_ids: Those that have to confirm it; None means all of the robot's.

    Raises:
        BusSetupError: A configured microcontroller does not answer; the order was sent nevertheless.
        BusDisconnectedError: The port is gone.
    """
    bus.set_torque(False)
    bus.open_session()
    bus.set_torque(False)
    left = {}
    for servo_id in bus.servo_ids if servo_ids is None else servo_ids:
        model = bus.model_of(servo_id)
        enable = model.table.torque_enable
        if other := _of_other_model(bus, servo_id):
            if not took(bus, servo_id, other.table.torque_enable, 0) or bus.read(servo_id, other.table.torque_enable):
                left[servo_id] = f"is {other.name}, not {model.name}, and does not turn its torque off"
            continue
        if not took(bus, servo_id, enable, 0):
            left[servo_id] = "does not answer, or refuses the order"
        elif bus.read(servo_id, enable):
            left[servo_id] = "reports that its torque is on"
    return left


def _of_other_model(bus: Servos, servo_id: int) -> ServoModel | None:
    """Return the model of a servo whose torque is turned off by another register than that of the robot's servos."""
    model = bus.model_of(servo_id)
    if bus.read(servo_id, model.table.model_number) in (None, model.number):
        return None
    other = told_model(bus, servo_id, model).model
    return None if other is None or other.table.torque_enable == model.table.torque_enable else other


class OtherServos(NamedTuple):
    """Servos that are not as the profile states them."""

    first: Answering  # one of them
    off: list[int]  # those that confirm that their torque is off
    left: dict[int, str]  # those that do not, and why


def torque_off_of_others(opener: Opener, model: ServoModel | None, ids: Iterable[int]) -> OtherServos | None:
    """Turn the torque off of servos that answer at another rate or in another protocol than the robot's.

    Args:
        opener: Opens the port, which is closed.
        model: Model of the robot's servos; None if they have no bus.
        ids: Ids to ask, and that of new servos; torque off reaches all servos of the first one's family and rate.

    Returns:
        The servos, None if none answers.

    Raises:
        NotAServoBusError: Another device sends on the port.
        BusDisconnectedError: The port is gone.
    """
    families = other_families(model) if model is None else (model, *other_families(model))
    with closing(opener.open(families[0].bus_rate, families[0])) as bus:
        refuse_another_device(bus)
    asked = sorted({FACTORY_ID, *ids})
    first = first_answer(opener, families, asked)
    if first is None:
        return None
    with closing(opener.open(first.rate, first.model)) as bus:
        there = [i for i in asked if i <= first.model.protocol.MAX_ID and retry(partial(bus.ping, i)) is not None]
        left = torque_off(bus, there)
        return OtherServos(first, [i for i in there if i not in left], left)


def end_pulses(opener: Opener, model: ServoModel) -> Problem | None:
    """End all pulses of a Maestro that answers in place of servos of a model; return that it does, None if none answers.

    Raises:
        BusDisconnectedError: The port is gone.
    """
    channels = range(maestro.MAX_CHANNELS)
    with closing(opener.open(model.bus_rate, model)) as bus:
        if not is_maestro(bus):
            return None
        bus.bytes_after(b"".join(maestro.set_target(channel, maestro.OFF) for channel in channels))
        left = sum(maestro.number(bus.bytes_after(maestro.get_position(channel))) > 0 for channel in channels)
    ended = f"{left} of its channels still have pulses" if left else "its pulses have ended"
    return Problem(f"a Pololu Maestro answers, {model.name} expected: {ended}", HOBBY_ROBOT)


@contextmanager
def torque_off_if_interrupted(bus: AnyBus, operator: Operator) -> Iterator[None]:
    """Turn all torque off if the operator interrupts or a servo falls silent."""
    try:
        yield
    except (KeyboardInterrupt, ServoNotRespondingError):
        left = torque_off(bus)
        words = [f"{named(i, bus.names)} {words}: switch the servos' power off" for i, words in left.items()]
        operator.say("\n".join(words) or "torque is off")
        raise
