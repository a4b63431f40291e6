"""Torque off at the port itself, where no actuator runs to be ordered so."""

from services.actuator.bus import ServoBus
from services.actuator.gentle import took
from shared import dynamixel as dxl


def let_go(bus: ServoBus) -> dict[int, str]:
    """Turn the torque of all servos on the bus off, whoever answers; who does not say that it is off, and what it says.

    Raises:
        BusGone: The port is gone.
    """
    bus.set_torque(False)
    left = {}
    for servo_id in bus.servo_ids:
        if not took(bus, servo_id, dxl.TORQUE_ENABLE, 0):
            left[servo_id] = "does not answer, or refuses"
        elif bus.read(servo_id, dxl.TORQUE_ENABLE):
            left[servo_id] = "says that its torque is on"
    return left
