import errno
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sextant.shared.files.whole_files import WriteError
from sextant.shared.recording.live import LiveRecorder
from sextant.shared.recording.reader import is_whole, read
from sextant.shared.recording.rotation import NoRoomError, Rotation
from sextant.shared.recording.writer import LEFT_OUT, Recorder, Unwritable
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Scan
from tests.support.recorded import frames, some_messages

ABOUT = {"scenario": "steps"}


def recorder(path: Path) -> Recorder:
    return Recorder(path, ABOUT)


def feed(live: LiveRecorder, n: int = 40) -> None:
    for topic, frame, at_ns in frames(some_messages(n=n)):
        live.take(topic, frame, at_ns)


def test_frames_within_queue_limit_are_recorded(tmp_path: Path) -> None:
    with LiveRecorder(recorder(tmp_path / "r")) as live:
        feed(live)
    assert live.finished
    assert (live.taken, live.dropped, live.problem) == (80, 0, "")
    assert [at for _, _, at in read(tmp_path / "r")] == [at for _, _, at in some_messages()]
    assert live.size == (tmp_path / "r").stat().st_size


def test_scans_that_arrive_unpacked_are_recorded_packed(tmp_path: Path) -> None:
    written: list[bytes] = []

    class Memory(Recorder):
        def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
            written.append(frame)

    none = np.zeros(0, dtype=np.uint8)
    scan = Scan(1, np.zeros(3), np.zeros((0, 3), dtype=np.int16), none, none, np.zeros(3), np.eye(6))
    with LiveRecorder(Memory(tmp_path / "r", ABOUT)) as live:
        live.take(topics.SCAN, codec.encode(scan, packs=False), 7)
    assert written == [codec.encode(scan)] != [codec.encode(scan, packs=False)]


@pytest.mark.parametrize("limit", ["_QUEUE_FRAMES", "_QUEUE_BYTES"])
def test_full_queue_drops_and_counts_without_blocking(tmp_path: Path, limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = frames(some_messages(n=10))
    most = {"_QUEUE_FRAMES": 10, "_QUEUE_BYTES": sum(len(frame) for _, frame, _ in messages[:10])}[limit]
    monkeypatch.setattr(f"sextant.shared.recording.live.{limit}", most)
    live = LiveRecorder(recorder(tmp_path / "r"))
    for topic, frame, at_ns in messages:  # nothing is written yet
        live.take(topic, frame, at_ns)
    assert live.taken + live.dropped == 20
    assert live.taken in (10, 11), "a small one may still have fitted"
    with live:
        pass
    assert len(list(read(tmp_path / "r"))) == live.taken


class FullDisk(Recorder):
    """A recorder whose disk is full."""

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        raise WriteError(self.path, OSError(errno.ENOSPC, "No space left on device"))


def test_full_disk_ends_recording_without_blocking_caller(tmp_path: Path) -> None:
    live = LiveRecorder(FullDisk(tmp_path / "r", ABOUT))
    with live:
        feed(live)
    assert "the disk is full; free some space" in live.problem
    assert str(tmp_path / "r") in live.problem
    feed(live)  # frames neither block the caller nor accumulate
    assert live.taken == 80


def test_full_device_is_reported_on_open(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match=r"/dev/full cannot be written: the disk is full; free some space$"):
        recorder(Path("/dev/full"))


def test_filling_disk_leaves_complete_files(tmp_path: Path) -> None:
    free = [10**9]

    def make(path: Path) -> Recorder:
        return recorder(path)

    rotation = Rotation(tmp_path, make, free_bytes=lambda _: free[0])
    with LiveRecorder(rotation) as live:
        feed(live)
        free[0] = 1_500_000
        feed(live)
    assert "only 1 MB are free" in live.problem
    assert "500 MB must stay free" in live.problem
    assert "record to another disk" in live.problem
    (file,) = tmp_path.iterdir()
    found = list(read(file))
    assert 0 < len(found) < 160
    with pytest.raises(NoRoomError):
        Rotation(tmp_path, make, free_bytes=lambda _: 0)


class Link:
    """A link that delivers frames to its subscribers."""

    def __init__(self) -> None:
        self.listeners: dict[str, Callable[[AnyTopic, bytes], None]] = {}

    def subscribe(self, topic: AnyTopic, receive: Callable[[AnyTopic, bytes], None]) -> Callable[[], None]:
        self.listeners[topic.key] = receive
        return lambda: self.listeners.pop(topic.key) and None

    def send(self, topic: AnyTopic, frame: bytes) -> None:
        raise AssertionError("a recorder says nothing")

    def wanted(self, topic: AnyTopic) -> bool:
        return True


def test_all_topics_except_images_and_floors_are_subscribed_until_close(tmp_path: Path) -> None:
    link: Any = Link()
    with LiveRecorder(recorder(tmp_path / "r")) as live:
        live.listen(link, lambda: 7)
        assert sorted(link.listeners) == sorted(t.key for t in topics.TOPICS if t not in LEFT_OUT)
        topic, message, _ = some_messages()[0]
        link.listeners[topic.key](topic, codec.encode(message))
    assert not link.listeners
    assert [(t, at) for t, _, at in read(tmp_path / "r")] == [(topic, 7)]


def test_frames_are_flushed_during_recording(tmp_path: Path) -> None:
    """Hand frames to the system continuously: a killed process loses at most a second."""
    flushed = threading.Event()

    class Watched(Recorder):
        def sync(self) -> None:
            super().sync()
            if self.size > 1000:
                flushed.set()

    with LiveRecorder(Watched(tmp_path / "r", ABOUT)) as live:
        topic, frame, at_ns = frames(some_messages())[0]
        live.take(topic, frame, at_ns)
        assert flushed.wait(10.0)
        assert len(list(read(tmp_path / "r"))) == 1, "it can be read without having been finished"


def test_recording_that_cannot_start_reports_reason(tmp_path: Path) -> None:
    error = WriteError(tmp_path / "r.mcap", OSError(errno.EROFS, "Read-only file system"))
    live = LiveRecorder(Unwritable(tmp_path / "r.mcap", error))
    with live:
        feed(live)
    assert "r.mcap cannot be written: the disk is read-only" in live.problem


def test_disk_reserve_ends_recording_with_complete_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.shared.recording.writer.RESERVE_BYTES", 1 << 60)
    live = LiveRecorder(recorder(tmp_path / "r.mcap"))
    with live:
        feed(live)
    assert "of the disk are free, which the report needs; free some space" in live.problem
    assert is_whole(tmp_path / "r.mcap")
