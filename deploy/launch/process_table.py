"""Table of Sextant's processes, and the commands that start them.

The launcher, the systemd units and compose.yaml are made from this table.
"""

import difflib
import importlib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from sextant.evaluation import params
from sextant.evaluation.params import SystemParams
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.params import Params
from sextant.shared.plugins.loading import Plugins
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.process import load_settings
from sextant.shared.scenario.scenario import MapOptions, Scenario
from sextant.shared.wire.transport import Endpoints

Value = str | int | float | bool | list[Any]
Role = Literal["all", "onboard", "offboard", "sim"]

BUS_PORT = 7450  # TCP port of the simulated servo bus in compose
ROUTER_ENDPOINT = "tcp/127.0.0.1:7447"
_ROUTER_SILENT_S = 1.5  # [s] watchdog timeout, as for the actuator; the router's links survive one second of silence

# One thread per library, so that a service does not take the cores of the other services.
ENVIRONMENT: Mapping[str, str] = {
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONUNBUFFERED": "1",
}
_ONE_HEAP = {"MALLOC_ARENA_MAX": "1"}  # GNU C library only; other C libraries have one heap anyway


@dataclass(frozen=True, slots=True)
class Choices:
    """Settings of a run that the processes receive."""

    robot: str = "phantomx_mk2"
    scenario: str = ""  # name or path that the simulator loads; empty without simulation
    seed: int = 3
    bus_port: int = BUS_PORT  # TCP port of the simulated servo bus
    viewer: bool = False  # the simulator opens MuJoCo's viewer
    blind: bool = False
    footholds: str = "score"  # map layer that the planner plans on
    arc: str = "flow"  # trajectory of swing feet
    bridge: bool = False  # a microcontroller drives the servo bus
    registration: str = "projective"
    pose_error: str = "none"  # pose error model of the scenario; simulation only
    map: MapOptions = field(default_factory=MapOptions)
    lift: float = 0.04  # [m] lift of swing feet when an operator drives the robot
    console_port: int = 8080  # TCP port of the operator page
    recordings: str = "recordings"  # folder for the operator's recordings
    params: SystemParams = field(default_factory=SystemParams)
    plugins: Plugins = field(default_factory=Plugins)
    camera: str = ""  # device that replaces the profile's: one of CAMERA_DEVICES, or a recorded folder


@dataclass(frozen=True, slots=True)
class Process:
    """One row of the table."""

    name: str
    module: str  # run with python -m
    # Place: "simulation" in place of the hardware, "device" on the robot only, "page" on request, "either" anywhere.
    side: Literal["robot", "device", "either", "simulation", "page"]
    restarts: int  # maximum number of restarts per run after it died
    settings: Callable[[Choices], dict[str, Value]] = field(compare=False)
    nice: int = 0  # niceness [1]: priority is lowered by this; 0 for the processes of the servos
    urgent: bool = False  # real-time priority on a robot, where the user may set it: for loops with a fixed period
    after: tuple[str, ...] = ()  # processes that must be ready before it starts
    ready_port: Callable[[Choices], int] = field(default=lambda _: 0, compare=False)  # once ready it listens there; 0: at once
    watchdog_s: float = 10.0  # [s] its loop may be silent after its first sign of life before it counts as hung
    memory_mb: int = 512  # [MB] memory limit, several times the measured use
    one_heap: bool = False  # one heap for all threads: separate heaps grow if one thread frees what others allocated


def _simulator(choices: Choices) -> dict[str, Value]:
    bridge: dict[str, Value] = {"bridge": True} if choices.bridge else {}
    viewer: dict[str, Value] = {"viewer": True} if choices.viewer else {}
    return {"scenario": choices.scenario, "seed": choices.seed, "bus_port": choices.bus_port, **bridge, **viewer}


def _camera(choices: Choices) -> dict[str, Value]:
    return {"device": choices.camera} if choices.camera else {}


def _perception(choices: Choices) -> dict[str, Value]:
    fine: dict[str, Value] = {"scan_resolution": choices.map.scan_resolution} if choices.map != MapOptions() else {}
    erring: dict[str, Value] = {} if choices.pose_error == "none" else {"pose_error": choices.pose_error, "seed": choices.seed}
    plugin = _named("registration", choices.plugins.registration)
    return {"method": choices.registration, **plugin, **fine, **erring, **_tuned(choices.params.perception)}


