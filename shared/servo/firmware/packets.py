"""Packets of the servo buses on the board: Dynamixel Protocol 1.0, which Feetech servos use too, 2.0, and LewanSoul.

Sources and details are in `sextant.shared.servo.dynamixel`, `dynamixel2` and `lx16a`; tests compare the two byte for byte.
"""

BROADCAST_ID = 0xFE
_PING, _READ, _WRITE, _REBOOT, _STATUS, _SYNC_WRITE = 1, 2, 3, 8, 0x55, 0x83
_ID_READ = 14  # of a LewanSoul servo
# Parameters [bytes] of the answers to its commands that read, and of its commands that write.
READS = {2: 4, 8: 4, 14: 1, 19: 1, 21: 4, 23: 4, 25: 1, 26: 1, 27: 2, 28: 2, 30: 4, 32: 1, 34: 1, 36: 1}
WRITES = {1: 4, 7: 4, 13: 1, 17: 1, 20: 4, 22: 4, 24: 1, 29: 4, 31: 1, 33: 1, 35: 1}
_STUFFED = b"\xff\xff\xfd"


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x18005) if crc & 0x8000 else crc << 1
        table.append(crc)
    return table


_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """Return the CRC of Protocol 2.0: polynomial 0x8005, highest bit first, initial value 0."""
    crc, table = 0, _TABLE
    for byte in data:
        crc = (crc & 0xFF) << 8 ^ table[crc >> 8 ^ byte]
    return crc


class Protocol1:
    """Instructions of Protocol 1.0: FF FF id length instruction parameters checksum."""

    HEADER = b"\xff\xff"
    OVERHEAD = 6  # bytes of an answer besides its parameters
    COUNTED = 2  # bytes besides the parameters that the length counts
    PING_SIZE = 0  # [bytes] of parameters in the answer to a ping

    def encode(self, servo_id: int, code: int, parameters: bytes) -> bytes:
        """Encode a packet."""
        body = bytes((servo_id, len(parameters) + self.COUNTED, code)) + parameters
        return self.HEADER + body + bytes((~sum(body) & 0xFF,))

    def number(self, value: int) -> bytes:
        """Encode an address or a size."""
        return bytes((value,))

    def next_packet(self, data: bytes, max_parameters: int) -> tuple:
        """Find the first packet after a header.

        Returns:
            Number of bytes to drop, whether they are lost, and the packet (id, error, parameters) or None. No bytes to drop
            means that the next bytes decide.
        """
        if len(data) < 4:
            return 0, False, None
        if data[2] == 0xFF or not 2 <= data[3] <= max_parameters + 2:
            return 1, True, None
        return self._checked(data, data[3] + 4)

    def _checked(self, data: bytes, size: int) -> tuple:
        """Check the sum of the first packet, of `size` bytes; see `next_packet`."""
        if len(data) < size:
            return 0, False, None
        if sum(data[2:size]) & 0xFF != 0xFF:
            return 1, True, None
        return size, False, (data[2], data[4], data[5 : size - 1])

    def answer_code(self, request: bytes) -> int:
        """Return the code of the right answer to a request, -1 for any."""
        return -1

    def ping(self, servo_id: int) -> bytes:
        """Encode a ping of a servo."""
        return self.encode(servo_id, _PING, b"")

    def read(self, servo_id: int, address: int, size: int) -> bytes:
        """Encode a read of `size` bytes from an address."""
        return self.encode(servo_id, _READ, self.number(address) + self.number(size))

    def write(self, servo_id: int, address: int, data: bytes) -> bytes:
        """Encode a write of bytes, starting at an address."""
        return self.encode(servo_id, _WRITE, self.number(address) + data)

    def sync_write(self, address: int, size: int, rows: bytes) -> bytes:
        """Encode a write of several servos, from rows of an id and `size` bytes each."""
        return self.encode(BROADCAST_ID, _SYNC_WRITE, self.number(address) + self.number(size) + rows)

    def reboot(self, servo_id: int) -> bytes:
        """Encode a reboot; Protocol 1.0 has none, and the bytes are empty."""
        return b""


