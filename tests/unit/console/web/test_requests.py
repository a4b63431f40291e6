"""Requests that a page may send; all others are rejected with a reason."""

import contextlib
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.console.web.requests import (
    MAX_BYTES,
    CancelGoal,
    Command,
    Drive,
    GoTo,
    Heartbeat,
    Name,
    Record,
    Release,
    RequestError,
    Seen,
    TakeOver,
    Walk,
    Watch,
    parse,
)

WALK = {"height": 0.1, "lift": 0.04, "gait": "tripod"}
DRIVE = {"type": "drive", "press": 1, "forward": 0.1, "left": 0.0, "turn": -0.2, "blind_walking": False, **WALK}
GO = {"type": "go to", "waypoints": [[1.0, -0.5], [2, 0]], "speed": 0.1, "passage": False, **WALK}
GOOD: list[tuple[dict[str, Any], object]] = [
    (DRIVE, Drive(1, 0.1, 0.0, -0.2, Walk(0.1, 0.04, "tripod"), False)),
    ({"type": "release"}, Release()),
    ({"type": "order", "order": "off"}, Command("off")),
    ({"type": "take over"}, TakeOver()),
    (GO, GoTo(((1.0, -0.5), (2.0, 0.0)), 0.1, Walk(0.1, 0.04, "tripod"), False)),
    ({"type": "give up"}, CancelGoal()),
    ({"type": "watch", "layer": "variance", "picture": True}, Watch("variance", True)),
    ({"type": "seen", "what": "map"}, Seen("map")),
    ({"type": "here"}, Heartbeat()),
    ({"type": "record", "on": True}, Record(True)),
    ({"type": "name", "name": "Ann"}, Name("Ann")),
]


@pytest.mark.parametrize(("fields", "request_"), GOOD)
def test_every_request_is_parsed(fields: dict[str, Any], request_: object) -> None:
    assert parse(json.dumps(fields)) == request_


@pytest.mark.parametrize(("fields", "_"), GOOD)
def test_missing_or_extra_field_is_named(fields: dict[str, Any], _: object) -> None:
    for key in fields:
        with pytest.raises(RequestError, match=f"{key} is missing|unknown request type"):
            parse(json.dumps({k: v for k, v in fields.items() if k != key}))
    with pytest.raises(RequestError, match="extra not expected"):
        parse(json.dumps({**fields, "extra": 1}))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({**DRIVE, "forward": 1.5}, "forward: a number from -1 to 1 expected, found 1.5"),
        ({**DRIVE, "forward": True}, "forward: a number"),
        ({**DRIVE, "forward": "1"}, "forward: a number"),
        ({**DRIVE, "forward": 10**400}, "forward: a number"),
        ({**DRIVE, "press": -1}, "press: a whole number"),
        ({**DRIVE, "press": 1.0}, "press: a whole number"),
        ({**DRIVE, "gait": "gallop"}, "gait: one of tripod, ripple, wave, auto expected, found gallop"),
        ({**DRIVE, "blind_walking": 1}, "blind_walking: true or false"),
        ({**GO, "waypoints": []}, "waypoints: 1 to 16 points"),
        ({**GO, "waypoints": [[1.0]]}, r"waypoints: points \[x, y\]"),
        ({**GO, "waypoints": [[1.0, 1e9]]}, "x: a number from -100 to 100"),
        ({**GO, "speed": 0.0}, "speed: a number from 0.01"),
        ({"type": "order", "order": "walk"}, "order: one of off, stop, ready, stand, sit expected"),
        ({"type": "record", "on": 1}, "on: true or false"),
        ({"type": "name", "name": "a\nb"}, "name: 1 to 24 printable"),
        ({"type": ["order"]}, "unknown request type"),
        ([1, 2], "a table expected, found a list"),
    ],
)
def test_invalid_request_is_refused_with_reason(fields: Any, words: str) -> None:
    with pytest.raises(RequestError, match=words):
        parse(json.dumps(fields))


@pytest.mark.parametrize("text", ["", "{", "NaN", '{"type": "drive", "forward": NaN}', "[" * 2000, "\x00", '{"a":1}' * 2])
def test_invalid_json_is_refused(text: str) -> None:
    with pytest.raises(RequestError):
        parse(text)


def test_request_size_is_limited() -> None:
    with pytest.raises(RequestError, match=f"at most {MAX_BYTES}"):
        parse(json.dumps({"type": "name", "name": "a" * MAX_BYTES}))


VALUES = st.none() | st.booleans() | st.floats() | st.integers() | st.text()
WILD = st.recursive(VALUES, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner))


@pytest.mark.slow
@given(WILD)
def test_any_json_is_parsed_or_refused_with_reason(value: Any) -> None:
    for sent in (value, {**DRIVE, "forward": value}, {**GO, "waypoints": value}, {"type": value}):
        with contextlib.suppress(RequestError):
            parse(json.dumps(sent))
