"""Gentle servo motion with limited torque and speed; torque is off afterwards.

Registers are restored at the end.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.services.actuator.servo_bus.attempts import retry
from sextant.services.actuator.servo_bus.bus_scan import ServoScan, call, named, problems
from sextant.services.actuator.servo_bus.servo_health import health_problems
from sextant.services.actuator.servo_bus.servo_interface import Servos
from sextant.services.actuator.servo_bus.several_buses import AnyBus
from sextant.shared.errors import SextantError
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import Register, ServoModel

TORQUE_SHARE = 0.3  # [1] of the stall torque; it lifts a leg in the air, and a finger can stop it
SPEED_RAD_S = np.radians(20.0)
_NOT_RESTORED = (
    "its torque was being turned off and its registers restored; turn torque off with `sextant servos off`, "
    "then switch its power off and on again"
)
_READS = 5  # position readings, for their median
_STILL_RAD = np.radians(0.9)  # largest position change over these readings for a servo at rest


class ServoNotRespondingError(SextantError, RuntimeError):
    """A servo that was present stopped answering, or refused."""

    exit_status = 1


def ready(bus: AnyBus, profile: RobotProfile, operator: Operator) -> bool:
    """Return whether all servos are present, healthy and without torque.

    Report problems to the operator.
    """
    if echo := bus.echo_problem():
        operator.say(": ".join(echo))
        return False
    seen = call(bus, profile.servo_names)
    wrong = problems(profile.servo_names, seen)
    low = profile.battery.warn_voltage
    told = [f"{words}: {advice}" for words, advice in dict.fromkeys(wrong.values())]
    well = {i: one for i, one in seen.items() if i not in wrong}
    told += [problem.words for problem in health_problems(well, low, bus.names)]
    if told:
        operator.say("the servos are not ready, nothing was moved:\n  " + "\n  ".join(told))
        return False
    return _released([one for one in seen.values() if one[one.expected.table.torque_enable]], bus, operator)


def _released(holding: Sequence[ServoScan], bus: AnyBus, operator: Operator) -> bool:
    """Return whether no servo has torque; turn it off only if the operator agrees."""
    if not holding:
        return True
    question = f"The torque of {len(holding)} servos is on and must be off first. Turn it off? Without a stand the robot sinks."
    if not operator.agree(question):
        operator.say("nothing was changed: end the program that drives the robot, place it on a stand, and start again")
        return False
    for one in holding:
        put(bus, one.servo_id, one.expected.table.torque_enable, 0)
    return True


def torque_words(model: ServoModel) -> str:
    """Return how much torque servos of a model have in a gentle motion, as "little torque"."""
    return "little torque" if model.has(model.table.torque_limit) else "its full torque, which these servos cannot limit,"


@contextmanager
def limited_motion(bus: AnyBus, servo_ids: Sequence[int], *, others: bool = True) -> Iterator[None]:
    """Limit torque and speed of servos, as far as their model can; turn torque off and restore at the end.

    The servos must be without torque.

    Args:
        bus: The servos.
        servo_ids: Those that are limited.
        others: Turn the torque of all others on the bus off, too.
    """
    before: dict[tuple[int, Register], int] = {}
    for i in servo_ids:
        model, table = bus.model_of(i), bus.model_of(i).table
        limits = [r for r in (table.goal_speed, table.torque_limit) if model.has(r) or r is table.goal_speed]
        before |= {(i, r): get(bus, i, r) for r in limits}
    again = {(i, bus.model_of(i).table.torque_enable): 0 for i in servo_ids} | before
    try:
        for i in servo_ids:
            model = bus.model_of(i)
            if model.has(model.table.torque_limit):
                _put_and_read(bus, i, model.table.torque_limit, round(TORQUE_SHARE / model.units.torque))
            put(bus, i, model.table.goal_speed, max(round(SPEED_RAD_S / model.units.speed_rad_s), 1))
        yield
    finally:
        try:
            _restore(bus, again, others)
        except KeyboardInterrupt:  # interrupted here; a command raises it only once
            _restore(bus, again, others)
            raise


def _restore(bus: AnyBus, registers: Mapping[tuple[int, Register], int], others: bool) -> None:
    """Turn torque off, with `others` by a broadcast to all servos, and restore registers."""
    if others:
        bus.set_torque(False)
    left = [i for (i, register), value in registers.items() if not took(bus, i, register, value)]
    if left:
        raise silent(bus, left[0], _NOT_RESTORED)


def hold(bus: AnyBus, servo_ids: Sequence[int]) -> None:
    """Turn torque on at the present positions.

    Goals are sent first, because not every firmware holds its position.
    """
    for i in servo_ids:
        model = bus.model_of(i)
        position = model.position(get(bus, i, model.table.present_position))
        put(bus, i, model.table.goal_position, min(max(position, 0), model.units.max_position))
        put(bus, i, model.table.torque_enable, 1)


def resting(bus: AnyBus, servo_ids: Sequence[int]) -> Array | None:
    """Return angles (n,) [rad] of servos at rest, None while one moves."""
    models = [bus.model_of(i) for i in servo_ids]
    asked = [(i, model) for i, model in zip(servo_ids, models, strict=True)]
    ticks = np.array([[model.position(get(bus, i, model.table.present_position)) for i, model in asked] for _ in range(_READS)])
    if (np.ptp(ticks, axis=0) > [round(_STILL_RAD / model.units.tick_rad) for model in models]).any():
        return None
    return np.array([model.units.angle(t) for model, t in zip(models, np.median(ticks, axis=0), strict=True)])


def get(bus: AnyBus, servo_id: int, register: Register) -> int:
    """Return the value of a register; raise ServoNotRespondingError without an answer."""
    value = retry(lambda: bus.read(servo_id, register))
    if value is None:
        raise silent(bus, servo_id, f"its {register.name} was being read")
    return value


def put(bus: AnyBus, servo_id: int, register: Register, value: int) -> None:
    """Write a register until it is acknowledged; else raise ServoNotRespondingError."""
    if not took(bus, servo_id, register, value):
        raise silent(bus, servo_id, f"its {register.name} was being set to {value}")


def _put_and_read(bus: AnyBus, servo_id: int, register: Register, value: int) -> None:
    """Write a register until it is acknowledged, and read it again; raise ServoNotRespondingError if it has another value."""
    put(bus, servo_id, register, value)
    if (found := get(bus, servo_id, register)) != value:
        raise silent(bus, servo_id, f"its {register.name} was being set to {value} and remained {found}")


def took(bus: Servos, servo_id: int, register: Register, value: int) -> bool:
    """Write a register, three times at most; return whether the servo acknowledges it."""
    return retry(lambda: bus.write(servo_id, register, value) or None) is not None


def silent(bus: AnyBus, servo_id: int, when: str) -> ServoNotRespondingError:
    """Return the error for a servo that stopped answering."""
    name = named(servo_id, bus.names)
    return ServoNotRespondingError(
        f"{name} did not answer, or refused, when {when}; check cable and power, then run `sextant servos scan`"
    )
