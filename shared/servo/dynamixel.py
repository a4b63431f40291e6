"""Dynamixel Protocol 1.0: packets, and the control table of the AX and RX series with its units.

Sources: ROBOTIS e-manual, control tables of AX-12A and RX-64, and Protocol 1.0; AX-12 user's manual 2006 for the ranges.
"""

import math
import struct
from collections import Counter
from collections.abc import Iterable
from enum import IntEnum, StrEnum

from sextant.shared.servo.servo_model import (
    ControlTable,
    Kind,
    Packet,
    Request,
    ServoError,
    Sign,
    Units,
    signed,
    unsigned,
)
from sextant.shared.servo.servo_model import measured as _r
from sextant.shared.servo.servo_model import setting as _rw

NAME = "Dynamixel Protocol 1.0"
HEADER = b"\xff\xff"
BROADCAST_ID = 0xFE
MAX_ID = 0xFD
OVERHEAD = 6  # bytes of a packet besides its parameters: header, id, length, instruction or error, checksum
PING_SIZE = 0
ALERT = 0  # an answer carries all errors
MAX_PARAMETERS = 0xFD  # the length byte counts the parameters and two more bytes
BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
ERRORS = tuple(map(ServoError, range(256)))  # by the error byte of a status packet

TICK_CENTRE = 512  # position register at servo angle 0
TICK_MAX = 1023
TICK_RAD = math.radians(300.0) / TICK_MAX  # [rad] per position tick
SPEED_RAD_S = 0.111 * 2.0 * math.pi / 60.0  # [rad/s] per tick of a speed register
LOAD_UNIT = 0.001  # fraction of the stall torque per tick of the load register (0.1 %)
VOLT_UNIT = 0.1  # [V] per tick of the voltage register
RETURN_DELAY_NS = 2_000  # [ns] per tick of the return delay register
DIRECTION_CW = 1 << 10  # direction bit of the speed and load registers
UNITS = Units(
    centre=TICK_CENTRE,
    max_position=TICK_MAX,
    tick_rad=TICK_RAD,
    speed_rad_s=SPEED_RAD_S,
    load=LOAD_UNIT,
    volt=VOLT_UNIT,
    speed_sign=Sign.BIT_10,
    load_sign=Sign.BIT_10,
    torque=LOAD_UNIT,
)


def full_torque_ticks(slope: int) -> int:
    """Return the position error [ticks] at which a servo exerts its full torque, given its compliance slope register.

    The AX-12A has seven compliance slopes, powers of two.
    """
    return 1 << max(slope, 2).bit_length() - 1


# --------------------------------------------------------------------------------------------------- registers


