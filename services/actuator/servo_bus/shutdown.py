"""End of the shutdown of an overloaded or hot servo, as its model asks for it."""

from collections.abc import Callable

from sextant.services.actuator.servo_bus.servo_interface import Servos
from sextant.shared.servo.servo_model import Recovery, Register


def end(bus: Servos, servo_id: int, goal_ticks: int, torque_limit: int, may_pull: Callable[[], bool]) -> bool:
    """End the shutdown of a servo at a goal that it acknowledges first; return whether it has torque again.

    A servo that must reboot has no torque afterwards: an operator's order turns it on. Each write is repeated once without an
    acknowledgement: a lost one, or one that packets before it delay, must not leave the servo without torque.

    Args:
        bus: The servos.
        servo_id: Id of the servo.
        goal_ticks: Goal position register, the present position.
        torque_limit: Torque limit register.
        may_pull: Returns whether torque may be on now; it is asked last, because torque off may be ordered meanwhile.
    """

    def write(register: Register, value: int) -> bool:
        return bus.write(servo_id, register, value) or bus.write(servo_id, register, value)

    model = bus.model_of(servo_id)
    if model.recovery is Recovery.ITSELF:
        return True
    table = model.table
    if model.recovery is Recovery.REBOOT:
        bus.reboot(servo_id)
        return False
    if model.recovery is Recovery.TORQUE_ENABLE and not write(table.torque_enable, 0):
        return False
    if not write(table.goal_position, goal_ticks):
        return False
    if model.has(table.torque_limit) and not write(table.torque_limit, torque_limit):
        return False
    return model.recovery is Recovery.TORQUE_LIMIT or (may_pull() and write(table.torque_enable, 1))
