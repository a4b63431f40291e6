"""Services in one process on simulated time."""

import pickle
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from sextant.shared.runtime.lockstep import HandOver, Lockstep, Outage, ServiceFailedError
from sextant.shared.runtime.service import AnyTopic, Every, Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message, ModeCommand, PlannerStatus, Tick, VelocityCommand
from tests.support.scripted_service import Scripted, order, status, velocity

MS = 1_000_000
VELOCITY, MODE, STATUS, HEALTH = topics.VELOCITY, topics.MODE, topics.PLANNER_STATUS, topics.HEALTH


@dataclass
class Recorder:
    """A tap that records every frame as it was sent, except health."""

    frames: list[tuple[str, bytes, int]] = field(default_factory=list)

    def __call__(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        if topic is not HEALTH:
            self.frames.append((topic.key, frame, at_ns))


def operator(period_ns: int = 10 * MS) -> Scripted:
    sequence = iter(range(10**6))

    def act(tick: Tick, _: Inbox) -> Iterator[Message]:
        yield velocity(tick.stamp_ns)
        yield ModeCommand(tick.stamp_ns, "walk", next(sequence))

    return Scripted("console", Every(period_ns), publishes=(VELOCITY, MODE), act=act)


def planner() -> Scripted:
    return Scripted(
        "planner",
        VELOCITY,
        subscribes=(MODE,),
        publishes=(STATUS,),
        act=lambda v, box: [status(len(box.drain(MODE)) + v.stamp_ns)],
    )


def system(**options: Any) -> tuple[Lockstep, Recorder]:
    tap = Recorder()
    return Lockstep({"console": operator, "planner": planner}, tap, **options), tap


def seen(run: Lockstep, name: str = "planner") -> list[tuple[int, Any]]:
    service = run.service(name)
    assert isinstance(service, Scripted)
    return service.seen


def test_message_arrives_after_its_latency() -> None:
    run, _ = system()
    run.run(100 * MS)
    latency_ns = round(1e9 * VELOCITY.latency_s)
    assert [(at, v.stamp_ns) for at, v in seen(run)] == [(10 * MS * n + latency_ns, 10 * MS * n) for n in range(10)]


def test_shared_message_is_decoded_once_and_read_only() -> None:
    run = Lockstep({"console": operator, "planner": planner, "mapper": lambda: Scripted("mapper", VELOCITY)})
    run.run(50 * MS)
    pairs = zip(seen(run), seen(run, "mapper"), strict=True)
    for (_, at_planner), (_, at_mapper) in pairs:
        assert at_planner is at_mapper
        with pytest.raises(ValueError, match="read-only"):
            at_planner.velocity[0] = 1.0


def test_messages_handed_over_are_copies_that_readers_share() -> None:
    sent: list[VelocityCommand] = []

    def act(tick: Tick, _: Inbox) -> Iterator[Message]:
        sent.append(velocity(tick.stamp_ns))
        yield sent[-1]
        sent[-1].velocity[:] = np.nan  # the sender may use its array again

    makers = {
        "console": lambda: Scripted("console", Every(10 * MS), publishes=(VELOCITY,), act=act),
        "planner": planner,
        "mapper": lambda: Scripted("mapper", VELOCITY),
    }
    run = Lockstep(makers, hand_over=HandOver(lambda _topic, _at_ns: False))
    run.run(50 * MS)
    pairs = list(zip(seen(run), seen(run, "mapper"), strict=True))
    assert len(pairs) > 3
    for (_, at_planner), (_, at_mapper) in pairs:
        assert at_planner is at_mapper
        np.testing.assert_array_equal(at_planner.velocity, velocity().velocity)
        with pytest.raises(ValueError, match="read-only"):
            at_planner.velocity[0] = 1.0


def test_handing_over_gives_the_tap_the_same_frames() -> None:
    (encoded, frames), (handed, same), (few, some) = (
        system(),
        system(hand_over=HandOver(lambda _topic, _at_ns: True)),
        system(hand_over=HandOver(lambda topic, at_ns: topic is STATUS and at_ns > 50 * MS)),
    )
    for run in (encoded, handed, few):
        run.run(100 * MS)
    assert frames.frames == same.frames
    assert some.frames == [frame for frame in frames.frames if frame[0] == STATUS.key and frame[2] > 50 * MS]


def test_message_handed_over_is_refused_as_its_frame_would_be() -> None:
    def refused(hand_over: HandOver | None) -> list[tuple[int, str]]:
        found: list[tuple[int, str]] = []

        def read(_: Tick, box: Inbox) -> Iterable[Message]:
            assert box.latest(VELOCITY) is None
            found.append((box.refused, box.last_refusal))
            return ()

        makers = {
            "console": lambda: Scripted("console", Every(10 * MS), publishes=(VELOCITY,), act=lambda _t, _b: [too_fast]),
            "planner": lambda: Scripted("planner", Every(10 * MS), subscribes=(VELOCITY,), act=read),
        }
        Lockstep(makers, hand_over=hand_over).run(50 * MS)
        return found

    too_fast = replace(velocity(), yaw_rate=1e13)
    assert refused(HandOver(lambda _topic, _at_ns: False)) == refused(None)
    assert refused(None)[-1][0] > 3


def test_latency_is_configurable() -> None:
    run, _ = system(latency_s={VELOCITY.key: 0.025})
    run.run(50 * MS)
    assert [at for at, _ in seen(run)] == [25 * MS, 35 * MS, 45 * MS]


def test_run_ends_exactly_at_requested_time() -> None:
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


def test_deliveries_precede_ticks_and_ticks_keep_order() -> None:
    happened: list[str] = []

    def note(name: str) -> Callable[[Any, Inbox], Iterable[Message]]:
        def act(_message: Any, box: Inbox) -> Iterable[Message]:
            happened.append(f"{name} {box.now_ns // MS} " + ("fresh" if box.waiting(MODE) else "-"))
            return [order(1)] if name == "b" else []

        return act

    makers = {name: (lambda name=name: Scripted(name, Every(10 * MS), (MODE,), (MODE,), note(name))) for name in ("b", "a")}
    Lockstep(makers, latency_s={MODE.key: 0.010}).run(10 * MS)
    assert happened == ["b 0 -", "a 0 -", "b 10 fresh", "a 10 fresh"]


def test_message_without_latency_keeps_order() -> None:
    run, _ = system(latency_s={VELOCITY.key: 0.0, MODE.key: 0.0})
    run.run(30 * MS)
    assert [at for at, _ in seen(run)] == [0, 10 * MS, 20 * MS, 30 * MS]


def test_repeated_run_gives_identical_frames() -> None:
    outages = (Outage("planner", 200 * MS, 400 * MS, kill=True), Outage("console", 500 * MS, 600 * MS, kill=False))
    runs = [system(outages=outages) for _ in range(2)]
    for run, _ in runs:
        run.run(1000 * MS)
    assert runs[0][1].frames == runs[1][1].frames
    assert len(runs[0][1].frames) > 200


def test_pause_between_runs_changes_nothing() -> None:
    (whole, tap), (parts, parts_tap) = system(), system()
    whole.run(300 * MS)
    for n in range(0, 301, 7):
        parts.run(n * MS)
    parts.run(300 * MS)
    assert tap.frames == parts_tap.frames


def test_killed_service_restarts_without_state() -> None:
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
    assert missed == 200 * MS  # messages in the meantime are lost
    assert len(seen(run, "console")) == 31  # the others go on


def test_hung_service_resumes_with_its_state() -> None:
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
    assert max(waited) >= 10  # orders waited in its queue while it hung


def test_hung_service_misses_its_ticks() -> None:
    run, _ = system(outages=[Outage("console", 20 * MS, 50 * MS, kill=False)])
    run.run(60 * MS)
    assert [at // MS for at, _ in seen(run, "console")] == [0, 10, 50, 60]


@pytest.mark.parametrize("kill", [True, False])
def test_outage_of_unknown_service_is_refused(kill: bool) -> None:
    with pytest.raises(ValueError, match="console, planner expected, found pilot"):
        system(outages=[Outage("pilot", 0, MS, kill)])


def test_latency_of_unknown_topic_is_refused() -> None:
    with pytest.raises(ValueError, match="keys of the topic table expected, found operator/speed"):
        system(latency_s={"operator/speed": 0.1})


def test_only_subscribed_topics_are_wanted() -> None:
    wanted: dict[str, bool] = {}

    def act(_tick: Any, box: Inbox) -> Iterable[Message]:
        wanted.update({t.key: box.wanted(t) for t in (VELOCITY, MODE, STATUS)})
        return ()

    Lockstep({"asks": lambda: Scripted("asks", Every(MS), act=act), "planner": planner}).run(0)
    assert wanted == {VELOCITY.key: True, MODE.key: True, STATUS.key: False}


def test_tap_receives_unsubscribed_topics() -> None:
    run, tap = system()
    run.run(0)
    run.run(10 * MS)
    assert STATUS.key in {key for key, _, _ in tap.frames}


def test_measured_latency_equals_configured_one() -> None:
    run, _ = system()
    run.run(200 * MS)
    expected_ms = VELOCITY.latency_s * 1e3
    assert run.service("planner").stages.percentiles()[f"latency {VELOCITY.key}"] == pytest.approx((expected_ms,) * 2)


def failing(name: str, trigger: Any) -> Scripted:
    def act(_message: Any, _box: Inbox) -> Iterable[Message]:
        yield velocity(1)
        raise IndexError("index 5 is out of bounds")

    return Scripted(name, trigger, publishes=(VELOCITY,), act=act)


@pytest.mark.parametrize("trigger", [Every(10 * MS), MODE], ids=["clock", "topic"])
def test_service_exception_names_service_and_line(trigger: Any) -> None:
    tap = Recorder()
    run = Lockstep({"console": operator, "planner": lambda: failing("planner", trigger)}, tap)
    with pytest.raises(ServiceFailedError, match=r"planner failed: IndexError: index 5 .* \(test_lockstep\.py:\d+\)") as caught:
        run.run(50 * MS)
    assert isinstance(caught.value.__cause__, IndexError)
    assert tap.frames[-1][0] == VELOCITY.key, "what it had sent before was seen"
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # a worker process passes it on


def test_tap_exception_is_not_attributed_to_service() -> None:
    def full(_topic: AnyTopic, _frame: bytes, _at_ns: int) -> None:
        raise OSError(28, "No space left on device")

    run = Lockstep({"console": operator}, full)
    with pytest.raises(OSError, match="No space left"):
        run.run(50 * MS)


def test_service_that_cannot_restart_has_failed() -> None:
    starts = iter([operator()])
    makers = {"console": lambda: next(starts)}
    run = Lockstep(makers, outages=[Outage("console", 20 * MS, 40 * MS, kill=True)])
    with pytest.raises(ServiceFailedError, match="console failed: StopIteration"):
        run.run(100 * MS)


@dataclass
class Repeated(Scripted):
    """A service that also steps on mode commands."""

    retrigger: AnyTopic = MODE


def test_second_trigger_repeats_step_with_newest_message() -> None:
    repeated = Repeated("planner", VELOCITY, (MODE,), act=lambda _velocity, box: box.drain(MODE)[:0])
    run = Lockstep({"planner": lambda: repeated}, latency_s={VELOCITY.key: 0.0, MODE.key: 0.0})
    run.say(order(1))
    run.run(0)
    assert seen(run) == [], "there is no message to repeat the step with"
    run.say(velocity(5))
    run.run(10 * MS)
    run.say(order(2))
    run.run(20 * MS)
    assert [(at, v.stamp_ns) for at, v in seen(run)] == [(0, 5), (10 * MS, 5)]