MODEL_NUMBER = _r("model number", 0, 2, 12, eeprom=True)
FIRMWARE = _r("firmware version", 2, 1, 24, eeprom=True)
ID = _rw("id", 3, 1, 1, 0, MAX_ID, eeprom=True)
BAUD_RATE = _rw("baud rate", 4, 1, 1, 0, 254, eeprom=True)
RETURN_DELAY = _rw("return delay", 5, 1, 250, 0, 254, eeprom=True)
CW_ANGLE_LIMIT = _rw("cw angle limit", 6, 2, 0, 0, TICK_MAX, eeprom=True)
CCW_ANGLE_LIMIT = _rw("ccw angle limit", 8, 2, TICK_MAX, 0, TICK_MAX, eeprom=True)
TEMPERATURE_LIMIT = _rw("temperature limit", 11, 1, 70, 0, 150, eeprom=True)
MIN_VOLTAGE = _rw("min voltage", 12, 1, 60, 50, 250, eeprom=True)
MAX_VOLTAGE = _rw("max voltage", 13, 1, 140, 50, 250, eeprom=True)
MAX_TORQUE = _rw("max torque", 14, 2, 1023, 0, 1023, eeprom=True)
STATUS_RETURN_LEVEL = _rw("status return level", 16, 1, 2, 0, 2, eeprom=True)
ALARM_LED = _rw("alarm led", 17, 1, 0x24, 0, 0x7F, eeprom=True)
SHUTDOWN = _rw("shutdown", 18, 1, 0x24, 0, 0x7F, eeprom=True)
TORQUE_ENABLE = _rw("torque enable", 24, 1, 0, 0, 1)
LED = _rw("led", 25, 1, 0, 0, 1)
CW_COMPLIANCE_MARGIN = _rw("cw compliance margin", 26, 1, 1, 0, 254)
CCW_COMPLIANCE_MARGIN = _rw("ccw compliance margin", 27, 1, 1, 0, 254)
CW_COMPLIANCE_SLOPE = _rw("cw compliance slope", 28, 1, 32, 1, 254)
CCW_COMPLIANCE_SLOPE = _rw("ccw compliance slope", 29, 1, 32, 1, 254)
GOAL_POSITION = _rw("goal position", 30, 2, TICK_CENTRE, 0, TICK_MAX)
MOVING_SPEED = _rw("moving speed", 32, 2, 0, 0, 1023)
TORQUE_LIMIT = _rw("torque limit", 34, 2, 1023, 0, 1023)
PRESENT_POSITION = _r("present position", 36, 2, 0)
PRESENT_SPEED = _r("present speed", 38, 2, 0)
PRESENT_LOAD = _r("present load", 40, 2, 0)
PRESENT_VOLTAGE = _r("present voltage", 42, 1, 0)
PRESENT_TEMPERATURE = _r("present temperature", 43, 1, 0)
REGISTERED = _r("registered", 44, 1, 0)
MOVING = _r("moving", 46, 1, 0)
LOCK = _rw("lock", 47, 1, 0, 0, 1)
PUNCH = _rw("punch", 48, 2, 32, 0, 1023)

TABLE_SIZE = 50  # [bytes] of a control table
# fmt: off
REGISTERS = (
    MODEL_NUMBER, FIRMWARE, ID, BAUD_RATE, RETURN_DELAY, CW_ANGLE_LIMIT, CCW_ANGLE_LIMIT, TEMPERATURE_LIMIT,
    MIN_VOLTAGE, MAX_VOLTAGE, MAX_TORQUE, STATUS_RETURN_LEVEL, ALARM_LED, SHUTDOWN, TORQUE_ENABLE, LED,
    CW_COMPLIANCE_MARGIN, CCW_COMPLIANCE_MARGIN, CW_COMPLIANCE_SLOPE, CCW_COMPLIANCE_SLOPE, GOAL_POSITION,
    MOVING_SPEED, TORQUE_LIMIT, PRESENT_POSITION, PRESENT_SPEED, PRESENT_LOAD, PRESENT_VOLTAGE, PRESENT_TEMPERATURE,
    REGISTERED, MOVING, LOCK, PUNCH,
)
# fmt: on


TABLE = ControlTable(
    size=TABLE_SIZE,
    registers=REGISTERS,
    eeprom=range(MODEL_NUMBER.address, SHUTDOWN.address + 1),
    ram=range(TORQUE_ENABLE.address, LOCK.address + 1),
    model_number=MODEL_NUMBER,
    firmware=FIRMWARE,
    id=ID,
    baud_rate=BAUD_RATE,
    return_delay=RETURN_DELAY,
    status_return_level=STATUS_RETURN_LEVEL,
    low_limit=CW_ANGLE_LIMIT,
    high_limit=CCW_ANGLE_LIMIT,
    temperature_limit=TEMPERATURE_LIMIT,
    min_voltage=MIN_VOLTAGE,
    max_voltage=MAX_VOLTAGE,
    max_torque=MAX_TORQUE,
    shutdown=SHUTDOWN,
    torque_enable=TORQUE_ENABLE,
    goal_position=GOAL_POSITION,
    goal_speed=MOVING_SPEED,
    torque_limit=TORQUE_LIMIT,
    present_position=PRESENT_POSITION,
    present_speed=PRESENT_SPEED,
    present_load=PRESENT_LOAD,
    present_voltage=PRESENT_VOLTAGE,
    present_temperature=PRESENT_TEMPERATURE,
    moving=MOVING,
    registered=REGISTERED,
    unlocked=range(TORQUE_ENABLE.address, TORQUE_LIMIT.address + TORQUE_LIMIT.size),
    lock=LOCK,
    compliance=(CW_COMPLIANCE_MARGIN, CCW_COMPLIANCE_MARGIN, CW_COMPLIANCE_SLOPE, CCW_COMPLIANCE_SLOPE),
)


