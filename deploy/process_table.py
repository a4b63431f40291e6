"""The processes of Sextant as a table, and the commands that start them; launcher and compose.yaml are made from it."""

import difflib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.scenario.scenario import MapOptions, Scenario
from sextant.shared.wire.transport import Endpoints

Value = str | int | float | bool
Role = Literal["all", "onboard", "offboard", "sim"]

BUS_PORT = 7450  # where compose's simulator offers its servo bus
ROUTER_ENDPOINT = "tcp/127.0.0.1:7447"
_ROUTER_SILENT_S = 1.5  # [s] as of the actuator; its links last for one without a word

# A process gets one thread a library: a service must not take the cores of its neighbours.
ENVIRONMENT: Mapping[str, str] = {
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONUNBUFFERED": "1",
}
_ONE_HEAP = {"MALLOC_ARENA_MAX": "1"}  # of the GNU C library; others have but one


@dataclass(frozen=True, slots=True)
class Choices:
    """What differs between runs, as far as the processes are told."""

    robot: str = "phantomx_mk2"
    scenario: str = ""  # name or path, for the simulator; empty where there is none
    seed: int = 3
    bus_port: int = BUS_PORT  # TCP port of the simulated servo bus
    blind: bool = False
    footholds: str = "score"  # the map's layer that the planner walks on
    arc: str = "flow"  # of swinging feet
    bridge: bool = False  # a microcontroller speaks the servo bus
    registration: str = "projective"
    pose_error: str = "none"  # of the scenario's; in simulation alone
    map: MapOptions = field(default_factory=MapOptions)
    lift: float = 0.04  # [m] of swinging feet, where an operator leads
    console_port: int = 8080  # TCP port of the operators' page
    recordings: str = "recordings"  # folder in which the operator's recordings go
    camera: str = ""  # device in place of the one of the robot's profile: "openni2", "realsense", or a recorded folder


@dataclass(frozen=True, slots=True)
class Process:
    """One row of the table."""

    name: str
    module: str  # run as python -m
    # Where it may run: "simulation" stands in for the hardware, a "device" is on the robot alone, a "page" where it is wanted.
    side: Literal["robot", "device", "either", "simulation", "page"]
    restarts: int  # times that a run starts it again after it died
    settings: Callable[[Choices], dict[str, Value]] = field(compare=False)
    nice: int = 0  # how far it gives way where cores are short: the servos' side never does
    urgent: bool = False  # goes before all others, where the user may: what has a beat to keep
    after: tuple[str, ...] = ()  # processes that must be ready before it starts
    ready_port: Callable[[Choices], int] = field(default=lambda _: 0, compare=False)  # listens there once ready, 0: at once
    watchdog_s: float = 10.0  # [s] for which its loop may be silent, once it has begun, before it counts as hung
    memory_mb: int = 512  # [MB] beyond which something has gone wrong with it: several times what it took when it was measured
    one_heap: bool = False  # for all its threads: where many hand on what one frees, heaps of their own would creep up


def _simulator(choices: Choices) -> dict[str, Value]:
    bridge: dict[str, Value] = {"bridge": True} if choices.bridge else {}
    return {"scenario": choices.scenario, "seed": choices.seed, "bus_port": choices.bus_port, **bridge}


def _camera(choices: Choices) -> dict[str, Value]:
    return {"device": choices.camera} if choices.camera else {}


def _perception(choices: Choices) -> dict[str, Value]:
    fine: dict[str, Value] = {"scan_resolution": choices.map.scan_resolution} if choices.map != MapOptions() else {}
    erring: dict[str, Value] = {} if choices.pose_error == "none" else {"pose_error": choices.pose_error, "seed": choices.seed}
    return {"method": choices.registration, **fine, **erring}


def _mapper(choices: Choices) -> dict[str, Value]:
    chosen = choices.map
    if chosen == MapOptions():
        return {}
    return {"cells": chosen.cells, "cells_y": chosen.cells_y, "resolution": chosen.resolution}


