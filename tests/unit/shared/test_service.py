"""What arrives for a service, and the two ways of running one."""

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import codec, topics
from shared.messages import Health, Message, ModeCommand, PlannerStatus, Tick, VelocityCommand
from shared.service import QUEUE_LENGTH, AnyTopic, Beats, Every, Inbox, Lockstep, Outage, Service, Stages, Worker, run_live

MS = 1_000_000
VELOCITY, MODE, STATUS, HEALTH = topics.VELOCITY, topics.MODE, topics.PLANNER_STATUS, topics.HEALTH
PATIENCE_S = 10.0  # an event that has not come by then never will


def velocity(stamp_ns: int = 0, forward: float = 0.1) -> VelocityCommand:
    return VelocityCommand(stamp_ns, np.array([forward, 0.0]), 0.0, 0.1, 0.04)


def order(sequence: int) -> ModeCommand:
    return ModeCommand(0, "walk", sequence)


def status(step: int) -> PlannerStatus:
    return PlannerStatus(0, "stepping", "", step, 0, -1)


def inbox(*reads: AnyTopic) -> Inbox:
    return Inbox(reads or (VELOCITY, MODE), Stages())


# ---------------------------------------------------------------------------------------------------- inbox


def test_latest_keeps_the_newest_only() -> None:
    box = inbox()
    for n in range(5):
        box.receive(VELOCITY, codec.encode(velocity(n)), n)
    assert [v.stamp_ns for v in box.drain(VELOCITY)] == [4]
    assert box.drain(VELOCITY) == []
    found = box.latest(VELOCITY)
    assert found is not None
    assert found.stamp_ns == 4
    assert box.dropped == 0  # passing over old states is no loss


def test_every_keeps_all_in_order() -> None:
    box = inbox()
    for n in range(5):
        box.receive(MODE, codec.encode(order(n)), n)
    assert box.waiting(MODE)
    assert [c.sequence for c in box.drain(MODE)] == [0, 1, 2, 3, 4]
    assert not box.waiting(MODE)


def test_a_flooded_queue_drops_the_oldest_and_counts() -> None:
    box = inbox()
    for n in range(QUEUE_LENGTH + 7):
        box.receive(MODE, codec.encode(order(n)), n)
    assert [c.sequence for c in box.drain(MODE)] == list(range(7, QUEUE_LENGTH + 7))
    assert box.dropped == 7


def test_what_is_fetched_counts_as_having_come_at_the_look() -> None:
    box, kept = inbox(), _Kept(codec.encode(order(1)), codec.encode(order(2)))
    velocities = _Kept(codec.encode(velocity(), codec.Timing(1, 2)))
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


def test_nothing_has_come_yet() -> None:
    box = inbox()
    assert box.latest(VELOCITY) is None
    assert box.fresh(VELOCITY) is None
    assert box.drain(MODE) == []


def test_a_message_is_fresh_for_three_periods_of_its_topic() -> None:
    box = inbox()
    box.receive(VELOCITY, codec.encode(velocity()), 1000)
    for age_ns, fresh in ((0, True), (VELOCITY.fresh_for_ns, True), (VELOCITY.fresh_for_ns + 1, False)):
        box.now_ns = 1000 + age_ns
        assert (box.fresh(VELOCITY) is not None) == fresh
        assert box.latest(VELOCITY) is not None  # however old
    assert VELOCITY.fresh_for_ns == 150 * MS


def test_a_refused_frame_is_counted_and_the_last_good_message_stays() -> None:
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
    assert box.fresh(VELOCITY) is None  # garbage does not keep the old message fresh


def test_good_frames_around_a_bad_one_are_kept() -> None:
    box = inbox()
    for frame in (codec.encode(order(1)), b"garbage", codec.encode(order(2))):
        box.receive(MODE, frame, 0)
    assert [c.sequence for c in box.drain(MODE)] == [1, 2]
    assert box.refused == 1


def test_a_frame_over_the_size_of_its_topic_is_refused() -> None:
    box = inbox()
    box.receive(MODE, codec.encode(order(1)) + bytes(MODE.max_bytes), 0)
    assert box.latest(MODE) is None
    assert "at most 2048 bytes" in box.last_refusal


