"""The bridge's messages on the board: constants, decoder of the host's messages, encoder of the board's (docs/bridge.md).

`sextant.shared.servo.bridge_protocol` declares the same messages for the host; tests compare the two.
"""

import struct

from .framing import MAX_PAYLOAD, Deframer, frame
from .packing import pack, unpack

VERSION = 2
MAX_SERVOS = 24
MAX_ID = 253
MAX_NAME = 32  # [characters]
MAX_TABLE = 200  # [bytes] of registers in one request
MIN_LIFETIME_MS, MAX_LIFETIME_MS = 20, 1000  # [ms] allowed lifetime of goals
ORDER_LIFETIME_MS = 200  # [ms] older commands except goals are refused; torque off is always accepted
AGE_UNIT_US = 100  # [us] unit of an age in a state
NEVER = 0xFFFF  # age of a value that has not been measured yet
ANGLE_RAD = 1e-4  # [rad] unit of positions
SPEED_RAD_S = 1e-3  # [rad/s] unit of speeds
LOAD = 1e-3  # [1] of the stall torque, unit of loads and torque limits
VOLT = 0.1  # [V] unit of voltages
SIGNED_MAX = 0x7FFF  # largest magnitude of a position, speed or load

HELLO, GOALS, TORQUE, LIMITS, ASK, FIRST = 1, 2, 3, 4, 5, 6
WELCOME, STATE, ANSWER = 129, 130, 131
WAITING, ADOPTING, OFF, ON, HOLDING, CATCHING_UP = 0, 1, 2, 3, 4, 5
NONE, SESSION, ORDER, AGE, COUNT, NO_GOALS, FAR, QUESTION, BUSY, OTHER_VERSION = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
ANSWERED, SILENT, REFUSED = 0, 1, 2
PING, READ, WRITE, REBOOT = 1, 2, 3, 8

_U8, _U16, _U32, _U64 = (0, 0xFF), (0, 0xFFFF), (0, 0xFFFF_FFFF), (0, 0xFFFF_FFFF_FFFF_FFFF)
_SESSION = (1, 0xFFFF_FFFF)
_HEAD = (_SESSION, _U32, _U64)
# Fields of the host's messages: lowest and highest number, or a coding and the largest number of bytes.
_FIELDS = {
    HELLO: (_U8, _SESSION, _U64, ("ids", MAX_SERVOS)),
    GOALS: _HEAD + ((MIN_LIFETIME_MS, MAX_LIFETIME_MS), ("h", 2 * MAX_SERVOS), ("H", 2 * MAX_SERVOS)),
    TORQUE: _HEAD + ((0, 1),),
    LIMITS: _HEAD + (("H", 2 * MAX_SERVOS),),
    ASK: _HEAD + ((0, MAX_ID), _U8, _U16, (0, MAX_TABLE), ("bytes", MAX_TABLE)),
    FIRST: _HEAD + (("ids", MAX_SERVOS),),
}


def decode(payload: bytes) -> list | None:
    """Decode a message of the host to its type and fields; None if it is invalid.

    Positions, speeds and limits become tuples. Of a hello of another version, only type and version are returned.
    """
    values = unpack(payload) if len(payload) <= MAX_PAYLOAD else None
    if not values or type(values[0]) is not int or values[0] not in _FIELDS:
        return None
    code = values[0]
    if code == HELLO and len(values) > 1 and type(values[1]) is int and values[1] != VERSION:
        return values[:2]
    fields = _FIELDS[code]
    if len(values) != 1 + len(fields):
        return None
    found: list = [code]
    for value, field in zip(values[1:], fields):
        valid = _field(value, field)
        if valid is None:
            return None
        found.append(valid)
    return found if code != GOALS or len(found[5]) == len(found[6]) else None


def _field(value: object, field: tuple) -> object:
    """Return the value of a field; None if it is invalid."""
    low, high = field
    if type(low) is int:
        return value if type(value) is int and low <= value <= high else None
    if type(value) is not bytes or len(value) > high:
        return None
    if low == "ids":
        return value if value and max(value) <= MAX_ID and len(set(value)) == len(value) else None
    if low == "bytes":
        return value
    if len(value) % 2:
        return None
    numbers = struct.unpack("<" + str(len(value) // 2) + low, value)
    if low == "h":
        return numbers if not numbers or min(numbers) >= -SIGNED_MAX else None
    return numbers if not numbers or max(numbers) <= SIGNED_MAX else None


def welcome(session: int, boot: int, now_us: int, name: str, servo: str) -> bytes:
    """Encode the greeting of the board."""
    return frame(pack([WELCOME, VERSION, session, boot, now_us, name, servo]))


def answer(session: int, sequence: int, result: int, error: int, data: bytes) -> bytes:
    """Encode the result of a request to a servo."""
    return frame(pack([ANSWER, session, sequence, result, error, data]))


def state(numbers: list[int], columns: list[list[int]]) -> bytes:
    """Encode the state of the board and its servos.

    Args:
        numbers: The eleven fields before the positions: session, sequence, time and so on.
        columns: Positions, speeds, loads, voltages, temperatures, errors and ages of all servos.
    """
    position, speed, load, voltage, temperature, error, age = columns
    n = str(len(position))
    fields: list[object] = [STATE]
    fields += numbers
    for column in (position, speed, load):
        fields.append(struct.pack("<" + n + "h", *column))
    for column in (voltage, temperature, error):
        fields.append(bytes(column))
    fields.append(struct.pack("<" + n + "H", *age))
    return frame(pack(fields))


class Receiver:
    """Decoder of the host's messages in an arbitrary byte stream."""

    def __init__(self) -> None:
        """Start between two frames."""
        self.refused = 0  # intact frames without a valid message
        self._frames = Deframer()

    @property
    def dropped(self) -> int:
        """Number of broken or refused frames."""
        return sum(self._frames.broken.values()) + self.refused

    def feed(self, data: bytes) -> list[list]:
        """Add the next bytes, and return the completed messages."""
        messages = []
        for payload in self._frames.feed(data):
            message = decode(payload)
            if message is None or len(message) == 2:  # a hello of another version counts as refused, too
                self.refused += 1
            if message is not None:
                messages.append(message)
        return messages


class RemoteClock:
    """Lower bound of the age of stamps from another clock, relative to the fastest message so far."""

    _DRIFT = 5000  # [us] in which two clocks may drift apart by 1 us

    def __init__(self) -> None:
        """Start without a message."""
        self._offset_us: int | None = None
        self._seen_us = 0
        self._rest_us = 0

    def age_us(self, stamp_us: int, now_us: int) -> int:
        """Return the age [us] of a stamp [us] of the other clock that arrives at `now_us`."""
        offset = now_us - stamp_us
        if self._offset_us is None:
            self._offset_us = offset
        else:
            self._rest_us += max(now_us - self._seen_us, 0)
            self._offset_us = min(offset, self._offset_us + self._rest_us // self._DRIFT)
            self._rest_us %= self._DRIFT
        self._seen_us = now_us
        return offset - self._offset_us
