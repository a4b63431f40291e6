"""Protocol between the actuator and a microcontroller that drives the servo bus.

docs/bridge.md describes it.

    frame of firmware.framing( msgpack array )        array = [type, field, field ...]

Constants and frames are those of the firmware, which decodes and encodes the same messages on a board.
Every received field is checked, and nothing is repaired. The module has no port and no clock; times are arguments.
"""

from collections import Counter
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Annotated, Any, ClassVar, get_type_hints

from sextant.shared.servo.bridge_fields import Choice, Kind, Octets, Text, Whole, Words
from sextant.shared.servo.firmware.framing import MAX_PAYLOAD, Deframer, frame
from sextant.shared.servo.firmware.wire import (
    AGE_UNIT_US,
    ANGLE_RAD,
    LOAD,
    MAX_ID,
    MAX_LIFETIME_MS,
    MAX_NAME,
    MAX_SERVOS,
    MAX_TABLE,
    MIN_LIFETIME_MS,
    NEVER,
    ORDER_LIFETIME_MS,
    SIGNED_MAX,
    SPEED_RAD_S,
    VERSION,
    VOLT,
)
from sextant.shared.wire.codec import DecodeError, pack_values, unpack_values

__all__ = [
    "AGE_UNIT_US",
    "ANGLE_RAD",
    "LOAD",
    "MAX_SERVOS",
    "NEVER",
    "ORDER_LIFETIME_MS",
    "SIGNED_MAX",
    "SPEED_RAD_S",
    "VERSION",
    "VOLT",
]


class Mode(IntEnum):
    """Mode of the microcontroller."""

    WAITING = 0  # no hello received; it does not access the bus
    ADOPTING = 1  # it reads torque states and goal positions, and writes nothing
    OFF = 2  # torque is off; goals are stored, but not written
    ON = 3  # it writes the received goals to the servos
    HOLDING = 4  # torque is on, but no fresh goals arrive; the last goals stay
    CATCHING_UP = 5  # it follows the goals slowly, after holding or from a new host

    @property
    def words(self) -> str:
        """Mode as text."""
        return self.name.lower().replace("_", " ")


class Refusal(IntEnum):
    """Reason for which the microcontroller refused a command."""

    NONE = 0
    SESSION = 1
    ORDER = 2
    AGE = 3
    COUNT = 4
    NO_GOALS = 5
    FAR = 6
    QUESTION = 7
    BUSY = 8
    VERSION = 9

    @property
    def words(self) -> str:
        """Reason as text."""
        return _REFUSAL_WORDS[self]


_REFUSAL_WORDS = {
    Refusal.NONE: "nothing was refused",
    Refusal.SESSION: "an order of another session",
    Refusal.ORDER: "an order that is not newer than the last",
    Refusal.AGE: "an order that is too old",
    Refusal.COUNT: "values for another number of servos than the session has",
    Refusal.NO_GOALS: "torque on without fresh goals",
    Refusal.FAR: "torque on with a goal far from its servo's position, or with a servo that does not answer",
    Refusal.QUESTION: "a request that is not passed on; torque has a separate order",
    Refusal.BUSY: "more requests than can wait",
    Refusal.VERSION: "a hello of another version",
}


class Result(IntEnum):
    """Result of a request to a servo."""

    ANSWERED = 0
    SILENT = 1  # no response of the servo, or only broken ones
    REFUSED = 2  # by the microcontroller; its state has the reason


class Instruction(IntEnum):
    """Instruction of a request."""

    PING = 1
    READ = 2
    WRITE = 3
    REBOOT = 8  # servos with Protocol 2.0 only


REFUSED = "message refused"  # a reason in the counter of dropped frames


# --------------------------------------------------------------------------------------------------------------- fields

