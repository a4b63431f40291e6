"""A service in a process of its own at real time, on whatever moves frames between processes."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Protocol, runtime_checkable

from sextant.shared.runtime.clock import now_ns
from sextant.shared.runtime.lateness import STALL
from sextant.shared.runtime.service import AnyTopic, Every, Service, Worker
from sextant.shared.runtime.simulated_time import hold

_LOOK_S = 0.2  # [s] of real time for which the thread that steps waits at most without saying that it lives
_SHORTEST_WAIT_S = 0.5e-3  # [s] between two looks at simulated time that stands


class Link(Protocol):
    """What moves frames between processes; `sextant.shared.wire.transport` has the one for Zenoh."""

    def send(self, topic: AnyTopic, frame: bytes) -> None:
        """Publish a frame, never blocking."""
        ...

    def subscribe(self, topic: AnyTopic, receive: Callable[[AnyTopic, bytes], None]) -> Callable[[], None]:
        """Have every frame of a topic handed over, from a thread of the link, until what is returned is called."""
        ...

    def collect(self, topic: AnyTopic) -> Callable[[], list[bytes]]:
        """Keep what comes of a topic, as it is delivered, until it is fetched; what fetches it."""
        ...

    def wanted(self, topic: AnyTopic) -> bool:
        """Whether anybody is subscribed to a topic."""
        ...

    @property
    def astray(self) -> int:
        """Frames that came under a key that they were not sent to, and were dropped; each once for every subscription."""
        ...

    @property
    def last_astray(self) -> str:
        """Where the last of them was to go, and where it came, in words."""
        ...


@runtime_checkable
class Listening(Protocol):
    """A service that takes frames from the link by itself, as they come and while it wants them, beside its inbox."""

    def meet(self, link: Link) -> None:
        """Be given the link, before the first step."""
        ...


def run_live(
    service: Service,
    link: Link,
    stop: threading.Event,
    alive: Callable[[int], object] = lambda _now_ns: None,
    ahead_s: Callable[[], float] = lambda: 0.0,
    role: str = "robot",
    robot_time: bool = False,
) -> None:
    """Run one service in this process until `stop` is set; stamps are the robot's time (`sextant.shared.runtime.clock`).

    That is real time, but in a simulated run with `shared.runtime.simulated_time`, which waits for this service if it is late.
    `alive` is told this machine's monotonic time [ns] at least every 0.2 s, as long as no step hangs and no beat is rarer.
    `ahead_s` says by how much [s] the robot's clock is ahead of this machine's, `role` is that of this machine.
    `robot_time`: whether this process goes by the robot's clock; messages that are stamped ahead of it are refused then.
    """
    clock = now_ns
    arrived = threading.Event()

    def send(topic: AnyTopic, frame: bytes, _: int) -> None:
        link.send(topic, frame)

    def astray() -> tuple[int, str]:
        return link.astray, link.last_astray

    worker = Worker(
        service,
        send,
        clock,
        link.wanted,
        ahead_s=ahead_s,
        astray=astray,
        role=role,
        hold=partial(hold, service.name),
        robot_time=robot_time,
    )
    pace = service.paced_by

    def receive(topic: AnyTopic, frame: bytes) -> None:
        worker.inbox.receive(topic, frame, clock())
        if topic is pace:
            arrived.set()

    fetches = isinstance(pace, Every) and pace.fetches
    for topic in worker.reads:
        if fetches:
            worker.inbox.fetch(topic, link.collect(topic))
        else:
            link.subscribe(topic, receive)
    if isinstance(service, Listening):
        service.meet(link)
    beats = Beats(pace, clock) if isinstance(pace, Every) else None
    wait = _waiting(pace, stop, clock, alive)
    while not stop.is_set():
        alive(time.monotonic_ns())
        if beats is not None:
            service.stages.add("cycle", beats.next(wait) * 1e-6)
            worker.tick()
        else:
            began_ns = clock()
            came = arrived.wait(_LOOK_S)
            worker.ages.note(STALL, clock() - began_ns)
            if came:
                arrived.clear()
                worker.arrived()
        worker.report_health(clock())  # also while nothing comes in, or nothing that decodes


def _waiting(
    pace: AnyTopic | Every, stop: threading.Event, clock: Callable[[], int], alive: Callable[[int], object]
) -> Callable[[float], object]:
    """What waits [s] for the next beat, by a clock [ns] that may be slower than the machine's."""

    def wait(length_s: float) -> None:
        until_ns = clock() + round(length_s * 1e9)
        while (left_ns := until_ns - clock()) > 0 and not stop.wait(min(max(left_ns * 1e-9, _SHORTEST_WAIT_S), _LOOK_S)):
            alive(time.monotonic_ns())

    if isinstance(pace, Every) and pace.by_machine:
        return stop.wait
    return (pace.wait if isinstance(pace, Every) else None) or wait


class Beats:
    """The beats of a service that its own clock paces: one a period; after a stall they are left out, none are raced."""

    def __init__(self, pace: Every, clock: Callable[[], int]):
        """The first one is due a period from now, by a clock [ns]."""
        self._period_ns, self._clock = pace.period_ns, clock
        self._due_ns = self._at_ns = clock()

    def next(self, wait: Callable[[float], object]) -> int:
        """Wait [s] until the next one; how long it is since the last [ns]."""
        self._due_ns = max(self._due_ns + self._period_ns, self._clock() - self._period_ns)
        wait(max(0, self._due_ns - self._clock()) * 1e-9)
        before, self._at_ns = self._at_ns, self._clock()
        self._due_ns = min(self._due_ns, self._at_ns)  # it has come early
        return self._at_ns - before