def _mapper(choices: Choices) -> dict[str, Value]:
    chosen = choices.map
    size: dict[str, Value] = {"cells": chosen.cells, "cells_y": chosen.cells_y, "resolution": chosen.resolution}
    plugin = _named("foothold_rule", choices.plugins.foothold)
    return {**(size if chosen != MapOptions() else {}), **plugin, **_tuned(choices.params.mapper)}


def _planner(choices: Choices) -> dict[str, Value]:
    plugin = _named("step_planner", choices.plugins.planner)
    return {"blind": choices.blind, "footholds": choices.footholds, **plugin, **_tuned(choices.params.planner)}


def _named(setting: str, plugin: str) -> dict[str, Value]:
    return {setting: plugin} if plugin else {}


def _tuned(of: Params) -> dict[str, Value]:
    """Return dotted key -> value of the parameters that differ from their defaults."""
    return params.flat(params.changes(of))


def _console(choices: Choices) -> dict[str, Value]:
    return {"port": choices.console_port, "lift": choices.lift}


def _recorder(choices: Choices) -> dict[str, Value]:
    return {"folder": choices.recordings}


def _servo_port(choices: Choices) -> dict[str, Value]:
    if not choices.scenario:
        return {}
    ports = [
        f"{bus.name}=socket://127.0.0.1:{choices.bus_port + number}" if bus.name else f"socket://127.0.0.1:{choices.bus_port}"
        for number, bus in enumerate(load_profile(choices.robot).servos.buses)
    ]
    return {"port": ", ".join(ports)}


def _actuator(choices: Choices) -> dict[str, Value]:
    arc: dict[str, Value] = {} if choices.arc == "flow" else {"arc": choices.arc}
    bridge: dict[str, Value] = {"bridge": True} if choices.bridge else {}
    return {**_servo_port(choices), **arc, **bridge, **_tuned(choices.params.actuator)}


# A crash of the simulator loses the world, so the run fails; all other processes recover their state from received messages.
TABLE: tuple[Process, ...] = (
    Process(
        "simulator",
        "sextant.services.simulator",
        "simulation",
        0,
        _simulator,
        ready_port=lambda choices: choices.bus_port,
        memory_mb=1024,
    ),
    Process(
        "actuator",
        "sextant.services.actuator",
        "robot",
        3,
        _actuator,
        urgent=True,
        after=("simulator",),
        watchdog_s=1.5,
        memory_mb=256,
    ),
    Process("stop", "sextant.services.actuator.estop", "robot", 3, _servo_port, watchdog_s=1.5, memory_mb=256),
    Process("camera", "sextant.services.perception.cameras", "device", 3, _camera),
    Process("imu", "sextant.services.perception.imu", "device", 3, lambda _: {}, memory_mb=256),
    Process("perception", "sextant.services.perception", "robot", 3, _perception, nice=2, memory_mb=1024),
    Process("mapper", "sextant.services.mapper", "either", 3, _mapper, nice=5, memory_mb=1024),
    Process("planner", "sextant.services.planner", "either", 3, _planner, nice=2, memory_mb=768),
    Process("console", "sextant.services.console", "page", 3, _console, memory_mb=256),  # it can stop the robot without a map
    # Its timeout is long because a disk may be slow.
    Process(
        "recorder",
        "sextant.services.console.recorder",
        "page",
        3,
        _recorder,
        nice=3,
        watchdog_s=120.0,
        memory_mb=512,
        one_heap=True,
    ),
)


ON_ROBOT = frozenset(p.name for p in TABLE if p.side == "device" or p.name in ("actuator", "stop"))  # never on another machine
# Processes that pack arrays, unless these readers run on the same machine.
_READERS: Mapping[str, frozenset[str]] = {
    "perception": frozenset(("mapper",)),
    "mapper": frozenset(("planner", "console")),
}


@dataclass(frozen=True, slots=True)
class Command:
    """How to start one process."""

    name: str
    arguments: tuple[str, ...]  # after the Python interpreter
    environment: Mapping[str, str]  # in addition to the inherited environment
    restarts: int = 0
    after: tuple[str, ...] = ()  # processes that must be ready before this one starts
    ready_port: int = 0  # TCP port of 127.0.0.1 that it listens on once it is ready; 0: ready at once
    watchdog_s: float = 0.0  # [s] without a sign of life after which it is ended as hung; 0: no watchdog
    memory_mb: int = 0  # [MB] memory limit in containers and units; 0: no limit


