"""Packet channel between two machines, with queueing, delay and loss.

This module is pure.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sextant.shared.scenario.scenario import Link

QUEUE_BYTES = 150_000  # [bytes] queue for the channel; further packets are dropped, as in a radio's buffer
_DRAWS = 4096  # random numbers drawn at once


@dataclass(slots=True)
class _UnderWay:
    due_ns: int
    packet: bytes


class Channel:
    """One direction of a radio."""

    def __init__(self, link: Link, seed: int):
        """Initialise an idle channel.

        Args:
            link: Delay, rate and loss; the rate applies to this direction alone.
            seed: Random seed of the losses.
        """
        self.dropped = 0  # packets lost, rejected by the full queue, or sent during an outage
        self.carried = 0  # [bytes] received
        self.packets = 0  # packets received
        self.cut = False
        self._delay_ns = round(link.delay_ms * 1e6)
        self._ns_per_byte = 8e3 / link.mbit if link.mbit else 0.0
        self._loss = link.loss
        self._rng = np.random.default_rng(seed)
        self._draws: list[float] = []
        self._free_ns = 0.0  # [ns] when the channel is free
        self._under_way: deque[_UnderWay] = deque()

    def send(self, packet: bytes, now_ns: int) -> None:
        """Send a packet at a time [ns]."""
        waits_ns = max(self._free_ns - now_ns, 0.0)
        if self.cut or waits_ns > QUEUE_BYTES * self._ns_per_byte > 0.0:
            self.dropped += 1
            return
        self._free_ns = max(self._free_ns, now_ns) + len(packet) * self._ns_per_byte
        if self._loss and self._draw() < self._loss:  # it has occupied the channel all the same
            self.dropped += 1
            return
        self._under_way.append(_UnderWay(round(self._free_ns) + self._delay_ns, packet))

    def arrived(self, now_ns: int) -> list[bytes]:
        """Return the packets received by a time [ns], in order."""
        there: list[bytes] = []
        while self._under_way and self._under_way[0].due_ns <= now_ns:
            packet = self._under_way.popleft().packet
            if self.cut:
                self.dropped += 1
            else:
                self.carried += len(packet)
                self.packets += 1
                there.append(packet)
        return there

    @property
    def due_ns(self) -> int | None:
        """Time [ns] at which the next packet arrives, or None."""
        return self._under_way[0].due_ns if self._under_way else None

    def _draw(self) -> float:
        if not self._draws:
            self._draws = self._rng.random(_DRAWS).tolist()
        return self._draws.pop()
