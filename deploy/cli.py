"""The command line. Every failure says its cause and what to do next.

Exit status: 0 only on success, 1 for a run that failed, 2 for wrong input, 130 when the operator ended it.
Modules that take long to import are imported by the command that needs them.
"""

import argparse
import datetime
import difflib
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deploy.process_table import Choices, Process
    from deploy.progress import Progress
    from deploy.report import Report
    from shared.scenario import Scenario
    from shared.transport import Endpoints

SUCCESS, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    arguments = parse(sys.argv[1:] if argv is None else argv)
    try:
        return int(arguments.command(arguments))
    except KeyboardInterrupt:
        _complain("stopped by the operator")
        return INTERRUPTED
    except BrokenPipeError:  # whoever read our output has had enough; nothing more can be said, also not on the way out
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except _refusals() as error:
        _complain(f"sextant {arguments.name}: {error}")
        return FAILED if _is_transport_error(error) else WRONG_INPUT


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """The arguments of a command, which is among them; whoever is wrong about them is told, and the program ends."""
    words = list(argv)
    if words[:2] == ["trials", "table"]:  # a command of two words, the first of which is one by itself
        words[:2] = ["trials table"]
    return _parser().parse_args(words)


class InputError(ValueError):
    """What the caller of a command got wrong, and what would be right."""


# ------------------------------------------------------------------------------------------------------------- commands


def run(arguments: argparse.Namespace) -> int:
    """`sextant run`: one scenario, over Zenoh or in lockstep."""
    if arguments.lockstep and arguments.connect:
        raise InputError("--lockstep runs in one process and meets nobody; leave --connect out")
    if arguments.record_depth and not arguments.lockstep:
        raise InputError("--record-depth writes the frames of a lockstep run; add --lockstep")
    if arguments.lockstep:
        return _run_lockstep(arguments)
    return _run_live(arguments)


def demo(arguments: argparse.Namespace) -> int:
    """`sextant demo`: the course of low steps over Zenoh, from a cold start."""
    arguments.scenario, arguments.robot, arguments.gait = "steps", "", ""
    arguments.lockstep, arguments.connect, arguments.json = False, None, False
    _say("A six-legged robot sees a field of low blocks and two stairs through its depth camera, maps it, chooses where each")
    _say("foot goes, and walks across. Five processes talk over Zenoh; the simulator is only a camera and a servo bus to them.")
    status = _run_live(arguments)
    if status == SUCCESS:
        _say("The robot stands at its goal. summary.png shows the walk: map, path, footholds, height and tilt.")
    return status


def trials(arguments: argparse.Namespace) -> int:
    """`sextant trials`: the success rate over many seeds, in lockstep."""
    if arguments.scenario == "all":
        return _campaign(arguments)
    scenario = _scenario(arguments)
    out = _out(arguments, f"trials-{scenario.name}")
    from deploy import trials as batches

    progress = _progress(arguments.json)
    seeing = batches.run_trials(scenario, arguments.seeds, arguments.jobs, out, say=progress.say)
    baseline = None
    if arguments.blind:
        progress.say("the same without a map")
        baseline = batches.run_trials(scenario, arguments.seeds, arguments.jobs, out, blind=True, say=progress.say)
    (out / "trials.json").write_text(batches.to_json(seeing, baseline), encoding="utf-8")
    if arguments.json:
        sys.stdout.write(batches.to_json(seeing, baseline))
    else:
        _say(batches.words(seeing, baseline))
        _say(f"written to {out}: trials.json, trials.jsonl")
    return SUCCESS


def _campaign(arguments: argparse.Namespace) -> int:
    """`sextant trials all`: the table of all terrains."""
    from deploy import campaign_table as tables
    from deploy.campaign import run_campaign

    asked = _asked(arguments)
    out = _out(arguments, "trials-all")
    say = _progress(arguments.json).say
    found = run_campaign(tables.WALKED, arguments.seeds, arguments.jobs, out, arguments.blind, asked, say)
    tables.write(found, out)
    if arguments.json:
        sys.stdout.write(tables.to_json(found))
    else:
        _say(tables.markdown(found))
        _say(f"written to {out}: table.md, campaign.json, campaign.jsonl, and a folder per terrain")
    return SUCCESS


