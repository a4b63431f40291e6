"""`sextant record`, `info`, `recover`, `export`, `replay` and `foxglove`."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import (
    FAILED,
    SUCCESS,
    WRONG_INPUT,
    InputError,
    complain,
    met,
    open_progress,
    out_folder,
    say,
)
from sextant.shared.files import whole_files

if TYPE_CHECKING:
    from collections.abc import Callable

    from sextant.shared.recording.live import LiveRecorder, Sink

_LOOK_S = 0.2
_SHOW_S = 5.0
_SILENCE_S = 3.0  # [s] without a message, after which that is reported


def record(arguments: argparse.Namespace) -> int:
    """`sextant record`: record all topics into a folder until Ctrl-C."""
    from datetime import datetime

    from sextant.services.console.recorder.config import Settings
    from sextant.services.console.recorder.service import open_rotation
    from sextant.shared.robot.profiles import load_profile

    settings = Settings(reserve_mb=arguments.reserve, pictures=arguments.pictures)
    profile = load_profile(arguments.robot)
    now = datetime.now().astimezone()
    folder = Path(arguments.out or Path(settings.folder) / now.strftime("%Y%m%d-%H%M%S"))
    about = {"robot": profile.name, "run": "live", "began": now.isoformat(timespec="seconds")}

    def opened() -> "Sink":
        try:
            rotation = open_rotation(folder, profile, settings, about)
        except OSError as error:
            raise InputError(f"cannot record to {folder}: {error}; give another folder with --out") from None
        say(f"recording to {folder}; Ctrl-C stops it")
        return rotation

    recording = _listen(arguments, opened, arguments.seconds)
    if recording.problem:
        complain(f"sextant record: {recording.problem}")
        return FAILED
    lost = f", {recording.dropped} lost, because the disk was too slow" if recording.dropped else ""
    say(f"recorded {recording.taken} messages, {recording.size / 1e6:.1f} MB to {folder}{lost}")
    return SUCCESS


def foxglove(arguments: argparse.Namespace) -> int:
    """`sextant topics foxglove`: serve live topics to Foxglove and Lichtblick until Ctrl-C."""
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.wire.transport import TransportError

    try:
        from sextant.deploy.viewers.foxglove_server import FoxgloveServer
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sextant[foxglove]'") from None
    profile = load_profile(arguments.robot)
    try:
        server = FoxgloveServer(profile, arguments.host, arguments.port)
    except OSError as error:
        complain(f"sextant topics foxglove: {error}")
        return FAILED
    say(f"open {server.target} in Foxglove or Lichtblick (Open connection, Foxglove WebSocket); Ctrl-C stops it")
    try:
        recording = _listen(arguments, lambda: server)
    except TransportError:
        server.abandon()
        raise
    say(f"sent {recording.taken} messages" + (f", {recording.dropped} dropped" if recording.dropped else ""))
    return SUCCESS


def _listen(arguments: argparse.Namespace, opened: "Callable[[], Sink]", seconds: float | None = None) -> "LiveRecorder":
    """Record all topics until Ctrl-C or for some seconds [s].

    The sink is opened once the robot is connected.
    """
    import time

    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.shared.recording.live import LiveRecorder
    from sextant.shared.wire.transport import ZenohLink

    endpoints = met(arguments)
    with Interrupts() as interrupts, ZenohLink(endpoints) as link, LiveRecorder(opened()) as recording:
        recording.listen(link, time.monotonic_ns)
        began = shown = time.monotonic()
        while not interrupts.asked() and not recording.problem:
            now = time.monotonic()
            if seconds and now - began >= seconds:
                break
            if now - shown >= (_SHOW_S if recording.taken else _SILENCE_S):
                shown = now
                say(_progress(recording, now - began, endpoints.connect[0]))
            time.sleep(_LOOK_S)
    return recording


def _progress(recording: "LiveRecorder", elapsed_s: float, endpoint: str) -> str:
    if not recording.taken:
        return f"no message received at {endpoint} for {elapsed_s:.0f} s; `sextant up` starts the services"
    return f"{elapsed_s:6.0f} s  {recording.taken} messages, {recording.size / 1e6:.1f} MB"


def export(arguments: argparse.Namespace) -> int:
    """`sextant recording export`: write a recording in another tool's format."""
    source = Path(arguments.recording)
    target = Path(arguments.rerun)
    if target.suffix != ".rrd":
        raise InputError(f"--rerun: a file that ends in .rrd expected, found {target}")
    try:
        from sextant.deploy.viewers import rerun_export
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sextant[rerun]'") from None
    count = rerun_export.export(source, target, open_progress(False))
    say(f"{target}: {count} messages; open it with `rerun {target}`")
    return SUCCESS


def info(arguments: argparse.Namespace) -> int:
    """`sextant recording info`: describe the contents of a recording."""
    from sextant.shared.recording.contents import as_table, contents, in_words

    found = contents(Path(arguments.recording))
    say(json.dumps(as_table(found), indent=1) if arguments.json else in_words(found))
    return SUCCESS


def recover(arguments: argparse.Namespace) -> int:
    """`sextant recording recover`: repair recordings that a crash truncated."""
    from sextant.shared.recording.layout import RecordingError
    from sextant.shared.recording.reader import files_of, is_recovered, is_whole, recovered
    from sextant.shared.recording.recovery import recover as rescue

    paths = files_of(Path(arguments.recording))
    if not paths:
        raise InputError(f"{arguments.recording}: no recordings in this folder")
    status = SUCCESS
    for path in paths:
        if is_recovered(path, paths):
            continue
        target = recovered(path)
        if target.exists() and is_whole(target):
            say(f"{target}: already recovered; move it away to recover it again")
            continue
        try:
            found = rescue(path, target)
        except RecordingError as error:  # the other files of a folder are still recovered
            complain(f"sextant recording recover: {error}")
            status = WRONG_INPUT
            continue
        if found.was_empty:
            say(f"{path}: empty recording, nothing to recover")
        elif found.was_whole:
            say(f"{path}: already complete, {found.messages} messages over {found.span_s:.1f} s")
        else:
            words = f"; lost: {', '.join(found.lost)}" if found.lost else ""
            say(f"{target}: {found.messages} messages over {found.span_s:.1f} s{words}")
    return status


def replay(arguments: argparse.Namespace) -> int:
    """`sextant replay`: replay a depth sequence or a run; fail without evidence."""
    source = Path(arguments.source)
    run = source.suffix == ".mcap" and source.is_file()
    parts = source.is_dir() and not (source / "depth.txt").is_file() and any(source.glob("recording*.mcap"))
    if not run and not source.is_dir():
        raise InputError(f"{source}: a folder with depth.txt and camera.toml, or the recording.mcap of a run, expected")
    out = out_folder(arguments, f"replay-{source.stem}")
    progress = open_progress(arguments.json)
    if run or parts:
        from sextant.deploy.replay import walk

        table = walk.replay_recording(source, out, progress, arguments.only or ())
        words = walk.in_words(table)
    else:
        from sextant.deploy.replay import sequence

        if arguments.only:
            raise InputError("--only is for recorded runs; a depth sequence is always replayed in full")
        table = sequence.replay_folder(source, out, progress)
        words = sequence.in_words(table)
    text = json.dumps(table, indent=1)
    say(text if arguments.json else words)
    whole_files.write_text(out / "replay.json", text + "\n", durable=True)
    if not arguments.json:
        say(f"written to {out}")
    problem = table["evidence"]["problem"]
    if problem:
        complain(f"sextant replay: {problem}")
        return FAILED
    return SUCCESS
