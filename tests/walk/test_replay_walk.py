"""A recorded walk, replayed through mapper and planner with the same results.

Other tests replay it with faulty inputs.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.evaluation.observers.progress import Silent
from sextant.evaluation.observers.run_observers import about
from sextant.evaluation.replay.walk import Change, replay_recording
from sextant.evaluation.video.timeline import Timeline
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.geometry import transform
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.recording.reader import Recording
from sextant.shared.recording.writer import Recorder
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import topics
from sextant.shared.wire.messages import BodyPose, Message, Scan, TerrainMap

S = 1_000_000_000
STEPS = load_scenario("steps")
WALKED_S, BROKEN_S = 15.0, (7.0, 10.0)  # [s] simulated; the robot stands up for two and a half


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record the beginning of a walk over the steps course."""
    path, profile = tmp_path_factory.mktemp("recorded") / "recording.mcap", load_profile(STEPS.robot)
    with Recorder(path, about(STEPS, 1000, "lockstep"), Foxglove(profile)) as recorder:
        LockstepRun(STEPS, 1000, profile, recorder.write, every_frame=False).run(round(WALKED_S * 1e9))
    return path


@pytest.fixture(scope="module")
def whole(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Replay the unchanged walk; return its table and folder."""
    out = tmp_path_factory.mktemp("whole")
    return replay_recording(recorded, out, Silent()), out


def replayed(recorded: Path, out: Path, change: Change, only: tuple[str, ...] = ()) -> dict[str, Any]:
    return replay_recording(recorded, out, Silent(), only, change)


def broken(message: Message) -> bool:
    return BROKEN_S[0] * S <= message.stamp_ns < BROKEN_S[1] * S


def test_replayed_walk_gives_same_maps_and_plans(whole: tuple[dict[str, Any], Path]) -> None:
    table, out = whole
    assert table["complete"]
    assert 10 <= table["maps"]["compared"] == table["maps"]["recorded"] < table["maps"]["made"]
    assert table["map_error_m"] == {"rmse": 0.0, "bias": 0.0, "p95": 0.0, "coverage": 1.0}
    assert table["plans"]["recorded"] > 200
    assert table["plans"]["made"] - table["plans"]["recorded"] in range(3), (
        "a state and a scan may have been under way at the end"
    )
    assert table["plans"]["compared"] >= 8
    assert set(table["plan_error_m"].values()) == {0.0}
    assert set(table["stages_ms"]) >= {"mapper.fuse", "mapper.score", "planner.plan step"}
    assert table["evidence"] == {"supported": True, "problem": ""}
    assert (out / "layers.png").stat().st_size > 1000


def test_lost_scans_give_same_map_later(recorded: Path, tmp_path: Path) -> None:
    count = 0

    def every_third_is_lost(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
        nonlocal count
        count += isinstance(message, Scan)
        return () if isinstance(message, Scan) and count % 3 == 0 else ((message, at_ns),)

    table = replayed(recorded, tmp_path, every_third_is_lost)
    assert table["maps"]["made"] < 0.7 * topics.TERRAIN.rate_hz * WALKED_S
    assert table["map_error_m"]["rmse"] < 0.003
    assert table["map_error_m"]["coverage"] > 0.98
    assert table["plans"]["compared"] >= 8
    assert table["plan_error_m"]["touchdown_p50"] < 0.01


def test_missing_scans_stop_planner_with_reason(recorded: Path, whole: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    def no_scans(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
        return () if isinstance(message, Scan) and broken(message) else ((message, at_ns),)

    table = replayed(recorded, tmp_path, no_scans)
    assert "expected; a lockstep run replays exactly" in table["evidence"]["problem"] or "off" in table["evidence"]["problem"]
    assert table["said"]["waiting: no fresh terrain map"] > 15, "ten words a second, from 0.8 s after the last map on"
    assert table["plans"]["compared"] < whole[0]["plans"]["compared"]
    assert table["plans"]["compared"] >= 4, "before and after it plans"


def test_late_scans_are_mapped_at_pose_of_their_stamp(recorded: Path, tmp_path: Path) -> None:
    def late(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
        is_late = isinstance(message, Scan) and broken(message)
        return ((message, at_ns + (2 * S if is_late else 0)),)

    table = replayed(recorded, tmp_path, late)
    assert table["map_error_m"]["rmse"] < 0.002, "a scan says itself from where it was taken"
    assert table["map_error_m"]["coverage"] > 0.98


def test_pose_jump_stops_planner(recorded: Path, tmp_path: Path) -> None:
    """Shift a confident pose by half a metre: the map no longer fits these feet."""
    aside = transform(np.eye(3), np.array([0.0, 0.5, 0.15]))

    def jumped(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
        if isinstance(message, BodyPose) and broken(message):
            moved = {"T_world_body": aside @ message.T_world_body, "T_world_odom": aside @ message.T_world_odom}
            message = replace(message, **moved)
        return ((message, at_ns),)

    table = replayed(recorded, tmp_path, jumped)
    stopped = [words for words in table["said"] if words.startswith(("blocked", "waiting"))]
    assert any("leg" in words or "map" in words for words in stopped), table["said"]
    assert table["plans"]["compared"] >= 4, "before and after it plans"


def test_scans_with_earlier_stamps_are_refused(recorded: Path, tmp_path: Path) -> None:
    def older(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
        if isinstance(message, Scan) and broken(message):
            message = replace(message, stamp_ns=message.stamp_ns - S)
        return ((message, at_ns),)

    table = replayed(recorded, tmp_path, older)
    assert table["map_error_m"]["rmse"] < 0.003
    reason = "waiting: no fresh terrain map; the mapper refuses scans: the scan is not newer than the previous one"
    assert table["said"][reason] > 0


def test_only_requested_topics_are_replayed(recorded: Path, tmp_path: Path) -> None:
    def as_it_was(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
        return ((message, at_ns),)

    scans = replayed(recorded, tmp_path, as_it_was, ("perception/scan", "perception/pose"))
    assert scans["fed"] == ["perception/pose", "perception/scan"]
    assert scans["maps"]["made"] > 50
    assert scans["plans"]["made"] == 0

    def maps_twice(_: AnyTopic, message: Message, at_ns: int) -> Iterable[tuple[Message, int]]:
        again = isinstance(message, TerrainMap)  # one map a second is recorded, and the planner uses none older than 0.8 s
        return ((message, at_ns), (message, at_ns + S // 2))[: 1 + again]

    only = ("mapper/terrain", "perception/pose", "actuator/state", "operator/velocity")
    maps = replayed(recorded, tmp_path, maps_twice, only)
    assert maps["maps"]["made"] == 0, "the recorded ones are fed"
    assert maps["plans"]["made"] > 0


def test_video_timeline_has_feet_on_ground_and_at_planned_footholds(recorded: Path) -> None:
    story, radius = Timeline.read(Recording(recorded)), load_profile(STEPS.robot).foot.radius
    terrain = build_terrain(STEPS, np.random.default_rng([1000, 0]))
    assert story.true
    assert story.feet_off(terrain.height_at, radius) < 0.005
    misses = []
    for t_ns in range(story.began_ns, story.ended_ns - 2 * S, S // 5):
        swings = [p for p in story.moment(t_ns).footholds if story.moment(t_ns).mode == "walk"]
        feet = np.array([m.feet for m in story.truth.between(t_ns, t_ns + 2 * S)]).reshape(-1, 3)
        misses += [float(np.linalg.norm(feet - p, axis=1).min()) for p in swings]
    assert len(misses) > 50
    assert np.median(misses) < 0.01
    assert np.percentile(misses, 90) < 0.02