def choices(scenario: Scenario, source: str, seed: int, bus_port: int = BUS_PORT) -> Choices:
    """Return the settings that a scenario gives the processes.

    `source` is the name or the path of the scenario.

    Raises:
        ConfigError: Parameters of the scenario are invalid.
    """
    return Choices(
        robot=scenario.robot,
        scenario=source,
        seed=seed,
        bus_port=bus_port,
        blind=scenario.walk.blind,
        footholds=scenario.walk.footholds,
        arc=scenario.walk.arc,
        bridge=scenario.bridge,
        registration=scenario.variation.registration,
        pose_error=scenario.pose_error,
        map=scenario.map,
        lift=scenario.walk.lift,
        params=params.of_scenario(scenario),
        plugins=scenario.plugins,
    )


def new_robot(chosen: Choices) -> None:
    """Open the torque-off latch of a simulated robot.

    Every simulated robot is a new one, so it must not inherit the latch of an earlier one.
    """
    if chosen.scenario:
        Latch.of_port(str(_servo_port(chosen)["port"])).open()


def rows(role: Role, simulated: bool, page: bool = False) -> tuple[Process, ...]:
    """Return the processes of a role.

    "onboard" is what must run on the robot, "offboard" the rest, "all" both. `page` adds the console and the recorder.
    """
    sides = {"all": ["robot", "device", "either"], "onboard": ["robot", "device"], "offboard": ["either"], "sim": []}[role]
    if role == "sim" or (simulated and role != "offboard"):
        sides = ["simulation", *(side for side in sides if side != "device")]
    if page and role in ("all", "offboard"):
        sides = [*sides, "page"]
    return tuple(p for p in TABLE if p.side in sides)


def rearranged(usual: Sequence[Process], also: Sequence[str], without: Sequence[str], role: Role) -> tuple[Process, ...]:
    """Return the processes of a role with some added and some removed, in table order.

    Args:
        usual: The processes of the role.
        also: Names of processes to add.
        without: Names of processes to remove, because they run elsewhere or not at all.
        role: The role, for error messages.

    Raises:
        ValueError: A name is unknown, or a process cannot run there.
    """
    known = {p.name: p for p in TABLE}
    names = {p.name for p in usual}
    for name in (*also, *without):
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            raise ValueError(f"no process {name!r}; {f'did you mean {near[0]!r}?' if near else ', '.join(known)}")
    for name in also:
        if role == "offboard" and name in ON_ROBOT:
            raise ValueError(f"{name} must run on the robot, with its servos and camera; `sextant up onboard` starts it there")
        if known[name].side == "simulation" and name not in names:
            raise ValueError(f"{name} is a simulation process; --scenario starts it")
    for name in without:
        if name not in names:
            raise ValueError(f"{name} is not started by the role {role}, which starts {', '.join(p.name for p in usual)}")
    names = (names | set(also)) - set(without)
    return tuple(p for p in TABLE if p.name in names)


def further_settings(assignments: Iterable[str], processes: Sequence[Process]) -> dict[str, tuple[str, ...]]:
    """Return process name -> assignments `key=value`, from texts SERVICE.KEY=VALUE.

    Raises:
        ValueError: A text is malformed, its process is not started, or has no such setting.
    """
    names = [p.name for p in processes]
    extra: dict[str, tuple[str, ...]] = {}
    for text in assignments:
        service, dot, rest = text.partition(".")
        if not dot or "=" not in rest:
            raise ValueError(f"SERVICE.KEY=VALUE expected, found {text!r}; for example actuator.port=/dev/ttyUSB0")
        if service not in names:
            near = difflib.get_close_matches(service, names, n=1)
            raise ValueError(f"no service {service!r} is started; {f'did you mean {near[0]!r}?' if near else ', '.join(names)}")
        extra[service] = (*extra.get(service, ()), rest)
    for process in processes:
        if process.name in extra:
            config = importlib.import_module(f"{process.module}.config")
            load_settings(config.Settings, None, extra[process.name], process.name)
    port = tuple(rest for rest in extra.get("actuator", ()) if re.match(r"port\s*=", rest))
    if port and "stop" in names:  # the estop process uses the same servos
        extra["stop"] = (*port, *extra.get("stop", ()))
    return extra


