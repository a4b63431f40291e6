"""Serial commands of a Pololu Maestro, of its compact and its Pololu protocol. Pure.

Source: Pololu Maestro Servo Controller User's Guide, sections 4.b and 5.c to 5.e.
"""

from collections.abc import Iterable, Sequence
from enum import IntEnum, IntFlag
from typing import NamedTuple

DEVICE = 12  # device number of a new Maestro
OFF = 0  # target without pulses
MAX_TARGET = (1 << 14) - 1  # [quarter us]
MAX_SPEED = (1 << 14) - 1  # [quarter us in 10 ms]
MAX_CHANNELS = 24  # of a Mini Maestro 24
_POLOLU = 0xAA
_COMMAND_BIT = 0x80  # set in the first byte of a command only


class Command(IntEnum):
    """Command, as in the compact protocol."""

    SET_TARGET = 0x84
    SET_SPEED = 0x87
    SET_ACCELERATION = 0x89
    GET_POSITION = 0x90
    GET_MOVING_STATE = 0x93
    SET_MULTIPLE_TARGETS = 0x9F  # of a Mini Maestro only
    GET_ERRORS = 0xA1
    GO_HOME = 0xA2


_DATA_BYTES = {
    Command.SET_TARGET: 3,
    Command.SET_SPEED: 3,
    Command.SET_ACCELERATION: 3,
    Command.GET_POSITION: 1,
    Command.GET_MOVING_STATE: 0,
    Command.GET_ERRORS: 0,
    Command.GO_HOME: 0,
}
_COMMANDS = frozenset(map(int, Command))


class BoardError(IntFlag):
    """Errors of a Maestro since they were last read."""

    NONE = 0
    SIGNAL = 1 << 0
    OVERRUN = 1 << 1
    BUFFER_FULL = 1 << 2
    CRC = 1 << 3
    PROTOCOL = 1 << 4
    TIMEOUT = 1 << 5
    SCRIPT_STACK = 1 << 6
    SCRIPT_CALL_STACK = 1 << 7
    SCRIPT_COUNTER = 1 << 8


ALL_ERRORS = (1 << 9) - 1

_ERROR_WORDS = {
    BoardError.SIGNAL: "serial signal error",
    BoardError.OVERRUN: "serial overrun",
    BoardError.BUFFER_FULL: "serial buffer full",
    BoardError.CRC: "wrong CRC",
    BoardError.PROTOCOL: "serial protocol error",
    BoardError.TIMEOUT: "serial timeout",
    BoardError.SCRIPT_STACK: "script stack error",
    BoardError.SCRIPT_CALL_STACK: "script call stack error",
    BoardError.SCRIPT_COUNTER: "script program counter error",
}


def error_words(errors: int) -> str:
    """Return errors as text, empty when no bit is set."""
    return ", ".join(words for bit, words in _ERROR_WORDS.items() if errors & bit)


class Packet(NamedTuple):
    """Command with its data bytes, without the device number."""

    command: Command
    data: bytes = b""


def encode(command: Command, data: Iterable[int] = (), device: int | None = None) -> bytes:
    """Encode a command in the compact protocol, or in the Pololu protocol for a device number."""
    if device is None:
        return bytes((command, *data))
    return bytes((_POLOLU, device, command & ~_COMMAND_BIT, *data))


def set_target(channel: int, target: int, device: int | None = None) -> bytes:
    """Encode the target [quarter us] of one channel; `OFF` ends its pulses."""
    return encode(Command.SET_TARGET, (channel, *_in_seven_bits(target, MAX_TARGET)), device)


def set_multiple_targets(first: int, targets: Sequence[int], device: int | None = None) -> bytes:
    """Encode the targets [quarter us] of consecutive channels."""
    if not 1 <= len(targets) <= MAX_CHANNELS - first:
        raise ValueError(f"1 to {MAX_CHANNELS - first} targets from channel {first} on expected, found {len(targets)}")
    data = (byte for target in targets for byte in _in_seven_bits(target, MAX_TARGET))
    return encode(Command.SET_MULTIPLE_TARGETS, (len(targets), first, *data), device)


