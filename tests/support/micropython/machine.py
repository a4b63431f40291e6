"""Stand-in for MicroPython's module `machine`, for CPython and MicroPython: ports whose bytes a test gives and takes."""


class Pin:
    """Output pin that keeps its level."""

    OUT = 1

    def __init__(self, number, mode=0):  # type: ignore[no-untyped-def]
        self.number, self.level = number, 0

    def value(self, level):  # type: ignore[no-untyped-def]
        self.level = level


class UART:
    """Serial port; it sends at most half of its bytes at once, as a board with a full buffer."""

    def __init__(self, number, **options):  # type: ignore[no-untyped-def]
        self.number, self.options = number, options
        self.received, self.sent = b"", b""
        self.pin = None  # direction pin, whose level is checked
        self.busy = 0  # questions whether all is sent that are answered with no

    def any(self):  # type: ignore[no-untyped-def]
        return len(self.received)

    def read(self, count):  # type: ignore[no-untyped-def]
        data, self.received = self.received[:count], self.received[count:]
        return data or None

    def write(self, data):  # type: ignore[no-untyped-def]
        assert self.pin is None or self.pin.level == 1, "sends while the transceiver receives"
        accepted = data[: (len(data) + 1) // 2]
        self.sent += accepted
        self.busy = 3
        return len(accepted)

    def txdone(self):  # type: ignore[no-untyped-def]
        assert self.pin is None or self.pin.level == 1, "the transceiver was switched too early"
        self.busy -= 1
        return self.busy <= 0

    def take(self):  # type: ignore[no-untyped-def]
        """Return what was sent since the last call."""
        data, self.sent = self.sent, b""
        return data


class I2C:
    """I2C bus whose next answer a test gives: 1 and the bytes to read, or a zero if no chip acknowledges."""

    def __init__(self, number, **options):  # type: ignore[no-untyped-def]
        self.number, self.options = number, options
        self.answer, self.sent, self.address = b"", b"", 0

    def writeto(self, address, data, stop):  # type: ignore[no-untyped-def]
        self.address = address
        self.sent += bytes((address, len(data), 0 if stop else len(self.answer) - 1)) + data
        if self.answer[0] != 1:
            raise OSError(19)

    def readfrom(self, address, size):  # type: ignore[no-untyped-def]
        assert address == self.address
        assert size == len(self.answer) - 1
        return self.answer[1:]

    def take(self):  # type: ignore[no-untyped-def]
        """Return the transfers since the last call."""
        data, self.sent = self.sent, b""
        return data


class WDT:
    """Watchdog that ends the program after a number of feeds."""

    left = 0
    before_feed = None  # called before each feed

    def __init__(self, timeout):  # type: ignore[no-untyped-def]
        self.timeout = timeout

    def feed(self):  # type: ignore[no-untyped-def]
        WDT.left -= 1
        if WDT.before_feed:
            WDT.before_feed()
        if WDT.left < 0:
            raise KeyboardInterrupt
