"""Service protocol, inbox and worker.

A service is a plain object that turns input messages into output messages. It declares what triggers its step, which topics it
reads and which it writes; a runner transports the messages. Two runners use the same service objects and frames:
`zenoh_runner` in real time and `lockstep` in simulated time.
"""

import math
import threading
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar, cast, runtime_checkable

import numpy as np

from sextant.shared.runtime.lateness import BEAT, MAX_STALL_S, STALL, InputAges, Limited
from sextant.shared.runtime.stopwatch import stopwatch_ns
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health, Message, Tick
from sextant.shared.wire.topics import Delivery, Topic

M = TypeVar("M", bound=Message)
AnyTopic = Topic[Any]

HEALTH_PERIOD_NS = 1_000_000_000
QUEUE_LENGTH = 512  # queued frames of an EVERY topic; further frames replace the oldest and are counted as dropped
_SAMPLES = 4096  # timings kept per stage
AHEAD_NS = 2_000_000_000  # [ns] maximum lead of a stamp over the robot's time: a later stamp would make all next messages old
_BEAT_LASTS = 1.0  # periods after the start of a step at which simulated time waits for its end, ...
_LATE_BEAT = 1.5  # ... and for the next step


@dataclass(frozen=True, slots=True)
class Every:
    """Periodic trigger of a service, by its own clock.

    `wait` replaces the wait [s] for the next beat, for services that have work to do between beats. If `wait` returns early,
    the beat runs at once and the next one is due a period later.

    `fetches` makes the inbox poll the link when the service reads a topic, instead of receiving frames from a thread. The time
    of polling then counts as the time of arrival. Use it for services that read all topics often and do not depend on the
    age of their inputs.

    `by_machine` makes the service wait by the machine's clock, so that it also beats while simulated time stands still.
    """

    period_ns: int
    wait: Callable[[float], object] | None = None
    fetches: bool = False
    by_machine: bool = False

    @classmethod
    def hz(cls, rate_hz: float) -> "Every":
        """Return a trigger with a rate [Hz]."""
        return cls(round(1e9 / rate_hz))


class Stages:
    """Durations of the named stages of a service's work, the newest 4096 of each."""

    def __init__(self) -> None:
        self._samples: dict[str, _Ring] = {}

    def __call__(self, name: str) -> "_Stage":
        """Return a context manager that times its block as one run of a stage."""
        return _Stage(self, name)

    def add(self, name: str, duration_ms: float) -> None:
        """Record one duration [ms] of a stage."""
        samples = self._samples.get(name)
        if samples is None:
            samples = self._samples[name] = _Ring()
        samples.add(duration_ms)

    def runs(self, name: str) -> int:
        """Return the number of runs of a stage."""
        return self._samples[name].count if name in self._samples else 0

    def percentiles(self) -> dict[str, tuple[float, float]]:
        """Return stage -> 50th and 99th percentile [ms], by nearest rank."""
        return {name: samples.percentiles() for name, samples in self._samples.items()}


class _Stage:
    """Context manager that times one run of a stage.

    It is several times faster than one from a generator.
    """

    __slots__ = ("_began", "_name", "_stages")

    def __init__(self, stages: Stages, name: str):
        self._stages, self._name = stages, name

    def __enter__(self) -> None:
        self._began = stopwatch_ns()

    def __exit__(self, *_: object) -> None:
        self._stages.add(self._name, (stopwatch_ns() - self._began) * 1e-6)


class _Ring:
    """Ring buffer of the newest numbers of a stream."""

    def __init__(self) -> None:
        self._values = array("d", bytes(8 * _SAMPLES))  # storing a number takes half as long as in a NumPy array
        self.count = 0  # of all numbers added

    def add(self, value: float) -> None:
        self._values[self.count % _SAMPLES] = value
        self.count += 1

    def percentiles(self) -> tuple[float, float]:
        values = np.array(self._values[: min(self.count, _SAMPLES)])
        ranks = (round(0.50 * (len(values) - 1)), round(0.99 * (len(values) - 1)))
        p50, p99 = np.partition(values, ranks)[[*ranks]].tolist()
        return p50, p99


Frame: TypeAlias = Any  # bytes; a runner may have another form for messages that stay in its process
Encode: TypeAlias = Callable[[Message, codec.Timing], Frame]