def set_speed(channel: int, speed: int, device: int | None = None) -> bytes:
    """Encode the speed limit [quarter us in 10 ms] of one channel, 0 for none."""
    return encode(Command.SET_SPEED, (channel, *_in_seven_bits(speed, MAX_SPEED)), device)


def set_acceleration(channel: int, acceleration: int, device: int | None = None) -> bytes:
    """Encode the acceleration limit of one channel, 0 for none; its unit is a quarter us in 10 ms, in 80 ms."""
    return encode(Command.SET_ACCELERATION, (channel, *_in_seven_bits(acceleration, 255)), device)


def get_position(channel: int, device: int | None = None) -> bytes:
    """Encode the request for the pulse width of one channel."""
    return encode(Command.GET_POSITION, (channel,), device)


def get_errors(device: int | None = None) -> bytes:
    """Encode the request for the errors, which also clears them."""
    return encode(Command.GET_ERRORS, (), device)


def go_home(device: int | None = None) -> bytes:
    """Encode the order to bring all channels to what the board is set to for its start."""
    return encode(Command.GO_HOME, (), device)


def number(answer: bytes) -> int:
    """Return the number in an answer, low byte first."""
    return int.from_bytes(answer, "little")


def value(low: int, high: int) -> int:
    """Return the number in two data bytes of seven bits."""
    return (low & 0x7F) | (high & 0x7F) << 7


def targets(packet: Packet) -> dict[int, int]:
    """Return the targets [quarter us] that a command sets, by channel; empty for other commands."""
    data = packet.data
    match packet.command:
        case Command.SET_TARGET:
            return {data[0]: value(data[1], data[2])}
        case Command.SET_MULTIPLE_TARGETS:
            return {data[1] + k: value(*data[2 + 2 * k : 4 + 2 * k]) for k in range(data[0])}
        case Command.GO_HOME:
            return dict.fromkeys(range(MAX_CHANNELS), OFF)
    return {}


def _in_seven_bits(found: int, most: int) -> tuple[int, int]:
    if not 0 <= found <= most:
        raise ValueError(f"0 to {most} expected, found {found}")
    return found & 0x7F, found >> 7


class CommandParser:
    """Parser of commands in a byte stream, as a Maestro reads them; commands of both protocols may follow each other."""

    def __init__(self, device: int = DEVICE) -> None:
        """Begin without data, for the Maestro with a device number."""
        self.errors = BoardError.NONE  # since they were last cleared
        self._device = device
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[Packet]:
        """Add the next bytes of the stream, and return the completed commands for this board."""
        found = []
        for byte in data:
            if byte & _COMMAND_BIT:
                self.errors |= BoardError.PROTOCOL if self._pending else BoardError.NONE  # a command is incomplete
                self._pending = bytearray((byte,))
            elif self._pending:
                self._pending.append(byte)
            else:
                self.errors |= BoardError.PROTOCOL
            found += self._completed()
        return found

    def _completed(self) -> list[Packet]:
        """Return the pending command if it is complete and for this board."""
        pending = self._pending
        if not pending:
            return []
        is_addressed = pending[0] == _POLOLU
        if is_addressed and len(pending) < 3:
            return []
        code, data = (pending[2] | _COMMAND_BIT, pending[3:]) if is_addressed else (pending[0], pending[1:])
        if code not in _COMMANDS:
            if not is_addressed or pending[1] == self._device:
                self.errors |= BoardError.PROTOCOL
            pending.clear()
            return []
        command = Command(code)
        if command is Command.SET_MULTIPLE_TARGETS:
            needed = 2 + 2 * data[0] if data else 1
        else:
            needed = _DATA_BYTES[command]
        if len(data) < needed:
            return []
        addressed = not is_addressed or pending[1] == self._device
        found = Packet(command, bytes(data))
        pending.clear()
        return [found] if addressed else []
