"""The port of servos for a command: its default, how it is opened, and the commands for it that messages name."""

import re
import shlex
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import wraps
from types import FrameType
from typing import TYPE_CHECKING, Any

from sextant.deploy.commands.common import CommandError, InputError
from sextant.deploy.terminal.interrupts import Interrupts
from sextant.shared.errors import SextantError

if TYPE_CHECKING:
    from sextant.services.actuator.commissioning.bus_survey import Line
    from sextant.services.actuator.servo_bus.bus_driver import ServoBus
    from sextant.services.actuator.servo_bus.bus_scan import Problem
    from sextant.services.actuator.servo_bus.servo_interface import Servos
    from sextant.services.actuator.servo_bus.several_buses import AnyBus
    from sextant.services.actuator.servo_bus.triage import Opener
    from sextant.shared.robot.profile import RobotProfile
    from sextant.shared.servo.servo_model import ServoModel

PATIENCE_NS = 25_000_000  # [ns] to wait for an answer; longer than an adapter's default latency timer
_LONGEST_BYTES = 110  # [bytes] of the longest answer that a scan reads, with its request
_NETWORK_PATIENCE_NS = 50_000_000  # [ns] longer, because a machine that emulates servos may be busy
_COMMAND = re.compile(r"`(sextant servos (?:scan|set-id(?: --all-rates)?|calibrate|test|off(?: --bridge)?))`")
_DEFAULTS = {"robot": "phantomx_mk2", "port": "/dev/ttyUSB0"}  # that no command has to name


@dataclass(frozen=True, slots=True)
class Bus:
    """A servo bus at a port, and the robot that it belongs to."""

    robot: str
    port: str
    echo: bool = False

    @property
    def networked(self) -> bool:
        """Whether the port is at a network address."""
        return "://" in self.port

    def of_robot(self, *, bridge: bool = False) -> "tuple[Bus, RobotProfile]":
        """Return the bus with the usual port of the robot's servos, unless one is given, and the robot's profile.

        Args:
            bridge: Whether a microcontroller is at the port.

        Raises:
            InputError: The robot's servos cannot be on such a port.
        """
        from sextant.shared.robot.profiles import load_profile

        profile = load_profile(self.robot)
        return self.checked(profile, bridge=bridge), profile

    def checked(self, profile: "RobotProfile | None", *, bridge: bool = False) -> "Bus":
        """Return the bus with the usual port of the robot's servos, unless one is given; None is for servos of no robot.

        Raises:
            InputError: The port is of another kind, or named as a bus that the robot does not have.
        """
        from sextant.shared.servo.bus_ports import all_ports, bus_ports, wrong_kind, wrong_ports

        servo = profile.servo if profile else None
        if not self.port:
            return replace(self, port=servo.usual_port(bridge=bridge) if servo else _DEFAULTS["port"])
        if not (profile and profile.buses) and (words := wrong_ports(bus_ports(self.port), [""])):
            raise InputError(f"--port: {words}")
        board = servo.pulses.board if servo and servo.pulses and not bridge else ""
        for port in all_ports(self.port):
            if words := wrong_kind(port, board):
                raise InputError(f"--port: {words}")
        return self

    def completed(self, text: str) -> str:
        """Add port and robot to each command of `sextant servos` that a text names."""
        given = {"port": self.port, "robot": self.robot}
        words = [f" --{name} {shlex.quote(value)}" for name, value in given.items() if value not in ("", _DEFAULTS[name])]
        return _COMMAND.sub(lambda found: f"`{found[1]}{''.join(words)}`", text)


def completing(command: Callable[..., int]) -> Callable[..., int]:
    """Return a command of `sextant servos` whose errors name whole commands."""

    @wraps(command)
    def run(**values: Any) -> int:
        try:
            return command(**values)
        except SextantError as error:
            one = values.get("bus") or values["one"]
            words = Bus(one.robot or "", one.port).completed(str(error))
            if words == str(error):
                raise
            raise CommandError(words) from error

    return run


def of_each_bus(bus: Bus, profile: "RobotProfile") -> "list[tuple[str, Bus, RobotProfile]]":
    """Return name, port and servos of each bus that --port names; the only bus of a robot has no name."""
    from sextant.shared.robot.one_bus import on_bus
    from sextant.shared.servo.bus_ports import bus_ports, wrong_ports

    if not profile.buses:
        return [("", bus, profile)]
    ports, names = bus_ports(bus.port), [part.name for part in profile.buses]
    if not ports.keys() <= set(names):
        raise InputError(f"--port: {wrong_ports(ports, names)}")
    return [(name, replace(bus, port=ports[name][0]), on_bus(profile, name)) for name in names if name in ports]


def of_servo(bus: Bus, profile: "RobotProfile", servo_id: int) -> Bus:
    """Return the bus of a servo, if --port names buses; else the bus as it is."""
    from sextant.shared.servo.bus_ports import bus_ports

    if not profile.buses or "" in bus_ports(bus.port):
        return bus
    found = next((port for _, port, on_it in of_each_bus(bus, profile) if servo_id in on_it.servo_names), None)
    if found is None:
        raise InputError(f"--port: the port of the bus with servo {servo_id} expected, found {bus.port!r}")
    return found


