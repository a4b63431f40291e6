"""Master of the half-duplex servo bus: one packet at a time, and answers matched to requests."""

from .packets import Parser, Protocol1

TIMEOUT_US = 2000  # [us] from the end of a request to the end of its answer, besides the time of its bytes
_BIT_PER_BYTE = 10  # start bit, eight data bits, stop bit


class BusMaster:
    """Bus master; the caller gives each request an object, which it gets back with the answer."""

    def __init__(self, protocol: Protocol1, max_parameters: int, baud_rate: int, now_us: int):
        """Start with an idle bus.

        Args:
            protocol: Protocol of the bus.
            max_parameters: Largest number of parameters of an answer.
            baud_rate: [bit/s].
            now_us: Current time [us].
        """
        self.silent = 0  # number of requests without a response
        self.garbled = 0  # number of packets that were not requested, have a wrong size or impossible values
        self._protocol = protocol
        self._parser = Parser(protocol, max_parameters)
        self._baud_rate = baud_rate
        self._about: object = None  # of the pending request, None without one
        # Of the pending request: servo, and number of parameters and code of a valid response; -1 for any code.
        self._servo_id = self._size = self._code = 0
        self._began_us = self._until_us = 0
        self._free_us = now_us

    @property
    def broken(self) -> int:
        """Number of unusable packets, including broken packets and noise."""
        return self.garbled + self._parser.dropped

    @property
    def due_us(self) -> int:
        """Latest time [us] at which the bus is free again."""
        return self._until_us if self.waits else self._free_us

    @property
    def waits(self) -> bool:
        """Whether a request is pending."""
        return self._about is not None

    def reading_us(self, size: int) -> int:
        """Return the time [us] of a request and its answer with `size` parameters, without delays."""
        return self.bytes_us(len(self._protocol.read(1, 0, size)) + self._protocol.OVERHEAD + size)

    def bytes_us(self, count: int) -> int:
        """Return the time [us] of a number of bytes."""
        return (count * _BIT_PER_BYTE * 1_000_000 + self._baud_rate - 1) // self._baud_rate

    def tell(self, packet: bytes, now_us: int) -> bytes:
        """Start a packet without a response, and return its bytes."""
        self._free_us = now_us + self.bytes_us(len(packet))
        return packet

    def ask(self, packet: bytes, servo_id: int, size: int, about: object, now_us: int) -> bytes:
        """Start a request to one servo, and return its bytes.

        A valid response has `size` parameters; a response that refuses the request has none.
        """
        self._servo_id, self._size, self._about, self._began_us = servo_id, size, about, now_us
        self._code = self._protocol.answer_code(packet)
        self._until_us = now_us + self.bytes_us(len(packet) + self._protocol.OVERHEAD + size) + TIMEOUT_US
        return packet

    def hear(self, data: bytes, now_us: int) -> list[tuple]:
        """Process bytes from the servos, and return the completed requests.

        Returns:
            Of each one the caller's object, its time [us], and the answer: id, error, parameters; None after a timeout.
        """
        closed = []
        for packet in self._parser.feed(data):
            wrong = not self.waits or packet[0] != self._servo_id or len(packet[2]) not in (0, self._size)
            if wrong or self._code not in (-1, packet[1]):
                self.garbled += 1
            else:
                closed.append(self._close(packet, now_us))
        if self.waits and now_us >= self._until_us:
            self._parser.flush()
            self.silent += 1
            closed.append(self._close(None, now_us))
        return closed

    def forget(self) -> None:
        """Cancel the pending request.

        The bus stays reserved until its timeout, to prevent a collision.
        """
        self._free_us, self._about = self.due_us, None

    def _close(self, packet: tuple | None, now_us: int) -> tuple:
        about, self._about, self._free_us = self._about, None, now_us
        return about, self._began_us, packet
