"""What becomes of a connection's bytes between two machines, where only its two ends can be had and no packets. Pure.

A lost packet is sent again by TCP: what it held comes later, and with it all that is behind it. While the air is cut nothing
comes; afterwards everything does, as what TCP still has to send would.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sextant.shared.scenario.scenario import Link

SEGMENT = 1348  # [bytes] of a stream in one packet, beside 52 of headers
QUEUE_BYTES = 150_000  # [bytes] that wait for the air; then nothing more is taken
AGAIN_NS = 200_000_000  # [ns] after which a packet that was lost is sent again: the least that Linux waits
_HEADERS = 52  # [bytes]


class Air:
    """One direction of a radio, which several connections share."""

    def __init__(self, link: Link, seed: int):
        """Of a link whose rate is this direction's own; `seed` of what is lost."""
        self.carried = self.packets = self.lost = 0  # [bytes], packets, and those that had to be sent again
        self._link = link
        self._rng = np.random.default_rng(seed)
        self._free_ns = 0.0  # when it is free
        self._cut = False
        self._open_ns = 0  # from when on what was under way in a cut comes through

    def cut(self) -> None:
        """Let nothing through."""
        self._cut = True

    def mend(self, now_ns: int) -> None:
        """Let everything through again, from when it is sent again."""
        self._cut, self._open_ns = False, now_ns + (AGAIN_NS if self._cut else 0)

    def opens_ns(self) -> int | None:
        """From when on something comes through; None while it is cut."""
        return None if self._cut else self._open_ns

    def take(self, size: int, now_ns: int) -> int:
        """When so many bytes that are sent at a time are there [ns]."""
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

    def __init__(self, air: Air):
        """Through air that others may use, too."""
        self.waiting = 0  # [bytes] that are under way
        self._air = air
        self._under_way: deque[_UnderWay] = deque()

    def send(self, data: bytes, now_ns: int) -> None:
        """Take bytes at a time [ns]."""
        for begin in range(0, len(data), SEGMENT):
            segment = data[begin : begin + SEGMENT]
            behind_ns = self._under_way[-1].due_ns if self._under_way else 0
            self._under_way.append(_UnderWay(max(self._air.take(len(segment), now_ns), behind_ns), segment))
            self.waiting += len(segment)

    def arrived(self, now_ns: int) -> bytes:
        """The bytes that are there by a time [ns], in their order."""
        there: list[bytes] = []
        while (due_ns := self.due_ns) is not None and due_ns <= now_ns:
            there.append(self._under_way.popleft().data)
        data = b"".join(there)
        self.waiting -= len(data)
        self._air.carried += len(data)
        return data

    @property
    def due_ns(self) -> int | None:
        """When the next bytes are there [ns], if any are under way and will come."""
        opens_ns = self._air.opens_ns()
        return max(self._under_way[0].due_ns, opens_ns) if self._under_way and opens_ns is not None else None
