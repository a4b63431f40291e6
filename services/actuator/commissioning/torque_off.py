"""Torque off at the port, without an actuator or after an interrupted motion."""

from collections.abc import Iterator
from contextlib import contextmanager

from sextant.services.actuator.commissioning.limited_motion import ServoNotRespondingError, took
from sextant.services.actuator.commissioning.set_ids import Operator
from sextant.services.actuator.servo_bus.bus_scan import named
from sextant.services.actuator.servo_bus.servo_interface import Servos
from sextant.services.actuator.servo_bus.several_buses import AnyBus
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import ServoModel


def torque_off(bus: Servos) -> dict[int, str]:
    """Turn all torque off; return the servos that do not confirm it, and why.

    A microcontroller executes it even before a session is open. With a session it also forwards each servo's answer.

    Raises:
        BusSetupError: A configured microcontroller does not answer; the order was sent nevertheless.
        BusDisconnectedError: The port is gone.
    """
    bus.set_torque(False)
    bus.open_session()
    bus.set_torque(False)
    left = {}
    for servo_id in bus.servo_ids:
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
    alike = (one for one in MODELS if one.protocol.answer_start is model.protocol.answer_start)
    others = (one for one in alike if one.table.torque_enable != model.table.torque_enable)
    return next((one for one in others if bus.read(servo_id, one.table.model_number) == one.number), None)


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
