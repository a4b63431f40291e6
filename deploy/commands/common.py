"""Common parts of all commands: exit status, output, folders and scenario."""

import argparse
import datetime
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.terminal.output import complain as complain
from sextant.deploy.terminal.output import say as say
from sextant.deploy.terminal.run_command import FAILED as FAILED
from sextant.deploy.terminal.run_command import INTERRUPTED as INTERRUPTED
from sextant.deploy.terminal.run_command import SUCCESS as SUCCESS
from sextant.deploy.terminal.run_command import WRONG_INPUT as WRONG_INPUT
from sextant.shared.errors import SextantError

if TYPE_CHECKING:
    from sextant.deploy.terminal.progress import Progress
    from sextant.shared.scenario.scenario import Link, Scenario
    from sextant.shared.wire.transport import Endpoints

ROUTER = "tcp/127.0.0.1:7447"  # of the robot, by default


class InputError(SextantError, ValueError):
    """Invalid input by the caller, with what is expected."""


def met(arguments: argparse.Namespace) -> "Endpoints":
    """Return the robot's endpoints, with the keys of the command line.

    Raises:
        AccessError: The keys are wrong.
        InputError: An endpoint needs keys, and there are none.
    """
    from sextant.shared.wire.access import Keys
    from sextant.shared.wire.transport import Endpoints

    keys = Keys.load(Path(arguments.key_folder)) if arguments.key_folder else None
    try:
        return Endpoints(tuple(arguments.connect or [ROUTER]), namespace=arguments.namespace, keys=keys)
    except ValueError as error:
        raise InputError(str(error)) from None


def out_folder(arguments: argparse.Namespace, name: str) -> Path:
    """Create and return the output folder of a command."""
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    out = Path(arguments.out) if arguments.out else Path("runs") / f"{stamp}-{name}"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create the folder {out}: {error.strerror}; give another with --out") from None
    if not os.access(out, os.W_OK | os.X_OK):
        raise InputError(f"this user may not write to the folder {out}; give another with --out")
    return out


def open_progress(as_json: bool) -> "Progress":
    """Return a progress display on stdout, or on stderr if the result is JSON."""
    from sextant.deploy.terminal.progress import progress_for

    return progress_for(sys.stderr if as_json else sys.stdout)


def warm_up(progress: "Progress") -> None:
    """Compile everything that services would otherwise compile during the walk.

    Raises:
        InputError: It failed; the message says why.
        KeyboardInterrupt: The operator interrupted it.
    """
    from sextant.deploy.runs.live_run import warm_up
    from sextant.deploy.terminal.interrupts import Interrupts

    with Interrupts() as interrupts:
        problem = warm_up(progress, interrupts)
    if interrupts.asked():
        raise KeyboardInterrupt
    if problem:
        raise InputError(f"{problem}; `sextant doctor` checks what the services need")


def asked_scenario(arguments: argparse.Namespace) -> "Scenario":
    """Return the requested scenario with the requested robot, gait, link and parameters."""
    from sextant.shared.scenario.scenario import load_scenario

    return as_asked(arguments)(load_scenario(arguments.scenario))


def as_asked(arguments: argparse.Namespace) -> Callable[["Scenario"], "Scenario"]:
    """Return a function that applies the requested robot, gait, link and parameters to a scenario."""
    from sextant.deploy import params
    from sextant.services.planner.locomotion.gait import GAITS

    robot, link = asked_robot(arguments), _asked_link(getattr(arguments, "link", ""))
    assignments = getattr(arguments, "set", ())

    def asked(scenario: "Scenario") -> "Scenario":
        if robot:
            scenario = replace(scenario, robot=robot)
        if link.exists:
            scenario = replace(scenario, link=link)
        scenario = params.assigned(scenario, assignments)
        if getattr(arguments, "bridge", False):
            scenario = replace(scenario, bridge=True)
        if arguments.gait:
            slower = GAITS[arguments.gait].slowness / GAITS[scenario.walk.gait].slowness
            walk = replace(scenario.walk, gait=arguments.gait)
            scenario = replace(scenario, walk=walk, time_limit_s=scenario.time_limit_s * max(slower, 1.0))
        return scenario

    return asked


def _asked_link(text: str) -> "Link":
    from sextant.shared.scenario.scenario import Link

    if not text:
        return Link()
    try:
        delay_ms, mbit, loss = (float(word) for word in text.split(","))
        return Link(delay_ms, mbit, loss)
    except ValueError as error:
        raise InputError(f"--link: MS,MBIT,LOSS expected, for example 20,20,0.05, found {text!r}: {error}") from None


def asked_robot(arguments: argparse.Namespace) -> str:
    """Return the requested robot as scenarios name it; empty for none."""
    from sextant.shared.robot.profiles import load_profile

    if not arguments.robot:
        return ""
    robot = str(Path(arguments.robot).resolve()) if arguments.robot.endswith(".toml") else str(arguments.robot)
    load_profile(robot)  # raises if the profile is wrong, before anything starts
    return robot