def test_latency_is_taken_from_the_frame() -> None:
    stages = Stages()
    box = Inbox((MODE,), stages)
    box.receive(MODE, codec.encode(order(1), codec.Timing(5 * MS, 6 * MS)), 12 * MS)
    box.drain(MODE)
    assert stages.percentiles() == {"latency operator/mode": (7.0, 7.0)}


def test_an_inbox_may_be_filled_from_many_threads() -> None:
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
    for i in range(4):  # each sender's in its order
        own = [n for n in found if n // 100 == i]
        assert own == sorted(own)


def test_stages_give_percentiles() -> None:
    stages = Stages()
    for ms in range(1, 102):
        stages.add("plan", float(ms))
    with stages("look"):
        pass
    found = stages.percentiles()
    assert found["plan"] == pytest.approx((51.0, 100.0))
    assert 0.0 <= found["look"][0] < 1000.0


def test_stages_forget_the_oldest() -> None:
    stages = Stages()
    for ms in range(10_000):
        stages.add("plan", float(ms))
    p50, p99 = stages.percentiles()["plan"]
    assert p50 > 10_000 - 4_096
    assert p99 > p50
    assert stages.runs("plan") == 10_000
    assert stages.runs("unheard of") == 0


def test_a_failing_stage_is_timed_and_fails() -> None:
    stages = Stages()
    with pytest.raises(KeyError), stages("bad"):
        raise KeyError
    assert "bad" in stages.percentiles()


# --------------------------------------------------------------------------------------------------- worker


@dataclass
class Scripted:
    """A service that does what a test says."""

    name: str
    paced_by: Any
    reads: tuple[AnyTopic, ...] = ()
    writes: tuple[AnyTopic, ...] = ()
    act: Callable[[Any, Inbox], Iterable[Message]] = lambda _message, _inbox: ()
    stages: Stages = field(default_factory=Stages)
    seen: list[Any] = field(default_factory=list)

    def step(self, message: Any, inbox: Inbox) -> Iterable[Message]:
        self.seen.append((inbox.now_ns, message))
        return self.act(message, inbox)

    def doing(self) -> str:
        return "what it is told"


def worker_of(service: Service, sent: list[tuple[AnyTopic, bytes]], now: Callable[[], int] = lambda: 5) -> Worker:
    return Worker(service, lambda topic, frame, _: sent.append((topic, frame)), now)


def test_a_message_that_its_writes_do_not_name_is_refused() -> None:
    service = Scripted("planner", Every.hz(10), act=lambda _m, _i: [order(1)])
    with pytest.raises(ValueError, match="planner made a ModeCommand, which its `writes` does not name"):
        worker_of(service, []).tick()


def test_a_message_without_a_topic_is_refused_too() -> None:
    service = Scripted("planner", Every.hz(10), writes=(MODE,), act=lambda _m, _i: [Tick(1)])
    with pytest.raises(ValueError, match="planner made a Tick, which its `writes` does not name"):
        worker_of(service, []).tick()


def test_a_step_sends_what_it_makes_in_order_and_reports_health_once_a_second() -> None:
    now = [0]
    sent: list[tuple[AnyTopic, bytes]] = []
    service = Scripted("planner", Every.hz(10), writes=(MODE, STATUS), act=lambda _m, _i: [order(1), status(2)])
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
    assert healths[0].doing == "what it is told"
    assert "planner" in healths[1].stages


def test_health_tells_of_frames_that_went_astray() -> None:
    sent: list[tuple[AnyTopic, bytes]] = []

    def send(topic: AnyTopic, frame: bytes, _: int) -> None:
        sent.append((topic, frame))

    astray = (3, "imu: a frame that was sent to a/mode has come")
    worker = Worker(Scripted("planner", MODE), send, lambda: 0, astray=lambda: astray)
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
    assert words[3] == astray[1], "the newest is told"


def test_health_tells_of_refusals() -> None:
    now = [0]
    sent: list[tuple[AnyTopic, bytes]] = []
    worker = worker_of(Scripted("planner", MODE, reads=(VELOCITY,)), sent, lambda: now[0])
    worker.inbox.receive(MODE, b"garbage", 0)
    worker.arrived()
    now[0] = 2_000 * MS
    worker.report_health(now[0])
    (health,) = (codec.decode(frame, Health)[0] for _, frame in sent)
    assert health.refused == 1
    assert health.last_refusal.startswith("operator/mode: ")
    assert health.steps == 0


def test_health_tells_that_nothing_comes_to_step_for() -> None:
    now, sent = [0], []  # type: ignore[var-annotated]
    worker = worker_of(Scripted("planner", VELOCITY), sent, lambda: now[0])
    doing = []
    for second in range(6):
        now[0] = second * 1_000 * MS
        if second in (0, 5):
            worker.inbox.receive(VELOCITY, codec.encode(velocity(now[0])), now[0])
            worker.arrived()
        worker.report_health(now[0])
        doing.append([codec.decode(frame, Health)[0].doing for topic, frame in sent if topic is HEALTH][-1])
    assert doing[0] == doing[1] == "what it is told"
    assert doing[4] == "nothing has come on operator/velocity for 4 s; the last: what it is told"
    assert doing[5] == "what it is told"


def test_a_service_steps_once_for_each_pacing_message() -> None:
    service = Scripted("actuator", MODE, reads=(VELOCITY, MODE))
    worker = worker_of(service, [])
    assert worker.reads == (MODE, VELOCITY)  # the pacing topic, once
    for n in range(3):
        worker.inbox.receive(MODE, codec.encode(order(n)), 0)
    worker.arrived()
    assert [message.sequence for _, message in service.seen] == [0, 1, 2]


# -------------------------------------------------------------------------------------------------- lockstep


@dataclass
class Recorder:
    """Every frame as it was sent, the timing inside health reports apart."""

    frames: list[tuple[str, bytes, int]] = field(default_factory=list)

    def __call__(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        if topic is not HEALTH:
            self.frames.append((topic.key, frame, at_ns))


def operator(period_ns: int = 10 * MS) -> Scripted:
    sequence = iter(range(10**6))

    def act(tick: Tick, _: Inbox) -> Iterator[Message]:
        yield velocity(tick.stamp_ns)
        yield ModeCommand(tick.stamp_ns, "walk", next(sequence))

    return Scripted("console", Every(period_ns), writes=(VELOCITY, MODE), act=act)


def planner() -> Scripted:
    return Scripted(
        "planner", VELOCITY, reads=(MODE,), writes=(STATUS,), act=lambda v, box: [status(len(box.drain(MODE)) + v.stamp_ns)]
    )


def system(**options: Any) -> tuple[Lockstep, Recorder]:
    tap = Recorder()
    return Lockstep({"console": operator, "planner": planner}, tap, **options), tap


def seen(run: Lockstep, name: str = "planner") -> list[tuple[int, Any]]:
    service = run.service(name)
    assert isinstance(service, Scripted)
    return service.seen


def test_a_message_takes_its_latency() -> None:
    run, _ = system()
    run.run(100 * MS)
    latency_ns = round(1e9 * VELOCITY.latency_s)
    assert [(at, v.stamp_ns) for at, v in seen(run)] == [(10 * MS * n + latency_ns, 10 * MS * n) for n in range(10)]


def test_what_several_read_is_decoded_once_and_none_of_them_can_change_it() -> None:
    run = Lockstep({"console": operator, "planner": planner, "mapper": lambda: Scripted("mapper", VELOCITY)})
    run.run(50 * MS)
    pairs = zip(seen(run), seen(run, "mapper"), strict=True)
    for (_, at_planner), (_, at_mapper) in pairs:
        assert at_planner is at_mapper
        with pytest.raises(ValueError, match="read-only"):
            at_planner.velocity[0] = 1.0


def test_a_latency_may_be_another() -> None:
    run, _ = system(latency_s={VELOCITY.key: 0.025})
    run.run(50 * MS)
    assert [at for at, _ in seen(run)] == [25 * MS, 35 * MS, 45 * MS]


def test_time_passes_to_the_instant_and_not_beyond() -> None:
    run, _ = system()
    run.run(20 * MS)
    assert run.now_ns == 20 * MS
    assert [at for at, _ in seen(run, "console")] == [0, 10 * MS, 20 * MS]
    run.run(25 * MS)
    run.run(25 * MS)
    assert run.now_ns == 25 * MS
    assert len(seen(run, "console")) == 3
    run.run(30 * MS)
    assert len(seen(run, "console")) == 4


def test_at_one_instant_deliveries_come_before_beats_and_beats_in_order() -> None:
    happened: list[str] = []

    def note(name: str) -> Callable[[Any, Inbox], Iterable[Message]]:
        def act(_message: Any, box: Inbox) -> Iterable[Message]:
            happened.append(f"{name} {box.now_ns // MS} " + ("fresh" if box.waiting(MODE) else "-"))
            return [order(1)] if name == "b" else []

        return act

    makers = {name: (lambda name=name: Scripted(name, Every(10 * MS), (MODE,), (MODE,), note(name))) for name in ("b", "a")}
    Lockstep(makers, latency_s={MODE.key: 0.010}).run(10 * MS)
    assert happened == ["b 0 -", "a 0 -", "b 10 fresh", "a 10 fresh"]


def test_a_message_that_takes_no_time_still_comes_in_its_turn() -> None:
    run, _ = system(latency_s={VELOCITY.key: 0.0, MODE.key: 0.0})
    run.run(30 * MS)
    assert [at for at, _ in seen(run)] == [0, 10 * MS, 20 * MS, 30 * MS]


def test_two_runs_are_the_same_to_the_byte() -> None:
    outages = (Outage("planner", 200 * MS, 400 * MS, kill=True), Outage("console", 500 * MS, 600 * MS, kill=False))
    runs = [system(outages=outages) for _ in range(2)]
    for run, _ in runs:
        run.run(1000 * MS)
    assert runs[0][1].frames == runs[1][1].frames
    assert len(runs[0][1].frames) > 200


def test_pausing_changes_nothing() -> None:
    (whole, tap), (parts, parts_tap) = system(), system()
    whole.run(300 * MS)
    for n in range(0, 301, 7):
        parts.run(n * MS)
    parts.run(300 * MS)
    assert tap.frames == parts_tap.frames


def test_a_killed_service_comes_back_as_a_new_object_that_knows_nothing() -> None:
    run, _ = system(outages=[Outage("planner", 100 * MS, 200 * MS, kill=True)])
    run.run(99 * MS)
    first = run.service("planner")
    run.run(199 * MS)
    assert run.service("planner") is first
    assert seen(run)[-1][0] < 100 * MS  # it does nothing while it is away
    run.run(300 * MS)
    assert run.service("planner") is not first
    assert seen(run)[0][0] == 200 * MS + round(1e9 * VELOCITY.latency_s)
    missed = seen(run)[0][1].stamp_ns
    assert missed == 200 * MS  # what came in the meantime is lost
    assert len(seen(run, "console")) == 31  # the others go on


def test_a_hung_service_goes_on_where_it_was() -> None:
    run, tap = system(outages=[Outage("planner", 100 * MS, 200 * MS, kill=False)])
    run.run(150 * MS)
    first = run.service("planner")
    assert seen(run)[-1][0] < 100 * MS
    run.run(300 * MS)
    assert run.service("planner") is first
    times = [at for at, _ in seen(run)]
    assert not [at for at in times if 100 * MS <= at < 200 * MS]
    assert [at for at in times if at >= 200 * MS]
    counts = [codec.decode(f, PlannerStatus)[0].step for key, f, _ in tap.frames if key == STATUS.key]
    stamps = [v.stamp_ns for _, v in seen(run)]
    waited = [count - stamp for count, stamp in zip(counts, stamps, strict=True)]
    assert max(waited) >= 10  # orders that came while it hung were waiting for it, as they would in its queue


def test_a_service_that_hangs_misses_its_beats() -> None:
    run, _ = system(outages=[Outage("console", 20 * MS, 50 * MS, kill=False)])
    run.run(60 * MS)
    assert [at // MS for at, _ in seen(run, "console")] == [0, 10, 50, 60]


@pytest.mark.parametrize("kill", [True, False])
def test_an_outage_of_nobody_is_refused(kill: bool) -> None:
    with pytest.raises(ValueError, match="console, planner expected, found pilot"):
        system(outages=[Outage("pilot", 0, MS, kill)])


def test_a_latency_of_no_topic_is_refused() -> None:
    with pytest.raises(ValueError, match="keys of the topic table expected, found operator/speed"):
        system(latency_s={"operator/speed": 0.1})


def test_only_what_somebody_reads_is_wanted() -> None:
    wanted: dict[str, bool] = {}

    def act(_tick: Any, box: Inbox) -> Iterable[Message]:
        wanted.update({t.key: box.wanted(t) for t in (VELOCITY, MODE, STATUS)})
        return ()

    Lockstep({"asks": lambda: Scripted("asks", Every(MS), act=act), "planner": planner}).run(0)
    assert wanted == {VELOCITY.key: True, MODE.key: True, STATUS.key: False}


def test_the_tap_sees_what_nobody_reads() -> None:
    run, tap = system()
    run.run(0)
    run.run(10 * MS)
    assert STATUS.key in {key for key, _, _ in tap.frames}


def test_in_lockstep_the_measured_latency_is_the_configured_one() -> None:
    run, _ = system()
    run.run(200 * MS)
    expected_ms = VELOCITY.latency_s * 1e3
    assert run.service("planner").stages.percentiles()[f"latency {VELOCITY.key}"] == pytest.approx((expected_ms,) * 2)


# ----------------------------------------------------------------------------------------------------- live


class _Kept:
    """Frames that wait to be fetched."""

    def __init__(self, *frames: bytes) -> None:
        self.frames = list(frames)

    def take(self) -> list[bytes]:
        taken, self.frames = self.frames, []
        return taken


class Wire:
    """A link in memory: what is sent is kept, what a test publishes arrives."""

    def __init__(self) -> None:
        self.receivers: dict[str, list[Any]] = {}
        self.kept: dict[str, _Kept] = {}
        self.sent: list[tuple[AnyTopic, bytes]] = []
        self.subscribed = threading.Event()
        self.expect: Callable[[AnyTopic], bool] = lambda _: False
        self.came = threading.Event()

    def send(self, topic: AnyTopic, frame: bytes) -> None:
        self.sent.append((topic, frame))
        if self.expect(topic):
            self.came.set()

    def subscribe(self, topic: AnyTopic, receive: Callable[[AnyTopic, bytes], None]) -> Callable[[], None]:
        self.receivers.setdefault(topic.key, []).append(receive)
        self.subscribed.set()
        return lambda: self.receivers[topic.key].remove(receive)

    def collect(self, topic: AnyTopic) -> Callable[[], list[bytes]]:
        return self.kept.setdefault(topic.key, _Kept()).take

    def wanted(self, topic: AnyTopic) -> bool:
        return topic is not STATUS

    astray, last_astray = 0, ""

    def publish(self, topic: AnyTopic, frame: bytes) -> None:
        for receive in self.receivers[topic.key]:
            receive(topic, frame)


@pytest.fixture
def wire() -> Wire:
    return Wire()


def running(service: Service, wire: Wire) -> tuple[threading.Thread, threading.Event]:
    stop = threading.Event()
    thread = threading.Thread(target=run_live, args=(service, wire, stop), daemon=True)
    thread.start()
    return thread, stop


def test_live_a_service_answers_its_pacing_messages_in_order(wire: Wire) -> None:
    service = Scripted("planner", MODE, writes=(STATUS,), act=lambda c, _: [status(c.sequence)])
    wire.expect = lambda topic: topic is STATUS and sum(t is STATUS for t, _ in wire.sent) == 20
    thread, stop = running(service, wire)
    assert wire.subscribed.wait(PATIENCE_S)
    for n in range(20):
        wire.publish(MODE, codec.encode(order(n)))
    assert wire.came.wait(PATIENCE_S)
    stop.set()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    steps = [codec.decode(f, PlannerStatus)[0].step for t, f in wire.sent if t is STATUS]
    assert steps == list(range(20))
    timings = [codec.decode(f, PlannerStatus)[1] for t, f in wire.sent if t is STATUS]
    assert all(0 < t.began_ns <= t.sent_ns for t in timings)


def test_live_a_service_that_gets_only_garbage_says_so(wire: Wire) -> None:
    def tells(topic: AnyTopic) -> bool:
        return topic is HEALTH and codec.decode(wire.sent[-1][1], Health)[0].refused > 0

    wire.expect = tells
    service = Scripted("planner", MODE)
    thread, stop = running(service, wire)
    assert wire.subscribed.wait(PATIENCE_S)
    flood = threading.Event()

    def publish() -> None:
        while not flood.wait(0.01):
            wire.publish(MODE, b"garbage")

    publisher = threading.Thread(target=publish, daemon=True)
    publisher.start()
    told = wire.came.wait(5.0)
    flood.set()
    stop.set()
    thread.join(PATIENCE_S)
    publisher.join(PATIENCE_S)
    assert told
    assert not service.seen


def test_live_a_beat_comes_at_its_rate_and_stops(wire: Wire) -> None:
    service = Scripted("operator", Every.hz(200), writes=(VELOCITY,), act=lambda t, _: [velocity(t.stamp_ns)])
    wire.expect = lambda topic: topic is VELOCITY and sum(t is VELOCITY for t, _ in wire.sent) == 11
    thread, stop = running(service, wire)
    assert wire.came.wait(PATIENCE_S)
    stop.set()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    stamps = [tick.stamp_ns for _, tick in service.seen]
    assert stamps == sorted(stamps)
    assert service.stages.runs("cycle") == len(stamps), "how regular it is goes out with its health"
    assert stamps[10] - stamps[0] > 30 * MS  # ten periods of 5 ms; a busy machine is late, never early by much


def test_live_a_service_may_wait_its_own_way_and_fetch_what_has_come(wire: Wire) -> None:
    waits: list[float] = []
    wire.kept[MODE.key] = _Kept(codec.encode(order(1)))
    wire.astray, wire.last_astray = 3, "sent to another"
    stop = threading.Event()

    def wait(length_s: float) -> None:
        waits.append(length_s)  # and comes back before its time
        if len(waits) == 3:
            stop.set()

    service = Scripted(
        "operator", Every(10_000 * MS, wait, fetches=True), reads=(MODE,), act=lambda _, box: seen.extend(box.drain(MODE)) or ()
    )
    seen: list[Any] = []
    run_live(service, wire, stop)
    assert [c.sequence for c in seen] == [1]
    assert wire.receivers == {}, "no thread hands anything over"
    (health,) = (codec.decode(frame, Health)[0] for topic, frame in wire.sent if topic is HEALTH)
    assert (health.refused, health.last_refusal) == (3, "sent to another"), "what the link has dropped is told of"
    assert all(9.0 < length_s <= 10.0 for length_s in waits)


@pytest.mark.parametrize("pace", [Every.hz(100), MODE])
def test_live_the_thread_that_steps_says_that_it_lives_also_where_nothing_has_it_step(
    wire: Wire, pace: AnyTopic | Every
) -> None:
    told: list[int] = []
    threads: set[threading.Thread] = set()
    stop = threading.Event()

    def alive(now_ns: int) -> None:
        told.append(now_ns)
        threads.add(threading.current_thread())
        if len(told) == 3:
            stop.set()

    run_live(Scripted("planner", pace), wire, stop, alive)
    assert threads == {threading.current_thread()}, "so that a step that hangs is noticed"
    assert len(told) == 3
    assert told == sorted(told)


def beaten(stalls: list[int], period: int) -> list[int]:
    """When beats come [ns], with work of some length before each, on a clock that nothing else moves."""
    now, came = 0, [0]

    def wait(seconds: float) -> None:
        nonlocal now
        now += round(seconds * 1e9)

    beats = Beats(Every(period), lambda: now)
    for stall in stalls:
        now += stall
        interval = beats.next(wait)
        assert interval == now - came[-1]
        came.append(now)
    return came


@given(work=st.lists(st.integers(0, 20 * MS), max_size=50))
def test_beats_come_when_they_are_due_whatever_the_work_takes(work: list[int]) -> None:
    assert beaten(work, 20 * MS) == [k * 20 * MS for k in range(len(work) + 1)]


@given(stalls=st.lists(st.integers(0, 200 * MS), max_size=50))
def test_beats_are_not_raced_after_a_stall(stalls: list[int]) -> None:
    came, period = beaten(stalls, 20 * MS), 20 * MS
    for i, at in enumerate(came):
        for k in range(i, len(came)):
            assert came[k] - at >= (k - i - 2) * period
            assert came[k] >= k * period


def test_live_an_error_in_a_step_ends_the_run(wire: Wire) -> None:
    def fail(_tick: Any, _box: Inbox) -> Iterable[Message]:
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        run_live(Scripted("planner", Every.hz(1000), act=fail), wire, threading.Event())
