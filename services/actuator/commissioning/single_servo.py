"""One servo turned alone: to the middle of its range for its horn, or a little for its builder to see which one it is.

No other servo on the bus gets torque, loses torque or moves.
"""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import NamedTuple

import numpy as np

from sextant.services.actuator.commissioning.limited_motion import (
    SPEED_RAD_S,
    TORQUE_SHARE,
    get,
    hold,
    limited_motion,
    put,
)
from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.services.actuator.servo_bus.attempts import retry
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.bus_scan import named, problems, scan_servo
from sextant.services.actuator.servo_bus.model_identification import models_alike, told_model
from sextant.services.actuator.servo_bus.other_device import refuse_another_device
from sextant.services.actuator.servo_bus.servo_health import error_of, remedy_of
from sextant.services.actuator.servo_bus.triage import HOBBY_ROBOT, Opener, is_maestro, usual_rates
from sextant.shared.errors import SextantError
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import ServoModel

WIGGLE_DEG = 8.0
WIGGLES = 3
_OPEN_DEG = 2.0  # largest error of an angle that counts as reached
_SLACK_NS = 1_500_000_000  # [ns] added to the time of a motion


class NotReadyError(SextantError):
    """The servo may not move now."""

    exit_status = 1


class Identified(NamedTuple):
    """Servo that answered, and the baud rate [1/s] at which it did."""

    model: ServoModel
    rate: int


def identify(opener: Opener, servo_id: int, model: ServoModel | None = None) -> Identified:
    """Return model and rate of the servo with an id. Without a model, all protocols are tried.

    Servos that do not tell their model get the first one with their packets.

    Raises:
        NotReadyError: None answers, or its model is not known.
        NotAServoBusError: Another device sends on the port.
        BusDisconnectedError: The port cannot be opened.
    """
    families = {one.protocol.answer_start: one for one in reversed(MODELS)}.values() if model is None else (model,)
    first = next(iter(families))
    with closing(opener.open(first.bus_rate, first)) as bus:
        if echo := bus.echo_problem():
            raise NotReadyError(": ".join(echo))
    for family in families:
        if servo_id > family.protocol.MAX_ID:
            continue
        for rate in usual_rates(family) if opener.has_rates else (family.bus_rate,):
            bus = opener.open(rate, family)
            try:
                if retry(lambda bus=bus: bus.ping(servo_id)) is not None:  # type: ignore[misc]
                    return Identified(_model_of(bus, servo_id, model), rate)
            finally:
                bus.close()
    with closing(opener.open(first.bus_rate, first)) as bus:
        refuse_another_device(bus)
        if is_maestro(bus):
            raise NotReadyError(f"a Pololu Maestro answers on {opener.name}; {HOBBY_ROBOT}")
    asked = " or ".join(dict.fromkeys(one.protocol.NAME for one in (MODELS if model is None else (model,))))
    raise NotReadyError(
        f"no servo with id {servo_id} answers on {opener.name} ({asked}); check its power and cable; "
        "`sextant servos scan` lists the ids, and new servos have id 1"
    )


def _model_of(bus: ServoBus, servo_id: int, expected: ServoModel | None) -> ServoModel:
    """Return the model of a servo, which must be the expected one, by its number where each model with its packets has it."""
    told = told_model(bus, servo_id, expected or bus.model)
    if not any(one.has(one.table.model_number) for one in models_alike(bus.model)):
        return expected or bus.model
    if told.model is not None and expected in (None, told.model):
        return told.model
    number = "silent" if told.number is None else f"of an unknown model, {told.number}"
    which = number if told.model is None else told.model.name
    if expected is None:
        raise NotReadyError(f"servo {servo_id} is {which}: name a model with the same registers with --servo")
    raise NotReadyError(f"servo {servo_id} is {which}, {expected.name} expected: leave out --servo, or give another --robot")


