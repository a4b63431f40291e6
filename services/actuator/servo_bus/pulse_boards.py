"""Boards that send pulses to hobby servos: a Pololu Maestro and PCA9685, over a port like pyserial's.

A board cannot measure its servos. It only reports the pulses that it sends.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol

from sextant.services.actuator.servo_bus.serial_port import LOST, Port, gone
from sextant.shared.servo import maestro, pca9685
from sextant.shared.servo.pwm import Pulses

_NO_ANSWER = "no answer"
_US_PER_TARGET = 0.25  # [us] of a Maestro


class PulseBoard(Protocol):
    """Channels that send pulses; one without pulses has a width of 0. Every method raises BusDisconnectedError."""

    lost: Counter[str]  # missing answers and errors of the board, by reason

    def open(self, channels: Sequence[int]) -> str:
        """Prepare the channels without a change of their pulses; return why that fails, or an empty string."""

    def send(self, widths_us: Mapping[int, float]) -> None:
        """Send pulses [us] on some channels, 0 for none."""

    def end_pulses(self, channels: Sequence[int]) -> None:
        """End the pulses of channels, and of all others of a PCA9685."""

    def width_us(self, channel: int) -> float | None:
        """Ask for the pulses [us] of one channel; None without an answer."""


class Maestro:
    """Pololu Maestro on a serial port, with the compact protocol, or with the Pololu protocol for a device number."""

    def __init__(self, port: Port, pulses: Pulses) -> None:
        """Take over an open port."""
        self.lost: Counter[str] = Counter()
        self._port, self._device = port, pulses.device or None

    def open(self, channels: Sequence[int]) -> str:
        """Clear the errors of the board, and remove limits of speed and acceleration."""
        errors = self._ask(maestro.get_errors(self._device), 2)
        if errors is None or maestro.number(errors) > maestro.ALL_ERRORS:  # else another device has sent these bytes
            return "no Maestro answers; check its cable, its USB port and that its serial mode is USB Dual Port"
        for channel in channels:
            self._send(maestro.set_speed(channel, 0, self._device) + maestro.set_acceleration(channel, 0, self._device))
        return ""

    def send(self, widths_us: Mapping[int, float]) -> None:
        """Send pulses with one command for channels that follow each other."""
        targets = {channel: round(width / _US_PER_TARGET) for channel, width in widths_us.items()}
        self._send(
            b"".join(maestro.set_multiple_targets(run[0], [targets[c] for c in run], self._device) for run in _runs(targets))
        )

    def end_pulses(self, channels: Sequence[int]) -> None:
        """Send the target 0."""
        self.send(dict.fromkeys(channels, 0.0))

    def width_us(self, channel: int) -> float | None:
        """Ask for errors and for the position of a channel."""
        answer = self._ask(maestro.get_errors(self._device) + maestro.get_position(channel, self._device), 4)
        if answer is None:
            return None
        if errors := maestro.number(answer[:2]):
            self.lost[f"Maestro: {maestro.error_words(errors) or 'unknown error'}"] += 1
        return maestro.number(answer[2:]) * _US_PER_TARGET

    def _send(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except LOST as error:
            raise gone(error) from error

    def _ask(self, request: bytes, size: int) -> bytes | None:
        return _exchange(self._port, request, size, self.lost)


class Pca9685:
    """PCA9685 on an I2C bus, 16 channels each; a second one has the next address."""

    def __init__(self, port: Port, pulses: Pulses) -> None:
        """Take over an open port for I2C transfers, see `pca9685.frame`."""
        self.lost: Counter[str] = Counter()
        self._port, self._address = port, pulses.device or pca9685.ADDRESS
        hertz = pulses.oscillator_mhz * 1e6
        self._scale = pca9685.pre_scale(pulses.rate_hz, hertz)
        self._count_us = pca9685.count_us(self._scale, hertz)

    def open(self, channels: Sequence[int]) -> str:
        """Wake boards that sleep, without pulses; one that sends pulses must have the right rate."""
        for number in dict.fromkeys(channel // pca9685.CHANNELS for channel in channels):
            address = self._address + number
            mode, scale = self._mode(address), self._read(address, pca9685.PRE_SCALE, 1)
            if mode is None or scale is None:
                return f"no PCA9685 answers at address 0x{address:02x}; check its cable, or `i2cdetect`"
            if not mode & pca9685.SLEEP and scale[0] == self._scale:
                continue
            if not mode & pca9685.SLEEP and any(
                self.width_us(channel) for channel in channels if channel // pca9685.CHANNELS == number
            ):
                return f"the PCA9685 at address 0x{address:02x} sends pulses at another rate; `sextant servos off` first"
            self._wake(address)
        return ""

    def _wake(self, address: int) -> None:
        """Set rate and outputs of a sleeping board that sends no pulses."""
        off = pca9685.channel_registers(0)
        for register, data in (
            (pca9685.MODE1, (pca9685.AUTO_INCREMENT | pca9685.SLEEP,)),
            (pca9685.ALL_LED, off),
            (pca9685.PRE_SCALE, (self._scale,)),
            (pca9685.MODE2, (pca9685.TOTEM_POLE,)),
            (pca9685.MODE1, (pca9685.AWAKE,)),
        ):
            self._write(address, register, data)

    def send(self, widths_us: Mapping[int, float]) -> None:
        """Send pulses with one transfer for channels that follow each other on a board."""
        for run in _runs(widths_us):
            for number in dict.fromkeys(channel // pca9685.CHANNELS for channel in run):
                own = [channel for channel in run if channel // pca9685.CHANNELS == number]
                counts = [round(widths_us[channel] / self._count_us) for channel in own]
                registers = b"".join(map(pca9685.channel_registers, counts))
                self._write(self._address + number, _register_of(own[0]), registers)

    def end_pulses(self, channels: Sequence[int]) -> None:
        """Set the bit that ends the pulses of all channels."""
        for number in dict.fromkeys(channel // pca9685.CHANNELS for channel in channels):
            self._write(self._address + number, pca9685.ALL_LED, pca9685.channel_registers(0))

    def width_us(self, channel: int) -> float | None:
        """Read mode and registers of a channel; a board that sleeps sends no pulses."""
        address = self._address + channel // pca9685.CHANNELS
        mode = self._mode(address)
        registers = None if mode is None else self._read(address, _register_of(channel), 4)
        if mode is None or registers is None:
            return None
        return 0.0 if mode & pca9685.SLEEP else pca9685.pulse_count(registers) * self._count_us

    def _mode(self, address: int) -> int | None:
        """Read MODE1; twice from a board that seems to sleep, because an answer has no checksum. None if it is not clear."""
        mode = self._read(address, pca9685.MODE1, 1)
        if mode is None or not mode[0] & pca9685.SLEEP:
            return None if mode is None else mode[0]
        return mode[0] if self._read(address, pca9685.MODE1, 1) == mode else None

    def _write(self, address: int, register: int, data: Sequence[int]) -> None:
        self._transfer(pca9685.write(address, register, data))

    def _read(self, address: int, register: int, size: int) -> bytes | None:
        return self._transfer(pca9685.read(address, register, size))

    def _transfer(self, transfer: pca9685.Transfer) -> bytes | None:
        """Return the bytes read, None if no board has acknowledged its address."""
        answer = _exchange(self._port, pca9685.frame(transfer), 1 + transfer.size, self.lost)
        if answer is not None and answer[0] != pca9685.ACKNOWLEDGED:
            self.lost["not acknowledged"] += 1
            return None
        return None if answer is None else answer[1:]


def open_board(port: Port, pulses: Pulses) -> PulseBoard:
    """Return the board of a profile on an open port."""
    return Maestro(port, pulses) if pulses.board == "maestro" else Pca9685(port, pulses)


def _register_of(channel: int) -> int:
    return pca9685.LED0 + 4 * (channel % pca9685.CHANNELS)


def _runs(channels: Mapping[int, object]) -> Iterator[list[int]]:
    """Yield channels that follow each other, in rising order."""
    run: list[int] = []
    for channel in sorted(channels):
        if run and channel != run[-1] + 1:
            yield run
            run = []
        run.append(channel)
    if run:
        yield run


def _exchange(port: Port, request: bytes, size: int, lost: Counter[str]) -> bytes | None:
    """Send a request and return its answer of `size` bytes; None if it is missing."""
    try:
        port.reset_input_buffer()
        port.write(request)
        answer = port.read(size)
    except LOST as error:
        raise gone(error) from error
    if len(answer) == size:
        return answer
    lost[_NO_ANSWER] += 1
    return None
