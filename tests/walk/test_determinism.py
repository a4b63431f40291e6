"""One seed gives one walk, byte by byte; durations are excluded."""

import json
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sextant.deploy.runs.lockstep_run import run_lockstep
from sextant.shared.recording.reader import Recording
from sextant.shared.scenario.scenario import Rubble
from sextant.shared.wire import topics
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
ROOT = Path(__file__).parents[2]
TIMING = ("real_time_factor", "stages_ms")


def left_behind(folder: Path, seed: int) -> tuple[str, list[tuple[str, bytes, int]], dict[str, Any]]:
    """Return a run's report without timing as text, its frames, and its report.

    Health frames are excluded.
    """
    scenario = flat(0.25, terrain=(*COURSE.terrain, BLOCKS))
    assert run_lockstep(scenario, seed, folder).success
    return without_timing(folder)


def without_timing(folder: Path) -> tuple[str, list[tuple[str, bytes, int]], dict[str, Any]]:
    """Read a run's folder: report as text, recorded frames, and report."""
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


TEXT = """
name = "short"
time_limit_s = 20.0
[goal]
distance = 0.25
[[terrain]]
kind = "plane"
"""


def test_a_run_that_is_stopped_and_continued_at_random_is_the_same_run(tmp_path: Path) -> None:
    """Stop and continue a run at random times.

    A preempted process reads its clocks at any distance from each other; nothing in lockstep may depend on that.
    """
    course = tmp_path / "course.toml"
    course.write_text(TEXT, encoding="utf-8")
    calm, stopped = tmp_path / "calm", tmp_path / "stopped"
    command = [sys.executable, "-m", "sextant.deploy.cli", "run", str(course), "--lockstep", "--seed", "1000", "--out"]
    subprocess.run([*command, str(calm)], cwd=ROOT, check=True, capture_output=True)
    chance, stops = random.Random(1000), 0
    with subprocess.Popen([*command, str(stopped)], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        while not ended(run, chance.uniform(0.05, 0.5)):
            run.send_signal(signal.SIGSTOP)
            stops += not ended(run, chance.choice((0.05, 0.2, 0.5, 2.0)))
            run.send_signal(signal.SIGCONT)
    assert run.returncode == 0
    assert stops >= 5
    assert without_timing(stopped)[:2] == without_timing(calm)[:2]


def ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    """Return whether a process ends within this time."""
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        return False
    return True
