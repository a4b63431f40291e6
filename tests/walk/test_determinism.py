"""One seed makes one walk, to the byte; what only says how long things took is left aside."""

import json
from pathlib import Path
from typing import Any

import pytest

from deploy.runs.lockstep_run import run_lockstep
from services.console.recording.reader import Recording
from shared import topics
from shared.scenario import Rubble
from tests.support.walks import flat

COURSE = flat(0.25)
BLOCKS = Rubble(x=(0.6, 1.4), y=(-0.4, 0.4), count=6, size=(0.10, 0.20), top=(0.01, 0.03))
WALKING = (
    topics.ODOMETRY,
    topics.ACTUATOR_STATE,
    topics.CAMERA_STATE,
    topics.BODY_POSE,
    topics.SCAN,
    topics.SCAN_RECEIPT,
    topics.TERRAIN,
    topics.STEP_PLAN,
    topics.PLANNER_STATUS,
    topics.VELOCITY,
    topics.MODE,
    topics.TRUTH,
)
TIMING = ("real_time_factor", "stages_ms")


def left_behind(folder: Path, seed: int) -> tuple[str, list[tuple[str, bytes, int]], dict[str, Any]]:
    """A run's report without timing as text, its recorded frames but health, and the report."""
    scenario = flat(0.25, terrain=(*COURSE.terrain, BLOCKS))
    assert run_lockstep(scenario, seed, folder).success
    table = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    for name in TIMING:
        del table[name]
    frames = [frame for frame in Recording(folder / "recording.mcap").frames() if frame[0] != topics.HEALTH.key]
    return json.dumps(table), frames, table


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, list[tuple[str, bytes, int]], dict[str, Any]]:
    return left_behind(tmp_path_factory.mktemp("first"), 1000)


def test_the_same_seed_gives_the_same_report_and_the_same_frames(first: Any, tmp_path: Path) -> None:
    report, frames, _ = left_behind(tmp_path, 1000)
    assert report == first[0]
    assert frames == first[1]
    assert {key for key, *_ in frames} == {topic.key for topic in WALKING}


def test_another_seed_gives_another_walk(first: Any, tmp_path: Path) -> None:
    _, frames, table = left_behind(tmp_path, 1001)
    assert frames != first[1]
    assert {**table, "seed": 1000} != first[2]