U8 = Annotated[int, Whole(0, 0xFF)]
U16 = Annotated[int, Whole(0, 0xFFFF)]
U32 = Annotated[int, Whole(0, 0xFFFF_FFFF)]
U64 = Annotated[int, Whole(0, (1 << 64) - 1)]
Session = Annotated[int, Whole(1, 0xFFFF_FFFF)]
Signed = Annotated[tuple[int, ...], Words(-SIGNED_MAX, SIGNED_MAX, MAX_SERVOS)]
Unsigned = Annotated[tuple[int, ...], Words(0, SIGNED_MAX, MAX_SERVOS)]
Ages = Annotated[tuple[int, ...], Words(0, NEVER, MAX_SERVOS)]  # [0.1 ms]
PerServo = Annotated[bytes, Octets(MAX_SERVOS)]
Ids = Annotated[bytes, Octets(MAX_SERVOS, MAX_ID)]
Table = Annotated[bytes, Octets(MAX_TABLE)]


# ------------------------------------------------------------------------------------------------------------- messages


class Message:
    """Base class of the messages; raises ValueError for invalid fields."""

    __slots__ = ()
    code: ClassVar[int]  # message type: below 128 from the host to the microcontroller, above in the other direction

    def __post_init__(self) -> None:
        for name, kind in _kinds(type(self)):
            _wire_value(type(self), name, kind.to_wire, getattr(self, name))
        self._agree()

    def _agree(self) -> None:
        """Check conditions between several fields."""


@dataclass(frozen=True, slots=True)
class Hello(Message):
    """Opens a session and lists the servos.

    The version is the first field in every version.
    """

    code = 1
    version: U8
    session: Session  # chosen by the host, different from the last one
    time_us: U64  # [us] host's clock, from any origin, monotonic
    ids: Ids  # servo ids, in the order of the values in all later messages

    def _agree(self) -> None:
        _each_once(self, self.ids)


@dataclass(frozen=True, slots=True)
class Goals(Message):
    """Goal positions and speeds of all servos."""

    code = 2
    session: Session
    sequence: U32  # of commands, increasing
    time_us: U64  # [us] when the goals were computed, host's clock
    lifetime_ms: Annotated[
        int, Whole(MIN_LIFETIME_MS, MAX_LIFETIME_MS)
    ]  # [ms] age from which goals are refused, or no longer fresh
    position: Signed  # [0.1 mrad] servo angles, counterclockwise positive
    speed: Unsigned  # [1 mrad/s] 0 for uncontrolled speed

    def _agree(self) -> None:
        _same_length(self, "position", "speed")


@dataclass(frozen=True, slots=True)
class Torque(Message):
    """Turns torque of all servos on or off.

    Off is executed in any mode, and with any session, sequence and age. It lasts until a command turns torque on.
    """

    code = 3
    session: Session
    sequence: U32
    time_us: U64
    on: Annotated[int, Whole(0, 1)]


@dataclass(frozen=True, slots=True)
class Limits(Message):
    """Torque limits of all servos; writing them ends a servo's shutdown."""

    code = 4
    session: Session
    sequence: U32
    time_us: U64
    limit: Unsigned  # [0.1 %] of the stall torque


@dataclass(frozen=True, slots=True)
class Ask(Message):
    """Instruction for one servo: ping, read, write or reboot.

    The microcontroller sends it to the bus in the packets of its protocol; it is for commissioning and repair.
    """

    code = 5
    session: Session
    sequence: U32
    time_us: U64
    servo_id: Annotated[int, Whole(0, MAX_ID)]
    instruction: U8  # of `Instruction`; the microcontroller refuses others
    address: U16  # of a read or write
    size: Annotated[int, Whole(0, MAX_TABLE)]  # [bytes] of a read
    data: Table  # of a write


@dataclass(frozen=True, slots=True)
class First(Message):
    """Servos that get the next goals first, and are read last before the state after them.

    It is for servos whose bus is too slow for all goals and readings.
    """

    code = 6
    session: Session
    sequence: U32
    time_us: U64
    ids: Ids

    def _agree(self) -> None:
        _each_once(self, self.ids)


