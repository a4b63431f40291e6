"""`sextant record`, `recording` and `topics foxglove`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import (
    SUCCESS,
    WRONG_INPUT,
    CommandError,
    InputError,
    complain,
    open_progress,
    out_folder,
    say,
)
from sextant.deploy.terminal.arguments import Group, argument, command, flag, option
from sextant.shared.files import whole_files

if TYPE_CHECKING:
    from collections.abc import Callable

    from sextant.shared.recording.live import LiveRecorder, Sink

_LOOK_S = 0.2
_SHOW_S = 5.0
_SILENCE_S = 3.0  # [s] without a message, after which that is reported

recording = Group("recording", "Describe, repair, replay or convert a recording.")
_path = argument("path", "an MCAP file, or a folder of them", "RECORDING")


@command()
@option("--out", "folder to write to (default: a new one below recordings/)", "DIR")
@option("--seconds", "duration of the recording (default: until Ctrl-C)", "S", type=options.SECONDS)
@flag("--pictures", "also record full camera images, 90 % of the data")
@options.count("--reserve", 500, "disk space to keep free", lowest=0, metavar="MB")
@options.robot
@options.connection
def record(
    out: str | None, seconds: float | None, pictures: bool, reserve: int, robot: str, connection: options.Connection
) -> int:
    """Record all topics to MCAP, one file per minute, until Ctrl-C."""
    from datetime import datetime

    from sextant.services.console.recorder.config import Settings
    from sextant.services.console.recorder.service import open_rotation
    from sextant.shared.robot.profiles import load_profile

    settings = Settings(reserve_mb=reserve, pictures=pictures)
    profile = load_profile(robot)
    now = datetime.now().astimezone()
    folder = Path(out or Path(settings.folder) / now.strftime("%Y%m%d-%H%M%S"))
    about = {"robot": profile.name, "run": "live", "began": now.isoformat(timespec="seconds")}

    def opened() -> "Sink":
        try:
            rotation = open_rotation(folder, profile, settings, about)
        except OSError as error:
            raise InputError(f"cannot record to {folder}: {error}; give another folder with --out") from None
        say(f"recording to {folder}; Ctrl-C stops it")
        return rotation

    recorded = _listen(connection, opened, seconds)
    if recorded.problem:
        raise CommandError(recorded.problem)
    lost = f", {recorded.dropped} lost, because the disk was too slow" if recorded.dropped else ""
    say(f"recorded {recorded.taken} messages, {recorded.size / 1e6:.1f} MB to {folder}{lost}")
    return SUCCESS


@command()
@option("--host", "address to listen on", "ADDRESS", default="127.0.0.1")
@option("--port", "TCP port, 0 for any free port", "N", type=options.PORT, default=8765)
@options.robot
@options.connection
def foxglove(host: str, port: int, robot: str, connection: options.Connection) -> int:
    """Serve live topics to Foxglove or Lichtblick, until Ctrl-C."""
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.wire.transport import TransportError

    try:
        from sextant.evaluation.viewers.foxglove_server import FoxgloveServer
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sextant[foxglove]'") from None
    profile = load_profile(robot)
    try:
        server = FoxgloveServer(profile, host, port)
    except OSError as error:
        raise CommandError(str(error)) from None
    say(f"open {server.target} in Foxglove or Lichtblick (Open connection, Foxglove WebSocket); Ctrl-C stops it")
    try:
        sent = _listen(connection, lambda: server)
    except TransportError:
        server.abandon()
        raise
    say(f"sent {sent.taken} messages" + (f", {sent.dropped} dropped" if sent.dropped else ""))
    return SUCCESS


def _listen(connection: options.Connection, opened: "Callable[[], Sink]", seconds: float | None = None) -> "LiveRecorder":
    """Record all topics until Ctrl-C or for some seconds [s].

    The sink is opened once the robot is connected.
    """
    import time

    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.shared.recording.live import LiveRecorder
    from sextant.shared.wire.transport import ZenohLink

    endpoints = connection.endpoints()
    with Interrupts() as interrupts, ZenohLink(endpoints) as link, LiveRecorder(opened()) as listening:
        listening.listen(link, time.monotonic_ns)
        began = shown = time.monotonic()
        while not interrupts.asked() and not listening.problem:
            now = time.monotonic()
            if seconds and now - began >= seconds:
                break
            if now - shown >= (_SHOW_S if listening.taken else _SILENCE_S):
                shown = now
                say(_progress(listening, now - began, endpoints.connect[0]))
            time.sleep(_LOOK_S)
    return listening


def _progress(listening: "LiveRecorder", elapsed_s: float, endpoint: str) -> str:
    if not listening.taken:
        return f"no message received at {endpoint} for {elapsed_s:.0f} s; `sextant up` starts the services"
    return f"{elapsed_s:6.0f} s  {listening.taken} messages, {listening.size / 1e6:.1f} MB"


@recording.command("export")
@_path
@option("--rerun", "output file for the rerun viewer", "FILE.rrd")
@option("--tum", "output file for the body's trajectory in the TUM format; the true one goes to FILE_true", "FILE.txt")
@option("--map", "output file for the merged height maps, with their place in FILE.json", "FILE.npy", into="map_file")
@option("--grid-map", "output file for these maps as a GridMap of ROS 2", "FILE.mcap")
def export(path: str, rerun: str | None, tum: str | None, map_file: str | None, grid_map: str | None) -> int:
    """Write a recording in other tools' formats."""
    wanted = {
        "--rerun": (rerun, ".rrd"),
        "--tum": (tum, ".txt"),
        "--map": (map_file, ".npy"),
        "--grid-map": (grid_map, ".mcap"),
    }
    for name, (given, suffix) in wanted.items():
        if given is not None and Path(given).suffix != suffix:
            raise InputError(f"{name}: a file that ends in {suffix} expected, found {given}")
    if not any(given for given, _ in wanted.values()):
        raise InputError(f"at least one of {', '.join(wanted)} expected, found none")
    if rerun:
        _export_to_rerun(path, Path(rerun))
    if tum:
        from sextant.evaluation.viewers.file_export import export_trajectories

        for written, count in export_trajectories(Path(path), Path(tum)).items():
            say(f"{written}: {count} poses")
    if map_file:
        from sextant.evaluation.viewers.file_export import export_map

        nx, ny = export_map(Path(path), Path(map_file))
        say(f"{map_file}: {nx} x {ny} heights; {Path(map_file).with_suffix('.json')}: where they are")
    if grid_map:
        _export_grid_map(path, Path(grid_map))
    return SUCCESS


