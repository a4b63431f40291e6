"""Simulated bridge board.

It runs the firmware of real boards between a host port and the emulated servo bus.
"""

from collections import deque
from typing import Protocol

from sextant.services.simulator.servo_bus.bus import BusTiming
from sextant.services.simulator.servo_bus.host_link import AdapterPort, HostLink, Outbox, Reply
from sextant.shared.servo.firmware.board import firmware_for
from sextant.shared.servo.firmware.bridge import Firmware
from sextant.shared.servo.models import AX_12A
from sextant.shared.servo.pwm import Pulses
from sextant.shared.servo.servo_model import ServoModel

_OUTBOX = 8  # maximum number of frames that wait for a host that does not read; the oldest are dropped
_NS_PER_US = 1_000
_NAME = "simulated board"
_START_NS = 300_000_000  # [ns] boot time of the microcontroller


class Servos(HostLink, Protocol):
    """Protocol of the bus behind the board."""

    def advance(self, now_ns: int) -> None:
        """Apply the writes up to a time [ns]."""


class Board:
    """Bridge board at a host port, in place of the bus.

    It has neither thread nor clock; times are arguments.
    """

    def __init__(
        self, bus: Servos, link: BusTiming | None = None, model: ServoModel = AX_12A, pulses: Pulses | None = None
    ) -> None:
        """Connect the board; it boots at the first time that it receives.

        Args:
            bus: The servo bus at the rate of the model, without the delay of a USB adapter.
            link: Delays of the link to the host; by default 1 Mbit/s and a USB frame.
            model: The servos for which the board is configured.
            pulses: Their pulses, if they are hobby servos.

        Raises:
            ValueError: The firmware does not know the servos.
        """
        self.boots = 1
        self._model, self._pulses = model, pulses
        self.firmware = self._boot(0)
        self._bus = bus
        self._link = link or BusTiming()
        self._now_ns = -1
        self._from_host: deque[Reply] = deque()  # bytes in transit, with their times of arrival
        self._from_bus = Outbox()
        self._outbox: deque[Reply] = deque(maxlen=_OUTBOX)
        self._in_free_ns = self._out_free_ns = 0  # [ns] times up to which the link is busy, per direction
        self._dead_until_ns = 0

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Process bytes that the host sends at a time [ns]; return all waiting replies."""
        self._in_free_ns = max(now_ns, self._in_free_ns) + self._link.wire_ns(len(data))
        self._from_host.append(Reply(self._in_free_ns, data))
        return self.unsolicited_replies(now_ns)

    def unsolicited_replies(self, now_ns: int) -> list[Reply]:
        """Return the unsolicited replies up to a time [ns]."""
        self._run(now_ns)
        said = list(self._outbox)
        self._outbox.clear()
        return said

    @property
    def due_ns(self) -> int:
        """Time [ns] of the next event on the board."""
        ends = (self._from_host[0].due_ns if self._from_host else None, self._from_bus.due_ns)
        return max(min([self.firmware.due_us * _NS_PER_US, *(end for end in ends if end is not None)]), self._dead_until_ns)

    def adapter_port(self, now_ns: int) -> AdapterPort | None:
        """Return the identity of the port.

        If the adapter is unplugged, the USB cable of the board is unplugged.
        """
        return self._bus.adapter_port(now_ns)

    def advance(self, now_ns: int) -> None:
        """Run the firmware and apply the writes to the servos up to a time [ns].

        Call it before each physics step.
        """
        self._run(now_ns)
        self._bus.advance(now_ns)

    def restart(self, now_ns: int) -> None:
        """Reset the board: the firmware loses its state, and the servos keep theirs."""
        self._run(now_ns)
        self.boots += 1
        self._dead_until_ns = self._now_ns + _START_NS
        self.firmware = self._boot(self._dead_until_ns)
        self._from_host.clear()
        self._outbox.clear()
        self._from_bus = Outbox()

    def _boot(self, now_ns: int) -> Firmware:
        pulses = self._pulses.of_board if self._pulses else ()
        now_us = now_ns // _NS_PER_US
        return firmware_for(self.boots, self._model.name, _NAME, now_us, self._model.bus_rate, pulses=pulses)

    def _run(self, now_ns: int) -> None:
        """Step the firmware through all events up to a time [ns]."""
        if self._now_ns < 0:
            self._now_ns = now_ns
            self.firmware = self._boot(now_ns)
        while (at_ns := max(self.due_ns, self._now_ns)) <= now_ns:
            self._now_ns = at_ns
            received = _arrived(self._from_host, at_ns), self._from_bus.take(at_ns)
            to_host, to_bus = self.firmware.step(at_ns // _NS_PER_US, *received)
            if to_bus:
                self._from_bus.put(self._bus.receive(to_bus, at_ns))
            if to_host:
                self._out_free_ns = max(at_ns, self._out_free_ns) + self._link.wire_ns(len(to_host))
                self._outbox.append(Reply(self._out_free_ns + self._link.usb_transaction_ns, to_host))


def _arrived(queue: deque[Reply], now_ns: int) -> bytes:
    data = bytearray()
    while queue and queue[0].due_ns <= now_ns:
        data += queue.popleft().data
    return bytes(data)
