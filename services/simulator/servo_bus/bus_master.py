"""Master of the half-duplex servo bus, a part of the bridge firmware.

It sends one packet at a time and matches responses to requests.
"""

from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import PacketParser
from sextant.shared.servo.servo_model import Packet

TIMEOUT_NS = 2_000_000  # [ns] from the end of a request: twice the sum of factory return delay and transfer of a whole table
BYTE_NS = 10_000  # [ns] duration of a byte at 1 Mbit/s

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _Question(Generic[T]):
    servo_id: int
    size: int  # number of parameters of a valid response
    about: T
    began_ns: int
    until_ns: int  # [ns] time of the timeout


class Closed(NamedTuple, Generic[T]):
    """Completed request, with its response or None after a timeout."""

    about: T
    began_ns: int
    packet: Packet | None


class BusMaster(Generic[T]):
    """Bus master that matches responses to requests.

    `T` is the type of the caller's data of a request.
    """

    def __init__(self, now_ns: int):
        """Start with an idle bus."""
        self.silent = 0  # number of requests without a response
        self.garbled = 0  # number of packets that were not requested or have a wrong size
        self._parser = PacketParser(max_length=dxl.TABLE_SIZE + 2)
        self._question: _Question[T] | None = None
        self._free_ns = now_ns

    @property
    def broken(self) -> int:
        """Number of unusable packets, including broken packets and noise."""
        return self.garbled + self._parser.dropped.total()

    @property
    def due_ns(self) -> int:
        """Latest time [ns] at which the bus is free again."""
        return self._question.until_ns if self._question else self._free_ns

    @property
    def waits(self) -> bool:
        """Whether a request is pending."""
        return self._question is not None

    def tell(self, packet: bytes, now_ns: int) -> bytes:
        """Start a packet without a response, and return its bytes."""
        self._free_ns = now_ns + len(packet) * BYTE_NS
        return packet

    def ask(self, packet: bytes, servo_id: int, size: int, about: T, now_ns: int) -> bytes:
        """Start a request to one servo, and return its bytes.

        A valid response has `size` parameters; a response that refuses the request has none.
        """
        until_ns = now_ns + len(packet) * BYTE_NS + TIMEOUT_NS
        self._question = _Question(servo_id, size, about, now_ns, until_ns)
        return packet

    def hear(self, data: bytes, now_ns: int) -> list[Closed[T]]:
        """Process bytes from the servos, and return the completed requests.

        A request is completed by a response or by its timeout.
        """
        closed: list[Closed[T]] = []
        for packet in self._parser.feed(data):
            question = self._question
            answers = question is not None and packet.servo_id == question.servo_id
            if question is None or not answers or len(packet.parameters) not in (0, question.size):
                self.garbled += 1
            else:
                closed.append(self._close(question, packet, now_ns))
        if self._question and now_ns >= self._question.until_ns:
            self._parser.flush()
            self.silent += 1
            closed.append(self._close(self._question, None, now_ns))
        return closed

    def forget(self) -> None:
        """Cancel the pending request.

        The bus stays reserved until its timeout, to prevent a collision.
        """
        self._free_ns, self._question = self.due_ns, None

    def _close(self, question: _Question[T], packet: Packet | None, now_ns: int) -> Closed[T]:
        self._question, self._free_ns = None, now_ns
        return Closed(question.about, question.began_ns, packet)