def _planner(choices: Choices) -> dict[str, Value]:
    return {"blind": choices.blind, "footholds": choices.footholds}


def _console(choices: Choices) -> dict[str, Value]:
    return {"port": choices.console_port, "lift": choices.lift}


def _recorder(choices: Choices) -> dict[str, Value]:
    return {"folder": choices.recordings}


def _servo_port(choices: Choices) -> dict[str, Value]:
    return {"port": f"socket://127.0.0.1:{choices.bus_port}"} if choices.scenario else {}


def _actuator(choices: Choices) -> dict[str, Value]:
    arc: dict[str, Value] = {} if choices.arc == "flow" else {"arc": choices.arc}
    bridge: dict[str, Value] = {"bridge": True} if choices.bridge else {}
    return {**_servo_port(choices), **arc, **bridge}


# A dead simulator takes its world with it, so that run has failed; every other process finds its way back from the wire.
TABLE: tuple[Process, ...] = (
    Process(
        "simulator",
        "sextant.services.simulator",
        "simulation",
        0,
        _simulator,
        urgent=True,  # the world waits for nobody, and its servos answer within milliseconds
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
    Process("perception", "sextant.services.perception", "robot", 3, _perception, nice=2, memory_mb=1024),
    Process("mapper", "sextant.services.mapper", "either", 3, _mapper, nice=5, memory_mb=1024),
    Process("planner", "sextant.services.planner", "either", 3, _planner, nice=2, memory_mb=768),
    Process("console", "sextant.services.console", "page", 3, _console, memory_mb=256),  # what stops the robot waits for no map
    # A disk may take its time.
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


ON_ROBOT = frozenset(p.name for p in TABLE if p.side == "device" or p.name in ("actuator", "stop"))  # wherever the rest is


@dataclass(frozen=True, slots=True)
class Command:
    """How one process is started."""

    name: str
    arguments: tuple[str, ...]  # behind the Python interpreter
    environment: Mapping[str, str]  # beside the inherited one
    restarts: int = 0
    after: tuple[str, ...] = ()  # processes that must be ready before this one starts
    ready_port: int = 0  # TCP port of 127.0.0.1 that it listens on once it is ready; 0: ready at once
    watchdog_s: float = 0.0  # [s] without a sign of life after which it is ended as hung; 0: it gives none
    memory_mb: int = 0  # [MB] that containers and units let it have; 0: what there is


def choices(scenario: Scenario, source: str, seed: int, bus_port: int = BUS_PORT) -> Choices:
    """What a scenario, named or found at `source`, tells the processes."""
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
    )


def new_robot(chosen: Choices) -> None:
    """See to it that a simulated robot, another one each time, inherits no order to let go."""
    if chosen.scenario:
        Latch.of_port(str(_servo_port(chosen)["port"])).open()


def rows(role: Role, simulated: bool, page: bool = False) -> tuple[Process, ...]:
    """The processes of a role: onboard what must be on the robot, offboard the rest, all both; with a page for operators."""
    sides = {"all": ["robot", "device", "either"], "onboard": ["robot", "device"], "offboard": ["either"], "sim": []}[role]
    if role == "sim" or (simulated and role != "offboard"):
        sides = ["simulation", *(side for side in sides if side != "device")]
    if page and role in ("all", "offboard"):
        sides = [*sides, "page"]
    return tuple(p for p in TABLE if p.side in sides)


def rearranged(usual: Sequence[Process], also: Sequence[str], without: Sequence[str], role: Role) -> tuple[Process, ...]:
    """The processes of a role with some more and without some, in the table's order.

    Args:
        usual: Those of the role.
        also: Names of those that run here, too.
        without: Names of those that run elsewhere, or not at all.
        role: For what is said.

    Raises:
        ValueError: A name that is none, or a process that cannot run there.
    """
    known = {p.name: p for p in TABLE}
    names = {p.name for p in usual}
    for name in (*also, *without):
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            raise ValueError(f"no process {name!r}; {f'did you mean {near[0]!r}?' if near else ', '.join(known)}")
    for name in also:
        if role == "offboard" and name in ON_ROBOT:
            raise ValueError(
                f"{name} stays on the robot, beside its servos and its camera: `sextant up onboard` starts it there"
            )
        if known[name].side == "simulation" and name not in names:
            raise ValueError(f"{name}: what is simulated is started by --scenario")
    for name in without:
        if name not in names:
            raise ValueError(f"{name} is not started by the role {role}, which starts {', '.join(p.name for p in usual)}")
    names = (names | set(also)) - set(without)
    return tuple(p for p in TABLE if p.name in names)


def further_settings(assignments: Iterable[str], processes: Sequence[Process]) -> dict[str, tuple[str, ...]]:
    """Process name -> assignments `key=value`, of texts SERVICE.KEY=VALUE.

    Raises:
        ValueError: A text that is none, or that is for a process which is not started.
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
    port = tuple(rest for rest in extra.get("actuator", ()) if re.match(r"port\s*=", rest))
    if port and "stop" in names:  # it watches over the same servos
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
    """How to start processes so that they meet at `endpoints`.

    Args:
        processes: Rows of the table.
        chosen: What this run is about.
        endpoints: Where they meet.
        extra: Process name -> assignments `key=value` that go before the table's; the last one of a key counts.
        elsewhere: Whether this is another machine than the robot's.
        role: Of this machine's certificate; empty: the robot's, or elsewhere that of a base.
        simulated_time: File of the time that the processes of a simulated run share; None has them go by real time.

    Raises:
        ValueError: Simulated time without a simulator: real servos do not wait.
    """
    processes = tuple(processes)
    if simulated_time is not None and not any(p.side == "simulation" for p in processes):
        raise ValueError("simulated time needs a simulator among the processes")
    started = {p.name for p in processes}
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
                    *_giving_way(p),
                    *away,
                    *shared_time,
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
    """What is run: perception with a pose error is another process, so that the robot's own knows nothing of it."""
    return (
        "sextant.deploy.erring_perception" if process.name == "perception" and chosen.pose_error != "none" else process.module
    )


def _giving_way(process: Process) -> tuple[str, ...]:
    return (*(("--nice", str(process.nice)) if process.nice else ()), *(("--urgent",) if process.urgent else ()))


def assignment(key: str, value: Value) -> str:
    """`key=value` as `--set` reads it: a bare word where TOML would not take it for something else."""
    if isinstance(value, bool):
        return f"{key}={str(value).lower()}"
    if isinstance(value, int | float):
        return f"{key}={value}"
    try:
        tomllib.loads(f"{key}={value}")
    except tomllib.TOMLDecodeError:
        if value.isprintable():
            return f"{key}={value}"
    escaped = "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value)
    return f'{key}="{escaped}"'


def router_command(listen: str, more: tuple[str, ...] = (), role: str = "", starts: Iterable[Process] = ()) -> Command:
    """How to start the router as a process of its own, where no launcher hosts it.

    Args:
        listen: Where processes of this machine meet it.
        more: All of its arguments, where that is not all of them.
        role: Of this machine, where the router is to tell another of it, for nobody else does.
        starts: What is started here, in that case.
    """
    port = int(listen.rpartition(":")[2])
    told = ("--role", role, "--starts", ",".join(p.name for p in starts)) if role else ()
    words = ("-m", "sextant.deploy.router", *(more or ("--listen", listen)), *told)
    return Command("router", words, ENVIRONMENT, restarts=3, ready_port=port, watchdog_s=_ROUTER_SILENT_S, memory_mb=256)


def _meeting(endpoints: Endpoints) -> tuple[str, ...]:
    found = tuple(word for endpoint in endpoints.connect for word in ("--connect", endpoint))
    keys = ("--keys", str(endpoints.keys.folder)) if endpoints.keys is not None else ()
    return (*found, *(("--scouting",) if endpoints.scouting else ()), "--namespace", endpoints.namespace, *keys)


def _set(assignments: Iterable[str]) -> tuple[str, ...]:
    return tuple(word for one in assignments for word in ("--set", one))
