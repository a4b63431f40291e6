"""In-process serial port of an emulated bus or board."""

from collections.abc import Callable

from sextant.services.simulator.servo_bus.host_link import HostLink, Outbox

_SEC = 1_000_000_000


class MemoryPort:
    """Serial port of an emulated bus or board in the same process, for lockstep.

    It implements the part of pyserial's interface that the driver uses. Its virtual time is the later of the given clock and
    its last transfer. A read advances virtual time instead of sleeping, so the driver observes the delays of the real bus
    without waiting.
    """

    def __init__(
        self, bus: HostLink, clock: Callable[[], int], timeout: float | None = 0.006, name: int | None = None, start_ns: int = 0
    ) -> None:
        """Open the port.

        Args:
            bus: The emulated bus; the caller must also call its `advance`.
            clock: Simulated time [ns].
            timeout: Maximum wait of a read [s]; None and 0 both mean no wait, because no other event advances virtual time.
            name: Name of the port, as in `AdapterPort`; None for any name.
            start_ns: Minimum of virtual time, e.g. the time of a previous port, so that a clock based on both is monotonic.

        Raises:
            OSError: The adapter is unplugged, or its port has another name.
        """
        self.timeout = timeout
        self.is_open = True
        self._bus = bus
        self._clock = clock
        self._last_ns = start_ns
        self._outbox = Outbox()
        self._buffer = bytearray()  # bytes that have arrived and are not read
        self._adapter_port = bus.adapter_port(self.now_ns())
        if self._adapter_port is None or name not in (None, self._adapter_port.name):
            found = "none" if self._adapter_port is None else f"{self._adapter_port.name}"
            raise OSError(f"port {'any' if name is None else name} of the simulated bus expected, found {found}")

    def now_ns(self) -> int:
        """Return virtual time [ns]; use it as the driver's clock."""
        return max(self._clock(), self._last_ns)

    @property
    def last_ns(self) -> int:
        """Time [ns] of the last transfer."""
        return self._last_ns

    @property
    def in_waiting(self) -> int:
        """Number of bytes that a read returns without waiting."""
        self._collect(self._check_open())
        return len(self._buffer)

    def write(self, data: bytes) -> int:
        """Send bytes now; the adapter's buffer accepts them without delay."""
        now = self._check_open()
        self._last_ns = now
        self._outbox.put(self._bus.receive(bytes(data), now))
        return len(data)

    def read(self, size: int = 1) -> bytes:
        """Read up to `size` bytes.

        The read returns once they have arrived, or returns fewer bytes after the timeout.
        """
        now = self._check_open()
        deadline = now + round((self.timeout or 0.0) * _SEC)
        self._outbox.put(self._bus.unsolicited_replies(deadline))
        self._collect(now)
        while len(self._buffer) < size and (due_ns := self._outbox.due_ns) is not None and due_ns <= deadline:
            now = max(now, due_ns)
            self._collect(now)
        if len(self._buffer) < size:
            now = deadline
        self._last_ns = max(self._last_ns, now)
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        return data

    def reset_input_buffer(self) -> None:
        """Discard the bytes that have arrived."""
        self._collect(self._check_open())
        self._buffer.clear()

    def close(self) -> None:
        """Close the port; later use raises OSError."""
        self.is_open = False

    def _check_open(self) -> int:
        now = self.now_ns()
        if not self.is_open:
            raise OSError("the port is closed; open a new one")
        if self._bus.adapter_port(now) != self._adapter_port:
            raise OSError("the adapter was unplugged; open the port again")
        return now

    def _collect(self, now_ns: int) -> None:
        self._buffer += self._outbox.take(now_ns)