def baud_rate(value: int) -> int:
    """Return the bit rate [1/s] of a baud rate register: 2e6 / (value + 1), rounded."""
    return round(2_000_000 / (value + 1))


# --------------------------------------------------------------------------------------------------- units


def angle_from_ticks(ticks: float) -> float:
    """Return the servo angle [rad] of a position register.

    It is 0 at the centre tick and counterclockwise positive; 1023 ticks are 300 deg.
    """
    return UNITS.angle(ticks)


def ticks_from_angle(angle: float) -> int:
    """Return the nearest position register of a servo angle [rad], not clamped.

    The caller checks the range.
    """
    return UNITS.ticks(angle)


def signed_magnitude(value: int) -> int:
    """Return the signed ticks of a speed or load register.

    Bit 10 means clockwise, which is negative here.
    """
    return signed(value & (2 * DIRECTION_CW - 1), Sign.BIT_10)


def direction_magnitude(value: int) -> int:
    """Compute the inverse of `signed_magnitude`, saturated at 1023."""
    return unsigned(value, Sign.BIT_10)


def speed_from_register(value: int) -> float:
    """Return the speed [rad/s] of a present speed register, counterclockwise positive."""
    return signed_magnitude(value) * SPEED_RAD_S


def register_from_speed(speed: float) -> int:
    """Return the present speed register of a speed [rad/s], counterclockwise positive."""
    return direction_magnitude(round(speed / SPEED_RAD_S))


def moving_speed_from(speed: float) -> int:
    """Return the moving speed register of a speed [rad/s] > 0.

    It is at least 1, because 0 means maximum speed.

    Raises:
        ValueError: The speed is not positive.
    """
    if not speed > 0.0:
        raise ValueError(f"a moving speed greater than 0 rad/s expected, found {speed}; write 0 for uncontrolled speed")
    return min(max(round(speed / SPEED_RAD_S), 1), MOVING_SPEED.max)


def load_from_register(value: int) -> float:
    """Return the load of a register as a fraction of the stall torque.

    It is in [-1.023, 1.023], counterclockwise positive.
    """
    return signed_magnitude(value) * LOAD_UNIT


def register_from_load(load: float) -> int:
    """Return the present load register of a fraction of the stall torque.

    Counterclockwise is positive.
    """
    return direction_magnitude(round(load / LOAD_UNIT))


# --------------------------------------------------------------------------------------------------- packets


class Instruction(IntEnum):
    """Instruction of the host to a servo."""

    PING = 1
    READ = 2
    WRITE = 3
    REG_WRITE = 4
    ACTION = 5
    RESET = 6
    SYNC_WRITE = 0x83


def encode(servo_id: int, code: int, parameters: bytes = b"") -> bytes:
    """Encode a packet: FF FF ID LEN CODE parameters CHECKSUM.

    Raises:
        ValueError: The id is not 0 to 254, or there are more than 253 parameters.
    """
    if not 0 <= servo_id <= BROADCAST_ID:
        raise ValueError(f"servo id 0 to 253, or 254 for all, expected, found {servo_id}")
    if len(parameters) > MAX_PARAMETERS:
        raise ValueError(f"at most {MAX_PARAMETERS} parameter bytes fit a packet, found {len(parameters)}; split it")
    body = bytes((servo_id, len(parameters) + 2, code)) + parameters
    return HEADER + body + bytes((~sum(body) & 0xFF,))


