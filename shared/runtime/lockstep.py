"""Lockstep runner: all services in one process on simulated time.

Runs are deterministic, and as fast as the machine allows.
"""

import heapq
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

from sextant.shared.errors import SextantError
from sextant.shared.runtime.service import AnyTopic, Decode, Encode, Every, Frame, Service, ServiceRunner
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Outage:
    """Outage of a service between two times.

    A killed service restarts as a new object; a hung one continues with the same object.
    """

    service: str
    from_ns: int
    until_ns: int
    kill: bool


class ServiceFailedError(SextantError, RuntimeError):
    """A service raised an exception (the `__cause__`), which would end its process."""

    exit_status = 1

    @classmethod
    def of(cls, service: str, error: Exception) -> Self:
        """Compose the message from the service, the exception and the line that raised it."""
        if isinstance(error, SextantError):  # its message says all
            return cls(f"{service} failed: {error}")
        frames = traceback.extract_tb(error.__traceback__)
        place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
        return cls(f"{service} failed: {type(error).__name__}: {error}{place}")


class Radio(Protocol):
    """Radio link between two machines."""

    def crosses(self, sender: str, reader: str, /) -> bool:
        """Return whether messages of a sender reach a reader over this link."""
        ...

    def arrival_ns(self, topic: AnyTopic, sender: str, size: int, now_ns: int, /) -> int | None:
        """Return when [ns] a message of `size` bytes sent now arrives, None if dropped."""
        ...


class HandOver:
    """Hands messages over to their readers as copies, without a codec.

    The copies are as `codec.decode` would return them, with the same checks, except for the size of a frame. Only frames for
    the tap are encoded.
    """

    def __init__(self, tapped: Callable[[AnyTopic, int], bool]):
        """Set which frames are encoded.

        Args:
            tapped: Whether the tap receives a frame of a topic that is sent at a time [ns].
        """
        self.tapped = tapped
        self._shown: tuple[bytes, _Copy] | None = None  # newest frame for the tap

    def frame(self, copy: "_Copy") -> bytes:
        """Encode a copy as the frame that the tap receives."""
        frame = codec.encode(copy.message, copy.timing)
        self._shown = frame, copy
        return frame

    def decode(self, frame: Frame, kind: type[M], max_bytes: int, /) -> tuple[M, codec.Timing]:
        """Return the message of a copy, or of the tap's newest frame; another frame is decoded.

        Raises:
            DecodeError: The message contradicts itself or has wrong values, or the frame does not decode.
        """
        if self._shown is not None and self._shown[0] is frame:
            frame = self._shown[1]
        return frame.received() if isinstance(frame, _Copy) else codec.decode(frame, kind, max_bytes)


class _Copy:
    """Copy of a message, which takes the place of its frame; all readers share it."""

    __slots__ = ("_is_checked", "message", "timing")

    def __init__(self, message: Message, timing: codec.Timing):
        self.message, self.timing, self._is_checked = codec.as_received(message), timing, False

    def received(self) -> tuple[Any, codec.Timing]:
        if not self._is_checked:
            codec.check_received(self.message)
            self._is_checked = True
        return self.message, self.timing


