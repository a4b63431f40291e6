"""A service in a separate process in real time."""

import itertools
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.runtime import clock
from sextant.shared.runtime.lateness import STALL
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Service
from sextant.shared.runtime.zenoh_runner import Beats, run_live
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health, Message, PlannerStatus
from tests.support.scripted_service import Kept, Scripted, order, status, velocity

MS = 1_000_000
VELOCITY, MODE, STATUS, HEALTH = topics.VELOCITY, topics.MODE, topics.PLANNER_STATUS, topics.HEALTH
PATIENCE_S = 10.0  # longest wait for an event


class Wire:
    """A link in memory: it stores sent frames and delivers a test's frames."""

    def __init__(self) -> None:
        self.receivers: dict[str, list[Any]] = {}
        self.kept: dict[str, Kept] = {}
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
        return self.kept.setdefault(topic.key, Kept()).take

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


def test_service_answers_pacing_messages_in_order(wire: Wire) -> None:
    service = Scripted("planner", MODE, publishes=(STATUS,), act=lambda c, _: [status(c.sequence)])
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


def test_service_reports_invalid_pacing_messages(wire: Wire) -> None:
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


def test_ticks_come_at_their_rate_and_stop(wire: Wire) -> None:
    service = Scripted("operator", Every.hz(200), publishes=(VELOCITY,), act=lambda t, _: [velocity(t.stamp_ns)])
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


def test_service_with_own_wait_fetches_collected_messages(wire: Wire) -> None:
    waits: list[float] = []
    wire.kept[MODE.key] = Kept(codec.encode(order(1)))
    wire.astray, wire.last_astray = 3, "sent to another"
    stop = threading.Event()

    def wait(length_s: float) -> None:
        waits.append(length_s)  # returns early
        if len(waits) == 3:
            stop.set()

    service = Scripted(
        "operator",
        Every(10_000 * MS, wait, fetches=True),
        subscribes=(MODE,),
        act=lambda _, box: seen.extend(box.drain(MODE)) or (),
    )
    seen: list[Any] = []
    run_live(service, wire, stop)
    assert [c.sequence for c in seen] == [1]
    assert wire.receivers == {}, "no thread hands anything over"
    (health,) = (codec.decode(frame, Health)[0] for topic, frame in wire.sent if topic is HEALTH)
    assert (health.refused, health.last_refusal) == (3, "sent to another"), "messages dropped by the link are reported"
    assert all(9.0 < length_s <= 10.0 for length_s in waits)


@pytest.mark.parametrize("pace", [Every.hz(100), MODE])
def test_stepping_thread_reports_liveness_without_input(wire: Wire, pace: AnyTopic | Every) -> None:
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
    """Return the times of beats [ns], with work before each.

    Only the work and the waits advance the clock.
    """
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
def test_ticks_are_on_time_for_any_work_within_period(work: list[int]) -> None:
    assert beaten(work, 20 * MS) == [k * 20 * MS for k in range(len(work) + 1)]


@given(stalls=st.lists(st.integers(0, 200 * MS), max_size=50))
def test_ticks_do_not_burst_after_stall(stalls: list[int]) -> None:
    came, period = beaten(stalls, 20 * MS), 20 * MS
    for i, at in enumerate(came):
        for k in range(i, len(came)):
            assert came[k] - at >= (k - i - 2) * period
            assert came[k] >= k * period


def test_error_in_step_ends_live_run(wire: Wire) -> None:
    def fail(_tick: Any, _box: Inbox) -> Iterable[Message]:
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        run_live(Scripted("planner", Every.hz(1000), act=fail), wire, threading.Event())


def test_ticks_wait_for_slower_simulated_time(wire: Wire) -> None:
    """Wait for beats on a clock that advances by 5 ms at each reading.

    The runner reports that it is alive while it waits.
    """
    times, lives = itertools.count(0, 5 * MS), list[int]()
    service = Scripted("operator", Every.hz(20), publishes=(VELOCITY,), act=lambda t, _: [velocity(t.stamp_ns)])
    stop = threading.Event()

    def alive(now_ns: int) -> None:
        lives.append(now_ns)
        if len(service.seen) == 2:
            stop.set()

    with clock.going_by(lambda: next(times)):
        run_live(service, wire, stop, alive)
    first, second = (tick.stamp_ns for _, tick in service.seen[:2])
    assert first >= 50 * MS
    assert second >= 100 * MS
    assert len(lives) > 8, "it is reported while it waits, not only at each cycle"


def test_machine_ticks_continue_while_time_stands(wire: Wire) -> None:
    stop = threading.Event()
    service = Scripted("simulator", Every(4 * MS, by_machine=True), act=lambda *_: stop.set() or () if service.seen[3:] else ())
    with clock.going_by(lambda: 42):
        run_live(service, wire, stop)
    assert [tick.stamp_ns for _, tick in service.seen] == [42] * 4


def test_health_contains_waiting_time_of_service(wire: Wire) -> None:
    stop = threading.Event()
    service = Limited("planner", MODE)
    wire.expect = lambda topic: topic is HEALTH and bool(stalls())

    def stalls() -> list[float]:
        healths = [codec.decode(frame, Health)[0] for topic, frame in wire.sent if topic is HEALTH]
        return [float(h.input_age_s[h.inputs.index(STALL)]) for h in healths if STALL in h.inputs]

    thread = threading.Thread(target=run_live, args=(service, wire, stop), daemon=True)
    thread.start()
    assert wire.came.wait(PATIENCE_S)
    stop.set()
    thread.join(PATIENCE_S)
    assert stalls()[0] >= 0.19, "nothing came within a look"


@dataclass
class Limited(Scripted):
    """A service that cannot use old orders."""

    max_age_s: dict[str, float] = field(default_factory=lambda: {MODE.key: 1.0})
