"""`sextant video`: a recorded run as a video."""

import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sextant.deploy.commands import options
from sextant.deploy.commands.common import SUCCESS, InputError, complain, say
from sextant.deploy.terminal.arguments import Parsed, argument, command, number, option

if TYPE_CHECKING:
    from sextant.evaluation.video.ground import Ground
    from sextant.evaluation.video.sinking import Sinking
    from sextant.evaluation.video.timeline import Timeline
    from sextant.shared.recording.reader import Recording
    from sextant.shared.robot.profile import RobotProfile

_TOLD_EVERY_S = 5.0
_INSTANT = number(0.0, 1e6, "seconds")  # from the beginning
_FEET_OFF = 0.02  # [m] median height of standing feet off the ground beyond which the ground is a different one


@command()
@argument("run", "folder of a run, an MCAP file, or a folder of them", "RUN")
@option(
    "--out", "output file: .mp4, .webm, .avi, or animated .webp, .gif, .png (default: walk.mp4 next to the recording)", "FILE"
)
@option("--speed", "playback speed", "X", type=number(0.05, 100.0, "a number"), default=1.0)
@option("--size", "picture size in pixels", "WxH", type=Parsed(options.picture_size, "size"), default="1280x720")
@option(
    "--scenario",
    "scenario that gives the ground of an older recording, by name or TOML file (default: the recorded one)",
    "NAME",
    default="",
)
@option("--fps", "frames per second", "N", type=number(1.0, 120.0, "frames per second"), default=25.0)
@option("--from", "start time in the recording (default: 0)", "S", into="from_s", type=_INSTANT, default=0.0)
@option("--to", "end time in the recording (default: its end)", "S", into="to_s", type=_INSTANT, default=math.inf)
def video(
    run: str, out: str | None, speed: float, size: tuple[int, int], scenario: str, fps: float, from_s: float, to_s: float
) -> int:
    """Draw a video of a recorded run: robot, ground, map, footholds and reports."""
    from sextant.evaluation.video import video_writer
    from sextant.evaluation.video.film import Animation, Cut
    from sextant.evaluation.video.timeline import Timeline
    from sextant.shared.recording.reader import Recording
    from sextant.shared.robot.profiles import load_profile

    source = Path(run)
    target = Path(out) if out else _beside(source)
    if target.suffix.lower() not in video_writer.SUFFIXES:
        raise InputError(
            f"--out: a name that ends in one of {', '.join(video_writer.SUFFIXES)} expected, found {target.name!r}"
        )
    recording = Recording(_recording_of(source))
    story = Timeline.read(recording)
    for path in recording.cut_off:
        complain(f"{path} is truncated; its first {story.duration_s:.1f} s are drawn")
    about = _about(source, recording.about, story)
    profile = load_profile(about["robot"])
    ground, sinking = _ground(recording, about, story, profile, scenario)
    cut = Cut(size, fps, speed, from_s, to_s)
    try:
        title = _title(about) if ground is not None else f"{_title(about)}, on the robot's map"
        film = Animation(recording.path, story, profile, ground, title, cut, sinking)
    except ValueError as error:
        raise InputError(f"{run}: {error}") from None
    began = told = time.monotonic()
    total = len(film.times_ns)

    def tell(done: int) -> None:
        nonlocal began, told
        now = time.monotonic()
        if done == 1:  # the first picture includes the setup
            began = now
        elif now - told >= _TOLD_EVERY_S:
            told = now
            say(f"{done:6d} of {total} frames, {(now - began) / (done - 1) * (total - done):.0f} s left")

    workers = min(os.cpu_count() or 1, 8)
    count = video_writer.write(target, film.frames(workers, tell), cut.fps, cut.size)
    seconds, written = count / cut.fps, target.stat().st_size
    say(f"{target}: {count} frames, {seconds:.1f} s at {cut.fps:g} frames per second, {written / 1e6:.1f} MB")
    return SUCCESS


def _beside(run: Path) -> Path:
    return (run if run.is_dir() else run.parent) / "walk.mp4"


def _recording_of(run: Path) -> Path:
    """Return the path of a run; raise InputError if it does not exist."""
    if not run.exists():
        raise InputError(f"{run}: no such run; give the output folder of `sextant run`, or a recording")
    return run


def _about(run: Path, said: Mapping[str, str], story: "Timeline") -> dict[str, str]:
    """Return scenario, seed and robot of a run.

    They come from the recording, else from the report next to it, else from the recorded simulator.
    """
    about = {name: said[name] for name in ("scenario", "seed", "robot") if name in said}
    from sextant.shared.files.input_file import FileError, read_json

    folder = run if run.is_dir() else run.parent
    try:
        report: Any = read_json(folder / "report.json")
    except FileError:
        report = None
    if isinstance(report, dict):
        about = {name: str(report[name]) for name in ("scenario", "seed", "robot") if name in report} | about
    if len(story.truth):
        truth = story.truth.said[0]
        about = {"scenario": truth.scenario, "seed": str(truth.seed), "robot": truth.robot} | about
    return {"robot": "phantomx_mk2"} | about


def _ground(
    recording: "Recording", about: Mapping[str, str], story: "Timeline", profile: "RobotProfile", asked: str
) -> tuple["Ground | None", "Sinking | None"]:
    """Return the true ground, or None where it is unknown.

    Without it the robot is drawn at its estimated pose, on its own map.
    """
    import numpy as np

    from sextant.evaluation.video.ground import of_terrain
    from sextant.evaluation.video.sinking import Sinking
    from sextant.evaluation.video.timeline import trail
    from sextant.evaluation.walked_scenario import walked_scenario
    from sextant.services.simulator.physics.terrain import build_terrain
    from sextant.shared.files.config import ConfigError
    from sextant.shared.scenario.loading import load_scenario

    if not story.true:
        return None, None
    name = asked or about["scenario"]
    try:
        walked = walked_scenario(recording, asked) or load_scenario(name)
        terrain = build_terrain(walked, np.random.default_rng([int(about["seed"]), 0]))
    except (ConfigError, ValueError) as error:
        if asked:
            raise
        problem = str(error).splitlines()[0]
    else:
        off = float(story.feet_off(terrain.height_at, profile.foot.radius))
        problem = f"the feet stood {100 * off:.0f} cm off the present ground of {name}" if off > _FEET_OFF else ""
    if problem:
        complain(f"{problem}; the video shows the robot's map instead; --scenario FILE selects another ground")
        story.draw_truth(False)
        return None, None
    steps = range(story.began_ns, story.ended_ns + 1, 500_000_000)
    return of_terrain(terrain, trail(story, list(steps))[:, :2, 3]), Sinking(terrain, story, profile.foot.radius)


def _title(about: Mapping[str, str]) -> str:
    return f"{about['scenario']}, seed {about['seed']}" if "scenario" in about and "seed" in about else about["robot"]
