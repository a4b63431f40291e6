"""`sextant run` and `sextant demo`: one walk, over Zenoh or in lockstep."""

import argparse
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import (
    FAILED,
    INTERRUPTED,
    SUCCESS,
    InputError,
    asked_scenario,
    complain,
    met,
    open_progress,
    out_folder,
    say,
)

if TYPE_CHECKING:
    from sextant.deploy.evaluation.report import Report
    from sextant.shared.wire.transport import Endpoints


def run(arguments: argparse.Namespace) -> int:
    """`sextant run`: run one scenario, over Zenoh or in lockstep."""
    if arguments.lockstep and arguments.connect:
        raise InputError("--lockstep runs in one process and connects to no router; leave --connect out")
    if arguments.bridge and arguments.connect:
        raise InputError("--bridge is for services that this command starts; leave --connect out")
    if arguments.set and arguments.connect:
        raise InputError("--set is for services that this command starts; give it to the `sextant up` that starts them")
    if arguments.record_depth and not arguments.lockstep:
        raise InputError("--record-depth writes the frames of a lockstep run; add --lockstep")
    if arguments.slow_down and (arguments.lockstep or arguments.connect):
        raise InputError("--slow-down is for services that this command starts live; leave --lockstep and --connect out")
    if arguments.lockstep:
        return _run_lockstep(arguments)
    return _run_live(arguments)


@dataclass(frozen=True, slots=True)
class _Demo:
    """A course of the demo, with the texts before and after it."""

    scenario: str
    before: str
    after: str


DEMOS = {
    "steps": _Demo(
        "steps",
        "A six-legged robot sees a field of low blocks and two stairs through its depth camera, maps it, chooses where each "
        "foot goes, and walks across.",
        "summary.png shows the walk: map, path, footholds, height and tilt.",
    ),
    "gap": _Demo(
        "passage1",
        "A six-legged robot stands before a gap of 80 cm with only six pillars in it. It stops, looks from higher up, plans "
        "each foothold on its map, and crosses one leg at a time.",
        "passage.png shows the crossing: where feet could stand, what was planned at each stop, and how it was walked.",
    ),
}
_TALKING = "Six processes communicate over Zenoh; the simulator stands in for the camera and the servo bus."
_LINE = 119  # characters


def demo(arguments: argparse.Namespace) -> int:
    """`sextant demo`: walk a course over Zenoh from a cold start: low steps, or a gap."""
    shown = DEMOS[arguments.course]
    arguments.scenario, arguments.robot, arguments.gait = shown.scenario, "", ""
    arguments.lockstep, arguments.connect, arguments.json, arguments.slow_down = False, None, False, True
    say(textwrap.fill(f"{shown.before} {_TALKING}", _LINE))
    status = _run_live(arguments)
    if status == SUCCESS:
        say(f"The robot stands at its goal. {shown.after}")
    return status


def _run_lockstep(arguments: argparse.Namespace) -> int:
    scenario = asked_scenario(arguments)
    out = out_folder(arguments, f"{scenario.name}-{arguments.seed}")
    import contextlib

    from sextant.deploy.replay.tum_recording import DepthRecorder
    from sextant.deploy.runs.lockstep_run import run_lockstep
    from sextant.shared.robot.profiles import load_profile

    with contextlib.ExitStack() as stack:
        taps = []
        if arguments.record_depth:
            try:
                recorder = DepthRecorder(Path(arguments.record_depth), load_profile(scenario.robot))
            except FileExistsError as error:
                raise InputError(f"--record-depth: {error}; name a new folder") from None
            taps.append(stack.enter_context(recorder).tap)
        report = run_lockstep(scenario, arguments.seed, out, open_progress(arguments.json), taps)
    return _tell(report, out, arguments.json)


def _run_live(arguments: argparse.Namespace) -> int:
    scenario = asked_scenario(arguments)
    if arguments.connect and not all(fault.of_camera for fault in scenario.faults):
        raise InputError(f"{scenario.name} injects faults into services that this command starts; leave --connect out")
    if arguments.connect and scenario.params:
        raise InputError(f"{scenario.name} has [params] for services that this command starts; leave --connect out")
    progress = open_progress(arguments.json)
    out = out_folder(arguments, f"{scenario.name}-{arguments.seed}")
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.shared.runtime.shutdown import end_with

    with Interrupts() as interrupts:
        if getattr(arguments, "parent", None):
            end_with(arguments.parent)
        from sextant.deploy.runs import live_run

        attach = _attach(arguments)
        problem = "" if attach else live_run.warm_up(progress, interrupts)
        if problem:
            complain(f"sextant {arguments.name}: {problem}; `sextant doctor` checks what the services need")
            return FAILED
        if interrupts.asked():
            complain("stopped by the operator")
            return INTERRUPTED
        source = str(Path(arguments.scenario).resolve()) if arguments.scenario.endswith(".toml") else arguments.scenario
        outcome = live_run.run_live_scenario(
            scenario, source, arguments.seed, out, progress, interrupts, attach, slow_down=arguments.slow_down
        )
    lockstep = f"use `sextant run {scenario.name} --lockstep`" if arguments.name == "demo" else "use --lockstep"
    status = _tell(outcome.report, out, arguments.json, f"{lockstep} or close programs")
    return INTERRUPTED if outcome.interrupted else status


def _tell(report: "Report", out: Path, as_json: bool, remedy: str = "use --lockstep or close programs") -> int:
    from sextant.deploy.evaluation.report import FILE, to_json

    if as_json:
        say(to_json(report).rstrip("\n"))
    else:
        verdict = f"{'success' if report.success else 'failed'}: {report.reason}"
        walked = f"{report.distance_m:.2f} m in {report.duration_s:.1f} s, {report.speed_mps:.3f} m/s"
        say(f"{verdict}; {walked}, {report.steps} steps, {report.falls} falls")
        if report.too_slow:
            say(f"{report.too_slow}; {remedy}")
        say(f"written to {out}: {', '.join(sorted(path.name for path in out.iterdir() if path.is_file()))}")
    return SUCCESS if report.success and (out / FILE).exists() else FAILED


def _attach(arguments: argparse.Namespace) -> "Endpoints | None":
    if not arguments.connect:
        return None
    return met(arguments)