def commands(
    processes: Iterable[Process],
    chosen: Choices,
    endpoints: Endpoints,
    extra: Mapping[str, tuple[str, ...]] | None = None,
    elsewhere: bool = False,
    role: str = "",
    simulated_time: Path | None = None,
) -> tuple[Command, ...]:
    """Return the commands that start processes which connect to `endpoints`.

    Args:
        processes: Rows of the table.
        chosen: Settings of this run.
        endpoints: Endpoints that the processes connect to.
        extra: Process name -> assignments `key=value`. They follow the table's; the last assignment of a key wins.
        elsewhere: Whether this is another machine than the robot's.
        role: Role of this machine's certificate; empty: "base" if `elsewhere`, else "robot".
        simulated_time: File with the shared simulated time of a run; None: real time.

    Raises:
        ValueError: Simulated time without a simulator; real servos cannot be slowed down.
    """
    processes = tuple(processes)
    if simulated_time is not None and not any(p.side == "simulation" for p in processes):
        raise ValueError("simulated time needs the simulator process")
    started = {p.name for p in processes}
    # Only a robot with a map of its own has its page elsewhere; a base and a simulated robot have it here or nowhere.
    here = started | ({"console"} if elsewhere or "simulator" in started else set())
    role = role or ("base" if elsewhere else "robot")
    away = (*(("--elsewhere",) if elsewhere else ()), *(("--role", role) if role != "robot" else ()))
    shared_time = () if simulated_time is None else ("--simulated-time", str(simulated_time))
    return tuple(
        Command(
            name=p.name,
            arguments=(
                *(
                    "-m",
                    _module(p, chosen),
                    "--robot",
                    chosen.robot,
                    *_meeting(endpoints),
                    *_giving_way(p, chosen),
                    *away,
                    *shared_time,
                    *(("--unpacked",) if p.name in _READERS and here >= _READERS[p.name] else ()),
                ),
                *_set([assignment(key, value) for key, value in p.settings(chosen).items()]),
                *_set((extra or {}).get(p.name, ())),
            ),
            environment={**ENVIRONMENT, **(_ONE_HEAP if p.one_heap else {})},
            restarts=p.restarts,
            after=tuple(name for name in p.after if name in started),
            ready_port=p.ready_port(chosen),
            watchdog_s=p.watchdog_s,
            memory_mb=p.memory_mb,
        )
        for p in processes
    )


def _module(process: Process, chosen: Choices) -> str:
    """Return the module to run; a perception with pose errors has its own module."""
    return (
        "sextant.evaluation.lockstep.noisy_perception"
        if process.name == "perception" and chosen.pose_error != "none"
        else process.module
    )


def _giving_way(process: Process, chosen: Choices) -> tuple[str, ...]:
    urgent = process.urgent and not chosen.scenario  # simulated time waits for a process that is late
    return (*(("--nice", str(process.nice)) if process.nice else ()), *(("--urgent",) if urgent else ()))


def assignment(key: str, value: Value) -> str:
    """Return `key=value` for `--set`, quoted only where TOML would misread it."""
    if isinstance(value, bool):
        return f"{key}={str(value).lower()}"
    if isinstance(value, int | float | list):
        return f"{key}={value}"
    try:
        tomllib.loads(f"{key}={value}")
    except tomllib.TOMLDecodeError:
        if value.isprintable():
            return f"{key}={value}"
    escaped = "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value)
    return f'{key}="{escaped}"'


def router_command(listen: str, more: tuple[str, ...] = (), role: str = "", starts: Iterable[Process] = ()) -> Command:
    """Return the command that starts the router as a separate process.

    Args:
        listen: Endpoint for processes of this machine.
        more: The complete arguments of the router; empty: only `listen`.
        role: Role of this machine if the router announces it to other machines; empty: no announcement.
        starts: Processes of this machine, which the router announces.
    """
    port = int(listen.rpartition(":")[2])
    told = ("--role", role, "--starts", ",".join(p.name for p in starts)) if role else ()
    words = ("-m", "sextant.deploy.launch.router", *(more or ("--listen", listen)), *told)
    return Command("router", words, ENVIRONMENT, restarts=3, ready_port=port, watchdog_s=_ROUTER_SILENT_S, memory_mb=256)


def _meeting(endpoints: Endpoints) -> tuple[str, ...]:
    found = tuple(word for endpoint in endpoints.connect for word in ("--connect", endpoint))
    keys = ("--keys", str(endpoints.keys.folder)) if endpoints.keys is not None else ()
    return (*found, *(("--scouting",) if endpoints.scouting else ()), "--namespace", endpoints.namespace, *keys)


def _set(assignments: Iterable[str]) -> tuple[str, ...]:
    return tuple(word for one in assignments for word in ("--set", one))
