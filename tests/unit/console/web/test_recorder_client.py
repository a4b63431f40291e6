from dataclasses import replace
from typing import Any

from sextant.services.console.web.recorder_client import RecorderClient
from sextant.shared.recording.event_log import EventLog
from sextant.shared.wire.messages import RecordCommand, RecorderState

S = 1_000_000_000
RESTING = RecorderState(0, False, -1, "", 0.0, 0, 5 * 10**9, 0, "")


class Recorder:
    """A recorder that follows its orders, as the clerk sees it."""

    def __init__(self) -> None:
        self.event_log = EventLog()
        self.clerk = RecorderClient(self.event_log)
        self.state: RecorderState | None = RESTING
        self.now_ns = 0
        self.beat()

    def beat(self, **changes: Any) -> list[RecordCommand]:
        self.now_ns += S // 2
        if self.state is not None:
            self.state = replace(self.state, **changes)
        return list(self.clerk.beat(self.now_ns, self.state))

    def want(self, record: bool) -> RecordCommand:
        assert self.clerk.want(record, self.now_ns) == ""
        (order,) = self.beat()
        return order

    def follow(self, order: RecordCommand) -> None:
        assert self.beat(recording=order.record, sequence=order.sequence, file="/r/0001.mcap") == []

    @property
    def words(self) -> list[str]:
        return [entry.words for entry in self.event_log.entries]


def test_command_is_repeated_until_followed() -> None:
    recorder = Recorder()
    first = recorder.want(True)
    assert recorder.beat() == [], "a second goes by first"
    assert recorder.beat() == [first]
    recorder.follow(first)
    assert [recorder.beat() for _ in range(5)] == [[]] * 5
    end = recorder.want(False)
    assert end.sequence > first.sequence
    recorder.follow(end)
    assert recorder.words == ["recording to /r/0001.mcap", "recorded /r/0001.mcap"]


def test_silent_recorder_is_reported_and_commanded_again() -> None:
    recorder = Recorder()
    order = recorder.want(True)
    recorder.follow(order)
    was, recorder.state = recorder.state, None
    assert recorder.beat() == []
    assert recorder.words[-1] == "no message from the recorder; messages are not recorded now"
    assert recorder.clerk.view() is None
    assert was is not None
    recorder.state = RESTING  # another process
    assert recorder.beat() == [order]
    recorder.follow(order)
    assert recorder.words[-1] == "recording to /r/0001.mcap"


def test_restarted_recorder_is_reported() -> None:
    recorder = Recorder()
    order = recorder.want(True)
    recorder.follow(order)
    recorder.state = RESTING
    assert recorder.beat() == [order]
    assert recorder.words[-1] == "the recorder has restarted; messages in the meantime were not recorded"


def test_failed_recorder_waits_for_new_command_of_operator() -> None:
    recorder = Recorder()
    order = recorder.want(True)
    recorder.follow(order)
    assert recorder.beat(recording=False, reason="the disk is full") == []
    assert recorder.words[-1] == "the disk is full"
    assert recorder.event_log.entries[-1].bad
    assert all(recorder.beat() == [] for _ in range(5))
    assert recorder.want(True).sequence > order.sequence


def test_lost_messages_are_reported_once_per_loss() -> None:
    recorder = Recorder()
    recorder.follow(recorder.want(True))
    recorder.beat(dropped=3)
    recorder.beat()
    assert [w for w in recorder.words if "not recorded" in w] == ["3 messages were not recorded: the disk is too slow"]


def test_missing_recorder_is_reported() -> None:
    clerk = RecorderClient(EventLog())
    assert "no recorder is running" in clerk.want(True, 0)
    assert clerk.view() is None
    assert list(clerk.beat(S, None)) == []


def test_recording_of_other_client_is_shown_and_not_changed() -> None:
    recorder = Recorder()
    assert recorder.beat(recording=True, sequence=7, file="/r/1.mcap", duration=61.2, size=2 * 10**6, disk_free=-1) == []
    view = recorder.clerk.view()
    assert view is not None
    assert view == {
        "recording": True,
        "file": "/r/1.mcap",
        "duration_s": 61,
        "size_mb": 2.0,
        "disk_free_gb": None,
        "dropped": 0,
        "reason": "",
    }
