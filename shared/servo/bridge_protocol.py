"""The wire between the actuator and a microcontroller that speaks the servo bus in its place; docs/bridge.md describes it.

    frame of shared.framing( msgpack array )        array = [type, field, field ...]

What comes is checked field by field and never repaired. Nothing here has a port or a clock: bytes in, messages out, times as
arguments.
"""

from collections import Counter
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Annotated, Any, ClassVar, get_type_hints

from sextant.shared.servo.bridge_fields import Choice, Kind, Octets, Text, Whole, Words
from sextant.shared.servo.dynamixel import MAX_ID, TABLE_SIZE, TICK_MAX
from sextant.shared.servo.framing import MAX_PAYLOAD, Deframer, frame
from sextant.shared.wire.codec import DecodeError, pack_values, unpack_values

VERSION = 1
MAX_SERVOS = 24
MAX_NAME = 32  # [characters]
LIFETIME_MS = (20, 1000)  # [ms] that goals may be given
ORDER_LIFETIME_MS = 200  # [ms] older orders that are not goals are refused; torque off never is
AGE_UNIT_US = 100  # [us] of an age in a state
SIGNED_MAX = 0x7FF  # a speed or load: magnitude, and bit 10 for clockwise
NEVER = 0xFFFF  # an age: it has not been measured yet


class Mode(IntEnum):
    """What the microcontroller does."""

    WAITING = 0  # nobody has said hello: it touches nothing
    ADOPTING = 1  # it reads which torques are on and where the goals are, and writes nothing
    OFF = 2  # torque is off; goals are kept, not written
    ON = 3  # it passes goals on
    HOLDING = 4  # torque is on and no fresh goals come: the last ones stand
    CATCHING_UP = 5  # goals had gone ahead while it held, or come from a new host: it follows them slowly

    @property
    def words(self) -> str:
        """In words."""
        return self.name.lower().replace("_", " ")


class Refusal(IntEnum):
    """Why the microcontroller did not do what it was told."""

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
        """In words."""
        return _REFUSAL_WORDS[self]


_REFUSAL_WORDS = {
    Refusal.NONE: "nothing was refused",
    Refusal.SESSION: "an order of another session",
    Refusal.ORDER: "an order that is not newer than the last",
    Refusal.AGE: "an order that is too old",
    Refusal.COUNT: "values for another number of servos than the session has",
    Refusal.NO_GOALS: "torque on without fresh goals",
    Refusal.FAR: "torque on with a goal that is far from where its servo is, or with a servo that is not heard",
    Refusal.QUESTION: "a question or a write that is not passed on; torque has an order of its own",
    Refusal.BUSY: "more questions than can wait",
    Refusal.VERSION: "a hello of another version",
}


class Result(IntEnum):
    """What became of a question to a servo."""

    ANSWERED = 0
    SILENT = 1  # no answer of the servo, or none that was intact
    REFUSED = 2  # by the microcontroller; its state says why


REFUSED = "message refused"  # among the reasons for which frames are dropped


# --------------------------------------------------------------------------------------------------------------- fields

U8 = Annotated[int, Whole(0, 0xFF)]
U16 = Annotated[int, Whole(0, 0xFFFF)]
U32 = Annotated[int, Whole(0, 0xFFFF_FFFF)]
U64 = Annotated[int, Whole(0, (1 << 64) - 1)]
Session = Annotated[int, Whole(1, 0xFFFF_FFFF)]
Ticks = Annotated[tuple[int, ...], Words(TICK_MAX, MAX_SERVOS)]
SignedTicks = Annotated[tuple[int, ...], Words(SIGNED_MAX, MAX_SERVOS)]
Ages = Annotated[tuple[int, ...], Words(NEVER, MAX_SERVOS)]  # [0.1 ms]
PerServo = Annotated[bytes, Octets(MAX_SERVOS)]
Ids = Annotated[bytes, Octets(MAX_SERVOS, MAX_ID)]
Table = Annotated[bytes, Octets(TABLE_SIZE)]


