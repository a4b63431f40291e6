import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sextant.services.console.recorder.config import Settings
from sextant.services.console.recorder.service import RecorderService
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.runtime.zenoh_runner import Listening
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import RecordCommand, RecorderState, Tick
from tests.support.recorded import frames, some_messages

PROFILE = load_profile("phantomx_mk2")
S = 1_000_000_000


class Link:
    """A link that delivers a test's frames to its subscribers."""

    def __init__(self) -> None:
        self.listeners: dict[str, Callable[[AnyTopic, bytes], None]] = {}

    def subscribe(self, topic: AnyTopic, receive: Callable[[AnyTopic, bytes], None]) -> Callable[[], None]:
        self.listeners[topic.key] = receive
        return lambda: self.listeners.pop(topic.key) and None

    def say(self, n: int = 5) -> None:
        for topic, frame, _ in frames(some_messages(n=n)):
            self.listeners[topic.key](topic, frame)


class Desk:
    """A recorder with a link, and a client that sends orders to it."""

    def __init__(self, folder: Path, **settings: Any):
        wall = lambda: datetime(2026, 3, 1, 12, 30, tzinfo=UTC)  # noqa: E731
        self.recorder = RecorderService(PROFILE, Settings(folder=str(folder), **settings), wall)
        self.link: Any = Link()
        assert isinstance(self.recorder, Listening)
        self.recorder.meet(self.link)
        self.inbox = Inbox(self.recorder.subscribes, Stages())
        self.now_ns = 0

    def beat(self, record: bool | None = None, sequence: int = 0) -> RecorderState:
        self.now_ns += S // 2
        if record is not None:
            order = RecordCommand(self.now_ns, record, sequence)
            self.inbox.receive(topics.RECORD, codec.encode(order), self.now_ns)
        (state,) = self.recorder.step(Tick(self.now_ns), self.inbox)
        assert isinstance(state, RecorderState)
        return state


def test_recording_lasts_from_one_command_to_the_next(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "recordings")
    resting = desk.beat()
    assert (resting.recording, resting.file, resting.sequence) == (False, "", -1)
    assert resting.disk_free == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.1)
    assert not desk.link.listeners, "while it rests nothing is sent to it"
    with desk.recorder:
        began = desk.beat(True, 7)
        assert (began.recording, began.sequence, began.reason) == (True, 7, "")
        assert began.file == str(tmp_path / "recordings" / "20260301-123000" / "recording-0001.mcap")
        desk.link.say()
        desk.beat()
        ended = desk.beat(False, 8)
        assert (ended.recording, ended.sequence) == (False, 8)
        assert ended.duration == 1.0
        assert not desk.link.listeners
        assert desk.beat().duration == 1.0
    recording = Recording(Path(ended.file).parent)
    assert sum(recording.counts().values()) == 10
    assert recording.complete
    assert recording.about.items() >= {"robot": "phantomx_mk2", "run": "live", "began": "2026-03-01T12:30:00+00:00"}.items()


def test_repeated_command_is_followed_once(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    with desk.recorder:
        for _ in range(3):
            state = desk.beat(True, 1)
            assert state.recording
        assert state.duration == 1.0, "it did not restart"
        desk.beat(False, 2)
        assert not desk.beat(True, 2).recording
        assert not desk.beat(True, 1).recording, "one that was overtaken"
        assert "recorded" in desk.recorder.status()


def test_file_is_complete_after_process_ends(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    with desk.recorder:
        file = desk.beat(True, 1).file
        desk.link.say()
    assert Recording(Path(file)).counts() == {"operator/mode": 5, "operator/velocity": 5}
    recording = Recording(Path(file))
    assert len(list(recording.frames())) == 10
    assert recording.complete


def test_insufficient_disk_space_is_reported_at_once(tmp_path: Path) -> None:
    desk = Desk(tmp_path, reserve_mb=10**9)
    state = desk.beat(True, 1)
    assert not state.recording
    assert state.sequence == 1
    assert "must stay free" in state.reason
    assert state.reason == desk.recorder.status() == desk.beat().reason, "until the next order"


def test_folder_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    assert "cannot record to" in Desk(tmp_path / "file").beat(True, 1).reason


def test_full_disk_ends_recording_with_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    desk = Desk(tmp_path)
    with desk.recorder:
        assert desk.beat(True, 1).recording
        monkeypatch.setattr("sextant.shared.recording.writer.Recorder.write", full)
        desk.link.say()
        state = desk.beat()
        while state.recording:  # its thread has not noticed yet
            state = desk.beat()
    assert "No space left on device" in state.reason
    assert not desk.link.listeners, "nothing more is sent to it"
    assert desk.recorder.status() == state.reason


@pytest.mark.parametrize("wrong", [{"folder": " "}, {"file_s": 0.0}, {"reserve_mb": -1}])
def test_invalid_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected, found"):
        Settings(**wrong)


def test_command_with_far_future_sequence_does_not_block_later_ones(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "recordings")
    with desk.recorder:
        assert not desk.beat(True, (1 << 63) - 1).recording
        assert desk.beat(True, desk.now_ns).recording
        assert not desk.beat(False, desk.now_ns).recording


@pytest.mark.parametrize(("reserve_mb", "records"), [(99, True), (101, False)])
def test_reserve_is_in_decimal_megabytes(
    reserve_mb: int, records: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=100_000_000))
    desk = Desk(tmp_path, reserve_mb=reserve_mb)
    with desk.recorder:
        state = desk.beat(True, 1)
        assert state.recording is records
        assert records or "only 100 MB are free" in state.reason
