"""What a page may ask for: text of the socket in, a request out, or why it is none. Nothing from a browser is believed."""

import json
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias, get_args

MAX_BYTES = 4096  # of one request
_MOST_WAYPOINTS = 16
_FAR = 100.0  # [m] of a waypoint from where the robot started
_FAST = 1.0  # [m/s] and [rad/s]; the robot's own limits are the planner's matter
_MOST_PRESSES = 1 << 53

Order: TypeAlias = Literal["off", "stop", "ready", "stand", "sit"]
Layer: TypeAlias = Literal["score", "evaluation", "variance", "color"]
Gait: TypeAlias = Literal["tripod", "ripple", "wave"]


class RequestError(ValueError):
    """What a page has sent is no request, with the reason in words."""


@dataclass(frozen=True, slots=True)
class Walk:
    """How the robot walks, by pad or to a goal."""

    height: float  # [m] of the body over the floor
    lift: float  # [m] clearance of swinging feet
    gait: Gait


@dataclass(frozen=True, slots=True)
class Drive:
    """The pad is held; said again and again for as long as it is."""

    press: int  # number of this press of the pad, counting up: one that has lapsed moves nothing any more
    forward: float  # [m/s] {body}
    left: float  # [m/s]
    turn: float  # [rad/s] to the left
    walk: Walk
    by_touch: bool  # walk without a map


@dataclass(frozen=True, slots=True)
class Release:
    """The pad is let go."""


@dataclass(frozen=True, slots=True)
class Command:
    """An order to the legs."""

    order: Order


@dataclass(frozen=True, slots=True)
class TakeOver:
    """Take the lease from whoever has it; the legs stop, nothing else moves."""


@dataclass(frozen=True, slots=True)
class GoTo:
    """Walk to the last of some places."""

    waypoints: tuple[tuple[float, float], ...]  # [m] {world}
    speed: float  # [m/s]
    walk: Walk
    passage: bool  # straight to it, deliberately, one leg at a time


@dataclass(frozen=True, slots=True)
class GiveUp:
    """Forget the goal."""


@dataclass(frozen=True, slots=True)
class Watch:
    """What this page wants to see; by default what a new one shows."""

    layer: Layer = "score"
    picture: bool = False


@dataclass(frozen=True, slots=True)
class Seen:
    """A map or a picture has been drawn: the next one may be sent."""

    what: Literal["map", "picture"]


@dataclass(frozen=True, slots=True)
class Here:
    """The page is alive, and in sight."""


@dataclass(frozen=True, slots=True)
class Record:
    """Begin to record what is said, or end it."""

    on: bool


@dataclass(frozen=True, slots=True)
class Name:
    """What the operator at this page is called."""

    name: str


Request: TypeAlias = Drive | Release | Command | TakeOver | GoTo | GiveUp | Watch | Seen | Here | Record | Name


@lru_cache(maxsize=64)  # a pad that is held says the same again and again
def parse(text: str) -> Request:
    """What a page has asked for.

    Raises:
        RequestError: It is nothing that a page may ask for; says what was expected and what was found.
    """
    if len(text) > MAX_BYTES:
        raise RequestError(f"a request of at most {MAX_BYTES} characters expected, found {len(text)}")
    try:
        fields = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError):
        raise RequestError("a request in JSON expected") from None
    if not isinstance(fields, dict):
        raise RequestError(f"a table expected, found a {type(fields).__name__}")
    return _Fields(fields).request()


def _refuse(constant: str) -> float:
    raise ValueError(constant)


class _Fields:
    """The fields of a request; each is taken once, and none may be left over."""

    def __init__(self, fields: dict[str, Any]):
        self._fields = fields

    def request(self) -> Request:
        kind = self._take("type")
        match kind:
            case "drive":
                turn, walk, touch = self._number("turn", _FAST), self._walk(), self._truth("by_touch")
                made: Request = Drive(
                    self._whole("press", _MOST_PRESSES),
                    self._number("forward", _FAST),
                    self._number("left", _FAST),
                    turn,
                    walk,
                    touch,
                )
            case "release":
                made = Release()
            case "order":
                made = Command(self._one_of("order", get_args(Order)))
            case "take over":
                made = TakeOver()
            case "go to":
                made = GoTo(self._waypoints(), self._speed(), self._walk(), self._truth("passage"))
            case "give up":
                made = GiveUp()
            case "watch":
                made = Watch(self._one_of("layer", get_args(Layer)), self._truth("picture"))
            case "seen":
                made = Seen(self._one_of("what", ("map", "picture")))
            case "here":
                made = Here()
            case "record":
                made = Record(self._truth("on"))
            case "name":
                made = Name(self._name())
            case _:
                raise RequestError(f"no request of type {str(kind)[:40]!r} is known")
        if self._fields:
            raise RequestError(f"{kind}: {', '.join(str(key)[:40] for key in list(self._fields)[:4])} not expected")
        return made

    def _take(self, key: str) -> Any:
        if key not in self._fields:
            raise RequestError(f"{key} is missing")
        return self._fields.pop(key)

    def _number(self, key: str, most: float, least: float | None = None) -> float:
        value = self._take(key)
        low = -most if least is None else least
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not low <= value <= most:  # neither a NaN nor infinity is
            raise RequestError(f"{key}: a number from {low:g} to {most:g} expected, found {str(value)[:40]}")
        return float(value)

    def _whole(self, key: str, most: int) -> int:
        value = self._take(key)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
            raise RequestError(f"{key}: a whole number from 0 to {most} expected, found {str(value)[:40]}")
        return value

    def _truth(self, key: str) -> bool:
        value = self._take(key)
        if not isinstance(value, bool):
            raise RequestError(f"{key}: true or false expected, found {str(value)[:40]}")
        return value

    def _one_of(self, key: str, known: tuple[str, ...]) -> Any:
        value = self._take(key)
        if not isinstance(value, str) or value not in known:
            raise RequestError(f"{key}: one of {', '.join(known)} expected, found {str(value)[:40]}")
        return value

    def _speed(self) -> float:
        return self._number("speed", _FAST, 0.01)

    def _walk(self) -> Walk:
        return Walk(self._number("height", 1.0, 0.0), self._number("lift", 1.0, 0.0), self._one_of("gait", get_args(Gait)))

    def _waypoints(self) -> tuple[tuple[float, float], ...]:
        value = self._take("waypoints")
        if not isinstance(value, list) or not 1 <= len(value) <= _MOST_WAYPOINTS:
            raise RequestError(f"waypoints: 1 to {_MOST_WAYPOINTS} places expected")
        places = []
        for place in value:
            if not isinstance(place, list) or len(place) != 2:
                raise RequestError("waypoints: places [x, y] expected")
            x, y = (_Fields({"x": number})._number("x", _FAR) for number in place)
            places.append((x, y))
        return tuple(places)

    def _name(self) -> str:
        value = self._take("name")
        if not isinstance(value, str) or not 1 <= len(value) <= 24 or not value.isprintable():
            raise RequestError("name: 1 to 24 printable characters expected")
        return value.strip() or "operator"
