"""Byte stream channel between two machines, for relays without access to packets.

This module is pure. TCP retransmits a lost packet: its data arrives later, and with it all data behind it. During an outage
nothing arrives; afterwards everything does, as with TCP's retransmissions.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sextant.shared.scenario.scenario import Link

SEGMENT = 1348  # [bytes] of a stream in one packet, plus 52 of headers
QUEUE_BYTES = 150_000  # [bytes] queue for the channel; when full, no more data is accepted
AGAIN_NS = 200_000_000  # [ns] until a lost packet is retransmitted: the minimum of Linux
_HEADERS = 52  # [bytes]


class RadioOutages:
    """One direction of a radio, shared by several connections."""

    def __init__(self, link: Link, seed: int):
        """Initialise; the link's rate applies to this direction, `seed` to its losses."""
        self.carried = self.packets = self.lost = 0  # [bytes], packets, and retransmitted packets
        self._link = link
        self._rng = np.random.default_rng(seed)
        self._free_ns = 0.0  # [ns] when the channel is free
        self._cut = False
        self._open_ns = 0  # [ns] when data delayed by an outage starts to arrive

    def cut(self) -> None:
        """Start an outage."""
        self._cut = True

    def mend(self, now_ns: int) -> None:
        """End the outage; data arrives after the next retransmission."""
        self._cut, self._open_ns = False, now_ns + (AGAIN_NS if self._cut else 0)

    def opens_ns(self) -> int | None:
        """Return the time [ns] from which data arrives; None during an outage."""
        return None if self._cut else self._open_ns

    def take(self, size: int, now_ns: int) -> int:
        """Return the arrival time [ns] of `size` bytes sent at `now_ns`."""
        size += _HEADERS
        tries = 1 + (int(self._rng.geometric(1.0 - self._link.loss)) - 1 if self._link.loss else 0)
        per_byte = 8e3 / self._link.mbit if self._link.mbit else 0.0
        self._free_ns = max(self._free_ns, now_ns) + tries * size * per_byte
        self.packets, self.lost = self.packets + 1, self.lost + tries - 1
        return round(self._free_ns + 1e6 * self._link.delay_ms) + (tries - 1) * AGAIN_NS


@dataclass(slots=True)
class _UnderWay:
    due_ns: int
    data: bytes


class Stream:
    """One direction of one connection."""

    def __init__(self, air: RadioOutages):
        """Use a channel that may be shared."""
        self.waiting = 0  # [bytes] in transit
        self._air = air
        self._under_way: deque[_UnderWay] = deque()

    def send(self, data: bytes, now_ns: int) -> None:
        """Send bytes at a time [ns]."""
        for begin in range(0, len(data), SEGMENT):
            segment = data[begin : begin + SEGMENT]
            behind_ns = self._under_way[-1].due_ns if self._under_way else 0
            self._under_way.append(_UnderWay(max(self._air.take(len(segment), now_ns), behind_ns), segment))
            self.waiting += len(segment)

    def arrived(self, now_ns: int) -> bytes:
        """Return the bytes received by a time [ns], in order."""
        there: list[bytes] = []
        while (due_ns := self.due_ns) is not None and due_ns <= now_ns:
            there.append(self._under_way.popleft().data)
        data = b"".join(there)
        self.waiting -= len(data)
        self._air.carried += len(data)
        return data

    @property
    def due_ns(self) -> int | None:
        """Arrival time [ns] of the next bytes, or None if nothing can arrive."""
        opens_ns = self._air.opens_ns()
        return max(self._under_way[0].due_ns, opens_ns) if self._under_way and opens_ns is not None else None
