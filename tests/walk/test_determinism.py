"""One seed gives one walk, byte by byte; durations are excluded."""

import json
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun, run_lockstep
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import topics
from tests.support.walks import Heard, S

COURSE = """
name = "short"
time_limit_s = 20.0
[goal]
distance = 0.25
[[terrain]]
kind = "plane"
[[terrain]]
kind = "rubble"
x = [0.6, 1.4]
y = [-0.4, 0.4]
count = 6
size = [0.10, 0.20]
top = [0.01, 0.03]
"""
SEED, OTHER_SEED = 1000, 1001
STOOD_UP_S = 3.0
WALKING = (
    topics.ODOMETRY,
    topics.ACTUATOR_STATE,
    topics.CAMERA_STATE,
    topics.HORN_ERRORS,
    topics.BODY_POSE,
    topics.CAMERA_ERRORS,
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


Frames = list[tuple[str, bytes, int]]


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("course") / "short.toml"
    path.write_text(COURSE, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def first(course: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Frames]:
    folder = tmp_path_factory.mktemp("first")
    assert run_lockstep(load_scenario(str(course)), SEED, folder).success
    return without_timing(folder)


def without_timing(folder: Path) -> tuple[str, Frames]:
    """Read a run's folder: report without timing as text, and recorded frames without health."""
    table: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    for name in TIMING:
        del table[name]
    frames = [frame for frame in Recording(folder / "recording.mcap").frames() if frame[0] != topics.HEALTH.key]
    return json.dumps(table), frames


def test_same_seed_gives_same_report_and_frames_despite_pauses(first: tuple[str, Frames], course: Path, tmp_path: Path) -> None:
    """Stop and continue a run at random times.

    A preempted process reads its clocks at any distance from each other; nothing in lockstep may depend on that.
    """
    report, frames = first
    assert {key for key, *_ in frames} == {topic.key for topic in WALKING}
    command = [sys.executable, "-m", "sextant.deploy.cli", "run", str(course), "--lockstep"]
    command += ["--seed", str(SEED), "--out", str(tmp_path)]
    chance, stops = random.Random(1000), 0
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        while not ended(run, chance.uniform(0.2, 0.8)):
            run.send_signal(signal.SIGSTOP)
            stops += not ended(run, chance.choice((0.05, 0.2, 1.0)))
            run.send_signal(signal.SIGCONT)
    assert run.returncode == 0
    assert stops >= 5
    assert without_timing(tmp_path) == (report, frames)


def test_different_seed_gives_different_walk(first: tuple[str, Frames], course: Path) -> None:
    scenario, heard = load_scenario(str(course)), Heard((topics.BODY_POSE,))
    LockstepRun(scenario, OTHER_SEED, load_profile(scenario.robot), heard.tap, every_frame=False).run(round(STOOD_UP_S * S))
    others = [frame for _, frame, _ in heard.frames]
    assert len(others) > 10
    assert others != [frame for key, frame, _ in first[1] if key == topics.BODY_POSE.key][: len(others)]


def ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    """Return whether a process ends within this time."""
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        return False
    return True
