"""The recorder as a process: its recordings after a kill, and errors."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy.launch.launcher import host_router
from sextant.shared.recording.reader import Recording
from sextant.shared.recording.recovery import recover
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import RecordCommand, RecorderState, VelocityCommand
from sextant.shared.wire.transport import Endpoints, ZenohLink

pytestmark = pytest.mark.live
ROOT = Path(__file__).parents[2]
SENT_HZ = 50.0


@pytest.fixture
def endpoints() -> Iterator[Endpoints]:
    with host_router() as met:
        yield met


@pytest.fixture
def velocity_publisher(endpoints: Endpoints) -> Iterator[threading.Event]:
    """Publish velocities continuously until the event is set."""
    stop = threading.Event()

    def speak() -> None:
        with ZenohLink(endpoints) as link:
            while not stop.wait(1.0 / SENT_HZ):
                message = VelocityCommand(time.monotonic_ns(), np.zeros(2), 0.0, 0.1, 0.04)
                link.send(topics.VELOCITY, codec.encode(message))

    thread = threading.Thread(target=speak)
    thread.start()
    yield stop
    stop.set()
    thread.join()


def sextant(*words: str) -> list[str]:
    return [sys.executable, "-m", "sextant.deploy.cli", *words]


def met(endpoints: Endpoints) -> tuple[str, ...]:
    return ("--connect", endpoints.connect[0], "--namespace", endpoints.namespace)


def wait_until(what: str, holds: object, within_s: float = 30.0) -> None:
    end = time.monotonic() + within_s
    assert callable(holds)
    while not holds():
        assert time.monotonic() < end, what
        threading.Event().wait(0.05)


def test_killed_recorder_loses_less_than_one_second(
    endpoints: Endpoints, velocity_publisher: threading.Event, tmp_path: Path
) -> None:
    out = tmp_path / "recorded"
    recorder = subprocess.Popen(sextant("record", "--out", str(out), "--reserve", "0", *met(endpoints)), cwd=ROOT)
    file = out / "recording-0001.mcap"
    wait_until("frames on the disk", lambda: file.is_file() and file.stat().st_size > 8000)
    killed_ns = time.monotonic_ns()
    recorder.kill()
    recorder.wait()
    recording = Recording(file)
    stamps = [at_ns for _, _, at_ns in recording.frames()]
    assert not recording.complete
    assert killed_ns - max(stamps) < 1_000_000_000, "no more than a second is lost"
    assert np.diff(stamps).max() < 1_000_000_000, "and nothing in between"
    assert recover(file, tmp_path / "whole.mcap").messages == len(stamps)


def test_recording_of_given_duration_is_complete(
    endpoints: Endpoints, velocity_publisher: threading.Event, tmp_path: Path
) -> None:
    words = sextant("record", "--out", str(tmp_path), "--reserve", "0", "--seconds", "1", *met(endpoints))
    told = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "recorded" in told
    recording = Recording(tmp_path)
    assert 0.5 * SENT_HZ < sum(recording.counts().values()) < 2.0 * SENT_HZ
    assert recording.complete


def test_insufficient_disk_space_is_refused_with_advice(endpoints: Endpoints, tmp_path: Path) -> None:
    words = sextant("record", "--out", str(tmp_path), "--reserve", "999999999", *met(endpoints))
    told = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert told.returncode == 2
    assert "free some space, or record to another disk" in told.stderr


def test_recorder_process_follows_commands_and_publishes_state(
    endpoints: Endpoints, velocity_publisher: threading.Event, tmp_path: Path
) -> None:
    words = ("-m", "sextant.services.console.recorder", *met(endpoints), "--set", f"folder={tmp_path}", "--set", "reserve_mb=0")
    states: list[RecorderState] = []
    with ZenohLink(endpoints) as link:
        link.subscribe(topics.RECORDER_STATE, lambda _, frame: states.append(codec.decode(frame, RecorderState)[0]))
        recorder = subprocess.Popen([sys.executable, *words], cwd=ROOT)
        try:
            wait_until("its first word", lambda: states)
            assert not states[-1].recording
            for record, sequence in ((True, 1), (False, 2)):
                link.send(topics.RECORD, codec.encode(RecordCommand(time.monotonic_ns(), record, sequence)))
                wait_until("the order followed", lambda n=sequence: states[-1].sequence == n)
                wait_until("something written", lambda: states[-1].size > 5000)
            assert not states[-1].recording
            assert states[-1].dropped == 0
        finally:
            recorder.terminate()
            recorder.wait()
    assert sum(Recording(Path(states[-1].file).parent).counts().values()) > 5
