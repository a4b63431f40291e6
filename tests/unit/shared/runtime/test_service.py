"""Messages that arrive for a service, and its steps."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from sextant.shared.runtime.lateness import BEAT
from sextant.shared.runtime.service import QUEUE_LENGTH, AnyTopic, Every, Inbox, Service, ServiceRunner, Stages
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health, ModeCommand, Tick
from tests.support.scripted_service import Kept, Scripted, order, status, velocity

MS = 1_000_000
VELOCITY, MODE, STATUS, HEALTH = topics.VELOCITY, topics.MODE, topics.PLANNER_STATUS, topics.HEALTH
PATIENCE_S = 10.0  # longest wait for an event


def inbox(*subscribes: AnyTopic) -> Inbox:
    return Inbox(subscribes or (VELOCITY, MODE), Stages())


# ---------------------------------------------------------------------------------------------------- inbox


def test_latest_keeps_newest_only() -> None:
    box = inbox()
    for n in range(5):
        box.receive(VELOCITY, codec.encode(velocity(n)), n)
    assert [v.stamp_ns for v in box.drain(VELOCITY)] == [4]
    assert box.drain(VELOCITY) == []
    found = box.latest(VELOCITY)
    assert found is not None
    assert found.stamp_ns == 4
    assert box.dropped == 0  # overwriting old states is no loss


def test_queue_keeps_all_in_order() -> None:
    box = inbox()
    for n in range(5):
        box.receive(MODE, codec.encode(order(n)), n)
    assert box.waiting(MODE)
    assert [c.sequence for c in box.drain(MODE)] == [0, 1, 2, 3, 4]
    assert not box.waiting(MODE)


def test_full_queue_drops_oldest_and_counts() -> None:
    box = inbox()
    for n in range(QUEUE_LENGTH + 7):
        box.receive(MODE, codec.encode(order(n)), n)
    assert [c.sequence for c in box.drain(MODE)] == list(range(7, QUEUE_LENGTH + 7))
    assert box.dropped == 7


def test_fetched_message_arrives_at_time_of_fetch() -> None:
    box, kept = inbox(), Kept(codec.encode(order(1)), codec.encode(order(2)))
    velocities = Kept(codec.encode(velocity(), codec.Timing(1, 2)))
    box.fetch(MODE, kept.take)
    box.fetch(VELOCITY, velocities.take)
    box.now_ns = 5000 * MS
    assert box.waiting(MODE)
    assert [c.sequence for c in box.drain(MODE)] == [1, 2]
    assert box.drain(MODE) == []
    assert box.fresh(VELOCITY) is not None
    assert box._stages.percentiles() == {}, "how long it was on its way is not known"
    box.now_ns += VELOCITY.fresh_for_ns + 1
    assert box.fresh(VELOCITY) is None


def test_empty_inbox_has_no_messages() -> None:
    box = inbox()
    assert box.latest(VELOCITY) is None
    assert box.fresh(VELOCITY) is None
    assert box.drain(MODE) == []


def test_message_is_fresh_for_three_periods() -> None:
    box = inbox()
    box.receive(VELOCITY, codec.encode(velocity()), 1000)
    for age_ns, fresh in ((0, True), (VELOCITY.fresh_for_ns, True), (VELOCITY.fresh_for_ns + 1, False)):
        box.now_ns = 1000 + age_ns
        assert (box.fresh(VELOCITY) is not None) == fresh
        assert box.latest(VELOCITY) is not None  # at any age
    assert VELOCITY.fresh_for_ns == 150 * MS


def test_refused_frame_is_counted_and_last_message_kept() -> None:
    box = inbox()
    box.receive(VELOCITY, codec.encode(velocity(7)), 1)
    assert box.latest(VELOCITY) is not None
    for n, garbage in enumerate((b"", b"garbage", codec.encode(order(1)), codec.encode(velocity())[:-9]), start=1):
        box.receive(VELOCITY, garbage, 2)
        found = box.latest(VELOCITY)
        assert found is not None
        assert found.stamp_ns == 7
        assert box.refused == n
        assert box.last_refusal.startswith("operator/velocity: ")
    box.now_ns = 1 + VELOCITY.fresh_for_ns + 1
    assert box.fresh(VELOCITY) is None  # an invalid message does not keep the old one fresh


def test_valid_frames_around_invalid_one_are_kept() -> None:
    box = inbox()
    for frame in (codec.encode(order(1)), b"garbage", codec.encode(order(2))):
        box.receive(MODE, frame, 0)
    assert [c.sequence for c in box.drain(MODE)] == [1, 2]
    assert box.refused == 1


def test_oversized_frame_is_refused() -> None:
    box = inbox()
    box.receive(MODE, codec.encode(order(1)) + bytes(MODE.max_bytes), 0)
    assert box.latest(MODE) is None
    assert "at most 2048 bytes" in box.last_refusal


def test_latency_is_read_from_frame() -> None:
    stages = Stages()
    box = Inbox((MODE,), stages)
    box.receive(MODE, codec.encode(order(1), codec.Timing(5 * MS, 6 * MS)), 12 * MS)
    box.drain(MODE)
    assert stages.percentiles() == {"latency operator/mode": (7.0, 7.0)}


def test_inbox_is_filled_from_many_threads() -> None:
    box = inbox()
    ready = threading.Barrier(4)

    def fill(first: int) -> None:
        ready.wait(PATIENCE_S)
        for n in range(first, first + 100):
            box.receive(MODE, codec.encode(order(n)), 0)

    threads = [threading.Thread(target=fill, args=(100 * i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    found = [c.sequence for _ in range(50) for c in box.drain(MODE)]
    for thread in threads:
        thread.join(PATIENCE_S)
    found += [c.sequence for c in box.drain(MODE)]
    assert sorted(found) == list(range(400))
    for i in range(4):  # in the order of each sender
        own = [n for n in found if n // 100 == i]
        assert own == sorted(own)


def test_stage_times_give_percentiles() -> None:
    stages = Stages()
    for ms in range(1, 102):
        stages.add("plan", float(ms))
    with stages("look"):
        pass
    found = stages.percentiles()
    assert found["plan"] == pytest.approx((51.0, 100.0))
    assert 0.0 <= found["look"][0] < 1000.0


def test_stage_times_drop_oldest() -> None:
    stages = Stages()
    for ms in range(10_000):
        stages.add("plan", float(ms))
    p50, p99 = stages.percentiles()["plan"]
    assert p50 > 10_000 - 4_096
    assert p99 > p50
    assert stages.runs("plan") == 10_000
    assert stages.runs("unheard of") == 0


def test_failing_stage_is_timed_and_raises() -> None:
    stages = Stages()
    with pytest.raises(KeyError), stages("bad"):
        raise KeyError
    assert "bad" in stages.percentiles()


# --------------------------------------------------------------------------------------------------- worker


def worker_of(service: Service, sent: list[tuple[AnyTopic, bytes]], now: Callable[[], int] = lambda: 5) -> ServiceRunner:
    return ServiceRunner(service, lambda topic, frame, _: sent.append((topic, frame)), now)


def test_undeclared_message_is_refused() -> None:
    service = Scripted("planner", Every.hz(10), act=lambda _m, _i: [order(1)])
    with pytest.raises(ValueError, match="planner returned a ModeCommand, which is not in its `publishes`"):
        worker_of(service, []).tick()


def test_message_without_topic_is_refused() -> None:
    service = Scripted("planner", Every.hz(10), publishes=(MODE,), act=lambda _m, _i: [Tick(1)])
    with pytest.raises(ValueError, match="planner returned a Tick, which is not in its `publishes`"):
        worker_of(service, []).tick()


def test_step_sends_messages_in_order_and_health_every_second() -> None:
    now = [0]
    sent: list[tuple[AnyTopic, bytes]] = []
    service = Scripted("planner", Every.hz(10), publishes=(MODE, STATUS), act=lambda _m, _i: [order(1), status(2)])
    worker = worker_of(service, sent, lambda: now[0])
    for _ in range(25):
        worker.tick()
        now[0] += 100 * MS
    keys = [topic.key for topic, _ in sent if topic is not HEALTH]
    assert keys == [MODE.key, STATUS.key] * 25
    healths = [codec.decode(frame, Health)[0] for topic, frame in sent if topic is HEALTH]
    assert [h.stamp_ns for h in healths] == [0, 1000 * MS, 2000 * MS]
    assert [h.steps for h in healths] == [1, 11, 21]
    assert healths[0].service == "planner"
    assert healths[0].status == "what it is told"
    assert "planner" in healths[1].stages


def test_health_counts_misrouted_frames() -> None:
    sent: list[tuple[AnyTopic, bytes]] = []

    def send(topic: AnyTopic, frame: bytes, _: int) -> None:
        sent.append((topic, frame))

    astray = (3, "imu: a frame that was sent to a/mode has come")
    worker = ServiceRunner(Scripted("planner", MODE), send, lambda: 0, astray=lambda: astray)
    worker.report_health(0)
    worker.inbox.receive(MODE, b"garbage", 0)
    worker.arrived()
    worker.report_health(2_000 * MS)
    worker.report_health(4_000 * MS)
    astray = (4, "imu: a frame that was sent to a/goal has come")
    worker.report_health(6_000 * MS)
    healths = [codec.decode(frame, Health)[0] for _, frame in sent]
    assert [health.refused for health in healths] == [3, 4, 4, 5]
    words = [health.last_refusal for health in healths]
    assert words[0] == "imu: a frame that was sent to a/mode has come"
    assert words[1].startswith("operator/mode: ")
    assert words[2] == words[1]
    assert words[3] == astray[1], "the newest is reported"


def test_health_counts_refusals() -> None:
    now = [0]
    sent: list[tuple[AnyTopic, bytes]] = []
    worker = worker_of(Scripted("planner", MODE, subscribes=(VELOCITY,)), sent, lambda: now[0])
    worker.inbox.receive(MODE, b"garbage", 0)
    worker.arrived()
    now[0] = 2_000 * MS
    worker.report_health(now[0])
    (health,) = (codec.decode(frame, Health)[0] for _, frame in sent)
    assert health.refused == 1
    assert health.last_refusal.startswith("operator/mode: ")
    assert health.steps == 0


def test_health_reports_missing_pacing_input() -> None:
    now, sent = [0], []  # type: ignore[var-annotated]
    worker = worker_of(Scripted("planner", VELOCITY), sent, lambda: now[0])
    doing = []
    for second in range(6):
        now[0] = second * 1_000 * MS
        if second in (0, 5):
            worker.inbox.receive(VELOCITY, codec.encode(velocity(now[0])), now[0])
            worker.arrived()
        worker.report_health(now[0])
        doing.append([codec.decode(frame, Health)[0].status for topic, frame in sent if topic is HEALTH][-1])
    assert doing[0] == doing[1] == "what it is told"
    assert doing[4] == "no message on operator/velocity for 4 s; last status: what it is told"
    assert doing[5] == "what it is told"


def test_service_steps_once_per_pacing_message() -> None:
    service = Scripted("actuator", MODE, subscribes=(VELOCITY, MODE))
    worker = worker_of(service, [])
    assert worker.subscribes == (MODE, VELOCITY)  # the pacing topic, once
    for n in range(3):
        worker.inbox.receive(MODE, codec.encode(order(n)), 0)
    worker.arrived()
    assert [message.sequence for _, message in service.seen] == [0, 1, 2]


# ---------------------------------------------------------------------------------------------------- lateness


@dataclass
class Needy(Scripted):
    """A service that cannot use old inputs."""

    max_age_s: dict[str, float] = field(default_factory=dict)


class Desk:
    """A worker on a test clock, its messages, and its holds of simulated time."""

    def __init__(self, service: Service) -> None:
        self.now_ns = 0
        self.health: list[Health] = []
        self.limits: list[int | None] = []
        self.worker = ServiceRunner(service, self.send, lambda: self.now_ns, hold=self.limits.append)

    def send(self, topic: AnyTopic, frame: bytes, _at_ns: int) -> None:
        if topic.type is Health:
            self.health.append(codec.decode(frame, Health)[0])


def test_health_contains_input_ages() -> None:
    service = Needy("planner", Every.hz(10), (VELOCITY, MODE), act=lambda _, box: (box.fresh(VELOCITY), ())[1])
    service.max_age_s = {VELOCITY.key: 0.2}
    desk = Desk(service)
    desk.worker.tick()
    desk.worker.inbox.receive(VELOCITY, codec.encode(velocity(100 * MS)), 150 * MS)
    for now_ns in range(200 * MS, 1100 * MS, 100 * MS):
        desk.now_ns = now_ns
        desk.worker.tick()
    assert desk.health[0].inputs == ()
    (told,) = desk.health[1:]
    assert told.inputs == (VELOCITY.key,)
    columns = (told.input_age_s, told.input_arrived_s, told.input_limit_s, told.input_late_share)
    assert [float(column[0]) for column in columns] == pytest.approx([0.9, 0.05, 0.2, 7 / 9])
    assert told.missed_ticks == 1, "the one at 100 ms"


def test_simulated_time_advances_until_input_or_tick_is_due() -> None:
    service = Needy("actuator", Every.hz(50), (VELOCITY,), act=lambda _, box: (box.latest(VELOCITY), ())[1])
    service.max_age_s = {BEAT: 0.2, VELOCITY.key: 0.03}
    desk = Desk(service)
    desk.now_ns = 1000 * MS
    desk.worker.tick()
    assert desk.limits == [1020 * MS, 1030 * MS], "within a beat, and until the next one is late"
    desk.worker.inbox.receive(VELOCITY, codec.encode(velocity(1010 * MS)), 1015 * MS)
    desk.now_ns = 1020 * MS
    desk.worker.tick()
    assert desk.limits[2:] == [1040 * MS, 1028 * MS], "three fifths of the age that it may have"


def test_service_without_limits_does_not_hold_simulated_time() -> None:
    desk = Desk(Scripted("operator", Every.hz(50), (VELOCITY,), act=lambda _, box: (box.latest(VELOCITY), ())[1]))
    desk.worker.tick()
    assert desk.limits == []


def test_pacing_topic_is_an_input() -> None:
    service = Needy("planner", MODE, act=lambda *_: ())
    service.max_age_s = {MODE.key: 0.5}
    desk = Desk(service)
    desk.now_ns = 100 * MS
    desk.worker.inbox.receive(MODE, codec.encode(order(1)), 90 * MS)
    desk.worker.arrived()
    assert desk.limits == [300 * MS, 300 * MS]
    assert float(desk.health[0].input_age_s[0]) == pytest.approx(0.1)


def test_message_from_future_is_refused_if_robot_time_is_known() -> None:
    for robot_time, expected in ((True, 1), (False, 2)):
        inbox = Inbox((MODE,), Stages(), robot_time=robot_time)
        for stamp_ns in (9_000_000_000, (1 << 63) - 1):
            inbox.receive(MODE, codec.encode(ModeCommand(stamp_ns, "stop", 1)), 8_000_000_000)
        assert len(inbox.drain(MODE)) == expected
        assert inbox.refused == 2 - expected
        assert robot_time == ("operator/mode: stamped 92233720" in inbox.last_refusal)