# ------------------------------------------------------------------------------------------------------------- messages


class Message:
    """What one frame says; making one that may not be is a ValueError."""

    __slots__ = ()
    code: ClassVar[int]  # its type on the wire: host to microcontroller below 128, the others above

    def __post_init__(self) -> None:
        for name, kind in _kinds(type(self)):
            _wire_value(type(self), name, kind.to_wire, getattr(self, name))
        self._agree()

    def _agree(self) -> None:
        """Check what concerns several fields."""


@dataclass(frozen=True, slots=True)
class Hello(Message):
    """Opens a session: which servos there are. The version stands first, in every version."""

    code = 1
    version: U8
    session: Session  # of the host's choice, different from the last one's
    time_us: U64  # [us] the host's clock, from any origin, never back
    ids: Ids  # in the order of all that follows

    def _agree(self) -> None:
        if not self.ids or len(set(self.ids)) != len(self.ids):
            raise ValueError(f"Hello.ids: at least one id, each once, expected, found {list(self.ids)}")


@dataclass(frozen=True, slots=True)
class Goals(Message):
    """Where all servos shall go."""

    code = 2
    session: Session
    sequence: U32  # of orders, growing
    time_us: U64  # [us] when they were decided, host's clock
    lifetime_ms: Annotated[int, Whole(*LIFETIME_MS)]  # [ms] too old by then, and no longer fresh when none follow
    position: Ticks
    speed: Ticks  # [0.111 rpm] 0 for uncontrolled

    def _agree(self) -> None:
        _same_length(self, "position", "speed")


@dataclass(frozen=True, slots=True)
class Torque(Message):
    """Turn all torque on or off. Off is obeyed in any mode, session, order and age, and lasts until on is ordered."""

    code = 3
    session: Session
    sequence: U32
    time_us: U64
    on: Annotated[int, Whole(0, 1)]


@dataclass(frozen=True, slots=True)
class Limits(Message):
    """The torque limits of all servos; writing them ends a servo's shutdown."""

    code = 4
    session: Session
    sequence: U32
    time_us: U64
    limit: Ticks  # [0.1 %] of the stall torque


@dataclass(frozen=True, slots=True)
class Ask(Message):
    """An instruction for one servo, ping, read or write, passed on to the bus; for commissioning and repair."""

    code = 5
    session: Session
    sequence: U32
    time_us: U64
    servo_id: Annotated[int, Whole(0, MAX_ID)]
    instruction: U8
    parameters: Table


@dataclass(frozen=True, slots=True)
class Welcome(Message):
    """Answers hello; also said ten times a second, with session 0, while there is none. The version stands first."""

    code = 129
    version: U8
    session: U32
    boot: U32  # another number after every start
    time_us: U64  # [us] the microcontroller's clock
    name: Annotated[str, Text(MAX_NAME)]  # of board and firmware


@dataclass(frozen=True, slots=True)
class State(Message):
    """All servos and the microcontroller itself, once a cycle."""

    code = 130
    session: Session
    sequence: U32  # of states, growing
    time_us: U64  # [us] when it was put together, microcontroller's clock
    mode: Annotated[Mode, Choice(Mode)]
    heard: U32  # sequence of the newest order taken
    goals_age_ms: U16  # [ms] since the newest goals were taken, NEVER without
    refusal: Annotated[Refusal, Choice(Refusal)]  # of the newest order refused
    refused: U32  # orders refused so far
    broken: U32  # frames of the host that were none
    silent: U32  # questions that servos left open
    garbled: U32  # packets of servos that were broken, or nobody had asked for
    position: Ticks
    speed: SignedTicks  # [0.111 rpm]
    load: SignedTicks  # [0.1 %] of the stall torque
    voltage: PerServo  # [0.1 V]
    temperature: PerServo  # [deg C]
    error: PerServo  # error bits
    age: Ages  # [0.1 ms] since each was asked, NEVER without an answer

    def _agree(self) -> None:
        _same_length(self, "position", "speed", "load", "voltage", "temperature", "error", "age")


