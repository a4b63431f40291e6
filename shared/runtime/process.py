"""Process of a service: command line, signals and exit status.

Every `services/<name>/__main__.py` calls `main`:

python -m sextant.services.planner --robot phantomx_mk2 --connect tcp/127.0.0.1:7447 --set blind=true
"""

import argparse
import contextlib
import dataclasses
import faulthandler
import gc
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from sextant.shared.files import config
from sextant.shared.plugins.loading import PluginError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime import clock, compile_progress, simulated_time
from sextant.shared.runtime.process_priority import go_first, keep_memory, switch_often
from sextant.shared.runtime.service import Service
from sextant.shared.runtime.shutdown import ShutdownRequested, end_with, leave, leave_at_errors
from sextant.shared.runtime.watchdog import Watchdog
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import Keys
from sextant.shared.wire.transport import Endpoints, TransportError, ZenohLink

_LOOK_S = 0.1  # [s] between two checks for the robot
_PATIENCE_S = 4.0  # [s] upper bound of a warm-up that compiles nothing

S = TypeVar("S")


def main(
    name: str,
    schema: type[S],
    make: Callable[[RobotProfile, S], Service],
    compile_functions: Callable[[RobotProfile, S], None] | None = None,
) -> NoReturn:
    """Run one service and end the process."""
    leave_at_errors()
    with ShutdownRequested() as told:
        leave(run(name, schema, make, told, compile_functions=compile_functions))


def run(
    name: str,
    schema: type[S],
    make: Callable[[RobotProfile, S], Service],
    told: ShutdownRequested,
    argv: Sequence[str] | None = None,
    compile_functions: Callable[[RobotProfile, S], None] | None = None,
) -> int:
    """Run one service with the settings of the command line, until shutdown.

    Args:
        name: Name of the service.
        schema: Class of its settings.
        make: Makes the service from a robot profile and settings.
        told: Shutdown request.
        argv: Command line without the program; that of this process by default.
        compile_functions: Warm-up that compiles the functions of the service before it reports that it is ready.

    Returns:
        Exit status: 0 after a shutdown request, 1 if a device or port is missing, 2 for invalid arguments. Any other error
        ends in a traceback.
    """
    arguments = _parser(name, _program(make), schema).parse_args(argv)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format=f"{name}: %(message)s")
    faulthandler.enable()
    if arguments.parent:
        end_with(arguments.parent)
    if not arguments.simulated_time:
        os.nice(arguments.nice)
    if arguments.urgent and (refused := go_first()):
        logging.warning(refused)
    keep_memory()
    switch_often()
    with contextlib.ExitStack() as stack:
        try:
            profile = load_profile(arguments.robot)
            settings = load_settings(schema, arguments.config, arguments.set)
            keys = Keys.load(Path(arguments.keys)) if arguments.keys else None
            if compile_functions is not None:
                with compile_progress.reported(_PATIENCE_S) if arguments.simulated_time else contextlib.nullcontext():
                    _patiently(lambda: compile_functions(profile, settings))
            if arguments.simulated_time:
                os.nice(arguments.nice)  # only now: a simulated robot starts once the last service has compiled
                if arguments.elsewhere:
                    raise ValueError("--simulated-time works on one machine only; remove --elsewhere")
                stack.enter_context(clock.going_by(simulated_time.SimulatedTime(Path(arguments.simulated_time))))
            told.open()
            endpoints = Endpoints(tuple(arguments.connect), arguments.scouting, arguments.namespace, keys)
            watchdog = stack.enter_context(Watchdog(os.environ))
            link = stack.enter_context(ZenohLink(endpoints))
            ahead_s = _follow_robot(link, told.event, watchdog.beat) if arguments.elsewhere else lambda: 0.0
            service = make(profile, settings)
            if isinstance(service, contextlib.AbstractContextManager):
                stack.enter_context(service)  # closes ports and servers on exit
            simulated_time.ready(name)
        except (ValueError, TransportError, PluginError) as error:
            logging.error("%s", error)
            return 2
        except OSError as error:  # a missing device or port; unlike the errors above it may return
            logging.error("%s", error)
            return 1
        try:  # a ValueError in this block is a bug and ends in a traceback
            role = arguments.role if keys is None else keys.role.name
            run_live(service, link, told.event, watchdog.beat, ahead_s, role, robot_time=True, packs=not arguments.unpacked)
        except (clock.ClockError, PluginError) as error:
            logging.error("%s", error)
            return 1
    return 0


