"""`sextant run` and `sextant demo`: one walk, over Zenoh or in lockstep."""

import contextlib
import sys
import textwrap
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sextant.deploy.commands import options
from sextant.deploy.commands.common import (
    FAILED,
    INTERRUPTED,
    SUCCESS,
    CommandError,
    InputError,
    open_progress,
    out_folder,
    say,
    say_if_it_compiles,
)
from sextant.deploy.terminal.arguments import Choice, argument, command, flag, option, options_of

if TYPE_CHECKING:
    from sextant.evaluation.report import Report
    from sextant.shared.scenario.scenario import Scenario
    from sextant.shared.wire.transport import Endpoints


@dataclass(frozen=True, slots=True)
class _Windows:
    """What shows the robot during a live run."""

    page: bool | None = None  # the operator's page; None: if the output is a terminal
    viewer: bool = False  # MuJoCo's


_windows = options_of(
    _Windows,
    "windows",
    click.option(
        "--page/--no-page", default=None, help="serve the operator's page during the run (default: if the output is a terminal)"
    ),
    flag("--viewer", "open MuJoCo's viewer, in which the mouse pushes the robot; needs a display"),
)


@command()
@argument(
    "scenario",
    "scenario name, FAMILY@VALUE such as riser@0.05, or TOML file",
    "SCENARIO",
    shell_complete=options.scenarios,
)
@options.variant
@flag("--lockstep", "run in one process on simulated time, as fast as the machine allows")
@flag("--bridge", "simulate a microcontroller on the servo bus, see docs/bridge.md")
@flag("--slow-down", "slow simulated time down if this computer is too slow, as the demo does (default: real time)")
@_windows
@options.as_json
@option("--record-depth", "also write the depth frames for `sextant recording replay` (with --lockstep)", "DIR")
@options_of(
    options.Connection,
    "connection",
    option("--connect", "use running services, at this endpoint, e.g. tcp/127.0.0.1:7447", "ENDPOINT", multiple=True),
    options.namespace,
    options.keys,
)
@option("--parent", "id of the launcher's process; this process ends with it", type=int, hidden=True)
@options.seed
@options.out
def run(
    scenario: str,
    variant: options.Variant,
    lockstep: bool,
    bridge: bool,
    slow_down: bool,
    windows: _Windows,
    as_json: bool,
    record_depth: str | None,
    connection: options.Connection,
    parent: int | None,
    seed: int,
    out: str | None,
) -> int:
    """Run a scenario; write a folder with report.json, pictures and recording.mcap.

    With --connect it uses running services, else it starts them.
    """
    if lockstep and connection.connect:
        raise InputError("--lockstep runs in one process and connects to no router; leave --connect out")
    if bridge and connection.connect:
        raise InputError("--bridge is for services that this command starts; leave --connect out")
    if variant.params and connection.connect:
        raise InputError("--set is for services that this command starts; give it to the `sextant up` that starts them")
    if record_depth and not lockstep:
        raise InputError("--record-depth writes the frames of a lockstep run; add --lockstep")
    if slow_down and (lockstep or connection.connect):
        raise InputError("--slow-down is for services that this command starts live; leave --lockstep and --connect out")
    course = variant.load(scenario)
    if connection.connect and not all(fault.of_camera for fault in course.faults):
        raise InputError(f"{course.name} injects faults into services that this command starts; leave --connect out")
    if connection.connect and course.params:
        raise InputError(f"{course.name} has [params] for services that this command starts; leave --connect out")
    if (windows.page or windows.viewer) and (lockstep or connection.connect):
        name = "--page" if windows.page else "--viewer"
        raise InputError(f"{name} is for services that this command starts live; leave --lockstep and --connect out")
    attach = connection.endpoints() if connection.connect else None
    course = replace(course, bridge=True) if bridge else course
    walk = _Walk(course, variant.source(scenario, course.robot), seed, out_folder(out, f"{course.name}-{seed}"), as_json)
    if lockstep:
        return _run_lockstep(walk, record_depth)
    return _run_live(walk, "use --lockstep", slow_down, attach, parent, windows)


@dataclass(frozen=True, slots=True)
class _Walk:
    """One walk and where its results go."""

    scenario: "Scenario"
    source: str  # name or absolute path of the scenario, for other processes
    seed: int
    out: Path
    as_json: bool = False


@dataclass(frozen=True, slots=True)
class _Demo:
    """A course of the demo, with the texts before and after it."""

    scenario: str
    before: str
    picture: str
    shows: str


DEMOS = {
    "steps": _Demo(
        "steps",
        "A six-legged robot sees a field of low blocks and two stairs through its depth camera, maps it, chooses where each "
        "foot goes, and walks across.",
        "summary.png",
        "shows the walk: map, path, footholds, height and tilt",
    ),
    "gap": _Demo(
        "passage1",
        "A six-legged robot stands before a gap of 80 cm with only six pillars in it. It stops, looks from higher up, plans "
        "each foothold on its map, and crosses one leg at a time.",
        "passage.png",
        "shows the crossing: where feet could stand, what was planned, how it was walked",
    ),
}
_TALKING = "Six processes communicate over Zenoh; the simulator stands in for the camera and the servo bus."
_LINE = 119  # characters


