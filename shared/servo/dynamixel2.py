"""Dynamixel Protocol 2.0: packets, without port or clock.

    FF FF FD 00 | id | length, 2 bytes | instruction | parameters | CRC-16, 2 bytes

Numbers are little-endian. In instruction and parameters, FD follows each FF FF FD, so no header occurs there (byte stuffing).
A status packet has the instruction 55, and its first parameter is the error.

Sources: ROBOTIS e-manual, Protocol 2.0 (https://emanual.robotis.com/docs/en/dxl/protocol2/) and CRC Calculation.
"""

from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum

from sextant.shared.servo.servo_model import Kind, Packet, Request, ServoError
from sextant.shared.servo.stream_parser import Dropped, StreamParser

NAME = "Dynamixel Protocol 2.0"
HEADER = b"\xff\xff\xfd\x00"
BROADCAST_ID = 0xFE
MAX_ID = 0xFC
OVERHEAD = 11  # bytes of a status packet besides its parameters: header, id, length, instruction, error, CRC
PING_SIZE = 3  # bytes of parameters in the response to a ping: model number, 2 bytes, and firmware version
MAX_LENGTH = 0xFFFF
ALERT = 1 << 7  # bit of the error byte: the hardware error status register holds the cause

_STUFFED = HEADER[:3]
_STUFFING = b"\xfd"
HEAD = 7  # [bytes] of header, id and length
_CRC = 2  # [bytes]
_COMBINED_HEAD = HEAD + 1  # [bytes] of a combined status before its first part
ROW_OVERHEAD = 4  # bytes of a servo's part of a combined status besides its data: error, id, CRC


class Instruction(IntEnum):
    """Instruction of the host to a servo, and the one of status packets."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


_STATUS = int(Instruction.STATUS)  # a member of an enumeration is slower to look up


class Reset(IntEnum):
    """Registers that a factory reset sets to their factory values."""

    ALL = 0xFF  # servos ignore it for all ids, from firmware 42
    ALL_BUT_ID = 0x01
    ALL_BUT_ID_AND_BAUD_RATE = 0x02


class Error(IntEnum):
    """Error number of a status packet, in the low 7 bits of the error byte."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


_ERRORS: dict[int, tuple[str, ServoError]] = {
    Error.RESULT_FAIL: ("instruction not executed", ServoError.INSTRUCTION),
    Error.INSTRUCTION: ("undefined instruction, or action without registered write", ServoError.INSTRUCTION),
    Error.CRC: ("CRC of the instruction was wrong", ServoError.CHECKSUM),
    Error.DATA_RANGE: ("value out of range", ServoError.RANGE),
    Error.DATA_LENGTH: ("fewer bytes than the register has", ServoError.RANGE),
    Error.DATA_LIMIT: ("value outside a limit of the servo", ServoError.RANGE),
    Error.ACCESS: ("no access to this address, or EEPROM written with torque enabled", ServoError.RANGE),
}
# Errors of Protocol 1.0 by the error byte. The alert bit adds none: the hardware error status register holds its cause.
ERRORS = tuple(_ERRORS[number][1] if number in _ERRORS else ServoError.NONE for number in range(ALERT)) * 2


def error_words(error: int) -> str:
    """Return an error byte as text, empty for 0."""
    number = error & ~ALERT
    words = [_ERRORS[number][0] if number in _ERRORS else f"unknown error {number}"] if number else []
    return ", ".join([*words, "hardware error"] if error & ALERT else words)


def _shifted(crc: int) -> int:
    for _ in range(8):
        crc = (crc << 1) ^ 0x18005 if crc & 0x8000 else crc << 1
    return crc


_TABLE = tuple(_shifted(byte << 8) for byte in range(256))


def crc16(data: bytes, start: int = 0) -> int:
    """Return the CRC of bytes: polynomial 0x8005, highest bit first, initial value 0.

    Args:
        data: Bytes, from the header on.
        start: CRC of the bytes before them.
    """
    crc, table = start, _TABLE
    for byte in data:
        crc = (crc & 0xFF) << 8 ^ table[crc >> 8 ^ byte]
    return crc


_HEADER_CRC = crc16(HEADER)


# ------------------------------------------------------------------------------------------------ instructions


