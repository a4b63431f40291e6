"""Checks of a servo port: device, access rights, latency, servos and calibration.

The servo checks include voltage and temperature. Nothing is moved and nothing is written to a servo.
"""

import os
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.doctor.check import Check, Level
from sextant.services.actuator.commissioning.bus_survey import hampered
from sextant.services.actuator.servo_bus import usb_adapter
from sextant.shared.files.config import ConfigError
from sextant.shared.servo.bus_ports import all_ports, bus_ports, find_port, wrong_kind, wrong_ports

if TYPE_CHECKING:
    from sextant.services.actuator.servo_bus.bus_driver import Port
    from sextant.services.actuator.servo_bus.bus_scan import ServoScan
    from sextant.services.actuator.servo_bus.servo_interface import Servos
    from sextant.shared.robot.profile import RobotProfile
    from sextant.shared.servo.servo_model import ServoModel

_PATIENCE_NS = 50_000_000  # [ns] to wait for an answer; a servo that answers late is present
_OLD_DAYS = 180  # [days] of a calibration: horns settle and screws are loosened
_NO_POWER = "check the servos' power and the cable at the adapter; if a microcontroller drives the servos, add --bridge"
_DEVICES = ("ttyUSB*", "ttyACM*")


def examine(port: str | None, robot: str, dev: Path = Path("/dev"), *, bridge: bool = False) -> Iterator[Check]:
    """Check a servo port and the robot on it.

    Without a port, report that none is checked; a base station has none. With `bridge` a microcontroller is at the port.
    """
    if port is None:
        yield none_given(dev)
        return
    away = [wrong for one in all_ports(port) if (wrong := out_of_reach(one))]
    if away:
        yield from away
        return
    try:
        import serial  # noqa: F401  (the driver that opens the port)

        from sextant.shared.robot.profiles import load_profile
    except ImportError as error:
        yield Check(f"servo port {port}", Level.FAIL, str(error), "pip install -e '.[actuator]'")
        return
    try:
        profile = load_profile(robot)
    except ConfigError as error:
        yield Check(f"servo port {port}", Level.FAIL, str(error), "correct the profile, or give another with --robot")
        return
    if words := wrong_ports(bus_ports(port), [bus.name for bus in profile.servos.buses]):
        advice = "name the port of each bus with --port" if profile.buses else "give the port alone with --port"
        yield Check(f"servo port {port}", Level.FAIL, words, advice)
        return
    board = profile.servo.pulses.board if profile.servo.pulses and not bridge else ""
    if words := next(filter(None, (wrong_kind(one, board) for one in all_ports(port))), ""):
        yield Check(f"servo port {port}", Level.FAIL, words, "name the port with --port, and the robot with --robot")
        return
    for one_port, servos_on_it in [(port, profile)] if bridge else of_each_bus(port, profile):
        yield from at_bridge(one_port, servos_on_it) if bridge else servos(one_port, servos_on_it)
        yield latency(one_port)
    made = calibration(profile, date.today())
    yield replace(made, advice=f"{made.advice}, with an adapter in the board's place") if bridge and made.advice else made


def of_each_bus(port: str, profile: "RobotProfile") -> "list[tuple[str, RobotProfile]]":
    """Return port and servos of each bus of a robot."""
    from sextant.shared.robot.one_bus import on_bus

    if not profile.buses:
        return [(port, profile)]
    return [(bus_ports(port)[bus.name][0], on_bus(profile, bus.name)) for bus in profile.buses]


def none_given(dev: Path) -> Check:
    """Report that no port is checked, and which ports exist."""
    there = sorted(str(device) for pattern in _DEVICES for device in dev.glob(pattern))
    words = f"not checked; give --port {there[0]} to check it" if there else "none found; a base station needs none"
    return Check("servo port", Level.OK, words)


def out_of_reach(port: str) -> Check | None:
    """Return why this process cannot open a port; None if it can."""
    name = f"servo port {port}"
    if "://" in port:
        return None
    path = Path(port)
    if not path.exists():
        return Check(name, Level.FAIL, "no such device", find_port(port))
    if not os.access(path, os.R_OK | os.W_OK):
        group = path.group()
        advice = f"`sudo usermod -aG {group} $USER`, then log in again"
        return Check(name, Level.FAIL, f"no permission to read and write (group {group})", advice)
    return None


