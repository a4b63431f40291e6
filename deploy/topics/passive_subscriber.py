"""Passive subscriber: frames are queued at once and read when there is time."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from sextant.shared.runtime.service import AnyTopic
from sextant.shared.runtime.zenoh_runner import Link
from sextant.shared.wire import topics
from sextant.shared.wire.codec import Label
from sextant.shared.wire.topics import Delivery

# These topics are large (a megabyte per frame), and a camera records colour only for subscribers: subscribe them by name only.
ONLY_BY_NAME: tuple[AnyTopic, ...] = (topics.DEPTH, topics.EXTERNAL_DEPTH, topics.COLOR, topics.PREVIEW, topics.FLOOR)
_QUEUE = 256  # most frames of an EVERY topic that may wait
_SAME_CLOCK_NS = 10_000_000_000  # [ns] a frame whose age is negative or larger than this is stamped by another machine's clock
_AHEAD_NS = 20_000_000  # [ns] a simulator stamps what it has computed, up to this time before it is due


def topics_named(keys: Sequence[str], namespace: str) -> tuple[AnyTopic, ...]:
    """Return the topics of some keys, with or without the namespace; without keys, all except the large ones.

    Raises:
        ValueError: Unknown key, with the nearest match.
    """
    if keys:
        return tuple(dict.fromkeys(topics.topic_named(key, namespace) for key in keys))
    return tuple(topic for topic in topics.TOPICS if topic not in ONLY_BY_NAME)


def listen(
    link: Link, wanted: Iterable[AnyTopic], take: Callable[[AnyTopic, bytes, int], None], clock: Callable[[], int]
) -> None:
    """Call `take` with each frame of some topics and its time of arrival [ns].

    Frames of state topics are all delivered, too.
    """

    def heard(topic: AnyTopic) -> Callable[[AnyTopic, bytes], None]:
        return lambda _, frame: take(topic, frame, clock())

    for topic in wanted:
        link.subscribe(replace(topic, delivery=Delivery.EVERY), heard(topic))


def age_ns(label: Label, at_ns: int) -> int | None:
    """Return the age [ns] of a frame's message when it arrived.

    None if it is stamped by another machine's clock.
    """
    sent_ns = label.timing.sent_ns or label.stamp_ns
    age = at_ns - label.stamp_ns
    return None if not 0 <= at_ns - sent_ns <= _SAME_CLOCK_NS else max(age, 0) if age > -_AHEAD_NS else age


@dataclass(frozen=True, slots=True)
class ReceivedMessage:
    """One received frame."""

    topic: AnyTopic
    frame: bytes
    at_ns: int  # time of arrival
    passed_over: int  # frames of its topic that were dropped since the last call of `drain`


class Mailbox:
    """Received frames that wait to be read.

    It keeps the newest frame of a state topic, and all of an event topic up to a limit.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, deque[tuple[AnyTopic, bytes, int]]] = {}
        self._lost: dict[str, int] = {}
        self._lock = threading.Lock()
        self.news = threading.Event()  # set whenever a frame arrives

    def take(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Add a frame, from any thread; never blocks."""
        with self._lock:
            queue = self._waiting.get(topic.key)
            if queue is None:
                queue = self._waiting[topic.key] = deque(maxlen=1 if topic.delivery is Delivery.LATEST else _QUEUE)
            if len(queue) == queue.maxlen:
                self._lost[topic.key] = self._lost.get(topic.key, 0) + 1
            queue.append((topic, frame, at_ns))
        self.news.set()

    def drain(self) -> list[ReceivedMessage]:
        """Return the frames since the last call, in order of arrival."""
        self.news.clear()
        with self._lock:
            found = [entry for queue in self._waiting.values() for entry in queue]
            lost, self._lost = self._lost, {}
            self._waiting.clear()
        found.sort(key=lambda entry: entry[2])
        return [ReceivedMessage(topic, frame, at_ns, lost.pop(topic.key, 0)) for topic, frame, at_ns in found]