@dataclass(frozen=True, slots=True)
class Welcome(Message):
    """Response to a hello.

    It is also sent ten times a second, with session 0, while there is no session.

    The version is the first field in every version.
    """

    code = 129
    version: U8
    session: U32
    boot: U32  # differs after every start
    time_us: U64  # [us] microcontroller's clock
    name: Annotated[str, Text(MAX_NAME)]  # of board and firmware
    servo: Annotated[str, Text(MAX_NAME)]  # model of all servos, by the board's configuration


@dataclass(frozen=True, slots=True)
class State(Message):
    """State of all servos and of the microcontroller, once per cycle."""

    code = 130
    session: Session
    sequence: U32  # of states, increasing
    time_us: U64  # [us] when the state was assembled, microcontroller's clock
    mode: Annotated[Mode, Choice(Mode)]
    heard: U32  # sequence of the newest accepted command
    goals_age: U16  # [0.1 ms] since the newest goals were accepted, NEVER without goals
    refusal: Annotated[Refusal, Choice(Refusal)]  # of the newest refused command
    refused: U32  # number of refused commands
    broken: U32  # number of invalid frames from the host
    silent: U32  # number of requests without a response from the servo
    garbled: U32  # number of servo packets that were broken or unexpected
    position: Signed  # [0.1 mrad] servo angles; these and the next two are counterclockwise positive
    speed: Signed  # [1 mrad/s]
    load: Signed  # [0.1 %] of the stall torque
    voltage: PerServo  # [0.1 V]
    temperature: PerServo  # [deg C]
    error: PerServo  # bits of `ServoError`, for servos of any protocol
    age: Ages  # [0.1 ms] since each servo was read, NEVER without a response

    def _agree(self) -> None:
        _same_length(self, "position", "speed", "load", "voltage", "temperature", "error", "age")


@dataclass(frozen=True, slots=True)
class Answer(Message):
    """Result of an `Ask`."""

    code = 131
    session: Session
    sequence: U32  # of the `Ask`
    result: Annotated[Result, Choice(Result)]
    error: U8  # of the servo's status packet, as its protocol has it
    data: Table


MESSAGES: dict[int, type[Message]] = {m.code: m for m in (Hello, Goals, Torque, Limits, Ask, First, Welcome, State, Answer)}
FROM_HOST = frozenset((Hello, Goals, Torque, Limits, Ask, First))
TO_HOST = frozenset((Welcome, State, Answer))


class OtherVersion(DecodeError):  # noqa: N818  (a state of the other end, handled by the caller)
    """A hello or welcome has another protocol version.

    Its other fields cannot be decoded.
    """

    def __init__(self, version: int):
        super().__init__(f"version {VERSION} of the bridge's wire expected, found version {version}")
        self.version = version


_KINDS: dict[type[Message], tuple[tuple[str, Kind], ...]] = {}


def _kinds(message: type[Message]) -> tuple[tuple[str, Kind], ...]:
    """Return name and kind of each field in protocol order, cached."""
    known = _KINDS.get(message)
    if known is None:
        hints = get_type_hints(message, include_extras=True)
        named = fields(message)  # type: ignore[arg-type]
        known = _KINDS[message] = tuple((field.name, hints[field.name].__metadata__[0]) for field in named)
    return known


def _wire_value(message: type[Message], name: str, turn: Any, value: Any) -> Any:
    try:
        return turn(value)
    except ValueError as error:
        raise ValueError(f"{message.__name__}.{name}: {error}") from None


def _each_once(message: Message, ids: bytes) -> None:
    if not ids or len(set(ids)) != len(ids):
        raise ValueError(f"{type(message).__name__}.ids: at least one id, each once, expected, found {list(ids)}")


def _same_length(message: Message, *names: str) -> None:
    counts = {name: len(getattr(message, name)) for name in names}
    if len(set(counts.values())) > 1:
        raise ValueError(f"{type(message).__name__}: equal numbers of values expected, found {counts}")


