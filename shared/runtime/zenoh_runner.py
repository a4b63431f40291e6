"""Real-time runner: one service in its own process, over any link."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Protocol, runtime_checkable

from sextant.shared.runtime.clock import now_ns
from sextant.shared.runtime.lateness import STALL
from sextant.shared.runtime.service import AnyTopic, Every, Service, ServiceRunner
from sextant.shared.runtime.simulated_time import hold
from sextant.shared.wire import codec

_LOOK_S = 0.2  # [s] maximum real time between two `alive` calls while the step thread waits
_SHORTEST_WAIT_S = 0.5e-3  # [s] between two polls of simulated time that stands still


class Link(Protocol):
    """Protocol of a link between processes.

    `sextant.shared.wire.transport` has the link for Zenoh.
    """

    def send(self, topic: AnyTopic, frame: bytes) -> None:
        """Publish a frame without blocking."""
        ...

    def subscribe(self, topic: AnyTopic, receive: Callable[[AnyTopic, bytes], None]) -> Callable[[], None]:
        """Pass every frame of a topic to `receive`, from a thread of the link.

        Returns:
            A function that ends the subscription.
        """
        ...

    def collect(self, topic: AnyTopic) -> Callable[[], list[bytes]]:
        """Queue the frames of a topic according to its delivery.

        Returns:
            A function that fetches and removes the queued frames.
        """
        ...

    def wanted(self, topic: AnyTopic) -> bool:
        """Return whether a topic has subscribers."""
        ...

    @property
    def astray(self) -> int:
        """Number of frames dropped because they arrived under a wrong key.

        A frame counts once for every subscription.
        """
        ...

    @property
    def last_astray(self) -> str:
        """Intended address and actual key of the last such frame, as text."""
        ...


@runtime_checkable
class Listening(Protocol):
    """Service that also subscribes to the link directly, besides its inbox."""

    def meet(self, link: Link) -> None:
        """Receive the link before the first step."""
        ...


def run_live(
    service: Service,
    link: Link,
    stop: threading.Event,
    alive: Callable[[int], object] = lambda _now_ns: None,
    ahead_s: Callable[[], float] = lambda: 0.0,
    role: str = "robot",
    robot_time: bool = False,
    packs: bool = True,
) -> None:
    """Run one service in this process until `stop` is set.

    Stamps are by the robot's clock (`sextant.shared.runtime.clock`). It runs in real time, except in a simulated run, where
    `shared.runtime.simulated_time` waits for this service if it is late.

    Args:
        service: The service.
        link: Link to the other processes.
        stop: Event that ends the run.
        alive: Called with this machine's monotonic time [ns] at least every 0.2 s, unless a step hangs or the service waits
            by its own `wait` or `by_machine`: then once per beat.
        ahead_s: Returns the offset [s] of the robot's clock from this machine's clock.
        role: Role of this machine.
        robot_time: Whether this process uses the robot's clock; messages stamped ahead of it are then refused.
        packs: Whether to pack arrays, for readers on other machines.
    """
    clock = now_ns
    arrived = threading.Event()

    def send(topic: AnyTopic, frame: bytes, _: int) -> None:
        link.send(topic, frame)

    def astray() -> tuple[int, str]:
        return link.astray, link.last_astray

    worker = ServiceRunner(
        service,
        send,
        clock,
        link.wanted,
        ahead_s=ahead_s,
        astray=astray,
        role=role,
        hold=partial(hold, service.name),
        robot_time=robot_time,
        encode=partial(codec.encode, packs=packs),
    )
    pace = service.trigger

    def receive(topic: AnyTopic, frame: bytes) -> None:
        worker.inbox.receive(topic, frame, clock())
        if topic in worker.triggers:
            arrived.set()

    fetches = isinstance(pace, Every) and pace.fetches
    for topic in worker.subscribes:
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
            beats.period_ns = service.trigger.period_ns if isinstance(service.trigger, Every) else beats.period_ns
            service.stages.add("cycle", beats.next(wait) * 1e-6)
            worker.tick()
        else:
            began_ns = clock()
            came = arrived.wait(_LOOK_S)
            worker.ages.note(STALL, clock() - began_ns)
            if came:
                arrived.clear()
                worker.arrived()
        worker.report_health(clock())  # also while no valid messages arrive


def _waiting(
    pace: AnyTopic | Every, stop: threading.Event, clock: Callable[[], int], alive: Callable[[int], object]
) -> Callable[[float], object]:
    """Return a function that waits for a time [s] until the next beat.

    The clock [ns] may be slower than the machine's.
    """

    def wait(length_s: float) -> None:
        until_ns = clock() + round(length_s * 1e9)
        while (left_ns := until_ns - clock()) > 0 and not stop.wait(min(max(left_ns * 1e-9, _SHORTEST_WAIT_S), _LOOK_S)):
            alive(time.monotonic_ns())

    if isinstance(pace, Every) and pace.by_machine:
        return stop.wait
    return (pace.wait if isinstance(pace, Every) else None) or wait


class Beats:
    """Periodic beats of a service, whose period may change.

    Beats missed during a stall are skipped, not caught up.
    """

    def __init__(self, pace: Every, clock: Callable[[], int]):
        """Start the period now, by a clock [ns]; the first beat is due one period later."""
        self.period_ns, self._clock = pace.period_ns, clock
        self._due_ns = self._at_ns = clock()

    def next(self, wait: Callable[[float], object]) -> int:
        """Wait for the next beat and return the time since the last one [ns]."""
        self._due_ns = max(self._due_ns + self.period_ns, self._clock() - self.period_ns)
        wait(max(0, self._due_ns - self._clock()) * 1e-9)
        before, self._at_ns = self._at_ns, self._clock()
        self._due_ns = min(self._due_ns, self._at_ns)  # the wait returned early
        return self._at_ns - before