class Decode(Protocol):
    """Function that decodes frames, such as `codec.decode`."""

    def __call__(self, frame: Frame, kind: type[M], max_bytes: int, /) -> tuple[M, codec.Timing]:
        """Decode a frame as a message of one type, or raise DecodeError."""
        ...


class Inbox:
    """Received frames of one service.

    Frames are decoded when the service reads their topic. A frame that does not decode is refused, counted and reported, and
    the last valid message of its topic stays.
    """

    def __init__(
        self,
        subscribes: Sequence[AnyTopic],
        stages: Stages,
        wanted: Callable[[AnyTopic], bool] = lambda _: True,
        decode: Decode = codec.decode,
        ages: InputAges | None = None,
        robot_time: bool = False,
    ):
        self.now_ns = 0
        self._ages = ages or InputAges({})
        self.refused = 0
        self.dropped = 0
        self.last_refusal = ""
        self.wanted = wanted  # whether a topic has subscribers; without any, a service need not make its messages
        self._stages = stages
        self._decode = decode
        self._robot_time = robot_time  # whether arrival times are by the robot's clock, as stamps are
        self._reads = {topic.key: topic for topic in subscribes}
        self._frames: dict[str, deque[tuple[Frame, int]]] = {}
        for topic in subscribes:
            length = 1 if topic.delivery is Delivery.LATEST else QUEUE_LENGTH
            self._frames[topic.key] = deque(maxlen=length)
        self._newest: dict[str, tuple[Message, int]] = {}
        self._refusals: dict[str, str] = {}  # topic key -> why its last frame was refused, until a valid one comes
        self._fetch: dict[str, Callable[[], list[Frame]]] = {}
        self._lock = threading.Lock()

    def receive(self, topic: AnyTopic, frame: Frame, at_ns: int) -> None:
        """Store a received frame; a runner calls this from any thread."""
        with self._lock:
            queue = self._frames[topic.key]
            if len(queue) == queue.maxlen:
                self.dropped += topic.delivery is Delivery.EVERY
            queue.append((frame, at_ns))

    def fetch(self, topic: AnyTopic, come: Callable[[], list[Frame]]) -> None:
        """Fetch the frames of a topic with `come` when it is read, in place of `receive`."""
        self._fetch[topic.key] = come

    def waiting(self, topic: AnyTopic) -> bool:
        """Return whether a topic has frames that have not been read."""
        self._look(topic)
        return bool(self._frames[topic.key])

    def latest(self, topic: Topic[M]) -> M | None:
        """Return the newest valid message of a topic, regardless of its age."""
        found = self._use_newest(topic)
        return cast(M, found[0]) if found else None

    def fresh(self, topic: Topic[M], within_s: float | None = None) -> M | None:
        """Return the newest valid message, or None if it arrived more than `within_s` ago.

        The default of `within_s` is three periods of the topic.
        """
        found = self._use_newest(topic)
        age_ns = topic.fresh_for_ns if within_s is None else within_s * 1e9
        if found is None or self.now_ns - found[1] > age_ns:
            return None
        return cast(M, found[0])

    def drain(self, topic: Topic[M]) -> list[M]:
        """Return all messages received since the last read, in order."""
        messages = self._decode_waiting(topic)
        if not messages or topic.key not in self._ages.limit_ns:
            return messages
        _, at_ns = self._newest[topic.key]
        for message in messages:
            self._ages.note(topic.key, self.now_ns - message.stamp_ns, at_ns - message.stamp_ns)
        return messages

    def _use_newest(self, topic: Topic[M]) -> tuple[Message, int] | None:
        """Return the newest valid message of a topic and its arrival time [ns].

        The use counts for the ages of the inputs.
        """
        self._decode_waiting(topic)
        found = self._newest.get(topic.key)
        if found is not None and topic.key in self._ages.limit_ns:
            self._ages.note(topic.key, self.now_ns - found[0].stamp_ns, found[1] - found[0].stamp_ns)
        return found

    def _decode_waiting(self, topic: Topic[M]) -> list[M]:
        """Decode the waiting frames of a topic, in order."""
        if self._fetch:
            self._look(topic)
        queue = self._frames[topic.key]
        if not queue:
            return []
        with self._lock:
            frames = list(queue)
            queue.clear()
        messages: list[M] = []
        for frame, at_ns in frames:
            try:
                message, timing = self._decode(frame, topic.type, topic.max_bytes)
            except codec.DecodeError as error:
                self._refuse(topic, str(error))
                continue
            if self._robot_time and message.stamp_ns > at_ns + AHEAD_NS:
                self._refuse(topic, f"stamped {(message.stamp_ns - at_ns) * 1e-9:.1f} s in the future")
                continue
            if timing.began_ns > 0 and topic.key not in self._fetch:
                self._stages.add(f"latency {topic.key}", (at_ns - timing.began_ns) * 1e-6)
            self._newest[topic.key] = (message, at_ns)
            if self._refusals:
                self._refusals.pop(topic.key, None)
            messages.append(message)
        return messages

    def _refuse(self, topic: AnyTopic, why: str) -> None:
        self.refused += 1
        self.last_refusal = self._refusals[topic.key] = f"{topic.key}: {why}"[:500]

    def refusal_of(self, topic: AnyTopic) -> str:
        """Return why the last frame of a topic was refused; an empty text if it was valid, or if there was none."""
        return self._refusals.get(topic.key, "")

    def _look(self, topic: AnyTopic) -> None:
        fetch = self._fetch.get(topic.key)
        for frame in fetch() if fetch is not None else ():
            self.receive(topic, frame, self.now_ns)