# ---------------------------------------------------------------------------------------------------------------- frames


def encode(message: Message) -> bytes:
    """Encode a message as a frame between zeros."""
    kind = type(message)
    values = [field.to_wire(getattr(message, name)) for name, field in _kinds(kind)]
    return frame(pack_values([kind.code, *values]))


def decode(payload: bytes, expected: frozenset[type[Message]]) -> Message:
    """Decode a frame's payload without its CRC.

    Raises:
        OtherVersion: It is a hello or welcome of another version.
        DecodeError: The payload differs from the declaration; nothing is repaired.
    """
    values = unpack_values(payload, MAX_PAYLOAD)
    if type(values) is not list or not values or type(values[0]) is not int:
        raise DecodeError("a message type and its fields expected")
    kind = MESSAGES.get(values[0])
    if kind is None or kind not in expected:
        raise DecodeError(f"one of the types {sorted(k.code for k in expected)} expected, found {values[0]}")
    greeting = kind in (Hello, Welcome) and len(values) > 1 and type(values[1]) is int
    if greeting and values[1] != VERSION:
        raise OtherVersion(values[1])
    kinds = _kinds(kind)
    if len(values) != 1 + len(kinds):
        raise DecodeError(f"{kind.__name__}: {len(kinds)} fields expected, found {len(values) - 1}")
    try:
        return kind(*(_wire_value(kind, name, k.from_wire, v) for (name, k), v in zip(kinds, values[1:], strict=True)))
    except ValueError as error:
        raise DecodeError(str(error)) from None


class Receiver:
    """Decoder of messages in an arbitrary byte stream; it buffers at most one frame."""

    def __init__(self, expected: frozenset[type[Message]]):
        """Start between two frames.

        Args:
            expected: Message types that the other end may send.
        """
        self.refused = 0  # intact frames without a valid message
        self.last_refusal = ""  # reason of the last one
        self.other_version: int | None = None  # version in the other end's last greeting, None if it is this version
        self._expected = expected
        self._frames = Deframer()

    @property
    def dropped(self) -> Counter[str]:
        """Number of broken or refused frames, by reason."""
        return Counter(self._frames.broken) + Counter({REFUSED: self.refused})

    @property
    def pending(self) -> int:
        """Number of buffered bytes of an incomplete frame."""
        return self._frames.pending

    def feed(self, data: bytes) -> list[Message]:
        """Add the next bytes, and return the completed messages."""
        decoded = (self._decoded(payload) for payload in self._frames.feed(data))
        return [message for message in decoded if message is not None]

    def _decoded(self, payload: bytes) -> Message | None:
        try:
            message = decode(payload, self._expected)
        except DecodeError as error:
            self.refused += 1
            self.last_refusal = str(error)
            if isinstance(error, OtherVersion):
                self.other_version = error.version
            return None
        if isinstance(message, Hello | Welcome):
            self.other_version = None
        return message


# ----------------------------------------------------------------------------------------------------------------- times


class RemoteClock:
    """Lower bound of the age of stamps from another clock.

    The age is relative to the fastest message so far.

    Two clocks differ by an offset and a slow drift. The delay of a message beyond that of the fastest message is its age. This
    detects messages that have waited in a buffer, without synchronized clocks.
    """

    _DRIFT = 2e-4  # [s/s] maximum drift between two clocks; that of crystals is 1e-4

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._seen_ns = 0

    def age_ns(self, stamp_us: int, now_ns: int) -> int:
        """Return the age [ns] of a stamp [us] of the other clock that arrives at `now_ns`."""
        offset = now_ns - 1000 * stamp_us
        if self._offset_ns is None:
            self._offset_ns = offset
        self._offset_ns = min(offset, self._offset_ns + self._DRIFT * max(now_ns - self._seen_ns, 0))
        self._seen_ns = now_ns
        return round(offset - self._offset_ns)
