"""A service goes through made-up messages before it begins, so that nothing is compiled while a robot waits for it.

What is compiled is compiled for the types that it is called with, and arrays that came in a message are of another type than
those that were made here: so the messages go through the codec.
"""

from sextant.shared.runtime.service import Every, Service, Worker
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message


class Rehearsal:
    """Steps a service that is none of the robot's, and sends nobody what it makes."""

    def __init__(self, service: Service):
        """Begin at a time of its own."""
        self._now_ns = 0
        self._paced_by = service.paced_by
        self._worker = Worker(service, lambda _topic, _frame, _at_ns: None, lambda: self._now_ns)

    def hear(self, message: Message) -> None:
        """Let a message come in at the time of its stamp [ns]; the service steps where that is what paces it."""
        topic = topics.OF_TYPE[type(message)]
        if topic not in self._worker.reads:
            return
        self._now_ns = max(self._now_ns, message.stamp_ns)
        self._worker.inbox.receive(topic, codec.encode(message), self._now_ns)
        if topic is self._paced_by:
            self._worker.arrived()

    def tick(self, for_s: float) -> None:
        """Let a service that its own clock paces step through some time [s]."""
        assert isinstance(self._paced_by, Every)
        for _ in range(round(for_s * 1e9 / self._paced_by.period_ns)):
            self._now_ns += self._paced_by.period_ns
            self._worker.tick()
