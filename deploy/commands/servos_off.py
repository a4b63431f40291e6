"""Torque off at the port: the latch, the robot's servos, and servos that are not as the profile states them."""

import errno
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import FAILED, SUCCESS, CommandError, complain, say
from sextant.deploy.commands.servo_port import Bus, ended_once, of_each_bus, open_bus, open_servos, opener_of

if TYPE_CHECKING:
    from sextant.services.actuator.commissioning.torque_off import OtherServos
    from sextant.shared.robot.profile import RobotProfile

_NOT_CONFIRMED = "torque off is not confirmed: if the legs do not give way, switch the servos' power off"
_ADD_BRIDGE = "if a microcontroller drives the servos, add --bridge"


def off(bus: Bus, profile: "RobotProfile", bridge: bool) -> int:
    """Latch the port, and turn the torque of all servos on it off; return the exit status."""
    from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError
    from sextant.services.actuator.servo_bus.other_device import NotAServoBusError

    unlatched = _latch(bus.port)
    errors: list[str] = []
    others = None
    with ended_once():
        left, failure = _order(bus, profile, bridge, unlatched)
        silent = [(port, on_it) for _, port, on_it in of_each_bus(bus, profile) if on_it.servo_names.keys() <= left.keys()]
        for one_bus, on_it in silent:
            try:
                if board := _of_maestro(one_bus, on_it):
                    errors.append(board)
                    continue
                others = _of_others(one_bus, on_it)
            except BusDisconnectedError as error:
                add_bridge = isinstance(error, NotAServoBusError) and profile.servo.pulses is None
                errors.append(f"{error}; {_ADD_BRIDGE}" if add_bridge else str(error))
            else:
                found = others.off if others else []
                left = {i: words for i, words in left.items() if i not in found} | (others.left if others else {})
    if failure and (bridge or not errors) and others is None:
        errors = [failure]
    if errors:
        complain(_NOT_CONFIRMED)
        raise CommandError("; ".join(errors))
    if failure:
        complain(failure)
    if not (others and profile.servo.pulses):  # else it is not known which of the robot's servos these are
        _say_who_holds(left, profile, bridge)
    if unlatched:
        complain(f"{unlatched}; an actuator that starts now leaves torque on at servos that have not received torque off")
    return FAILED if left or unlatched else SUCCESS


def _order(bus: Bus, profile: "RobotProfile", bridge: bool, unlatched: str) -> tuple[dict[int, str], str]:
    """Turn the torque of the robot's servos off.

    Returns:
        The servos that do not confirm it, each with the reason, and the error of a board that does not answer.
    """
    from sextant.services.actuator.commissioning.torque_off import torque_off
    from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError
    from sextant.services.actuator.servo_bus.bus_setup import BoardSilentError, BusSetupError

    try:
        servos = open_servos(bus, profile, bridge)
    except BusDisconnectedError as error:
        used = getattr(error.__cause__, "errno", None) in (errno.EAGAIN, errno.EBUSY)
        lets_go = "torque is latched off: an actuator on this port turns it off at once, or as soon as its servos respond"
        say(unlatched or lets_go)
        complain(_NOT_CONFIRMED)
        if not used:
            raise
        raise CommandError(f"{bus.port} is in use") from None
    with closing(servos):
        try:
            return torque_off(servos), ""
        except BoardSilentError as error:
            return dict.fromkeys(servos.servo_ids, "is not reached: no board answers"), str(error)
        except BusSetupError as error:
            complain(_NOT_CONFIRMED)
            raise CommandError(str(error)) from None


def _of_maestro(bus: Bus, profile: "RobotProfile") -> str:
    """End the pulses of a Maestro that answers in place of servos on a bus; return that it does, or ""."""
    from sextant.services.actuator.commissioning.torque_off import end_pulses

    if profile.servo.pulses:
        return ""
    return "\n  -> ".join(end_pulses(opener_of(bus, profile), profile.servo_model) or ())


def _of_others(bus: Bus, profile: "RobotProfile") -> "OtherServos | None":
    """Turn the torque off of servos on a bus that are not as the profile states them, and report how they answer."""
    from sextant.services.actuator.commissioning.torque_off import torque_off_of_others
    from sextant.services.actuator.servo_bus.bus_scan import on_wrong_bus
    from sextant.services.actuator.servo_bus.triage import USUAL_IDS
    from sextant.shared.servo.models import AX_12A

    if profile.servo.pulses and profile.servo.pulses.board != "maestro":  # an I2C bus has no other servos
        return None
    model = None if profile.servo.pulses else profile.servo_model
    with closing(open_bus(bus, profile, model=model or AX_12A)) as opened:
        echo = opened.echo_problem()
    if echo:
        say(f"{echo.words}\n  -> {echo.advice}")
    opener = opener_of(replace(bus, echo=bus.echo != bool(echo)), profile)
    elsewhere = profile.servos_elsewhere
    others = torque_off_of_others(opener, model, (*profile.servo_names, *elsewhere) if model else USUAL_IDS)
    if others is not None and others.first.servo_id in elsewhere:
        say("\n  -> ".join(on_wrong_bus(others.first.servo_id, elsewhere)))
    elif others is not None and (others.first.model, others.first.rate) != (model, model and model.bus_rate):
        say(bus.completed("\n  -> ".join(others.first.problem(model))))
    if others is not None and model is None:
        off, there = len(others.off), len(others.off) + len(others.left)
        say(f"{off} of {there} servos that answer on {bus.port} confirm torque off")
    return others


def _say_who_holds(left: dict[int, str], profile: "RobotProfile", bridged: bool) -> None:
    """Report the servos that did not confirm torque off, and how many did."""
    from sextant.services.actuator.servo_bus.bus_scan import Problem, grouped

    count, off = len(profile.servo_names), len(profile.servo_names) - len(left)
    alike = set(left.values())
    if off == 0 and len(alike) == 1:
        bridge = "" if bridged else f"{_ADD_BRIDGE}; otherwise "
        say(f"each of {count} servos {alike.pop()}\n  -> {bridge}switch their power off")
    else:
        found = {i: Problem(words, "check the cable, or switch the servos' power off") for i, words in left.items()}
        for words, advice in dict.fromkeys(grouped(found, profile.servo_names).values()):
            say(f"{words}\n  -> {advice}")
    say(f"{off} of {count} servos confirm torque off" if left else f"torque is off: confirmed by {off} of {count} servos")


def _latch(port: str) -> str:
    """Set the torque-off latch of a port; return the error as text, or nothing."""
    from sextant.services.actuator.safety.torque_off_latch import Latch
    from sextant.shared.runtime.clock import now_ns

    try:
        Latch.of_port(port).close(now_ns())
    except OSError as error:
        return f"torque is not latched off: {error}"
    return ""
