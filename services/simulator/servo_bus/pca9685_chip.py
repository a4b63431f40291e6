"""Registers of one emulated PCA9685."""

from collections.abc import Sequence

from sextant.shared.servo.pca9685 import (
    ALL_LED,
    AUTO_INCREMENT,
    AWAKE,
    CHANNELS,
    FULL,
    LED0,
    MODE1,
    MODE1_RESET,
    MODE2,
    MODE2_RESET,
    PRE_SCALE,
    PRE_SCALE_RESET,
    RESTART,
    SLEEP,
    channel_registers,
    count_us,
    pre_scale,
    pulse_count,
)

_LEAST_SCALE = 3
_LAST_LED = LED0 + 4 * CHANNELS - 1


class Pca9685Chip:
    """Board with 16 channels."""

    def __init__(self, oscillator_hz: float) -> None:
        """Begin as after its power-on; its oscillator has a frequency [Hz]."""
        self.registers = bytearray(256)
        self._oscillator_hz = oscillator_hz
        self.power_on()

    def power_on(self) -> None:
        """Set all registers as after power-on: it sleeps, and all channels are off."""
        self.registers[:] = bytes(256)
        self.registers[MODE1], self.registers[MODE2], self.registers[PRE_SCALE] = MODE1_RESET, MODE2_RESET, PRE_SCALE_RESET
        for channel in range(CHANNELS):
            self.registers[LED0 + 4 * channel + 3] = FULL

    def start(self, rate_hz: float, widths_us: Sequence[float]) -> None:
        """Send pulses [us] on all channels, 0 for none, as if a host had ordered that before."""
        self.registers[PRE_SCALE], self.registers[MODE1] = pre_scale(rate_hz, self._oscillator_hz), AWAKE
        for channel, width_us in enumerate(widths_us):
            at = LED0 + 4 * channel
            self.registers[at : at + 4] = channel_registers(round(width_us / self._count_us))

    def transfer(self, data: bytes, size: int) -> bytes:
        """Write bytes, the first of which is a register, then read `size` bytes."""
        register = data[0] if data else 0
        for byte in data[1:]:
            self._write(register, byte)
            register = self._next(register)
        found = bytearray()
        for _ in range(size):
            found.append(0 if ALL_LED <= register < PRE_SCALE else self.registers[register])
            register = self._next(register)
        return bytes(found)

    def widths_us(self) -> list[float]:
        """Return the pulses [us] of each channel, 0 for none."""
        if self.registers[MODE1] & SLEEP:
            return [0.0] * CHANNELS
        counts = (pulse_count(bytes(self.registers[at : at + 4])) for at in range(LED0, _LAST_LED, 4))
        return [count * self._count_us for count in counts]

    @property
    def _count_us(self) -> float:
        return count_us(self.registers[PRE_SCALE], self._oscillator_hz)

    def _write(self, register: int, byte: int) -> None:
        if register == MODE1:
            byte &= ~RESTART  # it clears itself
        elif register == PRE_SCALE:
            if not self.registers[MODE1] & SLEEP:
                return
            byte = max(byte, _LEAST_SCALE)
        elif ALL_LED <= register < PRE_SCALE:
            for at in range(LED0 + register - ALL_LED, _LAST_LED + 1, 4):
                self._write(at, byte)
            return
        elif LED0 <= register <= _LAST_LED and (register - LED0) % 2:
            byte &= FULL | 0x0F
        self.registers[register] = byte

    def _next(self, register: int) -> int:
        """Return the register that follows a transfer of one byte."""
        if not self.registers[MODE1] & AUTO_INCREMENT:
            return register
        return 0 if register in (_LAST_LED, PRE_SCALE) else (register + 1) % 256