def centre(bus: ServoBus, servo_id: int, operator: Operator, clock: Callable[[], int]) -> bool:
    """Turn a servo slowly to its middle, and hold it until the operator presses Enter; return whether it got there.

    Args:
        bus: The bus of the servo.
        servo_id: Its id.
        operator: Agrees to the motion, and ends the hold.
        clock: Monotonic time [ns].

    Raises:
        NotReadyError: The servo does not answer clearly, is of another model, has errors or torque.
        ServoNotRespondingError: It stopped answering.
        BusDisconnectedError: The port is gone.
    """
    units, middle = bus.model.units, bus.model.units.centre
    start = _start(bus, servo_id)
    low, high = (get(bus, servo_id, limit) for limit in (bus.model.table.low_limit, bus.model.table.high_limit))
    name = named(servo_id, bus.names)
    if not low <= middle <= high:
        raise NotReadyError(f"{name} turns from tick {low} to {high} only, and its middle is {middle}: `sextant servos set-id`")
    question = (
        f"{name}, {bus.model.name}, is {np.degrees(units.angle(start)):+.0f} deg from its middle and turns there, {_how(bus)}"
    )
    if not operator.agree(f"{question}. Can its shaft turn freely?"):
        operator.say("nothing was moved, torque is off")
        return False
    with _alone(bus, servo_id, operator):
        hold(bus, [servo_id])
        left = np.degrees((_turn(bus, servo_id, middle, clock) - middle) * units.tick_rad)
        if reached := bool(abs(left) <= _OPEN_DEG):
            operator.ask(f"{name} holds its middle, tick {middle}. Screw its horn on, then press Enter to turn torque off: ")
        else:
            operator.say(f"{name} stopped {left:+.0f} deg from its middle: something blocks it")
    return reached


def wiggle(bus: ServoBus, servo_id: int, operator: Operator, clock: Callable[[], int]) -> bool:
    """Turn a servo to and fro by some degrees; return whether it moved. Arguments and errors are those of `centre`."""
    units = bus.model.units
    start = min(max(_start(bus, servo_id), 0), units.max_position)
    name, step = named(servo_id, bus.names), round(np.radians(WIGGLE_DEG) / units.tick_rad)
    there = start - step if start > units.centre else start + step
    if not operator.agree(
        f"{name}, {bus.model.name}, turns to and fro by {WIGGLE_DEG:g} deg, {_how(bus)}. Can it move freely?"
    ):
        operator.say("nothing was moved, torque is off")
        return False
    with _alone(bus, servo_id, operator):
        hold(bus, [servo_id])
        ways = [_turn(bus, servo_id, goal, clock) - goal for _ in range(WIGGLES) for goal in (there, start)]
    if np.degrees(max(map(abs, ways)) * units.tick_rad) <= _OPEN_DEG:
        return True
    operator.say(f"{name} did not reach its goals: something blocks it")
    return False


def _how(bus: ServoBus) -> str:
    """Return speed and torque of the motion as text."""
    has_limit = bus.model.has(bus.model.table.torque_limit)
    torque = f"{100 * TORQUE_SHARE:.0f} % of its torque" if has_limit else "its full torque, which it cannot limit"
    return f"at {np.degrees(SPEED_RAD_S):.0f} deg/s with {torque}"


def _start(bus: ServoBus, servo_id: int) -> int:
    """Return the position register of a servo that may move; raise NotReadyError for another."""
    seen = scan_servo(bus, servo_id)
    if seen is None:
        raise NotReadyError(f"{named(servo_id, bus.names)} does not answer; check its power and cable")
    wrong = problems({servo_id: bus.names.get(servo_id, "")}, {servo_id: seen})
    if servo_id in wrong:
        raise NotReadyError(": ".join(wrong[servo_id]))
    if errors := error_of(seen):
        raise NotReadyError(f"{named(servo_id, bus.names)} reports {errors}: {remedy_of(seen)}")
    if seen[bus.model.table.torque_enable]:
        raise NotReadyError(
            f"the torque of {named(servo_id, bus.names)} is on: `sextant servos off` turns it off, then try again"
        )
    return bus.model.position(get(bus, servo_id, bus.model.table.present_position))


@contextmanager
def _alone(bus: ServoBus, servo_id: int, operator: Operator) -> Iterator[None]:
    """Limit torque and speed of one servo, and turn only its torque off at the end."""
    with limited_motion(bus, [servo_id], others=False):
        yield
    operator.say("torque is off")


def _turn(bus: ServoBus, servo_id: int, goal: int, clock: Callable[[], int]) -> int:
    """Send a servo to a goal, and return its position register when it is there or the time is over."""
    units, register = bus.model.units, bus.model.table.present_position
    position = bus.model.position(get(bus, servo_id, register))
    patience_ns = 1.5e9 * abs(goal - position) * units.tick_rad / SPEED_RAD_S + _SLACK_NS
    put(bus, servo_id, bus.model.table.goal_position, goal)
    began = clock()
    near = np.radians(_OPEN_DEG) / 2 / units.tick_rad
    while abs(position - goal) > near and clock() - began < patience_ns:
        position = bus.model.position(get(bus, servo_id, register))
    return position