class Protocol2(Protocol1):
    """Instructions of Protocol 2.0: FF FF FD 00 id length instruction parameters CRC."""

    HEADER = b"\xff\xff\xfd\x00"
    OVERHEAD = 11
    PING_SIZE = 3

    def encode(self, servo_id: int, code: int, parameters: bytes) -> bytes:
        """Encode a packet, with byte stuffing."""
        body = (bytes((code,)) + parameters).replace(_STUFFED, _STUFFED + b"\xfd")
        packet = self.HEADER + bytes((servo_id,)) + self.number(len(body) + 2) + body
        return packet + self.number(crc16(packet))

    def number(self, value: int) -> bytes:
        """Encode an address or a size."""
        return value.to_bytes(2, "little")

    def next_packet(self, data: bytes, max_parameters: int) -> tuple:
        """Find the first status packet after a header; see `Protocol1.next_packet`."""
        if len(data) < 7:
            return 0, False, None
        length = data[5] | data[6] << 8
        # The stuffing adds a byte to three at most.
        if data[4] > 0xFC or not 4 <= length <= max_parameters + 4 + max_parameters // 3:
            return 1, True, None
        size = 7 + length
        if data.find(self.HEADER, 5, size - 1) >= 0:  # the packet was cut off: stuffing leaves no header inside
            return 1, True, None
        if len(data) < size:
            return 0, False, None
        if crc16(data[: size - 2]) != data[size - 2] | data[size - 1] << 8:
            return 1, True, None
        if data[7] != _STATUS:
            return size, True, None
        body = data[7 : size - 2].replace(_STUFFED + b"\xfd", _STUFFED)
        return size, False, (data[4], body[1], body[2:])

    def reboot(self, servo_id: int) -> bytes:
        """Encode a reboot of a servo."""
        return self.encode(servo_id, _REBOOT, b"")


class LewanSoul(Protocol1):
    """Commands of LewanSoul servos: 55 55 id length command parameters checksum. Only commands that read are answered.

    An address is a command here, and the error of an answer is its command.
    """

    HEADER = b"\x55\x55"
    COUNTED = 3
    PING_SIZE = 1

    def next_packet(self, data: bytes, max_parameters: int) -> tuple:
        """Find the first answer after a header; see `Protocol1.next_packet`."""
        if len(data) < 5:
            return 0, False, None
        if data[2] > BROADCAST_ID or data[3] != READS.get(data[4], -1) + 3:
            return 1, True, None
        return self._checked(data, data[3] + 3)

    def answer_code(self, request: bytes) -> int:
        """Return the command of a request."""
        return request[4]

    def ping(self, servo_id: int) -> bytes:
        """Encode a read of the id of a servo."""
        return self.encode(servo_id, _ID_READ, b"")

    def read(self, servo_id: int, address: int, size: int) -> bytes:
        """Encode a command that reads."""
        return self.encode(servo_id, address, b"")

    def write(self, servo_id: int, address: int, data: bytes) -> bytes:
        """Encode a command that writes."""
        return self.encode(servo_id, address, data)


class Parser:
    """Parser of answers in a byte stream with noise and broken or truncated packets."""

    def __init__(self, protocol: Protocol1, max_parameters: int):
        """Start without bytes.

        Args:
            protocol: Protocol of the bus.
            max_parameters: Largest number of parameters of an answer; a lower value recovers sooner.
        """
        self.dropped = 0  # bytes outside of packets, and broken packets
        self._protocol = protocol
        self._max_parameters = max_parameters
        self._buffer = b""

    def feed(self, data: bytes) -> list[tuple]:
        """Add the next bytes, and return the completed answers: id, error, parameters."""
        if data:
            self._buffer += data
        return self._parse()

    def flush(self) -> list[tuple]:
        """Give up an incomplete packet, and return the intact packets inside it."""
        found = []
        while self._buffer:
            self._drop(1, True)
            found += self._parse()
        return found

    def _parse(self) -> list[tuple]:
        found: list[tuple] = []
        header = self._protocol.HEADER
        while self._buffer:
            start = self._buffer.find(header)
            if start < 0:  # the last bytes may be the first ones of a header
                keep = len(header) - 1
                while keep and not self._buffer.endswith(header[:keep]):
                    keep -= 1
                self._drop(len(self._buffer) - keep, True)
                break
            self._drop(start, True)
            count, lost, packet = self._protocol.next_packet(self._buffer, self._max_parameters)
            if not count:
                break
            self._drop(count, lost)
            if packet is not None:
                found.append(packet)
        return found

    def _drop(self, count: int, lost: bool) -> None:
        if count:
            self._buffer = self._buffer[count:]
            if lost:
                self.dropped += 1
