"""Radio between robot and base in lockstep: delay, rate, loss and queues.

There is a queue for each lane and direction. Both lanes are TCP streams: a lost packet is sent again, and everything behind it
waits. A loss among several packets is detected after three later packets and one round trip, or else by the kernel's timer. A
message that finds the queue of its lane full is dropped, as Zenoh does. The lanes share the rate: a lane sends when the channel
is free.
"""

import numpy as np

from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.scenario import Link
from sextant.shared.wire.topics import Lane

BASE = frozenset({"mapper", "planner", "console", "recorder", "operator"})  # services on the base; all others are on the robot
_PACKET = 1400  # [bytes]
_OVERHEAD = 80  # [bytes] of TCP, IP and Zenoh per message
_TIMER_NS = 200_000_000  # [ns] least retransmission timeout of Linux
_FOLLOWED = 3  # packets after a loss by which it is detected
_STEADY = 0.1  # [1] weight of the newest gap in the mean gap between a stream's messages
_WAITING = 128 * 1024  # [bytes] of bulk that may wait: the kernel's buffer, and one more message


class Radio:
    """Arrival times of messages that cross the radio; deterministic."""

    def __init__(self, link: Link, seed: int):
        """Initialise from a scenario's link.

        Args:
            link: Properties of the link.
            seed: Random seed of the losses.
        """
        self._delay_ns = round(link.delay_ms * 1e6)
        self._ns_per_byte = 8e3 / link.mbit if link.mbit else 0.0
        self._loss = link.loss
        self._rng = np.random.default_rng([seed, 8])
        self._air_free_ns = 0.0
        self._sent_ns: dict[tuple[Lane, bool], int] = {}  # when a stream's newest message was sent
        self._gap_ns: dict[tuple[Lane, bool], float] = {}  # between its messages
        self._stream_ns: dict[tuple[Lane, bool], float] = {}  # when the newest message of a stream arrives

    def crosses(self, sender: str, reader: str) -> bool:
        """Return whether messages from sender to reader cross the radio."""
        return (sender in BASE) != (reader in BASE)

    def arrival_ns(self, topic: AnyTopic, sender: str, size: int, now_ns: int) -> int | None:
        """Return when [ns] a message of `size` [bytes] arrives, or None if dropped."""
        stream = topic.lane, sender in BASE
        size += _OVERHEAD
        self._note(stream, now_ns)
        waits_ns = max(self._air_free_ns - now_ns, 0.0)
        if topic.lane is Lane.BULK and waits_ns > _WAITING * self._ns_per_byte:
            return None
        # Commands have a separate connection; its packets are interleaved with those of the bulk lane.
        begin_ns = now_ns + (waits_ns if topic.lane is Lane.BULK else min(waits_ns, _PACKET * self._ns_per_byte))
        self._air_free_ns = max(self._air_free_ns, now_ns) + size * self._ns_per_byte
        there_ns = begin_ns + size * self._ns_per_byte + self._delay_ns
        packets = -(-size // _PACKET)
        if self._loss and self._rng.random() < 1.0 - (1.0 - self._loss) ** packets:
            noticed_ns = 0.0 if packets > _FOLLOWED else _FOLLOWED * self._gap_ns.get(stream, np.inf)
            there_ns += 2 * self._delay_ns + min(noticed_ns, _TIMER_NS)
        there_ns = max(there_ns, self._stream_ns.get(stream, 0.0))
        self._stream_ns[stream] = there_ns
        return round(there_ns)

    def _note(self, stream: tuple[Lane, bool], now_ns: int) -> None:
        """Update the mean gap between a stream's messages."""
        before_ns = self._sent_ns.get(stream)
        self._sent_ns[stream] = now_ns
        if before_ns is not None:
            gap_ns = float(now_ns - before_ns)
            self._gap_ns[stream] = (1.0 - _STEADY) * self._gap_ns.get(stream, gap_ns) + _STEADY * gap_ns