class Service(Protocol):
    """Protocol of a service: one process of the robot, as a plain object."""

    name: str
    stages: Stages

    @property
    def trigger(self) -> AnyTopic | Every:
        """Trigger of its step: the messages of a topic, or its own clock."""
        ...

    @property
    def subscribes(self) -> tuple[AnyTopic, ...]:
        """Topics that it subscribes to; the trigger topic need not be repeated."""
        ...

    @property
    def publishes(self) -> tuple[AnyTopic, ...]:
        """Topics that it publishes."""
        ...

    def step(self, message: Any, inbox: Inbox) -> Iterable[Message]:
        """Return the messages made from the trigger message (or a Tick) and the inbox."""
        ...

    def status(self) -> str:
        """Return the current activity of the service as text for the operator."""
        ...


@runtime_checkable
class Retriggered(Protocol):
    """Service that repeats its step when another topic arrives, with the newest trigger message."""

    @property
    def retrigger(self) -> AnyTopic:
        """Topic whose messages also start a step; it must be one of `subscribes`."""
        ...


class ServiceRunner:
    """Runs the steps of one service and sends their messages; both runners use it."""

    def __init__(
        self,
        service: Service,
        send: Callable[[AnyTopic, Frame, int], None],
        clock: Callable[[], int],
        wanted: Callable[[AnyTopic], bool] = lambda _: True,
        decode: Decode = codec.decode,
        ahead_s: Callable[[], float] = lambda: 0.0,
        astray: Callable[[], tuple[int, str]] = lambda: (0, ""),
        role: str = "robot",
        hold: Callable[[int | None], object] | None = None,
        robot_time: bool = False,
        encode: Encode = codec.encode,
    ):
        self.service = service
        self._health_topic = topics.HEALTH_OF[role]  # of the machine's role; other roles may not publish there
        self._max_age_s = dict(service.max_age_s) if isinstance(service, Limited) else {}
        self.ages = InputAges({**self._max_age_s, STALL: MAX_STALL_S} if self._max_age_s else {})
        # Sets the time [ns] up to which simulated time may run without another step.
        self._hold = hold if self._max_age_s else None
        self._missed_beats = 0
        self._ahead_s = ahead_s
        self._astray = astray  # number of frames that the link dropped because of a wrong address, and the last of them
        self._last_refusals = ("", "")  # of wrong addresses, and of frames that did not decode
        self._last_refusal = ""  # the newer of these two
        self.subscribes = tuple(
            dict.fromkeys([*([] if isinstance(service.trigger, Every) else [service.trigger]), *service.subscribes])
        )
        self._retrigger = service.retrigger if isinstance(service, Retriggered) else None
        self.triggers = frozenset((service.trigger, self._retrigger))  # topics whose arrival calls `arrived`
        self.inbox = Inbox(self.subscribes, service.stages, wanted, decode, self.ages, robot_time)
        self._send, self._encode = send, encode
        self._clock = clock
        self._writes = set(service.publishes)
        self._steps = 0
        self._stepped_ns = clock()
        self._health_due_ns = 0

    def tick(self) -> None:
        """Run one beat of a service that is paced by its own clock."""
        now_ns, pace = self._clock(), self.service.trigger
        if isinstance(pace, Every) and self._steps:
            since_ns = now_ns - self._stepped_ns
            self._missed_beats += max(0, round(since_ns / pace.period_ns) - 1)
            self.ages.note(BEAT, since_ns)
        self._step(Tick(now_ns))

    def arrived(self) -> None:
        """Run one step for every waiting message of the trigger topic.

        Without any, repeat the step with the newest one if the second trigger has a message.
        """
        pace = self.service.trigger
        if isinstance(pace, Every):
            return
        self.inbox.now_ns = self._clock()
        messages = self.inbox.drain(pace)
        if not messages and self._retrigger is not None and self.inbox.waiting(self._retrigger):
            newest = self.inbox.latest(pace)
            messages = [] if newest is None else [newest]
        for message in messages:
            self._step(message)

    def _step(self, message: Message) -> None:
        began_ns = self.inbox.now_ns = self._clock()
        if self._hold is not None:
            self._hold(self._next_step_by(began_ns, _BEAT_LASTS))
        with self.service.stages(self.service.name):
            for made in self.service.step(message, self.inbox):
                topic = topics.OF_TYPE.get(type(made))
                if topic is None or topic not in self._writes:
                    raise ValueError(f"{self.service.name} returned a {type(made).__name__}, which is not in its `publishes`")
                self._send(topic, self._encode(made, codec.Timing(began_ns, self._clock())), began_ns)
        self._steps += 1
        self._stepped_ns = began_ns
        if self._hold is not None:
            self._hold(self._next_step_by(began_ns, _LATE_BEAT))
        if self._max_age_s:
            self.ages.forget_uses()
        self.report_health(began_ns)

    def _next_step_by(self, began_ns: int, periods: float) -> int | None:
        """Return when [ns] an input of this step, or a beat due within `periods`, is late.

        Returns None without limits.
        """
        left_ns = self.ages.left_ns()
        if BEAT in self._max_age_s and isinstance(pace := self.service.trigger, Every):
            left_ns = min(periods * pace.period_ns, math.inf if left_ns is None else left_ns)
        return None if left_ns is None else began_ns + round(left_ns)

    def report_health(self, now_ns: int) -> None:
        """Send a Health message if it is due."""
        if now_ns < self._health_due_ns:
            return
        self._health_due_ns = now_ns + HEALTH_PERIOD_NS
        timings, ages = self.service.stages.percentiles(), self.ages.report()
        astray, last_astray = self._astray()
        refusals = (last_astray, self.inbox.last_refusal)
        newer = [words for words, before in zip(refusals, self._last_refusals, strict=True) if words != before]
        self._last_refusals, self._last_refusal = refusals, [self._last_refusal, *newer][-1]
        health = Health(
            stamp_ns=now_ns,
            service=self.service.name,
            status=(self._starved(now_ns) + self.service.status())[:500],
            steps=self._steps,
            refused=self.inbox.refused + astray,
            dropped=self.inbox.dropped,
            last_refusal=self._last_refusal,
            stages=tuple(timings),
            stage_p50_ms=np.array([p50 for p50, _ in timings.values()], dtype=np.float64),
            stage_p99_ms=np.array([p99 for _, p99 in timings.values()], dtype=np.float64),
            robot_clock_offset_s=self._ahead_s(),
            inputs=tuple(age.what for age in ages),
            input_age_s=np.array([age.age_s for age in ages], dtype=np.float64),
            input_arrived_s=np.array([age.arrived_s for age in ages], dtype=np.float64),
            input_limit_s=np.array([age.limit_s for age in ages], dtype=np.float64),
            input_late_share=np.array([age.late for age in ages], dtype=np.float64),
            missed_ticks=self._missed_beats,
        )
        self._send(self._health_topic, self._encode(health, codec.Timing(now_ns, self._clock())), now_ns)

    def _starved(self, now_ns: int) -> str:
        """Return a text if the trigger topic is silent for too long, or an empty text."""
        pace, waited_ns = self.service.trigger, now_ns - self._stepped_ns
        if isinstance(pace, Every) or waited_ns <= max(pace.fresh_for_ns, HEALTH_PERIOD_NS):
            return ""
        return f"no message on {pace.key} for {waited_ns * 1e-9:.0f} s; last status: "
