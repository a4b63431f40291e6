"""The host's side of the emulated bus: what it gets and when, and whether there is a port at all."""

from bisect import insort
from collections.abc import Iterable
from typing import NamedTuple, Protocol


class Reply(NamedTuple):
    """Bytes for the host, and when it can have them."""

    due_ns: int
    data: bytes
    servo_id: int = -1  # whose answer it is; -1 for an echo or noise


class Outlet(NamedTuple):
    """How the bus is reached: a port that was opened works as long as this stays the same."""

    name: int = 0  # of the port: 0, then counted up with every return under another name
    times: int = 0  # that it has been pulled out


class Wire(Protocol):
    """What a port is the other end of."""

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Take bytes that the host sends at a time and return what it is to get."""

    def outlet(self, now_ns: int) -> Outlet | None:
        """How the bus is reached now, None while its adapter is unplugged."""

    @property
    def due_ns(self) -> int | None:
        """[ns] when something happens there next of itself; None where questions are answered and that is all."""

    def speak(self, now_ns: int) -> list[Reply]:
        """What it has said by now without being asked."""


class AnswersOnly:
    """The part of a `Wire` that servos have not: to say something of themselves."""

    @property
    def due_ns(self) -> int | None:
        """Never."""
        return None

    def speak(self, now_ns: int) -> list[Reply]:
        """Nothing."""
        return []


class Outbox:
    """Replies on their way to the host, in the order in which they are due."""

    def __init__(self) -> None:
        self._replies: list[Reply] = []

    def put(self, replies: Iterable[Reply]) -> None:
        """Take replies that are due at any time."""
        for reply in replies:
            if self._replies and reply.due_ns < self._replies[-1].due_ns:  # as when an earlier one is late
                insort(self._replies, reply, key=lambda other: other.due_ns)
            else:
                self._replies.append(reply)

    @property
    def due_ns(self) -> int | None:
        """When the next one is due."""
        return self._replies[0].due_ns if self._replies else None

    def take(self, now_ns: int) -> bytes:
        """The bytes that are due by now."""
        data = b""
        while self._replies and self._replies[0].due_ns <= now_ns:
            data += self._replies.pop(0).data
        return data
