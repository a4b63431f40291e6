"""LX-16A bus servo of LewanSoul (Hiwonder): packets, commands and units, without port or clock.

    55 55 | id | length | command | parameters | checksum

The servo answers only commands that read, with a packet of the same command. It reports no error, speed, load or current.

Source: LewanSoul (Hiwonder) Bus Servo Communication Protocol.
"""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from types import MappingProxyType

from sextant.shared.servo.servo_model import Packet
from sextant.shared.servo.stream_parser import Dropped, StreamParser

HEADER = b"\x55\x55"
BROADCAST_ID = 0xFE  # of the commands that read, only ID_READ is answered
MAX_ID = 0xFD
OVERHEAD = 6  # bytes of a packet besides its parameters: header, id, length, command, checksum
BAUD_RATE = 115_200  # [bit/s] of every servo

TICK_CENTRE = 500  # position at servo angle 0
TICK_MAX = 1000
TICK_RAD = math.radians(240.0) / TICK_MAX  # [rad] per position tick

_HEAD = 4  # [bytes] of header, id and length


class Command(IntEnum):
    """Command of the host to a servo."""

    MOVE_TIME_WRITE = 1
    MOVE_TIME_READ = 2
    MOVE_TIME_WAIT_WRITE = 7  # waits for MOVE_START
    MOVE_TIME_WAIT_READ = 8
    MOVE_START = 11
    MOVE_STOP = 12
    ID_WRITE = 13
    ID_READ = 14
    ANGLE_OFFSET_ADJUST = 17
    ANGLE_OFFSET_WRITE = 18  # saves the offset, which has no parameter
    ANGLE_OFFSET_READ = 19
    ANGLE_LIMIT_WRITE = 20
    ANGLE_LIMIT_READ = 21
    VIN_LIMIT_WRITE = 22
    VIN_LIMIT_READ = 23
    TEMP_MAX_LIMIT_WRITE = 24
    TEMP_MAX_LIMIT_READ = 25
    TEMP_READ = 26
    VIN_READ = 27
    POS_READ = 28
    MODE_WRITE = 29
    MODE_READ = 30
    LOAD_OR_UNLOAD_WRITE = 31
    LOAD_OR_UNLOAD_READ = 32
    LED_CTRL_WRITE = 33
    LED_CTRL_READ = 34
    LED_ERROR_WRITE = 35
    LED_ERROR_READ = 36


class Mode(IntEnum):
    """Mode of a servo; it is the position mode after power-on."""

    POSITION = 0
    MOTOR = 1


class Led(IntEnum):
    """Setting of the LED, saved in the servo."""

    ON = 0
    OFF = 1


class Fault(IntFlag):
    """Fault for which the LED flashes, if its bit is set."""

    NONE = 0
    OVERHEATING = 1 << 0
    INPUT_VOLTAGE = 1 << 1
    STALLED = 1 << 2


@dataclass(frozen=True, slots=True)
class Field:
    """Value in the parameters of a command."""

    name: str
    min: int
    max: int


