"""Replay of a recorded run through the real mapper and planner.

The results are compared with the recorded ones.
"""

import heapq
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sextant.evaluation import params
from sextant.evaluation.figures import layers_picture
from sextant.evaluation.metrics.stage_times import rounded, stages_ms
from sextant.evaluation.observers.progress import Progress
from sextant.evaluation.replay.error import ReplayError
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.service import Mapper
from sextant.services.planner.config import Settings as PlannerSettings
from sextant.services.planner.locomotion.plan_tracking import UNKNOWN_STEP
from sextant.services.planner.service import Planner
from sextant.shared.files import whole_files
from sextant.shared.files.input_file import parse_json
from sextant.shared.recording.layout import FOR_PROGRAMS
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import Lockstep
from sextant.shared.runtime.service import AnyTopic, Service
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Message, StepPlan, TerrainMap

_SETTLE_NS = 500_000_000  # [ns] simulated time after the last frame, for messages in transit
_SHOW_FRAMES = 5000
_BEGINNING = "begin the recording while the robot stands, before its first walk"


@dataclass(frozen=True, slots=True)
class Limits:
    """Allowed differences from a live run; a lockstep run is reproduced exactly."""

    map_rmse_m: float = 0.01
    map_coverage: float = 0.9  # [1] share of the recorded cells that are known now
    touchdown_p50_m: float = 0.02


Change = Callable[[AnyTopic, Message, int], Iterable[tuple[Message, int]]]  # message, time [ns] -> messages to feed instead


