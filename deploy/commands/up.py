"""`sextant up`: the processes of a role, until Ctrl-C."""

import re
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, INTERRUPTED, SUCCESS, CommandError, InputError, complain, open_progress, say
from sextant.deploy.commands.servo_port import Bus
from sextant.deploy.terminal.arguments import Choice, argument, command, flag, option, options_of

if TYPE_CHECKING:
    from sextant.deploy.launch.process_table import Choices, Process, Role
    from sextant.deploy.live.page import Page
    from sextant.deploy.live.readiness import Readiness
    from sextant.deploy.security.router_security import Gate
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.evaluation.observers.monitor import Monitor
    from sextant.evaluation.observers.progress import Progress

_SHOW_S = 1.0  # interval of the table, and of the services' health messages


@dataclass(frozen=True, slots=True)
class Launch:
    """The processes that start on this machine, and the machines that they connect to."""

    role: "Role"
    scenario: str | None
    no_page: bool
    robot: str
    camera: str
    seed: int
    also: tuple[str, ...]
    without: tuple[str, ...]
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    key_folder: str | None
    unguarded: bool
    namespace: str
    settings: tuple[str, ...]


launch_options = options_of(
    Launch,
    "launch",
    argument(
        "role",
        "processes to start; onboard: actuator, stop, camera, imu, perception; offboard: all others",
        type=Choice(("all", "onboard", "offboard", "sim")),
    ),
    option("--scenario", "scenario to simulate instead of the hardware", "NAME"),
    flag("--no-page", "do not start the console, so there is no operator's page"),
    option("--robot", "profile by name, or path of a TOML file (default: the scenario's, or phantomx_mk2)", "NAME", default=""),
    option(
        "--camera",
        "openni2, realsense, oak, orbbec, external, none, or a recorded folder (default: the profile's)",
        "DEVICE",
        default="",
    ),
    options.seed,
    option("--with", "also run these processes here, e.g. mapper,planner", "NAMES", into="also", multiple=True),
    option("--without", "processes not to start here", "NAMES", multiple=True),
    option(
        "--listen",
        "endpoint of this machine's router (default: tcp/127.0.0.1:7447, with --keys also tls/0.0.0.0:7448)",
        "ENDPOINT",
        multiple=True,
    ),
    option(
        "--connect",
        "router of another machine to connect to whenever reachable, e.g. tls/robot.local:7448",
        "ENDPOINT",
        multiple=True,
    ),
    options.keys,
    flag("--open", "admit any client, without certificates; repeats a warning while it runs", "unguarded"),
    options.namespace,
    option("--set", "setting or parameter of a service; repeatable", "SERVICE.KEY=VALUE", into="settings", multiple=True),
)


@command()
@launch_options
@flag("--print-zenoh", "print the Zenoh configuration of this machine's router, and start nothing")
def up(launch: Launch, print_zenoh: bool) -> int:
    """Run the processes of a role until Ctrl-C."""
    from sextant.deploy.launch import process_table
    from sextant.deploy.launch.host_launcher import HostLauncher
    from sextant.deploy.live.page import Page
    from sextant.deploy.live.readiness import CameraReport
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.deploy.terminal.progress import Terminal
    from sextant.shared.runtime.process_priority import allow_many_files

    rows, chosen, extra = asked(launch)
    if print_zenoh:
        return _print_zenoh(gate_of(launch, rows, process_table.ROUTER_ENDPOINT))
    torque_off = ""  # command
    if any(row.name == "actuator" for row in rows) and not chosen.scenario:
        torque_off = _torque_off(extra.get("actuator", ()), chosen.robot)
    paged = any(row.name == "console" for row in rows)
    if paged:
        chosen = replace(chosen, console_port=_page_port(chosen.console_port, extra.get("console", ())))
    process_table.new_robot(chosen)
    allow_many_files()
    with Interrupts() as interrupts:
        gated = _apart(gate_of(launch, rows, _usual(launch)))
        progress = open_progress(False)
        drawn = isinstance(progress, Terminal)
        if chosen.scenario and launch.role == "all":
            _compile_first(progress, interrupts)
        tell = progress.say if drawn and sys.stderr.isatty() else complain  # output of the processes
        with HostLauncher(launch.role, rows, chosen, extra, gated, tell) as half:
            say(half.where())
            say(f"starting {', '.join(half.names)}; Ctrl-C stops them")
            page = Page(chosen.console_port) if paged else None
            if page:
                say(f"the operator's page: {page.url}")
            camera = CameraReport()
            readiness = _readiness(half.names, bool(chosen.scenario), page, gated, launch.role)
            shown = time.monotonic()
            problem = ""
            with _monitor(gated, launch.role) as monitor:
                while not problem and not interrupts.asked():
                    problem = half.beat(0.2)
                    if page:
                        page.show()
                    doing, now_s = monitor.view.doing, time.monotonic()
                    if half.has_started:
                        for line in (*readiness.lines(doing, now_s), *camera.lines(doing, now_s)):
                            progress.say(line)
                    if drawn and time.monotonic() - shown >= _SHOW_S:
                        shown = time.monotonic()
                        progress.update(monitor.view)
            progress.finish()
            if problem:
                complain(f"sextant up: {problem}")
            else:
                half.stop(interrupts.insisted)
    if torque_off:
        say(f"the servos keep their torque on or off, as it was; {torque_off} turns it off")
    return FAILED if problem else INTERRUPTED


