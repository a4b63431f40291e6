"""A recorded run, heard again by the scorer that judged it: what its figures are drawn from."""

import heapq
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from deploy import report as reports
from deploy.report import Report
from deploy.scorer import Scorer
from deploy.trace import Trace
from deploy.walk import Walk
from deploy.walk_metrics import stability_margin
from services.console.recording.layout import RecordingError
from services.console.recording.reader import Recording
from shared import codec, topics
from shared.geometry import Array
from shared.messages import GroundTruth, TerrainMap
from shared.robot import load_profile
from shared.scenario import load_scenario
from shared.service import AnyTopic, Inbox, Stages

_INSTEAD = "give the folder of a `sextant run`"


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """What the figures need of a run."""

    name: str  # of its folder
    report: Report  # its verdict, and what its recording tells
    numbers: dict[str, Any]  # its report as a table: the one that the run has left behind, where it is there
    trace: Trace
    margin: Array  # (n,) [m] stability margin at the times of the trace, NaN where it did not walk
    torque_rms: Array  # (6, 3) [N m] of each joint while it walked, NaN where it did not
    torque_p95: Array  # (6, 3) [N m] likewise
    terrain: TerrainMap | None  # its last map
    cut_off: bool  # its recording ends before its end

    @property
    def begin(self) -> float:
        """Time [s] of the trace at which the first step began; zero where none did."""
        walking = self.trace.walking
        return float(self.trace.t[np.argmax(walking)]) if walking.any() else 0.0


def recorded_run(path: Path, scenario: str = "") -> RecordedRun:
    """Hear a run again.

    Args:
        path: Its folder, or its recording.
        scenario: Name or TOML file of what was walked; empty for what the recording says.

    Raises:
        RecordingError: There is no recording, or none of a simulated run, or of another scenario; or the report beside is none.
        ConfigError: Its scenario does not come with Sextant, and none is given.
    """
    recording = Recording(path)
    inbox, scorer = Inbox(Scorer.reads, Stages()), None
    for topic, frame, at_ns in _as_it_came(recording):
        if topic is not topics.TRUTH:
            inbox.receive(topic, frame, at_ns)
            continue
        truth = _truth(recording, frame)
        if scorer is None:
            scorer = _scorer(recording, scenario, truth)
        inbox.now_ns = at_ns
        scorer.step(truth, inbox)
    if scorer is None:
        raise RecordingError(f"{path}: no ground truth in it, so it is not of a simulation; {_INSTEAD}")
    folder = path if path.is_dir() else path.parent
    judged = scorer.result(in_a_hurry=True)
    left = _left_behind(folder)
    walk = scorer.walk
    torque = walk.torque[walk.walking] if walk.walking.any() else np.full((1, 6, 3), np.nan)
    verdict = {name: left[name] for name in ("success", "reason", "gait", "blind") if name in left}
    return RecordedRun(
        name=folder.resolve().name,
        report=replace(judged, **verdict),
        numbers=left or reports.as_table(judged),
        trace=scorer.trace,
        margin=_margin(walk),
        torque_rms=np.sqrt(np.mean(torque**2, axis=0)),
        torque_p95=np.percentile(torque, 95, axis=0),
        terrain=inbox.latest(topics.TERRAIN),
        cut_off=not recording.complete,
    )


def _as_it_came(recording: Recording) -> Iterator[tuple[AnyTopic, bytes, int]]:
    """(topic, frame, time [ns]) of what a scorer hears, when it hears it: in lockstep frames are recorded as they are sent."""
    wanted = {topic.key: topic for topic in (Scorer.paced_by, *Scorer.reads)}
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


def _truth(recording: Recording, frame: bytes) -> GroundTruth:
    try:
        message, _ = codec.decode(frame, GroundTruth, topics.TRUTH.max_bytes)
    except codec.DecodeError as error:
        raise RecordingError(f"{recording.path}: {topics.TRUTH.key}: {error}; read it with the version that wrote it") from None
    return message


def _scorer(recording: Recording, scenario: str, truth: GroundTruth) -> Scorer:
    """Who judges the run that a first message of truth is of."""
    walked = load_scenario(scenario or truth.scenario)
    if walked.name != truth.scenario:
        raise RecordingError(f"{recording.path}: a run of {truth.scenario}, not of {walked.name}; give what was walked")
    walked = replace(walked, robot=recording.about.get("robot", walked.robot))
    return Scorer(load_profile(walked.robot), walked, truth.seed)


def _left_behind(folder: Path) -> dict[str, Any]:
    """The report of a run's folder as a table; empty where there is none: the run was killed."""
    path = folder / "report.json"
    if not path.exists():
        return {}
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        table = None
    problems = reports.check(table)
    if problems:
        raise RecordingError(f"{path}: not a report: {problems[0]}; leave it out, or make the run again")
    return dict(table)


def _margin(walk: Walk) -> Array:
    margin, walking = np.full(len(walk.t_ns), np.nan), walk.walking
    if walking.any():
        margin[walking] = stability_margin(walk.feet[walking, :, :2], walk.carrying[walking], walk.p[walking, :2])
    return margin