def servos(port: str, profile: "RobotProfile") -> Iterator[Check]:
    """Check that all of the robot's servos respond, and their state."""
    from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, open_port
    from sextant.services.actuator.servo_bus.bus_scan import ALSO_ASKS, ECHO
    from sextant.services.actuator.servo_bus.other_device import NotAServoBusError

    if profile.servo.pulses is not None:
        yield from board(port, profile)
        return
    name, model = f"servo port {port}", profile.servo_model
    try:
        opened = open_port(port, model.bus_rate, _PATIENCE_NS)
    except BusDisconnectedError as error:
        yield Check(name, Level.FAIL, str(error), "give another port with --port")
        return
    try:
        seen, echo = _called(opened, profile)
    except BusDisconnectedError as error:
        advice = "check the plug and the cable"
        if isinstance(error, NotAServoBusError):
            advice = "add --bridge" if error.is_bridge else "give another port with --port"
        yield Check(name, Level.FAIL, str(error), advice)
        return
    if echo:
        yield Check(name, Level.WARN, *ECHO)
    yield from answering(name, seen, profile, f"{_NO_POWER}; {ALSO_ASKS}")


def answering(name: str, seen: "dict[int, ServoScan]", profile: "RobotProfile", power: str) -> Iterator[Check]:
    """Check that all of the robot's servos are among those that answer, and their state; `power` is the advice for none."""
    from sextant.services.actuator.servo_bus.bus_scan import problems

    names = profile.servo_names
    if not seen:
        yield Check(name, Level.FAIL, f"none of {len(names)} servos answers", power)
        return
    wrong = problems(names, seen)
    words = "; ".join(dict.fromkeys(problem.words for problem in wrong.values()))
    advice = "; ".join(dict.fromkeys(problem.advice for problem in wrong.values()))
    pulling = sum(bool(one[one.expected.table.torque_enable]) for i, one in seen.items() if i not in wrong)
    fine = f"all {len(names)} servos answer" + (f"; torque is on at {pulling} of them" if pulling else "")
    yield Check(name, Level.FAIL if wrong else Level.OK, words or fine, advice)
    right = [one for i, one in seen.items() if i not in wrong]
    yield from well(right, profile)
    if wrong_settings := hampered(right, profile):
        words, advice = ("; ".join(dict.fromkeys(part)) for part in zip(*wrong_settings, strict=True))
        yield Check("servo settings", Level.WARN, words, advice)


def board(port: str, profile: "RobotProfile") -> Iterator[Check]:
    """Check that the board answers that sends pulses to hobby servos; the servos themselves cannot be checked."""
    from sextant.services.actuator.commissioning.pulse_commissioning import open_servos
    from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, BusSetupError

    name = f"servo port {port}"
    try:
        with closing(open_servos(port, profile, time.monotonic_ns)) as opened:
            opened.setup()
            found = list(pulses(name, opened, profile))
    except (BusDisconnectedError, BusSetupError) as error:
        words = _in_place_of_board(port, profile, error) or str(error)
        yield Check(name, Level.FAIL, words, "check the board's power and cable, or give another port with --port")
        return
    yield from found


def pulses(name: str, board: "Servos", profile: "RobotProfile") -> Iterator[Check]:
    """Report the channels with pulses of a board that answers."""
    from sextant.services.actuator.commissioning.pulse_commissioning import NO_FEEDBACK

    channels = profile.servo_names
    count = sum(bool(board.read(channel, board.model_of(channel).table.torque_enable)) for channel in channels)
    yield Check(name, Level.OK, f"the board answers; it sends pulses on {count} of {len(channels)} channels")
    yield Check("servo feedback", Level.WARN, NO_FEEDBACK, "watch the legs and the battery yourself")


def at_bridge(port: str, profile: "RobotProfile") -> Iterator[Check]:
    """Check that a microcontroller answers and reaches all of the robot's servos, and their state."""
    from sextant.services.actuator.config import Settings
    from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, BusSetupError, open_port
    from sextant.services.actuator.servo_bus.bus_scan import call
    from sextant.services.actuator.servo_bus.bus_setup import BoardSilentError
    from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
    from sextant.services.actuator.servo_bus.servo_interface import on_port

    name = f"servo port {port}"
    try:
        with closing(open_port(port, timeout_ns=READ_NS)) as opened:
            board = on_port(profile, Settings(bridge=True), opened, time.monotonic_ns)
            board.open_session()
            if isinstance(board, Bridge):
                seen = call(board.registers, profile.servo_names)
                yield from answering(name, seen, profile, "check the servos' power and the cable at the board")
            else:
                yield from pulses(name, board, profile)
    except (BusDisconnectedError, BoardSilentError) as error:
        yield Check(name, Level.FAIL, str(error), "check the board's power and cable, or give another port with --port")
    except BusSetupError as error:
        yield Check(name, Level.FAIL, str(error), "make the board's config.py and the profile agree: docs/bridge.md")


