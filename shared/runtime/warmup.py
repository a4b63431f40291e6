"""Warm-up of a service with synthetic messages.

It compiles all functions before the robot needs them.

Numba compiles a function for the types of its arguments. Arrays from a received message have another type than new arrays
(they are read-only), so the synthetic messages pass through the codec.
"""

from sextant.shared.runtime.service import Every, Service, ServiceRunner
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message


class WarmupRunner:
    """Runs a separate instance of a service and discards its messages."""

    def __init__(self, service: Service):
        """Start at time zero."""
        self._now_ns = 0
        self._trigger = service.trigger
        self._worker = ServiceRunner(service, lambda _topic, _frame, _at_ns: None, lambda: self._now_ns)

    def deliver(self, message: Message) -> None:
        """Deliver a message at the time of its stamp [ns], if the service subscribes to its topic.

        If the topic is a trigger, the service runs a step.
        """
        topic = topics.OF_TYPE[type(message)]
        if topic not in self._worker.subscribes:
            return
        self._now_ns = max(self._now_ns, message.stamp_ns)
        self._worker.inbox.receive(topic, codec.encode(message), self._now_ns)
        if topic in self._worker.triggers:
            self._worker.arrived()

    def tick(self, for_s: float) -> None:
        """Run the cycles of a periodic service for some time [s]."""
        assert isinstance(self._trigger, Every)
        for _ in range(round(for_s * 1e9 / self._trigger.period_ns)):
            self._now_ns += self._trigger.period_ns
            self._worker.tick()
