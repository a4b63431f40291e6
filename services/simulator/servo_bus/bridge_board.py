"""A simulated microcontroller board: the reference firmware between a host's line and the emulated servo bus."""

from collections import deque
from typing import Protocol

from sextant.services.simulator.servo_bus.bridge_firmware import Firmware
from sextant.services.simulator.servo_bus.bus import BusTiming
from sextant.services.simulator.servo_bus.host_link import Outbox, Outlet, Reply, Wire

_OUTBOX = 8  # frames that wait for a host that does not read; the oldest go
_START_NS = 300_000_000  # [ns] a microcontroller takes to start


class Servos(Wire, Protocol):
    """The bus that the board is wired to."""

    def advance(self, now_ns: int) -> None:
        """Let what was written by now take effect."""


class Board:
    """The other end of a host's port, in place of the bus itself. No thread, no clock: times come in as arguments."""

    def __init__(self, bus: Servos, link: BusTiming | None = None) -> None:
        """Wire the board up; it is switched on when it first hears of the time.

        Args:
            bus: The servos, wired to the board: without a USB adapter's time.
            link: What the line to the host costs; by default 1 Mbit/s and a USB frame.
        """
        self.firmware = Firmware(boot=1)
        self.boots = 1
        self._bus = bus
        self._link = link or BusTiming()
        self._now_ns = -1
        self._from_host: deque[Reply] = deque()  # what is on its way, and when it is there
        self._from_bus = Outbox()
        self._outbox: deque[Reply] = deque(maxlen=_OUTBOX)
        self._in_free_ns = self._out_free_ns = 0  # until when the line is taken
        self._dead_until_ns = 0

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Take bytes that the host sends at a time; return what there is for it, with the time it has it."""
        self._in_free_ns = max(now_ns, self._in_free_ns) + self._link.wire_ns(len(data))
        self._from_host.append(Reply(self._in_free_ns, data))
        return self.speak(now_ns)

    def speak(self, now_ns: int) -> list[Reply]:
        """What it has said by now without being asked."""
        self._run(now_ns)
        said = list(self._outbox)
        self._outbox.clear()
        return said

    @property
    def due_ns(self) -> int:
        """[ns] when something happens on it next."""
        ends = (self._from_host[0].due_ns if self._from_host else None, self._from_bus.due_ns)
        return max(min([self.firmware.due_ns, *(end for end in ends if end is not None)]), self._dead_until_ns)

    def outlet(self, now_ns: int) -> Outlet | None:
        """How the board is reached: an adapter that is unplugged is the board's own cable."""
        return self._bus.outlet(now_ns)

    def advance(self, now_ns: int) -> None:
        """Let time pass, and what was written to the servos by now take effect. Call before each physics step."""
        self._run(now_ns)
        self._bus.advance(now_ns)

    def restart(self, now_ns: int) -> None:
        """Press the reset button: all is forgotten, and the servos stay as they are."""
        self._run(now_ns)
        self.boots += 1
        self._dead_until_ns = self._now_ns + _START_NS
        self.firmware = Firmware(self.boots, self._dead_until_ns)
        self._from_host.clear()
        self._outbox.clear()
        self._from_bus = Outbox()

    def _run(self, now_ns: int) -> None:
        """Give the firmware the time and the bytes, each as it comes."""
        if self._now_ns < 0:
            self._now_ns = now_ns
            self.firmware = Firmware(self.boots, now_ns)
        while (at_ns := max(self.due_ns, self._now_ns)) <= now_ns:
            self._now_ns = at_ns
            said = self.firmware.step(at_ns, _arrived(self._from_host, at_ns), self._from_bus.take(at_ns))
            if said.to_bus:
                self._from_bus.put(self._bus.receive(said.to_bus, at_ns))
            if said.to_host:
                self._out_free_ns = max(at_ns, self._out_free_ns) + self._link.wire_ns(len(said.to_host))
                self._outbox.append(Reply(self._out_free_ns + self._link.usb_transaction_ns, said.to_host))


def _arrived(queue: deque[Reply], now_ns: int) -> bytes:
    data = bytearray()
    while queue and queue[0].due_ns <= now_ns:
        data += queue.popleft().data
    return bytes(data)
