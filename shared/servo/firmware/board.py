"""The firmware on a board: its ports and its clock. `main.py` gives it the hardware, tests give it stand-ins."""

from .bridge import CYCLE_US, Firmware
from .commands import CommandFirmware
from .pulse_senders import MAESTRO
from .pulse_senders import NAME as PULSES
from .pulses import PulseFirmware
from .servo import ServoModel

MAX_BYTES = 512  # [bytes] that are read from the host at once


class Clock:
    """Time since the start in microseconds, which never wraps, from a counter that does."""

    def __init__(self, ticks_us: object, ticks_diff: object):
        """Start at 0.

        Args:
            ticks_us: The counter, `time.ticks_us`.
            ticks_diff: Difference of two of its values, `time.ticks_diff`. It holds for a few minutes.
        """
        self._ticks_us, self._ticks_diff = ticks_us, ticks_diff
        self._last = ticks_us()  # type: ignore[operator]
        self._now_us = 0

    def now_us(self) -> int:
        """Return the time [us]."""
        ticks = self._ticks_us()  # type: ignore[operator]
        self._now_us += self._ticks_diff(ticks, self._last)  # type: ignore[operator]
        self._last = ticks
        return self._now_us


class UartPort:
    """A `machine.UART`, full duplex to the host or half duplex to the servos."""

    def __init__(self, uart, direction=None, sends: int = 1, echo: bool = False):  # type: ignore[no-untyped-def]
        """Take over an open UART.

        Args:
            uart: A `machine.UART` with a read timeout of 0.
            direction: Pin that switches the transceiver, or None.
            sends: Level of the pin while the board sends.
            echo: Whether the board receives what it sends; exactly these bytes are dropped.
        """
        self._uart, self._direction, self._sends, self._echo = uart, direction, sends, echo
        self._to_drop = 0  # bytes of the echo that have not arrived
        if direction is not None:
            direction.value(1 - sends)

    def read(self) -> bytes:
        """Return the received bytes."""
        count = self._uart.any()
        data = (self._uart.read(count) or b"") if count else b""
        if data and self._to_drop:
            dropped = min(self._to_drop, len(data))
            self._to_drop -= dropped
            data = data[dropped:]
        return data

    def write(self, data: bytes) -> None:
        """Send bytes; with a direction pin, return after the last bit, when the transceiver receives again."""
        if self._direction is not None:
            self._direction.value(self._sends)
        if self._echo:
            self._to_drop = len(data)
        sent = self._uart.write(data) or 0
        while sent < len(data):
            sent += self._uart.write(data[sent:]) or 0
        if self._direction is not None:
            while not self._uart.txdone():
                pass
            self._direction.value(1 - self._sends)


class StreamPort:
    """The USB port of the board, on which MicroPython otherwise has its prompt."""

    def __init__(self, received, sent, poll):  # type: ignore[no-untyped-def]
        """Take over the port.

        Args:
            received: Stream of bytes, `sys.stdin.buffer`.
            sent: Stream of bytes, `sys.stdout.buffer`.
            poll: Returns whether a byte has been received.
        """
        self._received, self._sent, self._poll = received, sent, poll

    def read(self) -> bytes:
        """Return the received bytes."""
        data = bytearray()
        while len(data) < MAX_BYTES and self._poll():
            data += self._received.read(1)
        return bytes(data)

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._sent.write(data)


class I2cPort:
    """A `machine.I2C` with the chips that send pulses to hobby servos; transfers are those of `pulse_senders.Pca9685`."""

    def __init__(self, i2c):  # type: ignore[no-untyped-def]
        """Take over an open bus."""
        self._i2c = i2c
        self._answers = b""

    def read(self) -> bytes:
        """Return the answers."""
        data, self._answers = self._answers, b""
        return data

    def write(self, data: bytes) -> None:
        """Execute one transfer."""
        address, _, size = data[:3]
        try:
            self._i2c.writeto(address, data[3:], not size)
            self._answers += b"\1" + (self._i2c.readfrom(address, size) if size else b"")
        except OSError:  # no chip has acknowledged
            self._answers += bytes(1 + size)


def open_bus(machine, config) -> object:  # type: ignore[no-untyped-def]
    """Open the UART of the servos or of a Maestro, or the I2C bus of the chips that send pulses."""
    has_maestro = config.SERVO == PULSES and config.PULSES[0] == MAESTRO
    if config.SERVO == PULSES and not has_maestro:
        pins = {} if config.I2C_SCL is None else {"scl": machine.Pin(config.I2C_SCL), "sda": machine.Pin(config.I2C_SDA)}
        return I2cPort(machine.I2C(config.I2C_BUS, freq=400_000, **pins))
    uart = _open_uart(machine, config, config.BUS_UART, config.BAUD_RATE, config.BUS_TX, config.BUS_RX)
    if has_maestro:
        return UartPort(uart)  # full duplex
    pin = None if config.DIRECTION is None else machine.Pin(config.DIRECTION, machine.Pin.OUT)
    return UartPort(uart, pin, config.DIRECTION_SENDS, config.ECHO)


def open_host(machine, config, usb) -> object:  # type: ignore[no-untyped-def]
    """Open the port to the host: the UART of the settings, or USB without one."""
    if config.HOST_UART is None:
        return usb
    return UartPort(_open_uart(machine, config, config.HOST_UART, config.HOST_BAUD_RATE, config.HOST_TX, config.HOST_RX))


def _open_uart(machine, config, number: int, rate: int, tx: object, rx: object):  # type: ignore[no-untyped-def]
    options = {"baudrate": rate, "bits": 8, "parity": None, "stop": 1, "timeout": 0}
    options.update(config.UART_OPTIONS)
    if tx is not None:
        options["tx"], options["rx"] = machine.Pin(tx), machine.Pin(rx)
    return machine.UART(number, **options)


def firmware_for(
    boot: int,
    servo: str,
    name: str,
    now_us: int,
    baud_rate: int = 1_000_000,
    cycle_us: int = CYCLE_US,
    pulses: tuple = (),
) -> Firmware:
    """Return the firmware for servos with registers, commands or pulses; see `Firmware`."""
    if servo == PULSES:
        return PulseFirmware(boot, pulses, name, now_us, baud_rate, cycle_us)
    kind = CommandFirmware if ServoModel(servo).has_commands else Firmware
    return kind(boot, servo, name, now_us, baud_rate, cycle_us)


def start(config, boot: int, now_us: int) -> Firmware:  # type: ignore[no-untyped-def]
    """Return the firmware for the servos of the settings."""
    return firmware_for(boot, config.SERVO, config.NAME, now_us, config.BAUD_RATE, config.CYCLE_MS * 1000, config.PULSES)


def turn(firmware: Firmware, clock: Clock, host, bus) -> None:  # type: ignore[no-untyped-def]
    """Pass the received bytes to the firmware, and send what it returns."""
    to_host, to_bus = firmware.step(clock.now_us(), host.read(), bus.read())
    if to_bus:  # first, because the servos take longer
        bus.write(to_bus)
    if to_host:
        host.write(to_host)