@dataclass(frozen=True, slots=True)
class Answer(Message):
    """What became of a question."""

    code = 131
    session: Session
    sequence: U32  # of the question
    result: Annotated[Result, Choice(Result)]
    error: U8  # error bits of the servo's status packet
    data: Table


MESSAGES: dict[int, type[Message]] = {m.code: m for m in (Hello, Goals, Torque, Limits, Ask, Welcome, State, Answer)}
FROM_HOST = frozenset((Hello, Goals, Torque, Limits, Ask))
TO_HOST = frozenset((Welcome, State, Answer))


class OtherVersion(DecodeError):  # noqa: N818  (a state of the other end, handled by the caller)
    """A hello or welcome of another version of this wire; nothing else of it can be understood."""

    def __init__(self, version: int):
        super().__init__(f"version {VERSION} of the bridge's wire expected, found version {version}")
        self.version = version


_KINDS: dict[type[Message], tuple[tuple[str, Kind], ...]] = {}


def _kinds(message: type[Message]) -> tuple[tuple[str, Kind], ...]:
    """Name and kind of each field, in their order on the wire; worked out once."""
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


def _same_length(message: Message, *names: str) -> None:
    counts = {name: len(getattr(message, name)) for name in names}
    if len(set(counts.values())) > 1:
        raise ValueError(f"{type(message).__name__}: as many values of each kind expected, found {counts}")


# ---------------------------------------------------------------------------------------------------------------- frames


def encode(message: Message) -> bytes:
    """The frame of a message, zeros around it."""
    kind = type(message)
    values = [field.to_wire(getattr(message, name)) for name, field in _kinds(kind)]
    return frame(pack_values([kind.code, *values]))


def decode(payload: bytes, expected: frozenset[type[Message]]) -> Message:
    """The message of a frame's payload, the CRC taken off.

    Raises:
        OtherVersion: It greets in another version.
        DecodeError: Anything at all is not as declared; nothing is repaired.
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
    """Messages out of a byte stream that may hold anything. It keeps at most one frame's bytes."""

    def __init__(self, expected: frozenset[type[Message]]):
        """Begin between two frames.

        Args:
            expected: The messages that may come from there.
        """
        self.refused = 0  # intact frames that were no message
        self.last_refusal = ""  # why, in words
        self.other_version: int | None = None  # in which the other end greeted last, None when in this one
        self._expected = expected
        self._frames = Deframer()

    @property
    def dropped(self) -> Counter[str]:
        """Frames that were broken or refused, by reason."""
        return self._frames.broken + Counter({REFUSED: self.refused})

    @property
    def pending(self) -> int:
        """Bytes kept of a frame that has not ended."""
        return self._frames.pending

    def feed(self, data: bytes) -> list[Message]:
        """Take the next bytes and return the messages that they complete."""
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
    """How old what another clock has stamped is at least: against the quickest that has come so far.

    Two clocks differ by an offset and a slow drift; what is late beyond the quickest message is old. So bytes that have waited
    in a buffer are known for what they are, and no clock needs setting.
    """

    _DRIFT = 2e-4  # [s/s] that two clocks may part; crystals do by 1e-4

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._seen_ns = 0

    def age_ns(self, stamp_us: int, now_ns: int) -> int:
        """Age [ns] of a stamp [us] of the other clock that arrives now [ns]."""
        offset = now_ns - 1000 * stamp_us
        if self._offset_ns is None:
            self._offset_ns = offset
        self._offset_ns = min(offset, self._offset_ns + self._DRIFT * max(now_ns - self._seen_ns, 0))
        self._seen_ns = now_ns
        return round(offset - self._offset_ns)