@dataclass(frozen=True, slots=True)
class Layout:
    """Parameters of a command, little-endian."""

    struct: struct.Struct
    fields: tuple[Field, ...]

    def pack(self, values: tuple[int, ...]) -> bytes:
        """Encode values.

        Raises:
            ValueError: Their number is wrong, or one is outside its range.
        """
        if len(values) != len(self.fields):
            raise ValueError(f"{len(self.fields)} values expected ({', '.join(self.names) or 'none'}), found {len(values)}")
        for field, value in zip(self.fields, values, strict=True):
            if not field.min <= value <= field.max:
                raise ValueError(f"{field.name} takes {field.min} to {field.max}, found {value}")
        return self.struct.pack(*values)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields."""
        return tuple(field.name for field in self.fields)


def _layout(code: str, *fields: Field) -> Layout:
    return Layout(struct.Struct("<" + code), fields)


_MOVE = _layout("HH", Field("position [ticks]", 0, TICK_MAX), Field("time [ms]", 0, 30_000))
_ID = _layout("B", Field("id", 0, MAX_ID))
_OFFSET = _layout("b", Field("angle offset [ticks]", -125, 125))
_ANGLES = _layout("HH", Field("lowest position [ticks]", 0, TICK_MAX), Field("highest position [ticks]", 0, TICK_MAX))
_VOLTAGES = _layout("HH", Field("lowest voltage [mV]", 4_500, 12_000), Field("highest voltage [mV]", 4_500, 12_000))
_MAX_TEMPERATURE = _layout("B", Field("temperature limit [°C]", 50, 100))
_MODE = _layout("Bxh", Field("mode", 0, 1), Field("motor speed", -1000, 1000))
_LOADED = _layout("B", Field("torque enabled", 0, 1))
_LED = _layout("B", Field("LED off", 0, 1))
_LED_FAULTS = _layout("B", Field("faults of the LED", 0, 7))

WRITES: Mapping[Command, Layout] = MappingProxyType(
    {
        Command.MOVE_TIME_WRITE: _MOVE,
        Command.MOVE_TIME_WAIT_WRITE: _MOVE,
        Command.MOVE_START: _layout(""),
        Command.MOVE_STOP: _layout(""),
        Command.ID_WRITE: _ID,
        Command.ANGLE_OFFSET_ADJUST: _OFFSET,
        Command.ANGLE_OFFSET_WRITE: _layout(""),
        Command.ANGLE_LIMIT_WRITE: _ANGLES,
        Command.VIN_LIMIT_WRITE: _VOLTAGES,
        Command.TEMP_MAX_LIMIT_WRITE: _MAX_TEMPERATURE,
        Command.MODE_WRITE: _MODE,
        Command.LOAD_OR_UNLOAD_WRITE: _LOADED,
        Command.LED_CTRL_WRITE: _LED,
        Command.LED_ERROR_WRITE: _LED_FAULTS,
    }
)
READS: Mapping[Command, Layout] = MappingProxyType(  # layouts of the responses
    {
        Command.MOVE_TIME_READ: _MOVE,
        Command.MOVE_TIME_WAIT_READ: _MOVE,
        Command.ID_READ: _ID,
        Command.ANGLE_OFFSET_READ: _OFFSET,
        Command.ANGLE_LIMIT_READ: _ANGLES,
        Command.VIN_LIMIT_READ: _VOLTAGES,
        Command.TEMP_MAX_LIMIT_READ: _MAX_TEMPERATURE,
        Command.TEMP_READ: _layout("B", Field("temperature [°C]", 0, 255)),
        Command.VIN_READ: _layout("H", Field("voltage [mV]", 0, 65_535)),
        Command.POS_READ: _layout("h", Field("position [ticks]", -32_768, 32_767)),
        Command.MODE_READ: _MODE,
        Command.LOAD_OR_UNLOAD_READ: _LOADED,
        Command.LED_CTRL_READ: _LED,
        Command.LED_ERROR_READ: _LED_FAULTS,
    }
)
# Lengths of instructions and of responses, by command.
_INSTRUCTION_LENGTHS = {int(c): 3 + layout.struct.size for c, layout in WRITES.items()} | {int(c): 3 for c in READS}
_RESPONSE_LENGTHS = {int(c): 3 + layout.struct.size for c, layout in READS.items()}
MAX_LENGTH = max(_INSTRUCTION_LENGTHS.values())


def angle_from_ticks(ticks: float) -> float:
    """Return the servo angle [rad] of a position; it is 0 at the centre tick."""
    return (ticks - TICK_CENTRE) * TICK_RAD


def ticks_from_angle(angle: float) -> int:
    """Return the nearest position of a servo angle [rad], not clamped.

    The caller checks the range.
    """
    return round(angle / TICK_RAD) + TICK_CENTRE


def encode(servo_id: int, command: int, parameters: bytes = b"") -> bytes:
    """Encode a packet: 55 55 ID LEN COMMAND parameters CHECKSUM.

    Raises:
        ValueError: The id is not 0 to 254, or there are more than 4 parameters.
    """
    if not 0 <= servo_id <= BROADCAST_ID:
        raise ValueError(f"servo id 0 to {MAX_ID}, or {BROADCAST_ID} for all, expected, found {servo_id}")
    if len(parameters) > MAX_LENGTH - 3:
        raise ValueError(f"at most {MAX_LENGTH - 3} parameter bytes expected, found {len(parameters)}")
    body = bytes((servo_id, len(parameters) + 3, command)) + parameters
    return HEADER + body + bytes((~sum(body) & 0xFF,))


def write(servo_id: int, command: Command, *values: int) -> bytes:
    """Encode a command that writes, such as `write(1, Command.MOVE_TIME_WRITE, 500, 1000)`.

    Raises:
        ValueError: The command writes nothing, or its values are wrong.
    """
    if command not in WRITES:
        raise ValueError(f"a command that writes expected, found {command.name}; use read")
    return encode(servo_id, command, WRITES[command].pack(values))


def read(servo_id: int, command: Command) -> bytes:
    """Encode a command that reads.

    Raises:
        ValueError: The command reads nothing, or all servos would answer it.
    """
    if command not in READS:
        raise ValueError(f"a command that reads expected, found {command.name}; use write")
    if servo_id == BROADCAST_ID and command is not Command.ID_READ:
        raise ValueError(f"no servo answers {command.name} for all ids; give one id")
    return encode(servo_id, command)


def response(servo_id: int, command: Command, *values: int) -> bytes:
    """Encode the response of a servo to a command that reads."""
    return encode(servo_id, command, READS[command].struct.pack(*values))


def values_of(packet: Packet) -> tuple[int, ...]:
    """Return the values in the packet of a parser: in a response, or in a command that writes."""
    command = Command(packet.code)
    layout = READS[command] if command in READS and packet.parameters else WRITES.get(command)
    return layout.struct.unpack(packet.parameters) if layout else ()


class PacketParser(StreamParser):
    """Parser of responses, or of commands; the code of a packet is its command.

    A packet with an unknown command, or with a length that its command does not have, counts as one with a bad length.
    """

    header = HEADER
    head_size = _HEAD

    def __init__(self, max_length: int = MAX_LENGTH, *, keep_broken: bool = False, instructions: bool = False) -> None:
        """Start at stream offset 0; see `StreamParser`."""
        super().__init__(max_length, keep_broken=keep_broken, instructions=instructions)

    def _size(self) -> int | Dropped | None:
        buffer = self._buffer
        if len(buffer) <= _HEAD:
            return None
        if buffer[2] > BROADCAST_ID:
            return Dropped.NOISE
        length, command = buffer[3], buffer[_HEAD]
        lengths = (_INSTRUCTION_LENGTHS.get(command), _RESPONSE_LENGTHS.get(command))
        return length + 3 if length in lengths and length <= self._max_length else Dropped.LENGTH

    def _is_instruction(self, raw: bytes) -> bool:
        return raw[3] == _INSTRUCTION_LENGTHS[raw[_HEAD]]

    def _is_intact(self, raw: bytes) -> bool:
        return sum(raw[2:]) & 0xFF == 0xFF  # the checksum is the complement of the sum

    def _decode(self, raw: bytes, end: int, *, intact: bool) -> Packet:
        return Packet(raw[2], raw[_HEAD], raw[_HEAD + 1 : -1], end, intact)
