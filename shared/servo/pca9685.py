"""Registers of a PCA9685, and I2C transfers with it. Pure.

Source: NXP PCA9685 data sheet, revision 4, sections 7.3 and 7.4.
"""

from collections.abc import Sequence
from typing import NamedTuple

MODE1 = 0x00
MODE2 = 0x01
LED0 = 0x06  # first of four registers of each channel: ON and OFF, low bytes first
ALL_LED = 0xFA  # the same for all channels, write-only
PRE_SCALE = 0xFE
ADDRESS = 0x40  # without solder jumpers
CHANNELS = 16
COUNTS = 4096  # in a period

RESTART, AUTO_INCREMENT, SLEEP, ALL_CALL = 0x80, 0x20, 0x10, 0x01  # bits of MODE1
TOTEM_POLE = 0x04  # bit of MODE2
FULL = 0x10  # bit of the high bytes: on or off all the time; off has precedence
AWAKE = AUTO_INCREMENT  # MODE1 of a board that sends pulses
MODE1_RESET, MODE2_RESET, PRE_SCALE_RESET = 0x11, 0x04, 0x1E
_LEAST_SCALE, _MOST_SCALE = 3, 255


def pre_scale(rate_hz: float, oscillator_hz: float) -> int:
    """Return the PRE_SCALE register for a rate [Hz] of the pulses, equation (1) of the data sheet."""
    found = round(oscillator_hz / (COUNTS * rate_hz)) - 1
    if not _LEAST_SCALE <= found <= _MOST_SCALE:
        raise ValueError(f"a rate of pulses that a PCA9685 has expected, found {rate_hz:g} Hz")
    return found


def count_us(scale: int, oscillator_hz: float) -> float:
    """Return the duration [us] of one count with a PRE_SCALE register."""
    return (scale + 1) * 1e6 / oscillator_hz


def channel_registers(count: int) -> bytes:
    """Return the four registers of a channel whose pulse begins at count 0 and ends at `count`; 0 is without pulses."""
    if not 0 <= count < COUNTS:
        raise ValueError(f"a pulse of 0 to {COUNTS - 1} counts expected, found {count}")
    return bytes((0, 0, count & 0xFF, count >> 8)) if count else bytes((0, 0, 0, FULL))


def pulse_count(registers: bytes) -> int:
    """Return the counts of a pulse from the four registers of a channel, 0 without pulses; the inverse of the former."""
    on, off = registers[0] | (registers[1] & 0x0F) << 8, registers[2] | (registers[3] & 0x0F) << 8
    return 0 if registers[3] & FULL else (off - on) % COUNTS


class Transfer(NamedTuple):
    """I2C transfer: a write, and then a read after a repeated start."""

    address: int
    data: bytes
    size: int = 0  # [bytes] to read


_HEAD_BYTES = 3  # address, number of bytes to write, number of bytes to read
ACKNOWLEDGED = 1  # first byte of an answer


def frame(transfer: Transfer) -> bytes:
    """Encode a transfer for a port: address, number of written and read bytes, written bytes."""
    return bytes((transfer.address, len(transfer.data), transfer.size)) + transfer.data


def answer(read: bytes | None) -> bytes:
    """Encode the answer of a port to a transfer: the read bytes, or None if no board has acknowledged its address."""
    return b"\x00" if read is None else bytes((ACKNOWLEDGED,)) + read


def write(address: int, register: int, data: Sequence[int]) -> Transfer:
    """Return the write of registers from `register` on, with auto-increment."""
    return Transfer(address, bytes((register, *data)))


def read(address: int, register: int, size: int) -> Transfer:
    """Return the read of registers from `register` on, with auto-increment."""
    return Transfer(address, bytes((register,)), size)


class FrameParser:
    """Parser of encoded transfers in a byte stream."""

    def __init__(self) -> None:
        """Begin without data."""
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[Transfer]:
        """Add the next bytes of the stream, and return the completed transfers."""
        self._pending += data
        found = []
        while len(self._pending) >= _HEAD_BYTES and len(self._pending) >= _HEAD_BYTES + self._pending[1]:
            address, count, size = self._pending[:_HEAD_BYTES]
            found.append(Transfer(address, bytes(self._pending[_HEAD_BYTES : _HEAD_BYTES + count]), size))
            del self._pending[: _HEAD_BYTES + count]
        return found
