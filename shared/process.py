"""The process around a service: arguments, signals, last words. Every `services/<name>/__main__.py` is a call of `run`.

python -m services.planner --robot phantomx_mk2 --connect tcp/127.0.0.1:7447 --set blind=true
"""

import argparse
import contextlib
import ctypes
import dataclasses
import faulthandler
import logging
import os
import signal
import sys
import threading
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from shared import config
from shared.robot import RobotProfile, load_profile
from shared.service import Service, run_live
from shared.transport import Endpoints, TransportError, ZenohLink

S = TypeVar("S")

_PR_SET_PDEATHSIG = 1  # Linux: a signal for this process when its parent dies, so that nothing is orphaned


def run(name: str, schema: type[S], make: Callable[[RobotProfile, S], Service], argv: Sequence[str] | None = None) -> int:
    """Run one service until it is told to stop, with the settings of the command line.

    Returns:
        Exit status: 0 when it was told to stop, 2 for what the caller got wrong; anything else ends in a traceback.
    """
    arguments = _parser(name, schema).parse_args(argv)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format=f"{name}: %(message)s")
    faulthandler.enable()
    if arguments.parent:
        _end_with(arguments.parent)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        profile = load_profile(arguments.robot)
        settings = load_settings(schema, arguments.config, arguments.set)
        endpoints = Endpoints(tuple(arguments.connect), arguments.scouting, arguments.namespace)
        with ZenohLink(endpoints) as link:
            service = make(profile, settings)
            with contextlib.ExitStack() as stack:
                if isinstance(service, contextlib.AbstractContextManager):
                    stack.enter_context(service)  # ports and servers are closed on the way out
                run_live(service, link, stop)
    except (ValueError, TransportError) as error:
        logging.error("%s", error)
        return 2
    return 0


def load_settings(schema: type[S], path: str | None, assignments: Sequence[str]) -> S:
    """Settings of a service from a TOML file and `key=value` assignments over it, values in TOML's notation.

    Raises:
        ConfigError: What is wrong, all at once.
    """
    table: dict[str, Any] = {}
    if path is not None:
        table = config.as_table(config.load(Path(path), schema))
    for assignment in assignments:
        try:
            table |= tomllib.loads(assignment)
        except tomllib.TOMLDecodeError:
            key, _, value = assignment.partition("=")
            if not key.isidentifier():
                raise config.ConfigError("--set", [f"key=value expected, found {assignment!r}"]) from None
            table[key] = value  # a bare word is a text
    return config.build(table, schema, "settings")


def assignments(settings: object) -> list[str]:
    """The `--set` arguments that make `settings` again; fields at their defaults are left out."""
    out: list[str] = []
    for field in dataclasses.fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, field.name)
        if value != field.default:
            out += ["--set", f"{field.name}={str(value).lower() if isinstance(value, bool) else value}"]
    return out


def _parser(name: str, schema: type[Any]) -> argparse.ArgumentParser:
    known = ", ".join(f.name for f in dataclasses.fields(schema))
    parser = argparse.ArgumentParser(prog=f"python -m services.{name}", description=f"The {name} service.")
    parser.add_argument("--robot", default="phantomx_mk2", help="profile by name, or the path of a TOML file")
    parser.add_argument("--connect", action="append", default=[], help="endpoint to connect to, e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--scouting", action="store_true", help="find the others by multicast instead")
    parser.add_argument("--namespace", default="sextant", help="prefix of every key; runs with different ones do not meet")
    parser.add_argument("--config", help="TOML file with settings")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=f"one setting of: {known}")
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    return parser


def _end_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it died before the call above
        raise SystemExit(1)
