"""Ports in memory for commands: to emulated servos, or to another device that sends text. Their virtual time is the clock."""

import pytest

from sextant.deploy.commands import servo_port, servos
from sextant.services.actuator.commissioning import pulse_commissioning
from sextant.services.actuator.servo_bus import bus_driver
from sextant.services.actuator.servo_bus.serial_port import REPLY_TIMEOUT_NS, Port, open_port
from sextant.services.simulator.servo_bus.host_link import HostLink
from sextant.services.simulator.servo_bus.memory_port import MemoryPort

_LINE_NS = 100_000_000  # [ns] between two lines of text


class Line:
    """Ports in memory, one after the other, to an emulated device or one that sends text."""

    URL = "socket://127.0.0.1:1"

    def __init__(self, device: "HostLink | OtherDevice", monkeypatch: pytest.MonkeyPatch) -> None:
        self._device = device
        for module in (bus_driver, pulse_commissioning):
            monkeypatch.setattr(module, "open_port", self.open)
        monkeypatch.setattr(servos, "time", self)
        monkeypatch.setattr(servo_port, "time", self)
        self._port: MemoryPort | TextPort | None = None

    def monotonic_ns(self) -> int:
        return 0 if self._port is None else self._port.now_ns()

    def open(self, url: str, baud_rate: int = 1_000_000, timeout_ns: int = REPLY_TIMEOUT_NS) -> Port:
        if url != self.URL:
            return open_port(url, baud_rate, timeout_ns)
        start_ns = self.monotonic_ns()
        if isinstance(self._device, OtherDevice):
            self._port = TextPort(self._device, baud_rate, timeout_ns, start_ns)
        else:
            self._port = MemoryPort(self._device, lambda: 0, timeout=timeout_ns * 1e-9, start_ns=start_ns)
        return self._port


class OtherDevice:
    """A device that is no servo: it sends a line ten times a second, or in answer to each request."""

    def __init__(self, text: bytes, *, answers: bool = False, rate: int | None = None, unread: bytes = b"\xe0\x80\xf8") -> None:
        self.text, self.answers, self.rate, self.unread = text, answers, rate, unread

    def at(self, baud_rate: int) -> bytes:
        """Return the bytes that arrive at a baud rate [1/s]."""
        return self.text if self.rate in (None, baud_rate) else self.unread * 10


class TextPort:
    """A serial port to another device."""

    def __init__(self, device: OtherDevice, baud_rate: int, timeout_ns: int, start_ns: int) -> None:
        self.baudrate = baud_rate
        self._device, self._timeout_ns, self._now_ns = device, timeout_ns, start_ns
        self._next_ns = start_ns
        self._buffer = b""

    def now_ns(self) -> int:
        return self._now_ns

    def write(self, data: bytes, /) -> int:
        if self._device.answers:
            self._buffer += self._device.at(self.baudrate)
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        if len(self._buffer) < size:
            self._now_ns += self._timeout_ns
        while not self._device.answers and self._next_ns <= self._now_ns:
            self._buffer += self._device.at(self.baudrate)
            self._next_ns += _LINE_NS
        data, self._buffer = self._buffer[:size], self._buffer[size:]
        return data

    def reset_input_buffer(self) -> None:
        self._buffer = b""

    def close(self) -> None: ...
