"""Robot monitor: rare messages, read four times a second, and their log entries."""

import numpy as np

from sextant.services.console.web.robot_monitor import RobotMonitor
from sextant.shared.recording.event_log import EventLog
from sextant.shared.runtime.service import Inbox, Stages
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import CameraState, Message, PassagePlan

MS = 1_000_000
NO_WAY = PassagePlan(
    1, 1, "no way", "nothing carries", np.zeros(2), 0.0, 1.0, 0.5, 5, 5, 1.0, np.zeros(0, dtype=np.uint8), np.zeros((0, 3)),
    np.zeros((0, 3)), np.zeros((0, 2, 3), dtype=np.float32), np.zeros((0, 3)),
)  # fmt: skip


def inbox_with(*messages: Message) -> Inbox:
    inbox = Inbox([topics.CAMERA_STATE, topics.CALIBRATION, topics.PASSAGE_PLAN, *topics.HEALTH_OF.values()], Stages())
    for message in messages:
        inbox.receive(topics.OF_TYPE[type(message)], codec.encode(message), 0)
    return inbox


def test_camera_fault_is_logged_and_kept() -> None:
    log = EventLog()
    monitor = RobotMonitor(log)
    monitor.update(1000 * MS, inbox_with(CameraState(1, "a camera", False, "unplugged")))
    assert monitor.camera is not None
    assert not monitor.camera.ok
    assert any("unplugged" in entry.words for entry in log.entries)


def test_passage_plans_are_returned_once_and_logged() -> None:
    log = EventLog()
    monitor, inbox = RobotMonitor(log), inbox_with(NO_WAY)
    (plan,) = monitor.update(1000 * MS, inbox)
    assert plan.reason == "nothing carries"
    assert any("nothing carries" in entry.words for entry in log.entries)
    assert monitor.update(2000 * MS, inbox) == []


def test_messages_wait_for_the_next_period() -> None:
    monitor, inbox = RobotMonitor(EventLog()), inbox_with()
    monitor.update(1000 * MS, inbox)
    inbox.receive(topics.PASSAGE_PLAN, codec.encode(NO_WAY), 0)
    assert monitor.update(1100 * MS, inbox) == []
    assert len(monitor.update(1240 * MS, inbox)) == 1
