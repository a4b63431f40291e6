"""Message definitions as types, and their ROS 2 type hash.

Source: REP 2016, type descriptions and their hash RIHS01; the interface definition language of .msg files.
"""

import functools
import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from sextant.deploy.ros2.definitions import DEFINITIONS

# Type id of a plain type in a type description; arrays add to it.
_NESTED = 1
_PLAIN = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "bool": 15,
    "string": 17,
}
_ADDED = {"": 0, "fixed": 48, "bounded": 96, "sequence": 144}
_LINE = re.compile(r"(?P<base>[\w/]+)(?P<array>\[(?P<bound><=)?(?P<length>\d*)\])? (?P<name>[a-z]\w*)")


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message."""

    name: str
    base: str  # a plain type, or the full name of a message
    array: Literal["", "fixed", "bounded", "sequence"]
    length: int  # of a fixed array, or the most values of a bounded one

    @property
    def nested(self) -> bool:
        """Whether it holds messages."""
        return self.base not in _PLAIN


@functools.cache
def fields(name: str) -> tuple[Field, ...]:
    """Return the fields of a message, e.g. of "geometry_msgs/msg/Twist".

    Raises:
        ValueError: The message is unknown, or a line of its definition is invalid.
    """
    if name not in DEFINITIONS:
        raise ValueError(f"one of {', '.join(DEFINITIONS)} expected, found {name!r}")
    lines = (line.strip() for line in DEFINITIONS[name].splitlines())
    return tuple(_field(line, name) for line in lines if line)


def _field(line: str, name: str) -> Field:
    found = _LINE.fullmatch(line)
    if found is None:
        raise ValueError(f"{name}: a type and a name expected, found {line!r}")
    array: Literal["", "fixed", "bounded", "sequence"] = ""
    if found["array"]:
        array = "bounded" if found["bound"] else "fixed" if found["length"] else "sequence"
    return Field(found["name"], _whole_name(found["base"], name), array, int(found["length"] or 0))


def _whole_name(base: str, within: str) -> str:
    """Return the full name of a type in a definition, with its package."""
    if base in _PLAIN:
        return base
    package, _, kind = base.rpartition("/")
    return f"{package.removesuffix('/msg') or within.partition('/')[0]}/msg/{kind}"


@functools.cache
def type_hash(name: str) -> str:
    """Compute RIHS01 of a message: SHA-256 of its type description as JSON.

    The description includes the types that it refers to.
    """
    referred = sorted(set(_referred(name)))
    description = {"type_description": _described(name), "referenced_type_descriptions": [_described(one) for one in referred]}
    text = json.dumps(description, separators=(", ", ": "), ensure_ascii=True)
    return f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"


def _referred(name: str) -> Iterator[str]:
    for field in fields(name):
        if field.nested:
            yield field.base
            yield from _referred(field.base)


def _described(name: str) -> dict[str, Any]:
    return {
        "type_name": name,
        "fields": [
            {
                "name": field.name,
                "type": {
                    "type_id": _PLAIN.get(field.base, _NESTED) + _ADDED[field.array],
                    "capacity": field.length,
                    "string_capacity": 0,
                    "nested_type_name": field.base if field.nested else "",
                },
            }
            for field in fields(name)
        ],
    }