def encode(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Encode a packet, with byte stuffing.

    Raises:
        ValueError: The id is not 0 to 252 or 254, or there are too many parameters.
    """
    if not (0 <= servo_id <= MAX_ID or servo_id == BROADCAST_ID):
        raise ValueError(f"servo id 0 to {MAX_ID}, or {BROADCAST_ID} for all, expected, found {servo_id}")
    return _framed(servo_id, (bytes((instruction,)) + parameters).replace(_STUFFED, _STUFFED + _STUFFING))


def _framed(servo_id: int, body: bytes) -> bytes:
    """Add header, id, length and CRC to instruction and parameters."""
    length = len(body) + _CRC
    if length > MAX_LENGTH:
        raise ValueError(
            f"at most {MAX_LENGTH - _CRC} bytes of instruction and parameters fit a packet, found {len(body)}; split it"
        )
    packet = HEADER + bytes((servo_id,)) + length.to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(_CRC, "little")


def ping(servo_id: int) -> bytes:
    """Encode a ping of a servo; all servos respond to a ping of all ids, in turn."""
    return encode(servo_id, Instruction.PING)


def read(servo_id: int, address: int, size: int) -> bytes:
    """Encode a read of `size` bytes from an address."""
    return encode(servo_id, Instruction.READ, _u16(address) + _u16(size))


def write(servo_id: int, address: int, data: bytes) -> bytes:
    """Encode a write of bytes, starting at an address."""
    return encode(servo_id, Instruction.WRITE, _u16(address) + data)


def reg_write(servo_id: int, address: int, data: bytes) -> bytes:
    """Encode a registered write, which waits for `action`."""
    return encode(servo_id, Instruction.REG_WRITE, _u16(address) + data)


def action(servo_id: int = BROADCAST_ID) -> bytes:
    """Encode the instruction that executes the registered writes."""
    return encode(servo_id, Instruction.ACTION)


def reset(servo_id: int, what: Reset = Reset.ALL) -> bytes:
    """Encode a reset of a servo to its factory values."""
    return encode(servo_id, Instruction.FACTORY_RESET, bytes((what,)))


def reboot(servo_id: int) -> bytes:
    """Encode a reboot of a servo, which ends a shutdown by a hardware error."""
    return encode(servo_id, Instruction.REBOOT)


def clear(servo_id: int) -> bytes:
    """Encode the instruction that reduces the position of a stopped servo to one turn."""
    return encode(servo_id, Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")


def sync_read(address: int, size: int, ids: Iterable[int]) -> bytes:
    """Encode a read of `size` bytes at one address of several servos.

    Each of them responds, in this order.
    """
    return encode(BROADCAST_ID, Instruction.SYNC_READ, _u16(address) + _u16(size) + b"".join(map(_id, ids)))


def fast_sync_read(address: int, size: int, ids: Iterable[int]) -> bytes:
    """Encode a read of `size` bytes at one address of several servos.

    They respond in this order with one combined status packet; see `split_status`.
    """
    return encode(BROADCAST_ID, Instruction.FAST_SYNC_READ, _u16(address) + _u16(size) + b"".join(map(_id, ids)))


def sync_write(address: int, size: int, rows: Iterable[tuple[int, bytes]]) -> bytes:
    """Encode a write of `size` bytes at one address of several servos.

    The servos do not respond.

    Raises:
        ValueError: A row is not `size` bytes long, or the rows do not fit one packet.
    """
    body = bytearray()
    for servo_id, data in rows:
        if len(data) != size:
            raise ValueError(f"servo {servo_id}: {size} bytes expected, found {len(data)}")
        body += _id(servo_id) + data
    return sync_write_rows(address, size, bytes(body))


def sync_write_rows(address: int, size: int, rows: bytes) -> bytes:
    """Encode a sync write from rows of an id and `size` bytes each."""
    return encode(BROADCAST_ID, Instruction.SYNC_WRITE, _u16(address) + _u16(size) + rows)


def bulk_read(rows: Iterable[tuple[int, int, int]]) -> bytes:
    """Encode a read of several servos, from rows of id, address and size.

    Each of them responds, in this order.
    """
    return encode(BROADCAST_ID, Instruction.BULK_READ, _bulk_rows(rows))


def fast_bulk_read(rows: Iterable[tuple[int, int, int]]) -> bytes:
    """Encode a read of several servos, from rows of id, address and size.

    They respond in this order with one combined status packet; see `split_status`.
    """
    return encode(BROADCAST_ID, Instruction.FAST_BULK_READ, _bulk_rows(rows))


def bulk_write(rows: Iterable[tuple[int, int, bytes]]) -> bytes:
    """Encode a write of several servos, from rows of id, address and data.

    The servos do not respond.
    """
    body = b"".join(_id(servo_id) + _u16(address) + _u16(len(data)) + data for servo_id, address, data in rows)
    return encode(BROADCAST_ID, Instruction.BULK_WRITE, body)


def _bulk_rows(rows: Iterable[tuple[int, int, int]]) -> bytes:
    return b"".join(_id(servo_id) + _u16(address) + _u16(size) for servo_id, address, size in rows)


def _id(servo_id: int) -> bytes:
    if not 0 <= servo_id <= MAX_ID:
        raise ValueError(f"servo id 0 to {MAX_ID} expected, found {servo_id}")
    return bytes((servo_id,))


def _u16(value: int) -> bytes:
    if not 0 <= value <= 0xFFFF:
        raise ValueError(f"address or size 0 to 65535 expected, found {value}")
    return value.to_bytes(2, "little")


# --------------------------------------------------------------------------------------------------- responses


def status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Encode a status packet, the response of a servo."""
    return encode(servo_id, Instruction.STATUS, bytes((error,)) + parameters)


def combined_status(rows: Iterable[tuple[int, int, bytes]]) -> bytes:
    """Encode the response to a fast read, from rows of id, error and data.

    Each CRC covers the packet up to it. There is no byte stuffing.
    """
    parts = [bytes((error,)) + _id(servo_id) + data for servo_id, error, data in rows]
    packet = HEADER + bytes((BROADCAST_ID,)) + _u16(combined_length([len(part) - 2 for part in parts])) + bytes((_STATUS,))
    for part in parts:
        packet += part
        packet += crc16(packet).to_bytes(_CRC, "little")
    return packet


def with_part(packet: bytes, count: int, index: int, make: Callable[[int], bytes]) -> bytes:
    """Return the response to a fast read in which one of `count` equal parts is replaced by other bytes.

    `make` returns as many bytes as the part has, CRC included. The CRCs behind it cover the bytes that those servos have then
    received.
    """
    size = (len(packet) - _COMBINED_HEAD) // count
    spoilt = bytearray(packet)
    for k in range(index, count):
        begin, end = _COMBINED_HEAD + k * size, _COMBINED_HEAD + (k + 1) * size
        if k == index:
            spoilt[begin:end] = make(size)
        else:
            spoilt[end - _CRC : end] = crc16(bytes(spoilt[: end - _CRC])).to_bytes(_CRC, "little")
    return bytes(spoilt)


def combined_length(sizes: Sequence[int]) -> int:
    """Return the length field of the response to a fast read; a parser must accept it."""
    return 1 + sum(sizes) + ROW_OVERHEAD * len(sizes)


def split_status(packet: Packet, sizes: Sequence[int]) -> list[Packet]:
    """Return the status packets of the servos in the response to a fast read.

    A part counts if its own CRC is right. The last CRC alone does not protect the parts before it: the last servo may have
    computed it from the same spoilt bytes.

    Args:
        packet: Combined status packet, possibly broken or cut short.
        sizes: Bytes that were read from each servo, in the order of the instruction.
    """
    length, found = combined_length(sizes), []
    body = bytes((packet.code,)) + packet.parameters
    if packet.intact and len(body) != length - 1 - _CRC:
        return []  # these are not the sizes of this packet
    crc, at = crc16(HEADER + bytes((packet.servo_id,)) + _u16(length) + bytes((_STATUS,))), 0
    for size in sizes:
        end = at + 2 + size
        data, own = body[at:end], body[end : end + _CRC]
        crc = crc16(data, crc)
        is_last = packet.intact and end == len(body)  # the parser has compared its CRC
        if is_last or (len(own) == _CRC and crc == int.from_bytes(own, "little")):
            found.append(Packet(data[1], data[0], data[2:], packet.end))
        crc, at = crc16(own, crc), end + _CRC
    return found


def answer_start(servo_id: int) -> bytes:
    """Return the bytes with which a status packet of a servo begins."""
    return HEADER + bytes((servo_id,))


def answer_parser(max_parameters: int) -> "PacketParser":
    """Return a parser of status packets with at most this many parameters."""
    return PacketParser(OVERHEAD - HEAD + max_parameters + (max_parameters + 1) // len(_STUFFED))


def instruction_parser() -> "PacketParser":
    """Return a parser of instruction packets, which also returns those with a wrong checksum."""
    return PacketParser(keep_broken=True, instructions=True)


def request(packet: Packet) -> Request | None:
    """Return what an instruction packet asks; None if no servo can execute it."""
    given, everyone = packet.parameters, packet.servo_id == BROADCAST_ID
    address, size = (int.from_bytes(given[at : at + 2], "little") for at in (0, 2))
    match packet.code:
        case Instruction.PING:
            return Request(Kind.PING, size=len(given))
        case Instruction.READ if len(given) == 4:
            return Request(Kind.READ, address, size)
        case Instruction.WRITE if len(given) >= 3:
            return Request(Kind.WRITE, address, data=given[2:])
        case Instruction.REG_WRITE if len(given) >= 3:
            return Request(Kind.REGISTER, address, data=given[2:])
        case Instruction.ACTION if not given:
            return Request(Kind.ACTION)
        case Instruction.FACTORY_RESET if len(given) == 1 and not everyone:
            return Request(Kind.RESET)
        case Instruction.REBOOT if not given:
            return Request(Kind.REBOOT)
        case Instruction.SYNC_WRITE if everyone and size and (len(given) - 4) % (size + 1) == 0:
            rows = tuple((given[at], given[at + 1 : at + 1 + size]) for at in range(4, len(given), size + 1))
            return Request(Kind.SYNC_WRITE, address, size, rows=rows)
        case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ if everyone and size and len(given) > 4:
            kind = Kind.SYNC_READ if packet.code == Instruction.SYNC_READ else Kind.FAST_SYNC_READ
            return Request(kind, address, size, rows=tuple((servo_id, b"") for servo_id in given[4:]))
    return None


_NUMBERS = {ServoError.RANGE: Error.DATA_RANGE, ServoError.ANGLE_LIMIT: Error.DATA_LIMIT, ServoError.CHECKSUM: Error.CRC}


def error_code(refusal: int, state: int) -> int:
    """Return the error byte, from the errors of an instruction and those of the servo's state, which only set the alert bit."""
    number = next((number for error, number in _NUMBERS.items() if refusal & error), Error.INSTRUCTION if refusal else 0)
    return number | (ALERT if state else 0)


class PacketParser(StreamParser):
    """Parser of status packets, or of instruction packets.

    The code of a status packet is its error byte, that of an instruction packet its instruction. A header inside a packet shows
    that the packet was truncated, because of the byte stuffing; only a combined status may contain one. A parser that keeps
    broken packets also returns a combined status that was cut short, when it is flushed: `split_status` finds its whole parts.
    """

    header = HEADER
    head_size = HEAD

    def __init__(self, max_length: int = MAX_LENGTH, *, keep_broken: bool = False, instructions: bool = False) -> None:
        """Start at stream offset 0; see `StreamParser`."""
        super().__init__(max_length, keep_broken=keep_broken, instructions=instructions)

    def feed(self, data: bytes) -> list[Packet]:
        """Add the next bytes of the stream, and return the completed packets."""
        if not self._buffer and self._is_one_packet(data):  # the usual case
            self._offset += len(data)
            at = HEAD if self._instructions else HEAD + 1
            return [Packet(data[4], data[at], bytes(data[at + 1 : -_CRC]), self._offset)]
        return super().feed(data)

    def flush(self) -> list[Packet]:
        """Give up an incomplete packet, and return the intact packets inside it."""
        found: list[Packet] = []
        if self._keep_broken and not self._instructions and self._is_combined() and self.pending > HEAD + 1:
            end = self._offset + self.pending
            found.append(Packet(BROADCAST_ID, self._buffer[HEAD + 1], bytes(self._buffer[HEAD + 2 :]), end, intact=False))
        return found + super().flush()

    def _is_one_packet(self, data: bytes) -> bool:
        """Return whether the bytes are exactly one intact packet of the wanted kind, without byte stuffing."""
        size = len(data)
        return (
            size >= OVERHEAD - self._instructions
            and data.startswith(HEADER)
            and (data[HEAD] != _STATUS) == self._instructions
            and size - HEAD == data[5] | data[6] << 8 <= self._max_length
            and data.find(_STUFFED, 4) < 0
            and (data[4] <= MAX_ID or data[4] == BROADCAST_ID)
            and crc16(data[4:-2], _HEADER_CRC) == data[-2] | data[-1] << 8
        )

    def _size(self) -> int | Dropped | None:
        buffer = self._buffer
        if len(buffer) < HEAD:
            return None
        if not (buffer[4] <= MAX_ID or buffer[4] == BROADCAST_ID):
            return Dropped.NOISE
        length = buffer[5] | buffer[6] << 8
        size = HEAD + length
        if not 1 + _CRC <= length <= self._max_length:
            return Dropped.LENGTH
        if len(buffer) > HEAD and buffer[HEAD] == _STATUS and length < OVERHEAD - HEAD:
            return Dropped.LENGTH
        # The CRC has no byte stuffing: with the byte before it, it may look like the end of a header.
        if buffer.find(HEADER, HEAD - 2, size - 1) >= 0 and not self._is_combined():
            return Dropped.TRUNCATED
        return size

    def _is_combined(self) -> bool:
        """Return whether the buffer starts with the response to a fast read."""
        return len(self._buffer) > HEAD and self._buffer[4] == BROADCAST_ID and self._buffer[HEAD] == _STATUS

    def _is_intact(self, raw: bytes) -> bool:
        return crc16(raw[4:-2], _HEADER_CRC) == raw[-2] | raw[-1] << 8

    def _is_instruction(self, raw: bytes) -> bool:
        return raw[HEAD] != _STATUS

    def _decode(self, raw: bytes, end: int, *, intact: bool) -> Packet:
        body = raw[HEAD:-_CRC]
        if not (body[0] == _STATUS and raw[4] == BROADCAST_ID):
            body = body.replace(_STUFFED + _STUFFING, _STUFFED)
        if body[0] == _STATUS:
            body = body[1:]
        return Packet(raw[4], body[0], body[1:], end, intact)