def open_all(bus: Bus, profile: "RobotProfile") -> "AnyBus":
    """Open all servos of a robot, on one bus or several; raises BusDisconnectedError."""
    from sextant.services.actuator.servo_bus.several_buses import SeveralBuses
    from sextant.shared.servo.bus_ports import bus_ports, wrong_ports

    if not profile.buses:
        return open_bus(bus, profile)
    if words := wrong_ports(bus_ports(bus.port), [part.name for part in profile.buses]):
        raise InputError(f"--port: {words}")
    each = zip(profile.servos.buses, of_each_bus(bus, profile), strict=True)
    return SeveralBuses({part: open_bus(one_bus, on_it) for part, (_, one_bus, on_it) in each})


@contextmanager
def open_line(bus: Bus, profile: "RobotProfile", all_rates: bool = False) -> "Iterator[Line]":
    """Open the servo port; close it at the end, also after a signal."""
    from sextant.services.actuator.commissioning.bus_survey import Line
    from sextant.services.actuator.servo_bus import triage

    of_model = triage.all_rates if all_rates else triage.usual_rates
    models = (profile.servo_model, *profile.servo_models.values())
    rates = (models[0].bus_rate,) if bus.networked else triage.rates_of_all(models, of_model)
    with ended_once(), closing(Line(lambda rate: open_bus(bus, profile, rate), rates)) as line:
        yield line


def examine(bus: Bus, profile: "RobotProfile", rates: Sequence[int], ids: range) -> "Problem | None":
    """Return why no servo of the robot answers on the port, or None."""
    from sextant.services.actuator.servo_bus import triage

    opener = opener_of(bus, profile)
    asked = [i for i in profile.servo_names if i in ids] or list(ids)
    elsewhere = {i: name for i, name in profile.servos_elsewhere.items() if i in ids}
    return triage.examine(opener, profile.servo_model, asked, rates, elsewhere)


def opener_of(bus: Bus, profile: "RobotProfile") -> "Opener":
    """Return what opens the port for servos of several families."""
    from sextant.services.actuator.servo_bus.triage import Opener

    return Opener(lambda rate, model: open_bus(bus, profile, rate, model), bus.port, not bus.networked)


def open_bus(bus: Bus, profile: "RobotProfile", rate: int | None = None, model: "ServoModel | None" = None) -> "ServoBus":
    """Open the servos at the port, at a baud rate [1/s] and of a model; None is the robot's own.

    Raises:
        BusDisconnectedError: The port cannot be opened.
    """
    model = model or profile.servo_model
    same = model.protocol is profile.servo_model.protocol
    models = profile.servo_models if same else None  # else it asks for servos of another protocol
    return open_ids(bus, profile.servo_names, model, rate or model.bus_rate, models)


def open_ids(
    bus: Bus, names: "Mapping[int, str]", model: "ServoModel", rate: int, models: "Mapping[int, ServoModel] | None" = None
) -> "ServoBus":
    """Open servos by their ids, which are of a model, or of others by id; raises BusDisconnectedError."""
    from sextant.services.actuator.servo_bus.bus_driver import open_port
    from sextant.services.actuator.servo_bus.command_bus import bus_of

    patience = _NETWORK_PATIENCE_NS if bus.networked else patience_ns(rate)
    return bus_of(model)(
        open_port(bus.port, rate, patience),
        [i for i in names if i <= model.protocol.MAX_ID],
        time.monotonic_ns,
        model=model,
        models=models,
        names=names,
        echo=bus.echo,
        reply_timeout_ns=patience,
    )


def open_servos(bus: Bus, profile: "RobotProfile", bridge: bool) -> "Servos":
    """Open the servos of a robot on their bus, behind a microcontroller or behind a board that sends pulses."""
    from sextant.services.actuator.commissioning.pulse_commissioning import open_servos as open_board

    if bridge:
        return open_bridge(bus.port, profile)
    if profile.servo.pulses is not None:
        return open_board(bus.port, profile, time.monotonic_ns)
    return open_all(bus, profile)


def open_bridge(port: str, profile: "RobotProfile") -> "Servos":
    """Open the servos behind a microcontroller at the port.

    Raises:
        BusDisconnectedError: The port cannot be opened.
    """
    from sextant.services.actuator.servo_bus.bridge_link import READ_NS
    from sextant.services.actuator.servo_bus.bus_driver import open_port
    from sextant.services.actuator.servo_bus.servo_interface import behind_bridge

    return behind_bridge(profile, open_port(port, timeout_ns=READ_NS), time.monotonic_ns)


def patience_ns(rate: int) -> int:
    """Return the time [ns] to wait for an answer at a baud rate [1/s]: slow rates need longer for their longest answer."""
    return PATIENCE_NS + _LONGEST_BYTES * 10 * 1_000_000_000 // rate


class _Once(Interrupts):
    """Raise only the first Ctrl-C, SIGTERM or SIGHUP while entered.

    Later signals are ignored, because the command is cleaning up.
    """

    def _count(self, number: int, frame: FrameType | None) -> None:
        super()._count(number, frame)
        if not self.insisted():
            raise KeyboardInterrupt


def ended_once() -> AbstractContextManager[object]:
    """Return a context in which the first signal ends a command like Ctrl-C.

    Outside the main thread it does nothing, because only that thread receives signals.
    """
    return _Once() if threading.current_thread() is threading.main_thread() else nullcontext()
