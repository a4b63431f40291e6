import errno
import hashlib
import json
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from sextant.evaluation.lockstep.lockstep_run import CRASH, LockstepRun, run_lockstep
from sextant.evaluation.observers.progress import Silent
from sextant.evaluation.observers.run_observers import RunObservers, clear
from sextant.evaluation.trials.trials import run_trials
from sextant.shared.files.whole_files import WriteError
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import HandOver
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.scenario import Fault, Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire import topics

ROOT = Path(__file__).parents[4]
S = 1_000_000_000
FLAT = Scenario("short", (Plane(),), Goal(1.0), time_limit_s=1.5)
PROFILE = load_profile("phantomx_mk2")


@cache
def frames(
    seed: int, until_ns: int, scenario: Scenario = FLAT, every_frame: bool = True, encoded: bool = True
) -> tuple[tuple[str, bytes, int], ...]:
    """Return all frames of a run except health, which contains durations."""
    heard: list[tuple[str, bytes, int]] = []

    def tap(topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        if topic is not topics.HEALTH:
            heard.append((topic.key, frame, at_ns))

    hand_over = None if encoded else HandOver(lambda _topic, _at_ns: True)
    LockstepRun(scenario, seed, PROFILE, tap, every_frame=every_frame, hand_over=hand_over).run(until_ns)
    return tuple(heard)


@pytest.mark.slow
def test_skipping_unused_depth_frames_changes_nothing_else() -> None:
    every, used = frames(3, 3 * S), frames(3, 3 * S, every_frame=False)
    pictures = [{at_ns: frame for key, frame, at_ns in heard if key == topics.DEPTH.key} for heard in (every, used)]
    assert len(pictures[1]) == len(pictures[0]) // 2
    assert pictures[1].items() <= pictures[0].items()
    others = [[frame for frame in heard if frame[0] != topics.DEPTH.key] for heard in (every, used)]
    assert any(key == topics.SCAN.key for key, _, _ in others[0])
    assert others[0] == others[1]


@pytest.mark.slow
def test_handing_messages_over_changes_no_frame() -> None:
    assert frames(3, 3 * S, every_frame=False, encoded=False) == frames(3, 3 * S, every_frame=False)


@pytest.mark.slow
def test_all_depth_frames_are_rendered_with_faults() -> None:
    scenario = replace(FLAT, faults=(Fault(0.5, "mapper", "kill", for_s=0.1),))
    assert frames(3, S, scenario, every_frame=False) == frames(3, S, scenario)


@pytest.mark.slow
def test_all_services_publish_at_nominal_rates() -> None:
    heard = Counter(key for key, _, at_ns in frames(3, 3 * S) if at_ns <= S)
    for topic in (topics.DEPTH, topics.ACTUATOR_STATE, topics.ODOMETRY, topics.TRUTH):
        assert abs(heard[topic.key] - topic.rate_hz) <= 0.1 * topic.rate_hz + 2, topic.key
    assert heard[topics.BODY_POSE.key] > 2  # the rate is 15 Hz, after the robot has stood still for a while
    assert heard[topics.SCAN.key] > 2
    assert heard[topics.TERRAIN.key] >= 1
    assert heard[topics.COLOR.key] == 0, "no service asked for colour"


@pytest.mark.slow
def test_killed_service_is_silent_until_restart() -> None:
    faults = (Fault(1.2, "mapper", "kill", for_s=0.4),)
    scenario = Scenario("short", (Plane(),), Goal(1.0), faults=faults)
    times = [at_ns for key, _, at_ns in frames(3, 5 * S // 2, scenario) if key == topics.TERRAIN.key]
    assert [t for t in times if t < 1.2 * S]
    assert not [t for t in times if 1.2 * S <= t < 1.6 * S]
    assert [t for t in times if t >= 1.6 * S]


@pytest.mark.slow
def test_run_writes_report_summary_and_recording(tmp_path: Path) -> None:
    report = run_lockstep(FLAT, 3, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recording.mcap", "report.json", "summary.png"]
    assert not report.success
    assert "time limit" in report.reason


def crash(*_: object) -> None:
    raise IndexError("index 5 is out of bounds")


@pytest.mark.slow
def test_service_exception_ends_run_with_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.services.planner.service.Planner.step", crash)
    report = run_lockstep(FLAT, 3, tmp_path)
    assert not report.success
    assert re.fullmatch(r"planner failed: IndexError: index 5 is out of bounds \(test_lockstep_run\.py:\d+\)", report.reason)
    assert "Traceback" in (tmp_path / CRASH).read_text(encoding="utf-8")
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["reason"] == report.reason


def test_batch_continues_after_failed_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.services.mapper.service.Mapper.step", crash)
    trials = run_trials(FLAT, (1000, 1001), 1, tmp_path)
    assert (trials.success.n, trials.success.successes) == (2, 0)
    assert list(trials.failures) == ["mapper failed: IndexError: index # is out of bounds (test_lockstep_run.py:#)"]


NO_MACHINE_CLOCK = """
import random, sys, time

def refused(name):
    real = getattr(time, name)
    def read(*args):
        caller = sys._getframe(1).f_globals.get("__name__", "")
        if caller.partition(".")[0] == "sextant":
            raise AssertionError(f"{caller} reads time.{name} in lockstep")
        return real(*args)
    return read

clocks = "time time_ns monotonic monotonic_ns clock_gettime clock_gettime_ns process_time perf_counter"
for name in clocks.split():
    setattr(time, name, refused(name))
chance, stopwatch = random.Random(7), [0]

def torn():
    stopwatch[0] += chance.choice((0, 1_000, 2_000_000_000))
    return stopwatch[0]

time.perf_counter_ns = torn
import errno
import hashlib
from tests.unit.evaluation.lockstep.test_lockstep_run import FLAT, S, frames
print(hashlib.blake2s(repr(frames(3, 3 * S)).encode()).hexdigest())
"""


@pytest.mark.slow
def test_services_do_not_depend_on_machine_clock() -> None:
    done = subprocess.run([sys.executable, "-c", NO_MACHINE_CLOCK], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == hashlib.blake2s(repr(frames(3, 3 * S)).encode()).hexdigest()


class CapturedProgress(Silent):
    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)


@pytest.mark.slow
def test_full_disk_ends_recording_and_walk_is_still_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.shared.recording.writer.RESERVE_BYTES", 1 << 60)
    told = CapturedProgress()

    def tap(topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        raise WriteError(Path("depth.txt"), OSError(errno.ENOSPC, "No space left on device"))

    report = run_lockstep(FLAT, 3, tmp_path, told, [tap])
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["reason"] == report.reason
    assert (tmp_path / "summary.png").exists()
    depth, recording = told.said
    assert depth == "warning: a recording ended early: depth.txt cannot be written: the disk is full; free some space"
    assert f"{tmp_path / 'recording.mcap'} cannot be written: less than" in recording
    assert "MB are intact" in recording
    kept = Recording(tmp_path / "recording.mcap")
    assert list(kept.frames())
    assert kept.complete, "what was written before is a whole file"


def test_clear_removes_files_of_earlier_run(tmp_path: Path) -> None:
    for name in ("report.json", "walk.png", "notes.txt"):
        (tmp_path / name).write_text("of an earlier run")
    clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_unwritable_output_file_is_reported_by_name(tmp_path: Path) -> None:
    (tmp_path / "report.json").mkdir()
    attendance = RunObservers(PROFILE, FLAT, 3)
    (problem,) = attendance.leave_behind(attendance.judge(1.0, "ended"), tmp_path)
    assert problem == f"{tmp_path / 'report.json'} cannot be written: a folder has this name; choose another name"
