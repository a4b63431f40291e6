"""Servo models: control table, units of its registers, and what the data sheet states.

A model is data. The driver and the simulator read registers by their role, such as `table.goal_position`, and know no address.
"""

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum, Flag, IntFlag, StrEnum, auto
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

Order = Literal["little", "big"]


class Access(StrEnum):
    """Access of a register for the host."""

    READ = "R"
    READ_WRITE = "RW"


@dataclass(frozen=True, slots=True)
class Register:
    """One register of a control table: one, two or four bytes."""

    name: str
    address: int
    size: int  # [bytes]
    access: Access
    default: int  # value after a factory reset; 0 for measured values
    min: int  # lowest value that may be written
    max: int  # highest value that may be written
    eeprom: bool  # persists without power
    order: Order = "little"  # of its bytes

    @property
    def dtype(self) -> str:
        """Type of its number in NumPy."""
        return f"{'<' if self.order == 'little' else '>'}u{self.size}"

    def encode(self, value: int) -> bytes:
        """Encode a value.

        Raises:
            ValueError: The value is outside the register's range.
        """
        if not self.min <= value <= self.max:
            raise ValueError(f"{self.name} takes {self.min} to {self.max}, found {value}")
        return value.to_bytes(self.size, self.order)

    def decode(self, data: bytes) -> int:
        """Return the value in its bytes."""
        return int.from_bytes(data, self.order)


def measured(name: str, address: int, size: int, default: int = 0, *, eeprom: bool = False) -> Register:
    """Return a register that the host only reads."""
    return Register(name, address, size, Access.READ, default, 0, (1 << 8 * size) - 1, eeprom)


def setting(name: str, address: int, size: int, default: int, low: int, high: int, *, eeprom: bool = False) -> Register:
    """Return a register that the host may write."""
    return Register(name, address, size, Access.READ_WRITE, default, low, high, eeprom)


class ServoError(IntFlag):
    """Errors of a servo; the bits are those of Dynamixel Protocol 1.0."""

    NONE = 0
    INPUT_VOLTAGE = 1 << 0
    ANGLE_LIMIT = 1 << 1
    OVERHEATING = 1 << 2
    RANGE = 1 << 3
    CHECKSUM = 1 << 4
    OVERLOAD = 1 << 5
    INSTRUCTION = 1 << 6
    HARDWARE = 1 << 7  # no bit of Protocol 1.0: a fault of the servo itself


ALL_OF_PROTOCOL_1 = ServoError(0x7F)
REFUSAL = int(ServoError.ANGLE_LIMIT | ServoError.RANGE | ServoError.CHECKSUM | ServoError.INSTRUCTION)
_ERROR_WORDS = {
    ServoError.INPUT_VOLTAGE: "input voltage outside its limits",
    ServoError.ANGLE_LIMIT: "goal outside the angle limits",
    ServoError.OVERHEATING: "overheating",
    ServoError.RANGE: "value out of range",
    ServoError.CHECKSUM: "checksum of the instruction was wrong",
    ServoError.OVERLOAD: "overload",
    ServoError.INSTRUCTION: "undefined instruction, or action without registered write",
    ServoError.HARDWARE: "fault of its sensor or electronics",
}


def error_words(error: int) -> str:
    """Return an error byte as text, empty when no bit is set."""
    return ", ".join(words for bit, words in _ERROR_WORDS.items() if error & bit)


class Packet(NamedTuple):
    """Instruction or status packet."""

    servo_id: int
    code: int  # instruction, or error of a status packet
    parameters: bytes
    end: int = 0  # stream offset after its checksum, counted since the parser was made
    intact: bool = True  # False only from a parser that keeps packets with a wrong checksum


class Kind(Enum):
    """Kind of an instruction to servos."""

    PING = auto()
    READ = auto()
    WRITE = auto()
    REGISTER = auto()  # a write that waits for `ACTION`
    ACTION = auto()
    RESET = auto()  # to the factory values
    REBOOT = auto()
    SYNC_WRITE = auto()
    SYNC_READ = auto()
    FAST_SYNC_READ = auto()  # with one answer of all servos