@command()
@argument("course", "course to walk (default: steps)", type=Choice(tuple(DEMOS)), default="steps")
@options.seed
@options.out
@options.params
@_windows
def demo(course: str, seed: int, out: str | None, params: tuple[str, ...], windows: _Windows) -> int:
    """Simulate a walk over low steps, or across a gap, over Zenoh."""
    shown = DEMOS[course]
    say(textwrap.fill(f"{shown.before} {_TALKING}", _LINE))
    scenario = options.Variant(params=params).load(shown.scenario)
    walk = _Walk(scenario, shown.scenario, seed, out_folder(out, f"{scenario.name}-{seed}"))
    status = _run_live(walk, f"use `sextant run {shown.scenario} --lockstep`", slow_down=True, windows=windows)
    if status == SUCCESS:
        recording = f"has all messages; `sextant video {walk.out}` draws them, Foxglove opens them"
        files = {shown.picture: shown.shows, "recording.mcap": recording, "report.json": "has the result in numbers"}
        say("The robot stands at its goal. Three files are worth opening:")
        say("\n".join(f"  {walk.out / name} {words}" for name, words in files.items()))
        _offer_film(walk.out)
    return status


def _offer_film(folder: Path) -> None:
    """Draw the film of a walk if the user, at a terminal, wants it."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return
    try:
        wanted = click.confirm("Draw the film of the walk? It takes some minutes", default=False)
    except click.Abort:  # Ctrl-C or Ctrl-D: the walk is over, and nothing is lost
        wanted = False
    if not wanted:
        return
    from sextant.deploy.commands.video import video

    video.main([str(folder)], standalone_mode=False)


def _run_lockstep(walk: _Walk, record_depth: str | None) -> int:
    from sextant.deploy.terminal.interrupts import explained_interrupts
    from sextant.evaluation.lockstep.lockstep_run import run_lockstep
    from sextant.evaluation.replay.tum_recording import DepthRecorder
    from sextant.shared.robot.profiles import load_profile

    with contextlib.ExitStack() as stack:
        taps = []
        if record_depth:
            try:
                recorder = DepthRecorder(Path(record_depth), load_profile(walk.scenario.robot))
            except FileExistsError as error:
                raise InputError(f"--record-depth: {error}; name a new folder") from None
            taps.append(stack.enter_context(recorder).tap)
        progress = open_progress(walk.as_json)
        say_if_it_compiles(progress)
        kept = f"{walk.out} has an unfinished recording and no report; a lockstep run cannot be resumed, start it again"
        with explained_interrupts(lambda: kept):
            report = run_lockstep(walk.scenario, walk.seed, walk.out, progress, taps)
    return _tell(report, walk)


def _run_live(
    walk: _Walk,
    remedy: str,
    slow_down: bool,
    attach: "Endpoints | None" = None,
    parent: int | None = None,
    windows: _Windows = _Windows(),
) -> int:
    from sextant.deploy.live import live_run
    from sextant.deploy.live.page import Page, has_display, page_port
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.shared.runtime.shutdown import end_with

    if not attach:
        from sextant.services.simulator.scenario_validation import check_scenario

        check_scenario(walk.scenario, walk.seed, walk.scenario.robot)
    if windows.viewer and not has_display():
        raise InputError("--viewer: a display expected, found none; leave it out, and watch the operator's page in a browser")
    progress = open_progress(walk.as_json)
    with Interrupts() as interrupts:
        if parent:
            end_with(parent)
        # The search of gap crossings takes long to compile; the rest compiles while the services start.
        problem = live_run.warm_up(progress, interrupts) if walk.scenario.goal.passage and not attach else ""
        if problem:
            raise CommandError(f"{problem}; `sextant doctor` checks what the services need")
        if interrupts.asked():
            raise KeyboardInterrupt
        watched = not attach and (windows.page or (windows.page is None and sys.stdout.isatty() and not walk.as_json))
        shown = Page(page_port(progress.say)) if watched else None
        if shown:
            progress.say(f"watch it, or lead it yourself: {shown.url}")
        outcome = live_run.run_live_scenario(
            walk.scenario,
            walk.source,
            walk.seed,
            walk.out,
            progress,
            interrupts,
            attach,
            slow_down=slow_down,
            page=shown,
            viewer=windows.viewer,
        )
    status = _tell(outcome.report, walk, f"{remedy} or close programs")
    return INTERRUPTED if outcome.interrupted else status


def _tell(report: "Report", walk: _Walk, remedy: str = "use --lockstep or close programs") -> int:
    """Print the result of a walk; return the exit status."""
    from sextant.evaluation.report import FILE, to_json

    if walk.as_json:
        say(to_json(report).rstrip("\n"))
    else:
        verdict = f"{'success' if report.success else 'failed'}: {report.reason}"
        walked = f"{report.distance_m:.2f} m in {report.duration_s:.1f} s, {report.speed_mps:.3f} m/s"
        say(f"{verdict}; {walked}, {report.steps} steps, {report.falls} falls")
        if report.too_slow:
            say(f"{report.too_slow}; {remedy}")
        say(f"written to {walk.out}: {', '.join(sorted(path.name for path in walk.out.iterdir() if path.is_file()))}")
    return SUCCESS if report.success and (walk.out / FILE).exists() else FAILED