def ping(servo_id: int) -> bytes:
    """Encode a ping of a servo."""
    return encode(servo_id, Instruction.PING)


def read(servo_id: int, address: int, size: int) -> bytes:
    """Encode a read of `size` bytes from an address."""
    return encode(servo_id, Instruction.READ, bytes((address, size)))


def write(servo_id: int, address: int, data: bytes) -> bytes:
    """Encode a write of bytes, starting at an address."""
    return encode(servo_id, Instruction.WRITE, bytes((address,)) + data)


def reg_write(servo_id: int, address: int, data: bytes) -> bytes:
    """Encode a registered write, which waits for `action`."""
    return encode(servo_id, Instruction.REG_WRITE, bytes((address,)) + data)


def action(servo_id: int = BROADCAST_ID) -> bytes:
    """Encode the instruction that executes the registered writes."""
    return encode(servo_id, Instruction.ACTION)


def reset(servo_id: int) -> bytes:
    """Encode a reset of a servo to its factory values, including id and baud rate."""
    return encode(servo_id, Instruction.RESET)


def sync_write(address: int, size: int, rows: Iterable[tuple[int, bytes]]) -> bytes:
    """Encode a write of `size` bytes at one address of several servos.

    The servos do not respond.

    Raises:
        ValueError: A row is not `size` bytes long, or the rows do not fit one packet.
    """
    body = bytearray((address, size))
    for servo_id, data in rows:
        if len(data) != size:
            raise ValueError(f"servo {servo_id}: {size} bytes expected, found {len(data)}")
        body.append(servo_id)
        body += data
    return encode(BROADCAST_ID, Instruction.SYNC_WRITE, bytes(body))


def sync_write_rows(address: int, size: int, rows: bytes) -> bytes:
    """Encode a sync write from rows of an id and `size` bytes each."""
    return encode(BROADCAST_ID, Instruction.SYNC_WRITE, bytes((address, size)) + rows)


def answer_start(servo_id: int) -> bytes:
    """Return the bytes with which a status packet of a servo begins."""
    return HEADER + bytes((servo_id,))


def answer_parser(max_parameters: int) -> "PacketParser":
    """Return a parser of status packets with at most this many parameters."""
    return PacketParser(max_length=max_parameters + 2)


def instruction_parser() -> "PacketParser":
    """Return a parser of instruction packets, which also returns those with a wrong checksum."""
    return PacketParser(keep_broken=True)


def request(packet: Packet) -> Request | None:
    """Return what an instruction packet asks; None if no servo can execute it."""
    given, everyone = packet.parameters, packet.servo_id == BROADCAST_ID
    match packet.code:
        case Instruction.PING:
            return Request(Kind.PING, size=len(given))
        case Instruction.READ if len(given) == 2:
            return Request(Kind.READ, given[0], given[1])
        case Instruction.WRITE if len(given) >= 2:
            return Request(Kind.WRITE, given[0], data=given[1:])
        case Instruction.REG_WRITE if len(given) >= 2:
            return Request(Kind.REGISTER, given[0], data=given[1:])
        case Instruction.ACTION if not given:
            return Request(Kind.ACTION)
        case Instruction.RESET if not given and not everyone:
            return Request(Kind.RESET)
        case Instruction.SYNC_WRITE if everyone and len(given) > 1 and given[1] and (len(given) - 2) % (given[1] + 1) == 0:
            address, size = given[:2]
            starts = range(2, len(given), size + 1)
            rows = tuple((given[at], given[at + 1 : at + 1 + size]) for at in starts)
            return Request(Kind.SYNC_WRITE, address, size, rows=rows)
    return None


