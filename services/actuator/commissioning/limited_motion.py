"""Gentle servo motion with limited torque and speed; torque is off afterwards.

Registers are restored at the end.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from sextant.services.actuator.commissioning.set_ids import Operator
from sextant.services.actuator.servo_bus.bus_scan import ServoScan, call, health_problem, named, problems, retry
from sextant.services.actuator.servo_bus.dynamixel_bus import ServoBus
from sextant.services.actuator.servo_bus.servo_interface import Servos
from sextant.shared.errors import SextantError
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Register

TORQUE_LIMIT = 300  # [0.1 % of the stall torque] lifts a leg in the air; a finger can stop it
MOVING_SPEED = dxl.moving_speed_from(np.radians(20.0))
_NOT_RESTORED = (
    "its torque was being turned off and its registers restored; turn torque off with `sextant servos off`, "
    "then switch its power off and on again"
)
_READS = 5  # position readings, for their median
_STILL_TICKS = 3  # largest position change over these readings for a servo at rest


class ServoNotRespondingError(SextantError, RuntimeError):
    """A servo that was present stopped answering, or refused."""

    exit_status = 1


def ready(bus: ServoBus, profile: RobotProfile, operator: Operator) -> bool:
    """Return whether all servos are present, healthy and without torque.

    Report problems to the operator.
    """
    seen = call(bus, profile.servo_names)
    wrong = problems(profile.servo_names, seen, dxl.MODEL_NAMED[profile.servo.model])
    low = profile.battery.warn_voltage
    told = [f"{words}: {advice}" for words, advice in dict.fromkeys(wrong.values())]
    told += [
        f"{named(i, bus.names)} {words}" for i, one in seen.items() if i not in wrong and (words := health_problem(one, low))
    ]
    if told:
        operator.say("the servos are not ready, nothing was moved:\n  " + "\n  ".join(told))
        return False
    return _released([one for one in seen.values() if one[dxl.TORQUE_ENABLE]], bus, operator)


def _released(holding: Sequence[ServoScan], bus: ServoBus, operator: Operator) -> bool:
    """Return whether no servo has torque; turn it off only if the operator agrees."""
    if not holding:
        return True
    question = f"The torque of {len(holding)} servos is on and must be off first. Turn it off? Without a stand the robot sinks."
    if not operator.agree(question):
        operator.say("nothing was changed: end the program that drives the robot, place it on a stand, and start again")
        return False
    for one in holding:
        put(bus, one.servo_id, dxl.TORQUE_ENABLE, 0)
    return True


@contextmanager
def limited_motion(bus: ServoBus, servo_ids: Sequence[int]) -> Iterator[None]:
    """Limit torque and speed of servos; turn torque off and restore at the end.

    The servos must be without torque.
    """
    before = {(i, r): get(bus, i, r) for i in servo_ids for r in (dxl.MOVING_SPEED, dxl.TORQUE_LIMIT)}
    again = {(i, dxl.TORQUE_ENABLE): 0 for i in servo_ids} | before
    try:
        for i in servo_ids:
            put(bus, i, dxl.TORQUE_LIMIT, TORQUE_LIMIT)
            put(bus, i, dxl.MOVING_SPEED, MOVING_SPEED)
        yield
    finally:
        try:
            _restore(bus, again)
        except KeyboardInterrupt:  # interrupted here; a command raises it only once
            _restore(bus, again)
            raise


def _restore(bus: ServoBus, registers: Mapping[tuple[int, Register], int]) -> None:
    """Broadcast torque off to all servos, and restore registers."""
    bus.set_torque(False)
    left = [i for (i, register), value in registers.items() if not took(bus, i, register, value)]
    if left:
        raise silent(bus, left[0], _NOT_RESTORED)


def hold(bus: ServoBus, servo_ids: Sequence[int]) -> None:
    """Turn torque on at the present positions.

    Goals are sent first, because not every firmware holds its position.
    """
    for i in servo_ids:
        put(bus, i, dxl.GOAL_POSITION, get(bus, i, dxl.PRESENT_POSITION))
        put(bus, i, dxl.TORQUE_ENABLE, 1)


def resting(bus: ServoBus, servo_ids: Sequence[int]) -> Array | None:
    """Return angles (n,) [rad] of servos at rest, None while one moves."""
    ticks = np.array([[get(bus, i, dxl.PRESENT_POSITION) for i in servo_ids] for _ in range(_READS)])
    if (np.ptp(ticks, axis=0) > _STILL_TICKS).any():
        return None
    return np.array([dxl.angle_from_ticks(t) for t in np.median(ticks, axis=0)])


def get(bus: ServoBus, servo_id: int, register: Register) -> int:
    """Return the value of a register; raise ServoNotRespondingError without an answer."""
    value = retry(lambda: bus.read(servo_id, register))
    if value is None:
        raise silent(bus, servo_id, f"its {register.name} was being read")
    return value


def put(bus: ServoBus, servo_id: int, register: Register, value: int) -> None:
    """Write a register until it is acknowledged; else raise ServoNotRespondingError."""
    if not took(bus, servo_id, register, value):
        raise silent(bus, servo_id, f"its {register.name} was being set to {value}")


def took(bus: Servos, servo_id: int, register: Register, value: int) -> bool:
    """Write a register, three times at most; return whether the servo acknowledges it."""
    return retry(lambda: bus.write(servo_id, register, value) or None) is not None


def silent(bus: ServoBus, servo_id: int, when: str) -> ServoNotRespondingError:
    """Return the error for a servo that stopped answering."""
    name = named(servo_id, bus.names)
    return ServoNotRespondingError(
        f"{name} did not answer, or refused, when {when}; check cable and power, then run `sextant servos scan`"
    )