class Request(NamedTuple):
    """Instruction that a servo can execute."""

    kind: Kind
    address: int = 0
    size: int = 0  # [bytes] of a read, or of each row
    data: bytes = b""
    rows: tuple[tuple[int, bytes], ...] = ()  # id and data; of a sync read without data


class Parser(Protocol):
    """Parser of packets in a byte stream."""

    dropped: Counter[str]  # dropped bytes and packets, by reason

    @property
    def pending(self) -> int:
        """Number of buffered bytes of an incomplete packet."""

    def feed(self, data: bytes) -> list[Packet]:
        """Add the next bytes of the stream, and return the completed packets."""

    def flush(self) -> list[Packet]:
        """Give up an incomplete packet, and return the intact packets inside it."""


class BusProtocol(Protocol):
    """Packets of one family of buses. A module with these names implements it."""

    NAME: str
    BROADCAST_ID: int
    MAX_ID: int
    OVERHEAD: int  # [bytes] of an answer besides its parameters
    PING_SIZE: int  # [bytes] of parameters in the answer to a ping
    ERRORS: tuple[ServoError, ...]  # errors by the code of an answer
    ALERT: int  # bit of that code for an error in the hardware error register; 0 where there is none

    def answer_start(self, servo_id: int) -> bytes:
        """Return the bytes with which an answer of a servo begins."""

    def ping(self, servo_id: int) -> bytes:
        """Encode a ping of a servo."""

    def read(self, servo_id: int, address: int, size: int) -> bytes:
        """Encode a read of `size` bytes from an address."""

    def write(self, servo_id: int, address: int, data: bytes) -> bytes:
        """Encode a write of bytes, starting at an address."""

    def sync_write(self, address: int, size: int, rows: Iterable[tuple[int, bytes]]) -> bytes:
        """Encode a write of `size` bytes at one address of several servos, which do not respond."""

    def sync_write_rows(self, address: int, size: int, rows: bytes) -> bytes:
        """Encode the same from rows of an id and `size` bytes each."""

    def answer_parser(self, max_parameters: int) -> Parser:
        """Return a parser of answers with at most this many parameters."""

    def instruction_parser(self) -> Parser:
        """Return a parser of instructions, which also returns those with a wrong checksum."""

    def request(self, packet: Packet) -> Request | None:
        """Return what an instruction asks; None if no servo can execute it."""

    def status(self, servo_id: int, error: int, parameters: bytes = b"") -> bytes:
        """Encode an answer."""

    def error_code(self, refusal: int, state: int) -> int:
        """Return the code of an answer, from the errors of an instruction and those of the servo's state."""


class Sign(StrEnum):
    """Coding of negative values in a register."""

    BIT_10 = "magnitude of 10 bits, then the direction"
    BIT_15 = "magnitude of 15 bits, then the sign"
    COMPLEMENT = "two's complement"

    def largest(self, size: int) -> int:
        """Return the largest magnitude that a register of `size` bytes holds."""
        return 0x3FF if self is Sign.BIT_10 else 0x7FFF if self is Sign.BIT_15 else (1 << (8 * size - 1)) - 1


@dataclass(frozen=True, slots=True)
class Units:
    """Units of position, speed, load and voltage registers."""

    centre: int  # [ticks] position at servo angle 0
    max_position: int  # [ticks] highest position in joint mode
    tick_rad: float  # [rad] per position tick, counterclockwise positive
    speed_rad_s: float  # [rad/s] per tick of goal and present speed
    load: float  # [1] share of the stall torque per tick of the load register
    volt: float  # [V] per tick of the voltage register
    speed_sign: Sign
    load_sign: Sign
    torque: float  # [1] share of the stall torque per tick of the torque limit
    position_sign: Sign | None = None  # None for positions without a sign
    overrun: int = 0  # [ticks] beyond the ends of joint mode in which a position may be

    @property
    def range_rad(self) -> float:
        """Largest servo angle [rad] in both directions from the centre."""
        return self.tick_rad * self.max_position / 2

    def angle(self, ticks: float) -> float:
        """Return the servo angle [rad] of a position register."""
        return (ticks - self.centre) * self.tick_rad

    def ticks(self, angle: float) -> int:
        """Return the nearest position register of a servo angle [rad], not clamped; the caller checks the range."""
        return round(angle / self.tick_rad) + self.centre