def error_code(refusal: int, state: int) -> int:
    """Return the error byte, from the errors of an instruction and those of the servo's state."""
    return refusal | state


def status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Encode a status packet, the response of a servo."""
    return encode(servo_id, error, parameters)


PRESENT_STATE = struct.Struct("<HHHBB")  # position, speed, load, voltage, temperature: the 8 bytes from address 36


class Dropped(StrEnum):
    """Reason for which a parser dropped bytes."""

    NOISE = "noise"  # counts bytes outside packets, not packets
    LENGTH = "bad length"
    CHECKSUM = "bad checksum"
    TRUNCATED = "truncated"


class PacketParser:
    """Parser of packets in a byte stream with noise and broken or truncated packets.

    After a broken packet the search continues right after its header, so an intact packet inside it is found. `flush` gives up
    a packet whose length byte exceeds the received data.
    """

    def __init__(self, max_length: int = 0xFF, *, keep_broken: bool = False) -> None:
        """Start at stream offset 0.

        Args:
            max_length: Largest accepted length byte; a lower value recovers sooner on a bus with short packets.
            keep_broken: Also return packets with a wrong checksum, with `intact` False: a servo responds to those.
        """
        self.dropped: Counter[str] = Counter()  # by `Dropped`; bytes for NOISE, else packets
        self._max_length = max_length
        self._keep_broken = keep_broken
        self._buffer = bytearray()
        self._offset = 0  # stream offset of the buffer's first byte

    @property
    def pending(self) -> int:
        """Number of buffered bytes of an incomplete packet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """Add the next bytes of the stream, and return the completed packets."""
        if not self._buffer and self._is_one_packet(data):  # the usual case
            self._offset += len(data)
            return [Packet(data[2], data[4], bytes(data[5:-1]), self._offset)]
        self._buffer += data
        return self._parse()

    def _is_one_packet(self, data: bytes) -> bool:
        """Return whether the bytes are exactly one intact packet."""
        if len(data) < OVERHEAD or data[:2] != HEADER or data[2] == 0xFF:
            return False
        return data[3] <= self._max_length and len(data) == data[3] + 4 and sum(data[2:]) & 0xFF == 0xFF

    def flush(self) -> list[Packet]:
        """Give up an incomplete packet, and return the intact packets inside it."""
        found: list[Packet] = []
        while len(self._buffer) > 1:
            if len(self._buffer) >= 4:
                self.dropped[Dropped.TRUNCATED] += 1
            self._drop(1)
            found += self._parse()
        self._skip(len(self._buffer))
        return found

    def _parse(self) -> list[Packet]:
        buffer = self._buffer
        found: list[Packet] = []
        while buffer:
            start = buffer.find(HEADER)
            if start:
                # All of it is noise, but a final FF may be the first half of a header.
                self._skip(start if start > 0 else len(buffer) - buffer.endswith(b"\xff"))
                if start < 0:
                    return found
            if len(buffer) < 4:
                if len(buffer) == 3 and buffer[2] == 0xFF:
                    self._skip(1)
                return found
            servo_id, length = buffer[2], buffer[3]
            if servo_id == 0xFF:  # in a run of FF, the header is the last two
                self._skip(1)
                continue
            if not 2 <= length <= self._max_length:
                self.dropped[Dropped.LENGTH] += 1
                self._drop(1)
                continue
            size = length + 4
            if len(buffer) < size:
                return found
            intact = (sum(buffer[2:size]) & 0xFF) == 0xFF  # the checksum is the complement of the sum
            if not intact:
                self.dropped[Dropped.CHECKSUM] += 1
            if intact or self._keep_broken:
                parameters = bytes(buffer[5 : size - 1])
                found.append(Packet(servo_id, buffer[4], parameters, self._offset + size, intact))
            self._drop(size if intact else 1)
        return found

    def _skip(self, count: int) -> None:
        if count:
            self.dropped[Dropped.NOISE] += count
            self._drop(count)

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._offset += count