def as_recorded(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
    """Return each message unchanged, at its time."""
    return ((message, at_ns),)


def replay_recording(
    path: Path, out: Path, progress: Progress, only: Sequence[str] = (), change: Change = as_recorded
) -> dict[str, Any]:
    """Run mapper and planner on the recorded inputs; compare maps and plans.

    The last map with its foothold layers (layers.png) is written to `out`.

    Args:
        path: The recording.
        out: Folder for the picture.
        progress: Display of the progress.
        only: Keys of the recorded topics to feed; empty for all that the services do not publish. A service does not run if one
            of its outputs is fed.
        change: Returns what to feed instead of each message, in the order of time; for fault tests.

    Returns:
        Plain table: topics with their counts, compared maps and plans, map_error_m and plan_error_m of the new ones against the
        recorded ones, stages_ms, and evidence: whether the replay supports the recording, or the problem.
    """
    # 1. Read the recording.
    recording = Recording(path)
    replay: _Replay | None = None
    counts: dict[str, int] = {}
    for topic, message, at_ns in recording.messages():
        counts[topic.key] = counts.get(topic.key, 0) + 1
        if replay is None:  # the recording's robot is known from here on
            if words := recording.about.get("plugins", ""):
                raise ReplayError(f"{path}: walked with the plug-ins {words}; a replay runs only Sextant's own algorithms")
            replay = _Replay(recording, _fed(only))
        # 2. Feed each message at its time.
        replay.hear(topic, message, at_ns, change)
        if sum(counts.values()) % _SHOW_FRAMES == 0:
            progress.say(f"{sum(counts.values())} messages, {len(replay.maps)} maps, {len(replay.plans)} plans")
    if replay is None:
        raise ReplayError(f"{path}: no messages in it; the run ended before any message, or the file is truncated")
    if not recording.complete:
        progress.say(f"{path} is truncated; its readable part is replayed")
    replay.settle()
    # 3. Compare the results.
    maps, plans = replay.compared_maps(), compared_plans(replay.recorded_plans, replay.plans)
    if replay.maps:
        with whole_files.reported(progress.say):
            layers_picture.draw(out / "layers.png", replay.maps[max(replay.maps)])
    table = {
        "source": path.name,
        "about": {key: value for key, value in recording.about.items() if key not in FOR_PROGRAMS},
        "complete": recording.complete,
        "topics": dict(sorted(counts.items())),
        "fed": sorted(replay.fed_keys),
        "maps": {
            "made": len(replay.maps),
            "recorded": len(replay.recorded_maps),
            "compared": len(maps),
            "coverage_at_start": map_difference(maps[:5])["coverage"],
        },
        "plans": {"made": len(replay.plans), "recorded": len(replay.recorded_plans), "compared": len(plans)},
        "pose_error_m": {"rms": None, "final": None},
        "map_error_m": map_difference(maps),
        "plan_error_m": plan_difference(plans),
        "said": replay.said,
        "stages_ms": stages_ms(*replay.services()),
    }
    problem = problem_of(table, everything=not only)
    return table | {"evidence": {"supported": not problem, "problem": problem}}


def problem_of(table: Mapping[str, Any], everything: bool = True, limits: Limits | None = None) -> str:
    """Return why a replay does not support the recording, and what to do.

    It is empty if the replay does.

    Args:
        table: Result of `replay_recording`.
        everything: Whether all topics were fed, so that both maps and plans must be reproduced.
        limits: For a live run.
    """
    maps, plans, error, off = table["maps"], table["plans"], table["map_error_m"], table["plan_error_m"]
    if everything and plans["recorded"] and not plans["made"] and any(UNKNOWN_STEP in words for words in table["said"]):
        return (
            f"no plan was compared: {plans['recorded']} were recorded, 0 made now, because the recording begins during a step, "
            f"and the planner waits for its end; {_BEGINNING}"
        )
    if not (maps["compared"] or plans["compared"]):
        return (
            f"nothing was compared: {maps['recorded']} maps and {plans['recorded']} plans were recorded, {maps['made']} and "
            f"{plans['made']} made now; record perception/scan and mapper/terrain, or the planner's topics, of a longer run"
        )
    for name, found in (("map", maps), ("plan", plans)):
        if everything and found["recorded"] and not found["compared"]:
            said = max(table["said"], key=lambda words: table["said"][words], default="")
            mostly = f"the planner was mostly {said}; " if name == "plan" and said else ""
            return (
                f"no {name} was compared: {found['recorded']} were recorded, {found['made']} made now; {mostly}"
                f"`sextant recording info` shows whether the recording has the topics that they are made of"
            )
    exact = everything and table["about"].get("run") == "lockstep"
    allowed = Limits(0.0, 1.0, 0.0) if exact else limits or Limits()
    advice = (
        "a lockstep run replays exactly with the version that recorded it"
        if exact
        else "replay it with the version that recorded it, or record on a less busy computer"
    )
    if maps["compared"] and (error["rmse"] is None or error["coverage"] < allowed.map_coverage):
        known = 0.0 if error["rmse"] is None else error["coverage"]
        at_start = maps["coverage_at_start"]
        if not exact and at_start is not None and at_start < allowed.map_coverage:
            return (
                f"only {known:.1%} of the recorded cells are known now, {allowed.map_coverage:.0%} expected, because the robot "
                f"had mapped ground before the recording began; {_BEGINNING}"
            )
        return f"only {known:.1%} of the recorded cells are known now, {allowed.map_coverage:.0%} expected; {advice}"
    if maps["compared"] and error["rmse"] > allowed.map_rmse_m:
        found_mm, allowed_mm = 1e3 * error["rmse"], 1e3 * allowed.map_rmse_m
        return f"maps are {found_mm:.1f} mm rms off the recorded ones, {allowed_mm:g} mm allowed; {advice}"
    name = "touchdown_max" if exact else "touchdown_p50"
    if plans["compared"] and off[name] > allowed.touchdown_p50_m:
        which = "at most" if exact else "in the median"
        found_mm, allowed_mm = 1e3 * off[name], 1e3 * allowed.touchdown_p50_m
        return f"touchdowns are {found_mm:.1f} mm off the recorded ones {which}, {allowed_mm:g} mm allowed; {advice}"
    return ""


class _Replay:
    """Mapper and planner on simulated time, and their outputs."""

    def __init__(self, recording: Recording, only: frozenset[str]):
        profile = load_profile(recording.about.get("robot", "phantomx_mk2"))
        every: dict[str, Service] = {
            "mapper": Mapper(profile, _map_settings(recording)),
            "planner": Planner(profile, _planner_settings(recording)),
        }
        self._path = recording.path
        self._running = {
            name: service
            for name, service in every.items()
            if not any(topic.key in only for topic in service.publishes)  # one of its outputs is fed
        }
        made = {topic.key for service in self._running.values() for topic in service.publishes}
        self._feeds = frozenset(only or {topic.key for topic in topics.TOPICS}) - made
        self.fed_keys: set[str] = set()
        self.maps: dict[int, TerrainMap] = {}  # made now, by stamp
        self.recorded_maps: dict[int, TerrainMap] = {}
        self.plans: list[StepPlan] = []
        self.recorded_plans: list[StepPlan] = []
        self.said: dict[str, int] = {}  # planner state as text -> number of reports
        # A lockstep run records frames when they are sent, a live one when they arrive.
        late = recording.about.get("run") == "lockstep"
        latency_s = {} if late else dict.fromkeys(self._feeds, 0.0)
        self._lockstep = Lockstep({n: lambda s=s: s for n, s in self._running.items()}, self._take, latency_s)  # type: ignore[misc]
        self._waiting: list[tuple[int, int, Any]] = []  # feeding time [ns], order, message
        self._order = itertools.count()

    def hear(self, topic: AnyTopic, message: Message, at_ns: int, change: Change) -> None:
        """Feed the next recorded message to the services, or keep it for comparison."""
        if isinstance(message, TerrainMap):
            self.recorded_maps[message.stamp_ns] = message
        if isinstance(message, StepPlan):
            self.recorded_plans.append(message)
        if topic.key not in self._feeds:
            return
        self.fed_keys.add(topic.key)
        for fed, fed_ns in change(topic, message, at_ns):
            heapq.heappush(self._waiting, (fed_ns, next(self._order), fed))
        self._feed(at_ns)

    def _feed(self, until_ns: float) -> None:
        """Send all messages that are due."""
        while self._waiting and self._waiting[0][0] <= until_ns:
            at_ns, _, message = heapq.heappop(self._waiting)
            self._lockstep.run(max(at_ns, self._lockstep.now_ns))
            walking = isinstance(message, ActuatorState) and "planner" in self._running
            self._lockstep.say(self._as_walked(message) if walking else message)

    def settle(self) -> None:
        """Let messages in transit arrive."""
        self._feed(math.inf)
        self._lockstep.run(self._lockstep.now_ns + _SETTLE_NS)

    def services(self) -> Iterable[Service]:
        """Return the services that run."""
        return self._running.values()

    def compared_maps(self) -> list[tuple[TerrainMap, TerrainMap]]:
        """Return pairs of recorded and new maps of the same time.

        Raises:
            ReplayError: No pair has the same cells.
        """
        pairs = [(a, b) for a in self.recorded_maps.values() if (b := self._map_of(a.stamp_ns)) is not None]
        if pairs and not any(_same_cells(before, after) for before, after in pairs):
            raise ReplayError(
                f"{self._path}: none of its maps has the cells of those made now: {_cells(pairs[0][0])} recorded, "
                f"{_cells(pairs[0][1])} made; replay it with the version that wrote it"
            )
        return pairs

    def _map_of(self, stamp_ns: int) -> TerrainMap | None:
        """Return the new map at a time, or at one scan before or after it.

        Not every scan has a map if `publish_every` is above 1.
        """
        nearest = min(self.maps, key=lambda stamp: abs(stamp - stamp_ns), default=None)
        near_ns = 1.5e9 / topics.SCAN.rate_hz
        return None if nearest is None or abs(nearest - stamp_ns) > near_ns else self.maps[nearest]

    def _as_walked(self, state: ActuatorState) -> ActuatorState:
        """Return the state with the new plan's stamp in place of the recorded plan's.

        Both plans are of the same step. The planner then sees its own plan being executed.
        """
        walked = next((p for p in reversed(self.recorded_plans) if p.stamp_ns == state.plan_ns), None)
        if walked is None or any(p.stamp_ns == state.plan_ns for p in self.plans):
            return state
        own = [p for p in self.plans if _step_of(p) == _step_of(walked)]
        return replace(state, plan_ns=own[-1].stamp_ns) if own else state

    def _take(self, topic: AnyTopic, frame: bytes, _: int) -> None:
        """Store an output of the services; fed topics are ignored."""
        if topic.key in self._feeds:
            return
        if topic is topics.TERRAIN:
            terrain = codec.decode(frame, TerrainMap)[0]
            self.maps[terrain.stamp_ns] = terrain
        elif topic is topics.STEP_PLAN:
            self.plans.append(codec.decode(frame, StepPlan)[0])
        elif topic is topics.PLANNER_STATUS:
            status = codec.decode(frame, topics.PLANNER_STATUS.type)[0]
            words = status.state if status.state == "stepping" else f"{status.state}: {status.reason}"
            self.said[words] = self.said.get(words, 0) + 1


def map_difference(pairs: Iterable[tuple[TerrainMap, TerrainMap]]) -> dict[str, float | None]:
    """Compare the second map of each pair with the first.

    Errors [m] are over cells known to both. Coverage is the share of the first map's cells that the second one knows.
    """
    differences, known, shared_cells = [], 0, 0
    for before, after in pairs:
        if not _same_cells(before, after):
            continue
        both = np.isfinite(before.elevation) & np.isfinite(after.elevation)
        known += int(np.isfinite(before.elevation).sum())
        shared_cells += int(both.sum())
        differences.append((after.elevation[both] - before.elevation[both]).astype(np.float64))
    d = np.concatenate(differences) if differences else np.zeros(0)
    if d.size == 0:
        return {"rmse": None, "bias": None, "p95": None, "coverage": None}
    return {
        "rmse": rounded(float(np.sqrt(np.mean(d**2)))),
        "bias": rounded(float(d.mean())),
        "p95": rounded(float(np.percentile(np.abs(d), 95))),
        "coverage": rounded(shared_cells / known),
    }


def compared_plans(recorded: Iterable[StepPlan], made: Iterable[StepPlan]) -> list[tuple[StepPlan, StepPlan]]:
    """Return pairs of the last recorded and the last new plan of each step.

    New plans after the last recorded one are ignored.
    """
    recorded = list(recorded)
    end_ns = max((plan.stamp_ns for plan in recorded), default=0)
    last, now = _last_of_each_step(recorded), _last_of_each_step(plan for plan in made if plan.stamp_ns <= end_ns)
    return [(plan, now[key]) for key, plan in last.items() if key in now]


def plan_difference(pairs: Sequence[tuple[StepPlan, StepPlan]]) -> dict[str, float | None]:
    """Return touchdown and body goal differences [m] of plan pairs.

    Touchdowns differ in all three axes.
    """
    if not pairs:
        return {"touchdown_p50": None, "touchdown_p95": None, "touchdown_max": None, "body_max": None}
    feet = [np.linalg.norm((a.touchdown - b.touchdown)[a.swing], axis=1) for a, b in pairs]
    body = [float(np.linalg.norm(a.body_goal[:3, 3] - b.body_goal[:3, 3])) for a, b in pairs]
    d = np.concatenate(feet)
    return {
        "touchdown_p50": rounded(float(np.median(d))),
        "touchdown_p95": rounded(float(np.percentile(d, 95))),
        "touchdown_max": rounded(float(d.max())),
        "body_max": rounded(max(body)),
    }


def in_words(table: Mapping[str, Any]) -> str:
    """Format a replay's result as text."""
    lines = [f"{table['source']}:"]
    lines += [f"  {key:<20} {count:>6} messages" for key, count in table["topics"].items()]
    maps, plans, error, off = table["maps"], table["plans"], table["map_error_m"], table["plan_error_m"]
    lines.append(f"  the mapper made {maps['made']} maps from the recording; {maps['compared']} compared with recorded ones")
    if error["rmse"] is not None:
        lines.append(
            f"  they differ by {error['rmse'] * 1e3:.2f} mm rms, {error['coverage']:.1%} of the cells are known to both"
        )
    if plans["made"]:
        lines.append(
            f"  the planner made {plans['made']} plans; the last plans of {plans['compared']} steps compared with recorded ones"
        )
    if off["touchdown_max"] is not None:
        off_mm = [1e3 * off[name] for name in ("touchdown_p50", "touchdown_p95", "touchdown_max")]
        lines.append(
            f"  touchdowns are {off_mm[0]:.1f} mm off in the median, {off_mm[1]:.1f} mm at 95 %, {off_mm[2]:.1f} mm at most"
        )
    said = sorted(table["said"].items(), key=lambda item: -item[1])[:8]
    lines += [f"  {count:>6} times the planner was {words}" for words, count in said]
    lines += [f"  {name}: {t['p50']:.2f} ms, 99 % below {t['p99']:.2f} ms" for name, t in table["stages_ms"].items()]
    return "\n".join(lines)


def _fed(only: Sequence[str]) -> frozenset[str]:
    """Return the requested keys.

    Raises:
        ReplayError: A key is not in the topic table.
    """
    try:
        return frozenset(topics.topic_named(key).key for key in only)
    except ValueError as error:
        raise ReplayError(f"--only: {error}") from None


def _last_of_each_step(plans: Iterable[StepPlan]) -> dict[tuple[int, int, bytes], StepPlan]:
    return {_step_of(plan): plan for plan in plans}


def _step_of(plan: StepPlan) -> tuple[int, int, bytes]:
    """Identify the step that a plan belongs to: {odom} epoch, number and swing legs."""
    return plan.epoch, plan.step, plan.swing.tobytes()


def _same_cells(a: TerrainMap, b: TerrainMap) -> bool:
    same = a.elevation.shape == b.elevation.shape and math.isclose(a.resolution, b.resolution)
    return same and np.allclose(a.origin, b.origin)


def _cells(terrain: TerrainMap) -> str:
    nx, ny = terrain.elevation.shape
    x, y = terrain.origin
    return f"{nx}x{ny} cells of {terrain.resolution:g} m from ({x:.3f}, {y:.3f}) m on"


def _map_settings(recording: Recording) -> MapperSettings:
    """Return the mapper's settings of a recorded run; old recordings lack them."""
    about, usual = recording.about, MapperSettings()
    try:
        return params.settings(
            MapperSettings,
            _params(recording).mapper,
            cells=int(about.get("map.cells", usual.cells)),
            cells_y=int(about.get("map.cells_y", usual.cells_y)),
            resolution=float(about.get("map.resolution", usual.resolution)),
        )
    except ValueError as error:
        raise ReplayError(f"{recording.path}: its map options are invalid: {error}") from None


def _planner_settings(recording: Recording) -> PlannerSettings:
    """Return the planner's settings of a recorded run; old recordings lack them."""
    usual = PlannerSettings()
    blind = recording.about.get("walk.blind", str(usual.blind)) == "True"
    try:
        footholds = recording.about.get("walk.footholds", usual.footholds)
        return params.settings(PlannerSettings, _params(recording).planner, blind=blind, footholds=footholds)
    except ValueError as error:
        raise ReplayError(f"{recording.path}: its walk options are invalid: {error}") from None


def _params(recording: Recording) -> params.SystemParams:
    """Return the parameters of a recorded run; those of old recordings are the defaults."""
    try:
        return params.read(parse_json(recording.path, recording.about.get("params", "{}").encode()), "its parameters")
    except ValueError as error:
        raise ReplayError(f"{recording.path}: {error}") from None
