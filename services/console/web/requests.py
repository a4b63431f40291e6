"""Requests of pages: validate and parse the JSON text that a browser sends."""

import json
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias, get_args

MAX_BYTES = 4096  # maximum size of a request
_MAX_WAYPOINTS = 16  # maximum number of waypoints of a goal
_MAX_COORDINATE_M = 100.0  # [m] maximum coordinate of a waypoint {world}
_MAX_SPEED = 1.0  # [m/s] and [rad/s] maximum speed of a request; the planner applies the robot's own limits
_MAX_PRESS = 1 << 53  # up to which JavaScript represents all integers

Order: TypeAlias = Literal["off", "stop", "ready", "stand", "sit"]
Layer: TypeAlias = Literal["score", "evaluation", "variance", "color"]
Gait: TypeAlias = Literal["tripod", "ripple", "wave", "auto"]  # auto: the planner chooses gait and speed


class RequestError(ValueError):
    """A page sent an invalid request; the text states the reason."""


@dataclass(frozen=True, slots=True)
class Walk:
    """Walking parameters of the pad and of goals."""

    height: float  # [m] height of the body over the floor
    lift: float  # [m] clearance of swinging feet
    gait: Gait


@dataclass(frozen=True, slots=True)
class Drive:
    """Velocity of the held pad; the page repeats it while the pad is held."""

    press: int  # number of this press, counting up; a press that has ended cannot move the robot again
    forward: float  # [m/s] {body}
    left: float  # [m/s]
    turn: float  # [rad/s] to the left
    walk: Walk
    blind_walking: bool  # walk without a map, by touchdown detection


@dataclass(frozen=True, slots=True)
class Release:
    """End of a press of the pad."""


@dataclass(frozen=True, slots=True)
class Command:
    """Mode command for the actuator."""

    order: Order


@dataclass(frozen=True, slots=True)
class TakeOver:
    """Take the lease from its current holder; the robot stops."""


@dataclass(frozen=True, slots=True)
class GoTo:
    """Walk along waypoints to the last one."""

    waypoints: tuple[tuple[float, float], ...]  # [m] {world}
    speed: float  # [m/s]
    walk: Walk
    passage: bool  # cross a gap: walk straight to the goal, one leg at a time


@dataclass(frozen=True, slots=True)
class CancelGoal:
    """Cancel the goal."""


@dataclass(frozen=True, slots=True)
class Watch:
    """Content that a page shows: a map layer, and whether the camera picture."""

    layer: Layer = "score"
    picture: bool = False


@dataclass(frozen=True, slots=True)
class Seen:
    """Acknowledgement that a map or picture is drawn; the next one may be sent."""

    what: Literal["map", "picture"]


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Heartbeat of a page that is open and visible."""


@dataclass(frozen=True, slots=True)
class Record:
    """Start or end a recording."""

    on: bool


@dataclass(frozen=True, slots=True)
class Name:
    """Name of the operator at this page."""

    name: str


Request: TypeAlias = Drive | Release | Command | TakeOver | GoTo | CancelGoal | Watch | Seen | Heartbeat | Record | Name


@lru_cache(maxsize=64)  # a held pad repeats the same text
def parse(text: str) -> Request:
    """Parse and validate the text of a request.

    Raises:
        RequestError: The text is not a valid request; the message states the expected and the actual value.
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
    """Fields of a request; each field is read once, and unread fields are an error."""

    def __init__(self, fields: dict[str, Any]):
        self._fields = fields

    def request(self) -> Request:
        kind = self._take("type")
        match kind:
            case "drive":
                turn, walk, blind = self._number("turn", _MAX_SPEED), self._walk(), self._boolean("blind_walking")
                request: Request = Drive(
                    self._integer("press", _MAX_PRESS),
                    self._number("forward", _MAX_SPEED),
                    self._number("left", _MAX_SPEED),
                    turn,
                    walk,
                    blind,
                )
            case "release":
                request = Release()
            case "order":
                request = Command(self._one_of("order", get_args(Order)))
            case "take over":
                request = TakeOver()
            case "go to":
                request = GoTo(self._waypoints(), self._speed(), self._walk(), self._boolean("passage"))
            case "give up":
                request = CancelGoal()
            case "watch":
                request = Watch(self._one_of("layer", get_args(Layer)), self._boolean("picture"))
            case "seen":
                request = Seen(self._one_of("what", ("map", "picture")))
            case "here":
                request = Heartbeat()
            case "record":
                request = Record(self._boolean("on"))
            case "name":
                request = Name(self._name())
            case _:
                raise RequestError(f"unknown request type {str(kind)[:40]!r}")
        if self._fields:
            raise RequestError(f"{kind}: {', '.join(str(key)[:40] for key in list(self._fields)[:4])} not expected")
        return request

    def _take(self, key: str) -> Any:
        if key not in self._fields:
            raise RequestError(f"{key} is missing")
        return self._fields.pop(key)

    def _number(self, key: str, high: float, low: float | None = None) -> float:
        value = self._take(key)
        low = -high if low is None else low
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not low <= value <= high:  # also rejects NaN and infinity
            raise RequestError(f"{key}: a number from {low:g} to {high:g} expected, found {str(value)[:40]}")
        return float(value)

    def _integer(self, key: str, high: int) -> int:
        value = self._take(key)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= high:
            raise RequestError(f"{key}: a whole number from 0 to {high} expected, found {str(value)[:40]}")
        return value

    def _boolean(self, key: str) -> bool:
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
        return self._number("speed", _MAX_SPEED, 0.01)

    def _walk(self) -> Walk:
        return Walk(self._number("height", 1.0, 0.0), self._number("lift", 1.0, 0.0), self._one_of("gait", get_args(Gait)))

    def _waypoints(self) -> tuple[tuple[float, float], ...]:
        value = self._take("waypoints")
        if not isinstance(value, list) or not 1 <= len(value) <= _MAX_WAYPOINTS:
            raise RequestError(f"waypoints: 1 to {_MAX_WAYPOINTS} points expected")
        places = []
        for place in value:
            if not isinstance(place, list) or len(place) != 2:
                raise RequestError("waypoints: points [x, y] expected")
            x, y = (_Fields({"x": number})._number("x", _MAX_COORDINATE_M) for number in place)
            places.append((x, y))
        return tuple(places)

    def _name(self) -> str:
        value = self._take("name")
        if not isinstance(value, str) or not 1 <= len(value) <= 24 or not value.isprintable():
            raise RequestError("name: 1 to 24 printable characters expected")
        return value.strip() or "operator"