def number_decoder(sign: Sign | None, size: int) -> Callable[[int], int]:
    """Return the function that decodes a register of `size` bytes; None is for a register without a sign.

    A value with bits beyond its sign is none that a servo has. It is returned as it is, larger than any magnitude.
    """
    if sign is None:
        return _as_it_is
    if sign is Sign.COMPLEMENT:
        half, whole = 1 << (8 * size - 1), 1 << 8 * size
        return lambda value: value if value < half else value - whole
    bit = sign.largest(size) + 1
    return lambda value: value if value < bit or value >= 2 * bit else bit - value


def _as_it_is(value: int) -> int:
    return value


def signed(value: int, sign: Sign, size: int = 2) -> int:
    """Return the signed value of a register of `size` bytes; see `number_decoder`."""
    return number_decoder(sign, size)(value)


def unsigned(value: int, sign: Sign, size: int = 2) -> int:
    """Return the register of a signed value, saturated at the largest magnitude."""
    most = sign.largest(size)
    clipped = min(max(value, -most), most)
    if sign is Sign.COMPLEMENT:
        return clipped % (1 << 8 * size)
    return most + 1 - clipped if clipped < 0 else clipped


@dataclass(frozen=True, eq=False)
class ControlTable:
    """Registers of a servo by their role; None where a servo has none."""

    size: int  # [bytes]
    registers: tuple[Register, ...]  # all of them
    eeprom: range  # addresses that a scan reads ...
    ram: range  # ... in two requests

    model_number: Register
    firmware: Register
    id: Register
    baud_rate: Register
    return_delay: Register
    status_return_level: Register
    low_limit: Register  # lowest goal position
    high_limit: Register
    temperature_limit: Register
    min_voltage: Register
    max_voltage: Register
    max_torque: Register  # to which the torque limit is set at power-on
    shutdown: Register  # error bits for which the servo shuts down
    torque_enable: Register
    goal_position: Register
    goal_speed: Register  # maximum speed on the way to the goal, 0 for no limit
    torque_limit: Register
    present_position: Register
    present_speed: Register
    present_load: Register
    present_voltage: Register
    present_temperature: Register
    moving: Register
    registered: Register  # whether a registered write waits
    unlocked: range = range(0)  # addresses that the host may write in spite of the lock
    lock: Register | None = None  # 1 protects the EEPROM
    hardware_error: Register | None = None  # errors that an answer does not carry
    operating_mode: Register | None = None  # what it controls
    goal_time: Register | None = None  # [ms] for the way to the goal, 0 for the highest speed
    position_gain: Register | None = None  # of the position controller
    compliance: tuple[Register, ...] = ()  # margins and slopes, each clockwise and counterclockwise

    @property
    def measured(self) -> tuple[Register, ...]:
        """Position, speed, load, voltage and temperature."""
        return (
            self.present_position,
            self.present_speed,
            self.present_load,
            self.present_voltage,
            self.present_temperature,
        )

    @cached_property
    def of_bus(self) -> tuple[object, ...]:
        """What the tables of servos on one bus have in common: all registers by their role, but those of the torque limit."""
        own = ("size", "registers", "max_torque", "torque_limit")
        return tuple(getattr(self, one.name) for one in fields(self) if one.name not in own)

    @cached_property
    def state(self) -> "Block":
        """Block with position, speed, load, voltage and temperature, in this order."""
        return Block(self.measured)

    @cached_property
    def condition(self) -> "Block":
        """Block with max torque, torque enable, goal position, torque limit, present position and load, in this order."""
        return Block(
            (
                self.max_torque,
                self.torque_enable,
                self.goal_position,
                self.torque_limit,
                self.present_position,
                self.present_load,
            )
        )

    @cached_property
    def limits(self) -> "Block":
        """Block with the lowest and highest goal position, in this order."""
        return Block((self.low_limit, self.high_limit))

    @cached_property
    def goals(self) -> "Block":
        """Block with goal position and goal speed."""
        return Block((self.goal_position, self.goal_speed))