def _export_grid_map(path: str, target: Path) -> None:
    try:
        from sextant.deploy.ros2 import grid_map_file
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sextant[ros2]'") from None
    if target.exists() and Path(path) in (target, target.parent):
        raise InputError(f"--grid-map: a file other than the recording's expected, found {target}")
    nx, ny = grid_map_file.export_grid_map(Path(path), target)
    say(f"{target}: a GridMap of {nx} x {ny} heights on {grid_map_file.TOPIC}; `ros2 bag play {target}` publishes it")


def _export_to_rerun(path: str, target: Path) -> None:
    try:
        from sextant.evaluation.viewers import rerun_export
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sextant[rerun]'") from None
    count = rerun_export.export(Path(path), target, open_progress(False))
    say(f"{target}: {count} messages; open it with `rerun {target}`")


@recording.command("info")
@_path
@options.as_json
def info(path: str, as_json: bool) -> int:
    """Print a recording's files, topics, rates and sizes."""
    from sextant.shared.recording.contents import as_table, contents, in_words

    found = contents(Path(path))
    say(json.dumps(as_table(found), indent=1) if as_json else in_words(found))
    return SUCCESS


@recording.command("recover")
@_path
def recover(path: str) -> int:
    """Repair a recording that a crash truncated; the old file is kept."""
    from sextant.shared.recording.layout import RecordingError
    from sextant.shared.recording.reader import files_of, is_recovered, is_whole, recovered
    from sextant.shared.recording.recovery import recover as rescue

    paths = files_of(Path(path))
    if not paths:
        raise InputError(f"{path}: no recordings in this folder")
    status = SUCCESS
    for file in paths:
        if is_recovered(file, paths):
            continue
        target = recovered(file)
        if target.exists() and is_whole(target):
            say(f"{target}: already recovered; move it away to recover it again")
            continue
        try:
            found = rescue(file, target)
        except RecordingError as error:  # the other files of a folder are still recovered
            complain(f"sextant recording recover: {error}")
            status = WRONG_INPUT
            continue
        if found.was_empty:
            say(f"{file}: empty recording, nothing to recover")
        elif found.was_whole:
            say(f"{file}: already complete, {found.messages} messages over {found.span_s:.1f} s")
        else:
            words = f"; lost: {', '.join(found.lost)}" if found.lost else ""
            say(f"{target}: {found.messages} messages over {found.span_s:.1f} s{words}")
    return status


@recording.command("replay")
@argument("source", "folder with depth.txt, camera.toml (and groundtruth.txt), or a recording", "SOURCE")
@option("--only", "replay only this recorded topic; repeatable", "TOPIC", multiple=True)
@options.as_json
@options.out
def replay(source: str, only: tuple[str, ...], as_json: bool, out: str | None) -> int:
    """Replay a depth sequence, or a recorded run, through the services.

    Perception and mapper run on a depth sequence, mapper and planner on a recorded run.
    """
    path = Path(source)
    run = path.suffix == ".mcap" and path.is_file()
    parts = path.is_dir() and not (path / "depth.txt").is_file() and any(path.glob("recording*.mcap"))
    if not run and not path.is_dir():
        raise InputError(f"{source}: a folder with depth.txt and camera.toml, or the recording.mcap of a run, expected")
    folder = out_folder(out, f"replay-{path.stem}")
    progress = open_progress(as_json)
    if run or parts:
        from sextant.evaluation.replay import walk

        table = walk.replay_recording(path, folder, progress, only)
        words = walk.in_words(table)
    else:
        from sextant.evaluation.replay import sequence

        if only:
            raise InputError("--only is for recorded runs; a depth sequence is always replayed in full")
        table = sequence.replay_folder(path, folder, progress)
        words = sequence.in_words(table)
    text = json.dumps(table, indent=1)
    say(text if as_json else words)
    whole_files.write_text(folder / "replay.json", text + "\n", durable=True)
    if not as_json:
        say(f"written to {folder}")
    if problem := table["evidence"]["problem"]:
        raise CommandError(problem)
    return SUCCESS
