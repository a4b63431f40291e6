"""A recorded run for figures, evaluated again by the scorer."""

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sextant.evaluation import report as reports
from sextant.evaluation.figures.recorded_ground import SEED, WORDS, Frame, ground_of, scenario_of, with_truth
from sextant.evaluation.report import Report
from sextant.evaluation.scoring.scorer import Scorer
from sextant.evaluation.trace.trace import Trace
from sextant.evaluation.walked_scenario import walked_scenario
from sextant.shared.files.config import ConfigError
from sextant.shared.files.input_file import FileError, read_json
from sextant.shared.geometry import Array
from sextant.shared.recording.layout import SCENARIO, RecordingError
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import GroundTruth, TerrainMap

_INSTEAD = "give the folder of a `sextant run`"


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Data of a run for its figures."""

    name: str  # of its folder
    report: Report  # its result, and what its recording contains
    numbers: dict[str, Any]  # its report as a table: the file that the run wrote, if it exists
    trace: Trace
    margin: Array  # (n,) [m] stability margin at the times of the trace, NaN where it did not walk
    torque_rms: Array  # (6, 3) [N m] of each joint while it walked, NaN where it did not
    torque_p95: Array  # (6, 3) [N m] of each joint while it walked, NaN where it did not
    terrain: TerrainMap | None  # its last map
    own_words: bool  # without ground truth; the robot's own estimates replace it
    cut_off: bool  # its recording is truncated

    @property
    def begin(self) -> float:
        """Time [s] of the trace at which the first step began; 0 if there is none."""
        walking = self.trace.walking
        return float(self.trace.t[np.argmax(walking)]) if walking.any() else 0.0


def recorded_runs(paths: Sequence[Path], scenario: str = "") -> list[RecordedRun]:
    """Evaluate recorded runs again, see `recorded_run`; runs of folders with one name are named by their paths."""
    runs = [recorded_run(path, scenario) for path in paths]
    names = [run.name for run in runs]
    return [replace(run, name=str(path)) if names.count(run.name) > 1 else run for path, run in zip(paths, runs, strict=True)]


def recorded_run(path: Path, scenario: str = "") -> RecordedRun:
    """Evaluate a recorded run again; without truth, by the robot's estimates.

    Args:
        path: Folder or recording of the run.
        scenario: Name or TOML file of the scenario; empty for the one in the recording. An older recording has only the name.

    Raises:
        RecordingError: There is no recording, it holds no walk or another scenario, or the report next to it is invalid or from
            another version.
        ConfigError: The given scenario does not exist or is not the recorded one, or a file that it names has changed.
    """
    recording = Recording(path)
    try:
        scorer, terrain = _heard(_as_it_came(recording), partial(_scorer, recording, scenario))
        own_words = scorer is None
        if scorer is None:
            scorer, terrain = _in_own_words(recording)
    except codec.DecodeError as error:
        raise RecordingError(f"{path}: {error}; read it with the version that wrote it") from None
    folder = path if path.is_dir() else path.parent
    judged = scorer.result(in_a_hurry=True)
    left = _left_behind(folder)
    if own_words:  # whether a foothold is a misstep is unknown without ground truth
        left, judged = {}, replace(judged, success=True, reason=WORDS)
    walk = scorer.walk
    torque = walk.torque[walk.walking] if walk.walking.any() else np.full((1, 6, 3), np.nan)
    verdict = {name: left[name] for name in ("success", "reason", "gait", "blind") if name in left}
    trace = scorer.trace
    if own_words:
        downs = trace.touchdowns  # the distance from the target is unknown too: measured load reports contact before touchdown
        downs = replace(downs, misstep=np.zeros_like(downs.misstep), chosen=np.full_like(downs.chosen, np.nan))
        trace = replace(trace, touchdowns=downs, pose_error=np.full_like(trace.pose_error, np.nan))
    return RecordedRun(
        name=folder.resolve().name,
        report=replace(judged, **verdict),
        numbers=left or _table(judged, own_words),
        trace=trace,
        margin=np.where(walk.walking, walk.margin, np.nan),
        torque_rms=np.sqrt(np.mean(torque**2, axis=0)),
        torque_p95=np.percentile(torque, 95, axis=0),
        terrain=terrain,
        own_words=own_words,
        cut_off=not recording.complete,
    )


def _heard(frames: Iterable[Frame], judge: Callable[[GroundTruth], Scorer]) -> tuple[Scorer | None, TerrainMap | None]:
    """Feed all frames to a scorer; return it and the last map.

    The scorer is created at the first truth. Either result is None if there was none.
    """
    inbox, scorer = Inbox(Scorer.subscribes, Stages()), None
    for topic, frame, at_ns in frames:
        if topic is not topics.TRUTH:
            inbox.receive(topic, frame, at_ns)
            continue
        truth, _ = codec.decode(frame, GroundTruth, topic.max_bytes)
        scorer = scorer or judge(truth)
        inbox.now_ns = at_ns
        scorer.step(truth, inbox)
    return scorer, inbox.latest(topics.TERRAIN)


def _in_own_words(recording: Recording) -> tuple[Scorer, TerrainMap | None]:
    robot = recording.about.get("robot", "")
    if not robot:
        raise RecordingError(f"{recording.path}: an empty recording, or one of an unknown robot; {_INSTEAD}")
    profile = load_profile(robot)
    scenario, ground = scenario_of(recording, robot), ground_of(recording)
    frames = with_truth(_as_it_came(recording), profile.name)
    scorer, terrain = _heard(frames, lambda _: Scorer(profile, scenario, SEED, ground))
    if scorer is None:
        raise RecordingError(f"{recording.path}: no actuator messages in it, so no walk; {_INSTEAD}")
    return scorer, terrain


def _table(report: Report, own_words: bool) -> dict[str, Any]:
    """Return a report as a table, without the values that need ground truth."""
    table = reports.as_table(report)
    unknown: dict[str, Any] = dict.fromkeys(("scenario", "seed", "success", "missteps"))
    unknown |= {name: dict.fromkeys(table[name]) for name in ("map_error_m", "pose_error_m")}
    return table | unknown if own_words else table


def _as_it_came(recording: Recording) -> Iterator[Frame]:
    """Yield (topic, frame, time [ns]) of the scorer's topics at arrival.

    Lockstep recordings hold the time of sending, so latency is added.
    """
    wanted = {topic.key: topic for topic in (Scorer.trigger, *Scorer.subscribes)}
    on_the_way: list[tuple[int, int, AnyTopic, bytes]] = []
    for number, (key, frame, at_ns) in enumerate(recording.frames()):
        while on_the_way and on_the_way[0][0] <= at_ns:
            due, _, topic, waited = heapq.heappop(on_the_way)
            yield topic, waited, due
        if key in wanted:
            topic = wanted[key]
            late = round(topic.latency_s * 1e9) if recording.about.get("run") == "lockstep" else 0
            heapq.heappush(on_the_way, (at_ns + late, number, topic, frame))
    for due, _, topic, waited in sorted(on_the_way, key=lambda item: item[:2]):
        yield topic, waited, due


def _scorer(recording: Recording, scenario: str, truth: GroundTruth) -> Scorer:
    """Return a scorer for the run to which a first truth message belongs."""
    try:
        walked = walked_scenario(recording, scenario) or load_scenario(scenario or truth.scenario)
    except ConfigError:
        if scenario or SCENARIO in recording.about:
            raise
        raise RecordingError(
            f"{recording.path}: a run of {truth.scenario!r}, which does not come with Sextant; give its file with --scenario"
        ) from None
    if walked.name != truth.scenario:
        raise RecordingError(f"{recording.path}: a run of {truth.scenario}, not of {walked.name}; give its own scenario")
    walked = replace(walked, robot=recording.about.get("robot", walked.robot))
    return Scorer(load_profile(walked.robot), walked, truth.seed)


def _left_behind(folder: Path) -> dict[str, Any]:
    """Return the report of a run's folder as a table; empty if the run was killed."""
    path = folder / "report.json"
    if not path.exists():
        return {}
    try:
        table = read_json(path)
    except FileError as error:
        raise RecordingError(f"{error}; leave it out, or repeat the run") from None
    problems = reports.check(table)
    if problems:
        raise RecordingError(f"{path}: not a report: {problems[0]}; leave it out, or repeat the run")
    return dict(table)
