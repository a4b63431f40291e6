"""Interface between a host port and the emulated bus.

It covers replies with their times of arrival, and the state of the adapter.
"""

from bisect import insort
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol


class Reply(NamedTuple):
    """Bytes for the host and their time of arrival."""

    due_ns: int  # [ns] time of arrival at the host
    data: bytes
    servo_id: int = -1  # servo that sent the response, -1 for an echo or noise
    parts: tuple[int, ...] = ()  # servos that sent a combined response, in their order


class AdapterPort(NamedTuple):
    """Identity of the port of a USB adapter.

    A host can use an open port only while the identity does not change.
    """

    name: int = 0  # number of the device name; increases with each return under another name
    times: int = 0  # number of times that the adapter was unplugged


class HostLink(Protocol):
    """Protocol of a device at a host port: the servo bus, or a board in front of it."""

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes that the host sends at a time [ns], and return the replies."""

    def adapter_port(self, now_ns: int) -> AdapterPort | None:
        """Return the identity of the port at a time [ns], None if it is unplugged."""

    @property
    def due_ns(self) -> int | None:
        """Time [ns] of the next event of the device; None if it only responds to requests."""

    def unsolicited_replies(self, now_ns: int) -> list[Reply]:
        """Return the unsolicited replies up to a time [ns]."""


class EmulatedBus(HostLink, Protocol):
    """Protocol of the servos' bus, or of a board that sends them pulses."""

    overhear: Callable[[bytes, int], object]  # receives the arriving bytes and their time [ns]

    def cut_off(self, rows: frozenset[int]) -> None:
        """Disconnect the servos in these rows from the bus, and connect all others."""

    def advance(self, now_ns: int) -> None:
        """Apply what has reached the servos by a time [ns]."""


class AnswersOnly:
    """Mixin for a `HostLink` that only responds to requests."""

    @property
    def due_ns(self) -> int | None:
        """None, because the device has no events without a request."""
        return None

    def unsolicited_replies(self, now_ns: int) -> list[Reply]:
        """Return no unsolicited replies."""
        return []


class Outbox:
    """Queue of replies to the host, ordered by time of arrival."""

    def __init__(self) -> None:
        self._replies: list[Reply] = []

    def put(self, replies: Iterable[Reply]) -> None:
        """Add replies, with any times of arrival."""
        for reply in replies:
            if self._replies and reply.due_ns < self._replies[-1].due_ns:  # e.g. if an earlier reply is delayed by a fault
                insort(self._replies, reply, key=lambda other: other.due_ns)
            else:
                self._replies.append(reply)

    @property
    def due_ns(self) -> int | None:
        """Time of arrival [ns] of the next reply, None without one."""
        return self._replies[0].due_ns if self._replies else None

    def take(self, now_ns: int) -> bytes:
        """Remove and return the bytes that have arrived by a time [ns]."""
        data = b""
        while self._replies and self._replies[0].due_ns <= now_ns:
            data += self._replies.pop(0).data
        return data