def table(arguments: argparse.Namespace) -> int:
    """`sextant trials table`: a table of runs that were kept, nothing being run."""
    from deploy import campaign_table as tables
    from deploy import kept

    files = kept.files([Path(place) for place in arguments.kept])
    found = tables.of_runs(run for path in files for run in kept.read(path))
    if not found.entries:
        raise InputError(f"no finished run in {', '.join(map(str, files))}")
    sys.stdout.write(tables.to_json(found) if arguments.json else tables.markdown(found, arguments.of))
    return SUCCESS


def up(arguments: argparse.Namespace) -> int:
    """`sextant up`: the processes of a role until Ctrl-C."""
    import contextlib
    from dataclasses import replace

    from deploy import process_table
    from deploy.interrupts import Interrupts
    from deploy.launcher import Launcher
    from shared.transport import Endpoints, Router

    rows = process_table.rows(arguments.role, simulated=arguments.scenario is not None)
    chosen = _choices(arguments)
    device = _camera(arguments, rows)
    if device == "none":
        rows = tuple(row for row in rows if row.side != "device")
    chosen, extra = replace(chosen, camera=arguments.camera and device), _extra(arguments.set, rows)
    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        if arguments.connect:
            endpoints = Endpoints(tuple(arguments.connect), namespace=arguments.namespace)
        else:
            stack.enter_context(Router((arguments.listen,)))
            endpoints = Endpoints(
                (re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", arguments.listen),), namespace=arguments.namespace
            )
            _say(
                f"router on {arguments.listen}; others join with --connect {arguments.listen} --namespace {arguments.namespace}"
            )
        launcher = stack.enter_context(Launcher(process_table.commands(rows, chosen, endpoints, extra), hear=_pass_on))
        _say(f"starting {', '.join(row.name for row in rows)}; Ctrl-C ends them")
        while not interrupts.asked():
            for ended in launcher.wait(0.2):
                _complain(str(ended))
                if not ended.restarted:
                    _complain("stopping the others; `sextant doctor` checks what a process needs")
                    return FAILED
        for name in launcher.stop(interrupts.insisted):
            _complain(f"{name} did not end when asked and was killed")
    return INTERRUPTED


def replay(arguments: argparse.Namespace) -> int:
    """`sextant replay`: a recorded depth sequence, or a recorded run."""
    source = Path(arguments.source)
    if not (source.is_dir() or (source.is_file() and source.suffix == ".mcap")):
        raise InputError(f"{source}: a folder with depth.txt and camera.toml, or the recording.mcap of a run, expected")
    from deploy import replay as replays

    out = _out(arguments, f"replay-{source.stem}")
    progress = _progress(arguments.json)
    if source.is_dir():
        table = replays.replay_folder(source, out, progress)
    else:
        table = replays.replay_recording(source, out, progress)
    text = json.dumps(table, indent=1)
    (out / "replay.json").write_text(text + "\n", encoding="utf-8")
    _say(text if arguments.json else replays.in_words(table))
    if not arguments.json:
        _say(f"written to {out}")
    return SUCCESS


def bench_accuracy(arguments: argparse.Namespace) -> int:
    """`sextant bench accuracy`: how right pose and map are, on rebuilt scenes."""
    from deploy.bench import accuracy

    out = _out(arguments, "bench-accuracy")
    rows = accuracy.tables(arguments.seeds, arguments.jobs, _progress(arguments.json).say)
    return _tell_bench(accuracy.in_words(rows), accuracy.to_json(rows), out / "accuracy.json", arguments.json)


def bench_speed(arguments: argparse.Namespace) -> int:
    """`sextant bench speed`: how fast registration is beside its peers."""
    from deploy.bench import chart, speed, timing

    out = _out(arguments, "bench-speed")
    timings, missing = speed.registration(arguments.seeds, arguments.frames, _progress(arguments.json).say)
    chart.draw(out / "speed.png", "Registration beside its peers", timings, missing)
    words, text = timing.in_words(timings, missing, speed.HEADINGS), timing.to_json(timings, missing)
    return _tell_bench(words, text, out / "speed.json", arguments.json)


def bench_stages(arguments: argparse.Namespace) -> int:
    """`sextant bench stages`: how fast the stages of the map are beside their peers."""
    from deploy.bench import chart, stages, timing

    out = _out(arguments, "bench-stages")
    found = stages.stages(arguments.seeds, arguments.frames, _progress(arguments.json).say)
    chart.draw(out / "stages.png", "The stages of the map beside their peers", found.timings, found.missing, found.parts_ms)
    words = f"{timing.in_words(found.timings, found.missing, stages.HEADINGS)}\n{timing.parts_in_words(found.parts_ms)}"
    text = timing.to_json(found.timings, found.missing, parts_ms=found.parts_ms)
    return _tell_bench(words, text, out / "stages.json", arguments.json)


def _tell_bench(words: str, text: str, path: Path, as_json: bool) -> int:
    path.write_text(text, encoding="utf-8")
    _say(text.rstrip() if as_json else f"{words}\nwritten to {path}")
    return SUCCESS


def list_topics(arguments: argparse.Namespace) -> int:
    """`sextant topics list`: the topic table."""
    from shared.topics import TOPICS

    if arguments.json:
        rows = [{"key": t.key, "type": t.type.__name__, "rate_hz": t.rate_hz, "delivery": t.delivery.value} for t in TOPICS]
        _say(json.dumps(rows, indent=1))
        return SUCCESS
    _say(f"{'key':<20} {'type':<16} {'rate':>8}  delivery  what")
    for t in TOPICS:
        doc = (t.type.__doc__ or "").split("\n")[0]
        _say(f"{t.key:<20} {t.type.__name__:<16} {t.rate_hz:>5.1f} Hz  {t.delivery.value:<8}  {doc}")
    return SUCCESS


def doctor(arguments: argparse.Namespace) -> int:
    """`sextant doctor`: whether this machine has what the services need."""
    from deploy import doctor as checks

    found = checks.examine(arguments.port, arguments.robot, arguments.camera)
    _say(checks.to_json(found) if arguments.json else checks.in_words(found))
    return FAILED if any(check.level is checks.Level.FAIL for check in found) else SUCCESS


def compose(arguments: argparse.Namespace) -> int:
    """`sextant compose`: compose.yaml of a local launch."""
    from deploy.compose import compose_yaml

    sys.stdout.write(compose_yaml(arguments.scenario, arguments.seed))
    return SUCCESS


# ------------------------------------------------------------------------------------------------------------- running


def _scenario(arguments: argparse.Namespace) -> "Scenario":
    """The scenario that is asked for, walked as is asked for."""
    from shared.scenario import load_scenario

    return _asked(arguments)(load_scenario(arguments.scenario))


def _asked(arguments: argparse.Namespace) -> Callable[["Scenario"], "Scenario"]:
    """Makes of a scenario what is walked in its place: by the robot and in the gait that are asked for."""
    from services.planner.gait import GAITS

    robot = _robot(arguments)

    def asked(scenario: "Scenario") -> "Scenario":
        if robot:
            scenario = replace(scenario, robot=robot)
        if arguments.gait:
            slower = GAITS[arguments.gait].slowness / GAITS[scenario.walk.gait].slowness
            walk = replace(scenario.walk, gait=arguments.gait)
            scenario = replace(scenario, walk=walk, time_limit_s=scenario.time_limit_s * max(slower, 1.0))
        return scenario

    return asked


def _robot(arguments: argparse.Namespace) -> str:
    """The robot that is asked for in place of the scenario's, as scenarios name it; empty for none."""
    from shared.robot import load_profile

    if not arguments.robot:
        return ""
    robot = str(Path(arguments.robot).resolve()) if arguments.robot.endswith(".toml") else str(arguments.robot)
    load_profile(robot)  # what is wrong with it is told before anything starts
    return robot


def _run_lockstep(arguments: argparse.Namespace) -> int:
    scenario = _scenario(arguments)
    out = _out(arguments, f"{scenario.name}-{arguments.seed}")
    import contextlib

    from deploy.lockstep_run import run_lockstep
    from deploy.tum_recording import DepthRecorder
    from shared.robot import load_profile

    with contextlib.ExitStack() as stack:
        taps = []
        if arguments.record_depth:
            try:
                recorder = DepthRecorder(Path(arguments.record_depth), load_profile(scenario.robot))
            except FileExistsError as error:
                raise InputError(f"--record-depth: {error}; name a new folder") from None
            taps.append(stack.enter_context(recorder).tap)
        report = run_lockstep(scenario, arguments.seed, out, _progress(arguments.json), taps)
    return _tell(report, out, arguments.json)


def _run_live(arguments: argparse.Namespace) -> int:
    scenario = _scenario(arguments)
    if arguments.connect and not all(fault.of_camera for fault in scenario.faults):
        raise InputError(f"{scenario.name} breaks services, which only who started them can; leave --connect out")
    progress = _progress(arguments.json)
    out = _out(arguments, f"{scenario.name}-{arguments.seed}")
    from deploy.interrupts import Interrupts
    from shared.host import end_with

    with Interrupts() as interrupts:
        if getattr(arguments, "parent", None):
            end_with(arguments.parent)
        from deploy import live_run

        attach = _attach(arguments)
        problem = "" if attach else live_run.warm_up(progress, interrupts)
        if problem:
            _complain(f"sextant {arguments.name}: {problem}; `sextant doctor` checks what the services need")
            return FAILED
        if interrupts.asked():
            _complain("stopped by the operator")
            return INTERRUPTED
        source = str(Path(arguments.scenario).resolve()) if arguments.scenario.endswith(".toml") else arguments.scenario
        outcome = live_run.run_live_scenario(scenario, source, arguments.seed, out, progress, interrupts, attach)
    status = _tell(outcome.report, out, arguments.json)
    return INTERRUPTED if outcome.interrupted else status


def _tell(report: "Report", out: Path, as_json: bool) -> int:
    from deploy.report import to_json

    if as_json:
        sys.stdout.write(to_json(report))
    else:
        verdict = f"{'success' if report.success else 'failed'}: {report.reason}"
        walked = f"{report.distance_m:.2f} m in {report.duration_s:.1f} s, {report.speed_mps:.3f} m/s"
        _say(f"{verdict}; {walked}, {report.steps} steps, {report.falls} falls")
        _say(f"written to {out}: {', '.join(sorted(path.name for path in out.iterdir() if path.is_file()))}")
    return SUCCESS if report.success else FAILED


def _attach(arguments: argparse.Namespace) -> "Endpoints | None":
    if not arguments.connect:
        return None
    from shared.transport import Endpoints

    return Endpoints(tuple(arguments.connect), namespace=arguments.namespace)


def _choices(arguments: argparse.Namespace) -> "Choices":
    from dataclasses import replace

    from deploy.launcher import free_port
    from deploy.process_table import Choices, choices
    from shared.scenario import load_scenario

    if arguments.scenario is None and arguments.role != "sim":
        return Choices(robot=arguments.robot)
    source = arguments.scenario or "steps"
    if source.endswith(".toml"):
        source = str(Path(source).resolve())
    chosen = choices(load_scenario(source), source, arguments.seed)
    # Where both ends of the simulated servo bus start here any free port will do, so two sets on one machine do not clash.
    return replace(chosen, bus_port=free_port()) if arguments.role == "all" else chosen


def _camera(arguments: argparse.Namespace, rows: "Sequence[Process]") -> str:
    """The camera that is to be read, a folder by its whole path; "none" where no camera is started."""
    from shared.robot import load_profile

    if not any(row.side == "device" for row in rows):
        if arguments.camera:
            raise InputError("--camera: no camera is started here; leave --scenario out, and take the role all or onboard")
        return "none"
    device = str(arguments.camera or load_profile(arguments.robot).camera.device)
    if device not in ("openni2", "realsense", "none"):
        if not (Path(device) / "depth.txt").is_file():
            raise InputError(f"--camera: openni2, realsense, none, or a folder with depth.txt expected, found {device!r}")
        return str(Path(device).resolve())
    if device == "none" and not arguments.camera:
        _say(f"no camera is started: the profile {arguments.robot} names none; give --camera openni2, realsense or a folder")
    return device


def _extra(assignments: Sequence[str], rows: "Sequence[Process]") -> dict[str, tuple[str, ...]]:
    names = [row.name for row in rows]
    extra: dict[str, tuple[str, ...]] = {}
    for text in assignments:
        service, dot, rest = text.partition(".")
        if not dot or "=" not in rest:
            raise InputError(f"--set: SERVICE.KEY=VALUE expected, found {text!r}; for example actuator.port=/dev/ttyUSB0")
        if service not in names:
            near = difflib.get_close_matches(service, names, n=1)
            raise InputError(
                f"--set: no service {service!r} is started; {f'did you mean {near[0]!r}?' if near else ', '.join(names)}"
            )
        extra[service] = (*extra.get(service, ()), rest)
    return extra


def _out(arguments: argparse.Namespace, name: str) -> Path:
    """The folder that the command leaves behind, made."""
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    out = Path(arguments.out) if arguments.out else Path("runs") / f"{stamp}-{name}"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {out}: {error.strerror}; give another with --out") from None
    return out


def _progress(as_json: bool) -> "Progress":
    from deploy.progress import progress_for

    return progress_for(sys.stderr if as_json else sys.stdout)


def _refusals() -> tuple[type[Exception], ...]:
    """What is the caller's mistake or the machine's state, and says so in words; everything else is a traceback."""
    from shared.config import ConfigError

    known: list[type[Exception]] = [ConfigError, InputError]
    if "shared.transport" in sys.modules:
        known.append(sys.modules["shared.transport"].TransportError)
    if "deploy.recording" in sys.modules:
        known.append(sys.modules["deploy.recording"].RecordingError)
    if "deploy.kept" in sys.modules:
        known.append(sys.modules["deploy.kept"].KeptError)
    if "deploy.replay" in sys.modules:
        known.append(sys.modules["deploy.replay"].ReplayError)
    return tuple(known)


def _is_transport_error(error: Exception) -> bool:
    return type(error).__name__ == "TransportError"


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _complain(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def _pass_on(_name: str, line: str) -> None:
    _complain(line)


# ------------------------------------------------------------------------------------------------------------- arguments


def _seeds(text: str) -> range:
    found = re.fullmatch(r"(\d+):(\d+)", text)
    if found is None or int(found[1]) >= int(found[2]):
        raise argparse.ArgumentTypeError(f"A:B with A < B expected, B not included, found {text!r}; for example 0:50")
    return range(int(found[1]), int(found[2]))


def _any_seeds(text: str) -> Sequence[int]:
    """Seeds from A to B, or as many as are wanted that the commit gives."""
    drawn = re.fullmatch(r"commit:([1-9]\d*)", text)
    if drawn is None:
        return _seeds(text)
    from deploy.provenance import seeds_of_commit

    try:
        return seeds_of_commit(int(drawn[1]))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _natural(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"a whole number of at least 0 expected, found {text!r}")
    return int(text)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"a whole number of at least 1 expected, found {text!r}")
    return int(text)


def _frames(text: str) -> int:
    if not text.isdecimal() or int(text) < 3:
        raise argparse.ArgumentTypeError(f"a whole number of at least 3 expected, found {text!r}: a ride has a way to go")
    return int(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sextant", description="Six-legged walking where only some places carry a foot.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, command: Any, words: str, to: Any = commands, listed: bool = True) -> argparse.ArgumentParser:
        about = {"help": words} if listed else {}
        made: argparse.ArgumentParser = to.add_parser(
            name, description=words[0].upper() + words[1:].replace("%%", "%") + ".", **about
        )
        made.set_defaults(command=command, name=name)
        return made

    one = add("demo", demo, "watch the robot walk a field of low steps, over Zenoh")
    _add_seed_and_out(one)

    one = add("run", run, "run a scenario and write a folder with report.json, summary.png, walk.png and recording.mcap")
    one.add_argument("scenario", help="name of a scenario that comes with sextant, or path of a TOML file")
    _add_robot_and_gait(one)
    one.add_argument("--lockstep", action="store_true", help="in one process on simulated time, as fast as the machine allows")
    one.add_argument("--json", action="store_true", help="print report.json; progress goes to stderr")
    one.add_argument("--record-depth", metavar="DIR", help="also write the depth frames for `sextant replay` (with --lockstep)")
    one.add_argument("--connect", action="append", help="use services that already run, met here, e.g. tcp/127.0.0.1:7447")
    one.add_argument("--namespace", default="sextant", help="of those services (default %(default)s)")
    one.add_argument("--parent", type=int, help=argparse.SUPPRESS)  # a launcher's id, as every process of the table has it
    _add_seed_and_out(one)

    one = add("trials", trials, "run a scenario in lockstep with many seeds: success rate with its 95 %% interval")
    one.add_argument("scenario", help="name of a scenario that comes with sextant, path of a TOML file, or all that are walked")
    _add_robot_and_gait(one)
    words = "from A up to, not including, B; or commit:N, N that the hash of the commit gives, so that nobody has chosen them"
    one.add_argument("--seeds", type=_any_seeds, required=True, metavar="A:B", help=words)
    one.epilog = "`sextant trials table --help`: print tables of trials that were kept, nothing being run."
    one.add_argument("--blind", action="store_true", help="also run the baseline, without a map, and compare")
    one.add_argument("--jobs", type=_positive, default=1, metavar="N", help="processes at a time (default %(default)s)")
    one.add_argument("--out", metavar="DIR", help="folder to write to; seeds that it has already are not run again")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")

    one = add("trials table", table, "print a table of trials that were kept, in Markdown, nothing being run", listed=False)
    words = "folder that trials have left, or a campaign.jsonl of one; parts of a campaign are put together"
    one.add_argument("kept", nargs="+", metavar="KEPT", help=words)
    words = "walks, how often the goal was reached, missteps, or how right the maps were (default %(default)s)"
    one.add_argument("--of", choices=("walks", "reached", "missteps", "maps"), default="walks", help=words)
    one.add_argument("--json", action="store_true", help="print all of it as JSON")

    one = add("up", up, "start the processes of a role and keep them until Ctrl-C")
    one.add_argument(
        "role", choices=("all", "onboard", "offboard", "sim"), help="onboard: actuator, camera, perception; offboard: the rest"
    )
    one.add_argument("--scenario", help="simulate it in place of the hardware")
    one.add_argument("--robot", default="phantomx_mk2", help="profile by name, or path of a TOML file (default %(default)s)")
    one.add_argument(
        "--camera", default="", metavar="DEVICE", help="openni2, realsense, none, or a recorded folder, over the profile"
    )
    one.add_argument("--seed", type=_natural, default=3, help="of the simulation (default %(default)s)")
    one.add_argument("--listen", default="tcp/127.0.0.1:7447", help="where to host the router (default %(default)s)")
    one.add_argument("--connect", action="append", help="use the router there, and host none")
    one.add_argument("--namespace", default="sextant", help="prefix of every key (default %(default)s)")
    one.add_argument("--set", action="append", default=[], metavar="SERVICE.KEY=VALUE", help="a setting of one service")

    one = add("replay", replay, "run perception and mapper on a recorded depth sequence, or the mapper on a recorded run")
    one.add_argument("source", help="folder with depth.txt, camera.toml (and groundtruth.txt), or a recording.mcap")
    one.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")
    one.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")

    group = commands.add_parser("bench", help="what the stages are worth").add_subparsers(required=True, metavar="WHAT")
    one = add("accuracy", bench_accuracy, "ride over rebuilt scenes: errors of pose and map through the real services", group)
    one.add_argument("--jobs", type=_positive, default=1, metavar="N", help="processes at a time (default %(default)s)")
    _add_bench(one)
    one = add("speed", bench_speed, "time registration beside its peers, frame by frame in one run", group)
    _add_frames(one)
    _add_bench(one)
    one = add("stages", bench_stages, "time the stages of the map beside their peers, frame by frame in one run", group)
    _add_frames(one)
    _add_bench(one)

    group = commands.add_parser("topics", help="what travels on the wire").add_subparsers(required=True, metavar="WHAT")
    one = add("list", list_topics, "print the topic table", group)
    one.add_argument("--json", action="store_true", help="as JSON")

    one = add("doctor", doctor, "check that this machine has what the services need")
    one.add_argument("--port", help="also check this servo port, e.g. /dev/ttyUSB0")
    one.add_argument("--camera", default="", metavar="DEVICE", help="also check this camera: openni2, realsense, or a folder")
    one.add_argument("--robot", default="phantomx_mk2", help="whose servos and camera are looked for (default %(default)s)")
    one.add_argument("--json", action="store_true", help="as JSON")

    one = add("compose", compose, "print a compose.yaml that starts the services in containers of their own")
    one.add_argument("--scenario", default="steps", help="name of the scenario (default %(default)s)")
    one.add_argument("--seed", type=_natural, default=3, help="of the simulation (default %(default)s)")
    return parser


def _add_frames(parser: argparse.ArgumentParser) -> None:
    words = "of each ride, 2 cm apart (default %(default)s)"
    parser.add_argument("--frames", type=_frames, default=100, metavar="N", help=words)


def _add_bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=_seeds, default=range(1000, 1003), metavar="A:B", help="rides (default 1000:1003)")
    parser.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")
    parser.add_argument("--json", action="store_true", help="print the result as JSON; progress goes to stderr")


def _add_robot_and_gait(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="", help="profile by name, or path of a TOML file, in place of the scenario's")
    gaits = ("tripod", "ripple", "wave")
    parser.add_argument("--gait", default="", choices=gaits, help="in place of the scenario's, with more time for slower ones")


def _add_seed_and_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=_natural, default=3, help="of everything random (default %(default)s)")
    parser.add_argument("--out", metavar="DIR", help="folder to write to (default: a new one below runs/)")


if __name__ == "__main__":
    sys.exit(main())