class Lockstep:
    """Runs services in one process on simulated time, deterministically.

    Each message reaches its readers after the latency of its topic. Beats fall on multiples of their period. At the same
    instant deliveries come first, then beats in the order of the services.
    """

    def __init__(
        self,
        makers: Mapping[str, Callable[[], Service]],
        tap: Callable[[AnyTopic, bytes, int], object] = lambda _topic, _frame, _at_ns: None,
        latency_s: Mapping[str, float] | None = None,
        outages: Sequence[Outage] = (),
        busy_until: Mapping[str, Callable[[], int]] | None = None,
        radio: Radio | None = None,
        hand_over: HandOver | None = None,
    ):
        """Make the services.

        Args:
            makers: Name -> function that makes the service.
            tap: Callback with topic, frame and time [ns] of every sent frame, for recorders and tests.
            latency_s: Topic key -> delay [s], where it differs from the topic table.
            outages: Outages of services.
            busy_until: Name -> function that returns until when [ns] the service is busy. A busy service skips its beats.
            radio: Link between services on two machines.
            hand_over: Takes the place of the codec; without effect where a radio needs the sizes of frames.

        Raises:
            ValueError: An outage of an unknown service, or a latency of an unknown topic.
        """
        unknown = {o.service for o in outages} - makers.keys()
        if unknown:
            raise ValueError(f"outages of the services {', '.join(makers)} expected, found {', '.join(sorted(unknown))}")
        strange = (latency_s or {}).keys() - {t.key for t in topics.TOPICS}
        if strange:
            raise ValueError(f"latencies of keys of the topic table expected, found {', '.join(sorted(strange))}")
        self.now_ns = 0
        self._makers = makers
        self._tap = tap
        self._latency_ns = {t.key: round(1e9 * (latency_s or {}).get(t.key, t.latency_s)) for t in topics.TOPICS}
        self._outages: dict[str, list[Outage]] = {name: [] for name in makers}
        self._busy_until = busy_until or {}
        self._radio = radio
        self._hand_over = hand_over if radio is None else None
        self._encode: Encode = codec.encode if self._hand_over is None else _Copy
        self._decode: Decode = _DecodedOnce() if self._hand_over is None else self._hand_over.decode
        self._events: list[tuple[int, int, int, Callable[[], None]]] = []
        self._sequence = 0
        self._workers: dict[str, ServiceRunner] = {}
        self._readers: dict[str, list[str]] = {}
        self._sent: list[tuple[AnyTopic, Frame]] = []  # frames of the current step, which the tap receives at its end
        for order, name in enumerate(makers):
            self._start(name)
            pace = self._workers[name].service.trigger
            if isinstance(pace, Every):
                self._keep_beating(name, order)
        for outage in outages:
            self.lose(outage)

    def service(self, name: str) -> Service:
        """Return the service object that currently runs under a name."""
        return self._workers[name].service

    def lose(self, outage: Outage) -> None:
        """Add an outage of a service, which must end in the future."""
        self._outages[outage.service].append(outage)
        if outage.kill:
            name = outage.service
            self._schedule(outage.until_ns, -2, lambda: self._guarded(name, lambda: self._start(name)))

    def say(self, message: Message, topic: AnyTopic | None = None) -> None:
        """Send a message now from outside the services.

        Give `topic` for a role other than the robot.
        """
        frame = self._encode(message, codec.Timing(self.now_ns, self.now_ns))
        self._send("", topic or topics.OF_TYPE[type(message)], frame)
        self._show()

    def run(self, until_ns: int) -> None:
        """Advance simulated time up to and including `until_ns`.

        Raises:
            ServiceFailedError: A service raised an exception.
        """
        while self._events and self._events[0][0] <= until_ns:
            at_ns, _, _, act = heapq.heappop(self._events)
            self.now_ns = at_ns
            act()
        self.now_ns = max(self.now_ns, until_ns)

    def _start(self, name: str) -> None:
        service = self._makers[name]()
        worker = ServiceRunner(
            service,
            lambda topic, frame, _: self._send(name, topic, frame),
            lambda: self.now_ns,
            self._wanted,
            self._decode,
            robot_time=True,
            encode=self._encode,
        )
        self._workers[name] = worker
        for topic in worker.subscribes:
            readers = self._readers.setdefault(topic.key, [])
            if name not in readers:
                readers.append(name)

    def _guarded(self, name: str, act: Callable[[], object]) -> None:
        """Run a service, then pass its frames to the tap.

        An exception of the tap does not count as one of the service.
        """
        try:
            act()
        except Exception as error:
            raise ServiceFailedError.of(name, error) from error
        finally:
            self._show()

    def _show(self) -> None:
        if not self._sent:
            return
        sent, self._sent = self._sent, []
        for topic, frame in sent:
            if self._hand_over is None:
                self._tap(topic, frame, self.now_ns)
            elif self._hand_over.tapped(topic, self.now_ns):
                self._tap(topic, self._hand_over.frame(frame), self.now_ns)

    def _wanted(self, topic: AnyTopic) -> bool:
        return bool(self._readers.get(topic.key))

    def _outage(self, name: str) -> Outage | None:
        for outage in self._outages[name]:
            if outage.from_ns <= self.now_ns < outage.until_ns:
                return outage
        return None

    def _schedule(self, at_ns: int, rank: int, act: Callable[[], None]) -> None:
        self._sequence += 1
        heapq.heappush(self._events, (at_ns, rank, self._sequence, act))

    def _keep_beating(self, name: str, order: int) -> None:
        busy_until = self._busy_until.get(name, lambda: 0)

        def beat() -> None:
            if self._outage(name) is None and busy_until() <= self.now_ns:
                self._guarded(name, self._workers[name].tick)
            pace = self._workers[name].service.trigger  # its period may have changed
            assert isinstance(pace, Every)
            self._schedule(self.now_ns + pace.period_ns, order, beat)

        self._schedule(0, order, beat)

    def _send(self, sender: str, topic: AnyTopic, frame: Frame) -> None:
        self._sent.append((topic, frame))
        readers = self._readers.get(topic.key)
        if not readers:
            return
        at_ns = self.now_ns + self._latency_ns[topic.key]
        if self._radio is None:
            self._schedule(at_ns, -1, lambda: self._deliver(topic, frame, readers))
            return
        far = [reader for reader in readers if self._radio.crosses(sender, reader)]
        if len(far) < len(readers):
            self._schedule(at_ns, -1, lambda: self._deliver(topic, frame, [name for name in readers if name not in far]))
        if not far:
            return
        there_ns = self._radio.arrival_ns(topic, sender, len(frame), at_ns)
        if there_ns is not None:
            self._schedule(there_ns, -1, lambda: self._deliver(topic, frame, far))

    def _deliver(self, topic: AnyTopic, frame: Frame, readers: Iterable[str]) -> None:
        for name in readers:
            outage = self._outage(name)
            if outage is not None and outage.kill:
                continue
            worker = self._workers[name]
            worker.inbox.receive(topic, frame, self.now_ns)  # a hung service reads it later
            if outage is None and topic in worker.triggers:
                self._guarded(name, worker.arrived)


class _DecodedOnce:
    """Decodes a frame once for all its readers.

    They can share a message, because messages are frozen and their arrays are read-only.
    """

    def __init__(self) -> None:
        self._newest: dict[type[Message], tuple[bytes, tuple[Any, codec.Timing]]] = {}

    def __call__(self, frame: bytes, kind: type[M], max_bytes: int, /) -> tuple[M, codec.Timing]:
        known = self._newest.get(kind)
        if known is not None and known[0] is frame:
            return known[1]
        decoded = codec.decode(frame, kind, max_bytes)
        self._newest[kind] = frame, decoded
        return decoded