def _patiently(compile_functions: Callable[[], None]) -> None:
    """Run the warm-up, and log a notice if it has to compile.

    Python's garbage collector would take a seventh of the time of a compilation.
    """
    telling = threading.Timer(_PATIENCE_S, logging.info, ["compiling the inner loops takes half a minute, the first time only"])
    telling.daemon = True
    telling.start()
    gc.disable()
    try:
        compile_functions()
    finally:
        gc.enable()
        telling.cancel()


def _follow_robot(link: ZenohLink, stop: threading.Event, alive: Callable[[int], object]) -> Callable[[], float]:
    """Wait for a message of the robot, and use the robot's clock in this process.

    Returns:
        A function that returns the offset [s] of the robot's clock from this machine's clock.
    """
    robot = clock.RobotClock()

    def hear(_topic: object, frame: bytes) -> None:
        with contextlib.suppress(codec.DecodeError):  # the inbox refuses, counts and reports it
            label = codec.label(frame)
            robot.heard(label.timing.sent_ns)
            schemas.add(label.schema_id)

    schemas: set[str] = set()
    link.subscribe(topics.ACTUATOR_STATE, hear)
    told = False
    while not robot.known and not stop.wait(_LOOK_S):
        alive(time.monotonic_ns())
        if not told:
            logging.info("waiting for the robot: no message on %s yet", topics.ACTUATOR_STATE.key)
            told = True
    expected = codec.schema_id(topics.ACTUATOR_STATE.type)
    if other := sorted(schemas - {expected}):
        logging.warning(
            "%s: schema %s expected, found %s: the robot runs another version of Sextant; install the same on both",
            topics.ACTUATOR_STATE.key,
            expected,
            other[0],
        )
    clock.go_by(robot)
    return lambda: robot.ahead_s


def load_settings(schema: type[S], path: str | None, assignments: Sequence[str], source: str = "settings") -> S:
    """Read the settings of a service from a TOML file and `key=value` assignments.

    The values of assignments are in TOML notation. They override the file.

    Raises:
        ConfigError: The settings are invalid; the text lists all errors.
    """
    table: dict[str, Any] = {}
    if path is not None:
        table = config.as_table(config.load(Path(path), schema))
    config.assign(table, assignments)
    return config.build(table, schema, source)


def assignments(settings: object) -> list[str]:
    """Return the `--set` arguments that reproduce `settings`.

    Fields at their defaults are omitted.
    """
    out: list[str] = []
    for field in dataclasses.fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, field.name)
        default = field.default_factory() if callable(field.default_factory) else field.default
        if value != default and value is not None:
            out += ["--set", f"{field.name}={toml_value(config.as_table(value))}"]
    return out


def toml_value(value: object) -> str:
    """Return a plain value in TOML notation, on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml_value(str(key))} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):  # JSON and TOML have the same escapes, except for DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value)


def _program(make: Callable[..., Service]) -> str:
    """Return what `python -m` starts: the package of `make`, or the module that runs if it defines `make`."""
    spec = sys.modules["__main__"].__spec__
    return spec.name if make.__module__ == "__main__" and spec else make.__module__.rpartition(".")[0]


def _parser(name: str, package: str, schema: type[Any]) -> argparse.ArgumentParser:
    known = ", ".join(f.name for f in dataclasses.fields(schema))
    parser = argparse.ArgumentParser(prog=f"python -m {package}", description=f"The {name} service.")
    parser.add_argument(
        "--robot", default="phantomx_mk2", help="robot profile, by name or path of a TOML file (default %(default)s)"
    )
    parser.add_argument("--connect", action="append", default=[], help="endpoint to connect to, e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--scouting", action="store_true", help="discover the other processes by multicast instead")
    parser.add_argument(
        "--namespace",
        default="sextant",
        help="prefix of every key; runs with different prefixes are separate (default sextant)",
    )
    parser.add_argument("--keys", metavar="DIR", help="folder with the certificate of this machine, for tls endpoints")
    parser.add_argument("--config", help="TOML file with settings")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help=f"value of a setting, repeatable; settings: {known}"
    )
    parser.add_argument("--elsewhere", action="store_true", help="use the robot's clock, on a machine that is not the robot's")
    words = "role of this machine, under which the service publishes its health (default %(default)s)"
    parser.add_argument("--role", default="robot", choices=topics.ROLE_NAMES, help=words)
    words = "file with the shared time of a simulated run (default: real time)"
    parser.add_argument("--simulated-time", metavar="FILE", help=words)
    parser.add_argument("--unpacked", action="store_true", help="do not pack arrays: their readers run on this machine")
    parser.add_argument("--nice", type=int, default=0, help="niceness of the process, 0 to 19 (default 0)")
    parser.add_argument("--urgent", action="store_true", help="use real-time priority, if this user may")
    parser.add_argument("--parent", type=int, help="id of the parent process; end when it ends")
    return parser
