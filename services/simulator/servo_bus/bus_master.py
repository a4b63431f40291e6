"""The firmware's half of the servo bus: one packet at a time on a half-duplex wire, and whose answer is awaited."""

from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Packet, PacketParser

TIMEOUT_NS = 2_000_000  # [ns] from the end of a request: a factory return delay, a whole table, and as much again
BYTE_NS = 10_000  # [ns] at 1 Mbit/s

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _Question(Generic[T]):
    servo_id: int
    size: int  # parameters of a good answer
    about: T
    began_ns: int
    until_ns: int  # no answer comes later


class Closed(NamedTuple, Generic[T]):
    """A question that has its answer, or will have none."""

    about: T
    began_ns: int
    packet: Packet | None


class BusMaster(Generic[T]):
    """Sends packets to servos, and knows which answer belongs to which question. `T` is what a question is about."""

    def __init__(self, now_ns: int):
        """Take over a wire on which nobody speaks."""
        self.silent = 0  # questions that were left open
        self.garbled = 0  # packets that nobody had asked for, or of the wrong size
        self._parser = PacketParser(max_length=dxl.TABLE_SIZE + 2)
        self._question: _Question[T] | None = None
        self._free_ns = now_ns

    @property
    def broken(self) -> int:
        """Packets and noise that were of no use, asked for or not."""
        return self.garbled + self._parser.dropped.total()

    @property
    def due_ns(self) -> int:
        """[ns] when the wire is free again, at the latest."""
        return self._question.until_ns if self._question else self._free_ns

    @property
    def waits(self) -> bool:
        """Whether an answer is awaited."""
        return self._question is not None

    def tell(self, packet: bytes, now_ns: int) -> bytes:
        """Send what nobody answers."""
        self._free_ns = now_ns + len(packet) * BYTE_NS
        return packet

    def ask(self, packet: bytes, servo_id: int, size: int, about: T, now_ns: int) -> bytes:
        """Send what one servo answers, with so many parameters, or refuses with none."""
        until_ns = now_ns + len(packet) * BYTE_NS + TIMEOUT_NS
        self._question = _Question(servo_id, size, about, now_ns, until_ns)
        return packet

    def hear(self, data: bytes, now_ns: int) -> list[Closed[T]]:
        """Take what the servos have sent by now; the questions that are closed by it, or by time."""
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
        """Await no answer any more, and let none collide with what is sent next."""
        self._free_ns, self._question = self.due_ns, None

    def _close(self, question: _Question[T], packet: Packet | None, now_ns: int) -> Closed[T]:
        self._question, self._free_ns = None, now_ns
        return Closed(question.about, question.began_ns, packet)