def _in_place_of_board(port: str, profile: "RobotProfile", error: Exception) -> str:
    """Return what else answers on the port of a board that is silent, or ""."""
    from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, ServoBus, open_port
    from sextant.services.actuator.servo_bus.bus_scan import FACTORY_ID
    from sextant.services.actuator.servo_bus.bus_setup import BoardSilentError
    from sextant.services.actuator.servo_bus.command_bus import bus_of
    from sextant.services.actuator.servo_bus.triage import Opener, instead_of_board

    if not isinstance(error, BoardSilentError) or profile.servo.pulses is None:
        return ""

    def at(rate: int, model: "ServoModel") -> ServoBus:
        opened = open_port(port, rate, _PATIENCE_NS)
        return bus_of(model)(opened, [FACTORY_ID], time.monotonic_ns, model=model, reply_timeout_ns=_PATIENCE_NS)

    try:
        found = instead_of_board(Opener(at, port, "://" not in port), profile.servo.pulses.board)
    except BusDisconnectedError as other:
        return str(other)
    return ": ".join(found or ())


def _called(port: "Port", profile: "RobotProfile") -> "tuple[dict[int, ServoScan], bool]":
    """Return the servos that respond, and whether the adapter echoes.

    The port is closed at the end.

    Raises:
        NotAServoBusError: Another device sends on the port.
        BusDisconnectedError: The port is gone.
    """
    from sextant.services.actuator.servo_bus.bus_scan import ECHO, call
    from sextant.services.actuator.servo_bus.command_bus import bus_of
    from sextant.services.actuator.servo_bus.other_device import refuse_another_device

    names = profile.servo_names
    connect = partial(
        bus_of(profile.servo_model),
        port,
        list(names),
        time.monotonic_ns,
        model=profile.servo_model,
        models=profile.servo_models,
        names=names,
    )
    bus = connect(reply_timeout_ns=_PATIENCE_NS)
    try:
        echo = bus.echo_problem() is ECHO
        bus = connect(echo=True, reply_timeout_ns=_PATIENCE_NS) if echo else bus
        seen = call(bus, names)
        if not seen:
            refuse_another_device(bus)
        return seen, echo
    finally:
        bus.close()


def well(seen: "list[ServoScan]", profile: "RobotProfile") -> Iterator[Check]:
    """Check voltage, temperature and error registers of working servos."""
    from sextant.services.actuator.servo_bus.bus_scan import Problem, grouped, named
    from sextant.services.actuator.servo_bus.servo_health import WARM, error_of, remedy_of, span

    if not seen:
        return
    names, low = profile.servo_names, profile.battery.warn_voltage
    volts, degrees = sorted(one.voltage for one in seen), [one.temperature for one in seen]
    advice = f"charge the battery to at least {low:g} V" if volts[0] < low else ""
    yield Check("servo voltage", Level.WARN if advice else Level.OK, f"{span(volts, 1)} V", advice)
    warm = [one for one in seen if one.temperature > one[one.expected.table.temperature_limit] - WARM]
    words = ", ".join(named(one.servo_id, names) for one in warm)
    found = f"{span(degrees, 0)} deg C" + (f"; near their limit: {words}" if warm else "")
    yield Check("servo temperature", Level.WARN if warm else Level.OK, found, "let the servos cool down" if warm else "")
    errors = {one.servo_id: Problem(f"reports {words}", remedy_of(one)) for one in seen if (words := error_of(one))}
    if errors:
        told, advice = ("; ".join(dict.fromkeys(part)) for part in zip(*grouped(errors, names).values(), strict=True))
        yield Check("servo errors", Level.FAIL, told, advice)


def latency(port: str, devices: Path = usb_adapter.DEVICES) -> Check:
    """Name the adapter, and check its latency timer, after the port was opened once."""
    found = usb_adapter.latency_ms(port, devices)
    words = "none" if found is None else f"{found} ms"
    words = f"{words}; the adapter is {name}" if (name := usb_adapter.name_of(port)) else words
    advice = usb_adapter.advice(port, devices)
    return Check("latency timer", Level.WARN if advice else Level.OK, words, advice)


def calibration(profile: "RobotProfile", today: date) -> Check:
    """Check that the horns of every leg are calibrated, and how long ago."""
    from sextant.shared.robot.profile import LEGS

    name, measured = "calibration", {entry.leg: entry.date for entry in profile.calibration}
    advice = "`sextant servos calibrate` measures the horn offsets"
    missing = [leg for leg in LEGS if leg not in measured]
    if not measured:
        words = f"none in the profile {profile.name}; give the robot's own TOML file with --robot once it exists"
        return Check(name, Level.WARN, words, advice)
    age = (today - min(measured.values())).days
    words = f"{age} days old" + (f"; missing: {', '.join(missing)}" if missing else "")
    return Check(name, Level.WARN, words, advice) if missing or age > _OLD_DAYS else Check(name, Level.OK, words)