def _compile_first(progress: "Progress", interrupts: "Interrupts") -> None:
    """Compile before the simulated robot takes the processor, if nothing has been compiled yet.

    Raises:
        CommandError: It failed.
    """
    from sextant.deploy.launch.warm_up import has_compiled
    from sextant.deploy.live import live_run

    if has_compiled():
        return
    if problem := live_run.warm_up(progress, interrupts, whole=False):
        raise CommandError(f"{problem}; `sextant doctor` checks what the services need")


def _readiness(names: Sequence[str], simulated: bool, page: "Page | None", gated: "Gate", role: "Role") -> "Readiness":
    """Return what announces that the services of this machine are ready."""
    from sextant.deploy.live.readiness import Readiness, next_steps

    connect = "" if gated.own == options.ROUTER else f"--connect {gated.own}"
    namespace = "" if gated.namespace == "sextant" else f"--namespace {gated.namespace}"
    words = " ".join(filter(None, (connect, namespace)))
    steps = next_steps(names, simulated, page.url if page else "", gated.own, gated.namespace, words)
    return Readiness(names, gated.role(role == "offboard"), steps)


@contextmanager
def _monitor(gated: "Gate", role: "Role") -> "Iterator[Monitor]":
    """Monitor the services in a thread of this process, while the context is entered."""
    from sextant.evaluation.observers.monitor import Monitor
    from sextant.shared.runtime.zenoh_runner import run_live
    from sextant.shared.wire.transport import Endpoints, ZenohLink

    monitor, stop = Monitor(None), threading.Event()
    with ZenohLink(Endpoints((gated.own,), namespace=gated.namespace)) as link:
        words = {"role": gated.role(role == "offboard")}
        running = threading.Thread(target=run_live, args=(monitor, link, stop), kwargs=words, name="monitor")
        running.start()
        try:
            yield monitor
        finally:
            stop.set()
            running.join()


def _print_zenoh(gated: "Gate") -> int:
    """Print the Zenoh configuration of this machine's router."""
    import json

    from sextant.shared.wire.transport import Router

    say(json.dumps(Router(gated.behind_proxy(0), gated.upstream, gated.configuration()).configuration, indent=2))
    return SUCCESS


def asked(launch: Launch) -> "tuple[tuple[Process, ...], Choices, dict[str, tuple[str, ...]]]":
    """Return the requested processes, their settings, and further settings by name."""
    rows = _rows(launch)
    chosen = _choices(launch, any(row.name == "simulator" for row in rows))
    device = _camera(launch.camera, chosen.robot, rows)
    absent = {"camera"} if device == "none" else set()
    if not _has_imu(chosen.robot):
        absent.add("imu")
    rows = tuple(row for row in rows if row.name not in absent)
    settings = launch.settings
    if not chosen.scenario and any(row.name == "actuator" for row in rows):
        settings = (*_usual_port(chosen.robot, _extra(settings, rows).get("actuator", ())), *settings)  # a later one counts
    return rows, replace(chosen, camera=launch.camera and device), _extra(settings, rows)


def _rows(launch: Launch) -> "tuple[Process, ...]":
    """Return the requested processes: those of the role, plus --with, minus --without."""
    from sextant.deploy.launch import process_table

    usual = process_table.rows(launch.role, simulated=launch.scenario is not None, page=not launch.no_page)
    try:
        return process_table.rearranged(usual, _names(launch.also), _names(launch.without), launch.role)
    except ValueError as error:
        raise InputError(str(error)) from None


def _names(words: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for word in words for name in word.split(",") if name)


def gate_of(launch: Launch, rows: "Sequence[Process]", usual: str) -> "Gate":
    """Return endpoints and access rules of this machine's router.

    It listens at `usual` where --listen is not given.

    Raises:
        AccessError: The router would admit any client without --open, or the keys are wrong.
    """
    from sextant.deploy.security import router_security

    keys, upstream = launch.key_folder, launch.connect
    gated = router_security.of_arguments(launch.listen, keys, launch.unguarded, launch.namespace, usual, upstream)
    gated.configuration()  # raises if the keys are wrong, before anything starts
    if misplaced := gated.misplaced([row.name for row in rows]):
        raise InputError(misplaced)
    return gated


def _apart(gated: "Gate") -> "Gate":
    """Add a loopback endpoint for local processes if all others are public."""
    from sextant.shared.wire.access import plain_elsewhere
    from sextant.shared.wire.ports import free_port

    if plain_elsewhere(gated.listen) != gated.listen:
        return gated
    return replace(gated, listen=(f"tcp/127.0.0.1:{free_port()}", *gated.listen))