_STRUCT_CODES = {1: "B", 2: "H", 4: "I"}


class Block:
    """Registers that one request reads or writes, and the bytes between them."""

    def __init__(self, registers: tuple[Register, ...]) -> None:
        """Find the smallest range of addresses with all of these registers; two roles may have one address."""
        at_address = {register.address: register for register in registers}
        ordered = [at_address[address] for address in sorted(at_address)]
        self.address = ordered[0].address
        self.size = ordered[-1].address + ordered[-1].size - self.address  # [bytes]
        codes, at = [ordered[0].dtype[0]], self.address
        for register in ordered:
            codes.append(f"{register.address - at}x" if register.address > at else "")
            codes.append(_STRUCT_CODES[register.size])
            at = register.address + register.size
        self._struct = struct.Struct("".join(codes))
        self._order = tuple(sorted(at_address).index(register.address) for register in registers)
        self._is_ordered = self._order == tuple(range(len(registers)))

    def unpack(self, data: bytes) -> tuple[int, ...]:
        """Return the values of the registers, in the order in which they were given."""
        values = self._struct.unpack(data)
        return values if self._is_ordered else tuple(values[k] for k in self._order)


# Bits of the shutdown register, and of the hardware error register of X series servos.
_ERROR_BITS = {
    1 << 0: ServoError.INPUT_VOLTAGE,
    1 << 2: ServoError.OVERHEATING,
    1 << 3: ServoError.HARDWARE,  # encoder
    1 << 4: ServoError.HARDWARE,  # electrical shock
    1 << 5: ServoError.OVERLOAD,
}


class Feedback(Flag):
    """What a servo measures and reports; everything else about it is estimated or unknown."""

    NONE = 0
    POSITION = auto()
    SPEED = auto()
    LOAD = auto()
    VOLTAGE = auto()
    TEMPERATURE = auto()
    ALL = POSITION | SPEED | LOAD | VOLTAGE | TEMPERATURE


SyncRead = Callable[[int, int, Iterable[int]], bytes]  # of address, size [bytes] and ids


class Recovery(StrEnum):
    """Way to end the shutdown of a servo."""

    TORQUE_LIMIT = "write the torque limit"
    TORQUE_ENABLE = "turn torque off and on"
    REBOOT = "reboot"
    ITSELF = "wait: it ends with its cause"


class Commands(NamedTuple):
    """Commands of servos without registers, whose control table is ours; they do not answer writes."""

    reading: Callable[[int, int], int]  # command that reads these bytes of the table, from address and size
    answer_code: Callable[[bytes], int]  # code of the right answer to a request
    inside: Callable[[int, int], list[tuple[int, int]]]  # address and size of what commands read in a range of addresses
    lacks: frozenset[Register] = frozenset()  # registers of the table that no command reads or writes


