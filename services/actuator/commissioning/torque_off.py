"""Torque off at the port itself: where no actuator runs to be ordered so, and where whoever moves servos here breaks off."""

from collections.abc import Iterator
from contextlib import contextmanager

from sextant.services.actuator.commissioning.bus_scan import named
from sextant.services.actuator.commissioning.limited_motion import ServoSilentError, took
from sextant.services.actuator.commissioning.set_ids import Operator
from sextant.services.actuator.servo_bus.dynamixel_bus import ServoBus
from sextant.services.actuator.servo_bus.servos import Servos
from sextant.shared.servo import dynamixel as dxl


def let_go(bus: Servos) -> dict[int, str]:
    """Turn the torque of all servos on the bus off, whoever answers; who does not say that it is off, and what it says.

    A microcontroller in between obeys before it has been met, too; once met it passes on what each servo says.

    Raises:
        BusSetupError: A microcontroller is to be in between, and does not answer; it was told all the same.
        BusGone: The port is gone.
    """
    bus.set_torque(False)
    bus.meet()
    bus.set_torque(False)
    left = {}
    for servo_id in bus.servo_ids:
        if not took(bus, servo_id, dxl.TORQUE_ENABLE, 0):
            left[servo_id] = "does not answer, or refuses"
        elif bus.read(servo_id, dxl.TORQUE_ENABLE):
            left[servo_id] = "says that its torque is on"
    return left


@contextmanager
def limp_if_broken_off(bus: ServoBus, operator: Operator) -> Iterator[None]:
    """Where the operator breaks off within, or a servo falls silent, all are let go, and the operator is told so."""
    try:
        yield
    except (KeyboardInterrupt, ServoSilentError):
        left = let_go(bus)
        words = [f"{named(i, bus.names)} {words}: switch the servos' power off" for i, words in left.items()]
        operator.say("\n".join(words) or "torque is off")
        raise