def _usual(launch: Launch) -> str:
    """Return the usual router endpoint, or one with a free port if it is taken."""
    from sextant.deploy.launch.process_table import ROUTER_ENDPOINT
    from sextant.shared.wire.ports import free_port, port_taken

    if not (launch.connect and port_taken(int(ROUTER_ENDPOINT.rpartition(":")[2]))):
        return ROUTER_ENDPOINT
    return f"tcp/127.0.0.1:{free_port()}"  # a second machine's processes on the same machine


def _choices(launch: Launch, simulated: bool) -> "Choices":
    from sextant.deploy.launch.process_table import Choices, choices
    from sextant.shared.scenario.loading import absolute, load_scenario
    from sextant.shared.wire.ports import free_port

    robot = options.checked_robot(launch.robot)
    if launch.scenario is None and launch.role != "sim":
        return Choices(robot=robot) if robot else Choices()
    source = absolute(launch.scenario or "steps")
    scenario = load_scenario(source)
    chosen = choices(scenario, source, launch.seed)
    chosen = replace(chosen, robot=robot) if robot else chosen
    if simulated:
        from sextant.services.simulator.scenario_validation import check_scenario

        check_scenario(scenario, launch.seed, chosen.robot)
    # If both ends of the simulated servo bus start here, any free port will do, so two sets on one machine do not clash.
    return replace(chosen, bus_port=free_port()) if launch.role in ("all", "onboard") else chosen


def _camera(camera: str, robot: str, rows: "Sequence[Process]") -> str:
    """Return the camera to read, a folder as absolute path, or "none".

    It is "none" where no camera process is started.
    """
    from sextant.shared.robot.profile import CAMERA_DEVICES
    from sextant.shared.robot.profiles import load_profile

    if not any(row.name == "camera" for row in rows):
        if camera:
            raise InputError("--camera: no camera is started here; leave --scenario out, and use the role all or onboard")
        return "none"
    device = str(camera or load_profile(robot).camera.device)
    if device not in CAMERA_DEVICES:
        if not (Path(device) / "depth.txt").is_file():
            raise InputError(f"--camera: {', '.join(CAMERA_DEVICES)}, or a folder with depth.txt expected, found {device!r}")
        return str(Path(device).resolve())
    if device == "none" and not camera:
        say(f"no camera is started: the profile {robot} names none; give --camera with a device or a folder")
    return device


def _has_imu(robot: str) -> bool:
    """Return whether the robot has an IMU that is not part of its camera."""
    from sextant.shared.robot.profiles import load_profile

    return load_profile(robot).imu.is_separate


def _usual_port(robot: str, settings: Sequence[str]) -> tuple[str, ...]:
    """Return the setting of the servo port where servos are usually at another one than the actuator's default."""
    from sextant.services.actuator.config import Settings
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.runtime.process import load_settings

    port = load_profile(robot).servo.usual_port(bridge=load_settings(Settings, None, settings).bridge)
    return () if port == Settings().port else (f"actuator.port={port}",)


def _extra(assignments: Sequence[str], rows: "Sequence[Process]") -> dict[str, tuple[str, ...]]:
    from sextant.deploy.launch.process_table import further_settings

    try:
        return further_settings(assignments, rows)
    except ValueError as error:
        raise InputError(f"--set: {error}") from None


def _page_port(usual: int, settings: Sequence[str]) -> int:
    """Return the page's port: as requested, else the usual one, else a free one."""
    from sextant.deploy.live.page import page_port
    from sextant.services.console.config import Settings
    from sextant.shared.runtime.process import load_settings
    from sextant.shared.wire.ports import port_taken

    if any(re.match(r"port\s*=", setting) for setting in settings):
        port = load_settings(Settings, None, settings).port
        if port_taken(port):
            raise InputError(f"console.port: another program listens on port {port}; --set console.port=PORT names another")
        return port
    return page_port(lambda words: say(f"{words}; --set console.port=PORT selects another"), usual)


def _torque_off(settings: Sequence[str], robot: str) -> str:
    """Return the command that turns torque off; raise an InputError if the port is none for these servos or does not exist."""
    from sextant.services.actuator.config import Settings
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.runtime.process import load_settings
    from sextant.shared.servo.bus_ports import bus_ports, find_port, wrong_kind

    pulses, found = load_profile(robot).servo.pulses, load_settings(Settings, None, settings)
    board = pulses.board if pulses and not found.bridge else ""
    for names in bus_ports(found.port).values():
        for name in names:
            if words := wrong_kind(name, board):
                raise InputError(f"--set actuator.port: {words}")
        if any("://" in name or Path(name).exists() for name in names):
            continue
        raise InputError(
            f"no servo port {' or '.join(names)}; {find_port(names[0])}; --set actuator.port=DEVICE names another, and "
            "--scenario simulates it; `sextant doctor --port` checks a port"
        )
    return Bus(robot, found.port).completed("`sextant servos off --bridge`" if found.bridge else "`sextant servos off`")


def _pass_on(_name: str, line: str) -> None:
    complain(line)