@dataclass(frozen=True, eq=False)
class ServoModel:
    """Servo model: protocol, control table and units, and the factory values that differ from the table."""

    name: str
    number: int  # value of the model number register
    protocol: BusProtocol
    table: ControlTable
    units: Units
    rates: Mapping[int, int]  # value of the baud rate register -> [bit/s]
    settings: Mapping[str, int]  # register name -> value that a joint needs; the last one identifies a new servo
    no_load_rpm: float  # [rpm] in joint mode, at the highest voltage of the data sheet
    overrides: Mapping[str, int]  # register name -> factory value, where it differs from the table
    common_rates: tuple[int, ...] = ()  # [bit/s] rates that the manual lists, if the register has many more
    recovery: Recovery = Recovery.TORQUE_LIMIT
    errors: ServoError = ALL_OF_PROTOCOL_1  # all that its answers can report
    gain_stiffness: float = 0.0  # [1/rad] share of the stall torque per position error and unit of the position gain
    eeprom_needs_torque_off: bool = False
    sync_read: SyncRead | None = None  # encodes a read of several servos, where the family has it
    fast_firmware: int | None = None  # firmware from which servos answer a fast sync read; None if none of them does
    masks: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # register name -> bits, and their value
    unlocks: bool = False  # whether writing 0 ends the lock; otherwise only a power cycle does
    feedback: Feedback = Feedback.ALL
    error_bits: Mapping[int, ServoError] = field(default_factory=lambda: _ERROR_BITS)  # of both error registers
    commands: Commands | None = None  # None for a servo with registers
    lacks: frozenset[Register] = frozenset()  # roles of its table that it does not have
    limits_current: bool = False  # whether the torque limit is a current, and its unit that of the load
    bus_rate: int = 1_000_000  # [bit/s] of a robot's bus

    @property
    def no_load_speed(self) -> float:
        """No-load speed [rad/s] in joint mode."""
        return self.no_load_rpm * 2.0 * math.pi / 60.0

    @property
    def full_torque(self) -> float:
        """Torque limit [ticks] with which a servo exerts its stall torque."""
        return 1.0 / self.units.torque if self.limits_current else float(self.table.torque_limit.max)

    def has(self, register: Register) -> bool:
        """Return whether a servo of this model has a register of its table."""
        return register not in (self.lacks if self.commands is None else self.commands.lacks)

    def hardware_errors(self, value: int) -> ServoError:
        """Return the errors in the hardware error register, or in the shutdown register."""
        found = ServoError.NONE
        for bit, error in self.error_bits.items():
            found |= error if value & bit else ServoError.NONE
        return found

    def hardware_error_code(self, error: int) -> int:
        """Return the register of errors; the inverse of `hardware_errors`."""
        return sum(bit for bit, meaning in self.error_bits.items() if error & meaning and bit != 1 << 4)

    @cached_property
    def joint_settings(self) -> dict[Register, int]:
        """Settings by register; the last one differs from that of a new servo, and is written last."""
        named = {register.name: register for register in self.table.registers}
        return {named[name]: value for name, value in self.settings.items()}

    @cached_property
    def required(self) -> dict[Register, tuple[int, int]]:
        """Bits by register, and the value that they must have."""
        named = {register.name: register for register in self.table.registers}
        return {named[name]: bits for name, bits in self.masks.items()}

    def position(self, value: int) -> int:
        """Return the position [ticks] in a position register; it is negative beyond the end of some servos."""
        sign = self.units.position_sign
        return value if sign is None else signed(value, sign, self.table.present_position.size)

    def load(self, value: int) -> float:
        """Return the share of the stall torque in a load register, counterclockwise positive."""
        return signed(value, self.units.load_sign, self.table.present_load.size) * self.units.load

    def rate_code(self, rate: int) -> int:
        """Return the value of the baud rate register for a rate [bit/s]."""
        return next(code for code, found in self.rates.items() if found == rate)

    def default(self, register: Register) -> int:
        """Return the factory value of a register."""
        if register is self.table.model_number:
            return self.number
        return self.overrides.get(register.name, register.default)

    def factory_table(self) -> bytes:
        """Return the control table with its factory values."""
        table = bytearray(self.table.size)
        for register in self.table.registers:
            value = self.default(register)
            table[register.address : register.address + register.size] = value.to_bytes(register.size, register.order)
        return bytes(table)
