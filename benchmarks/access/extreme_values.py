"""Well-formed messages with extreme values.

A client with a valid certificate may send them. One to three fields of an example are replaced. So the message passes the
schema, and reaches the code that validates its meaning.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzz import message_corpus
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec
from sextant.shared.wire.messages import MAX_ITEMS, MAX_TEXT, Dims, Message, schema

_LARGEST = (1 << 63) - 1
_INTS = (0, 1, -1, 2, 255, 1 << 31, 10**9, 1 << 62, _LARGEST, -_LARGEST)
_AGES_NS = tuple(round(s * 1e9) for s in (0.0, 0.0, 0.0, -0.4, 0.1, 1.9, 3.0, -1.9, -3.0, -60.0, 60.0, -86400.0, 86400.0))
_FLOATS = (0.0, -0.0, 5e-324, 1e-9, -1e-9, 0.5, -0.5, 1.0, -1.0, math.pi, 1e3, -1e3, 1e6, -1e9, 1e12, -1e12)
_WILD = (1e19, 1e30, 3e38)  # for fields that need not be finite
_TEXTS = (
    "",
    "x" * MAX_TEXT,
    "\U0001f9ed" * 400,
    "operator",
    "console 1 at robot:8080",
    "router of viewer",
    "actuator",
    "\x1b[31m\r\n\t\0<script>",
    "../../etc/passwd",
    " ",
)
_FREE_LENGTHS = (0, 1, 2, 7, 64, 400, 3000)
_FIELDS = (1, 1, 1, 2, 3)  # number of fields replaced
_TRIES = 20  # attempts to get a well-formed message that is not too large


def worst(topic: AnyTopic, examples: Sequence[Message], now_ns: int, rng: Random) -> Message:
    """Return a well-formed message of a topic with extreme values in some fields.

    Args:
        topic: Topic of the message.
        examples: Valid messages of the topic; if empty, one is generated from the declaration.
        now_ns: [ns] the robot's time, near which some stamps are.
        rng: Random generator.
    """
    for _ in range(_TRIES):
        example = rng.choice(examples) if examples else _made(topic.type, rng)
        fields = schema(topic.type)
        chosen = {name for name, _, _ in rng.sample(fields, min(len(fields), rng.choice(_FIELDS)))}
        lengths: dict[str, int] = {}
        values = {name: _value(base, detail, lengths, now_ns, rng) for name, base, detail in fields if name in chosen}
        values |= {
            name: _value(base, detail, lengths, now_ns, rng)
            for name, base, detail in fields
            if name not in chosen and base is np.ndarray and set(detail[1].shape) & lengths.keys()
        }  # the lengths have to agree
        if "stamp_ns" not in chosen and rng.random() < 0.8:
            values["stamp_ns"] = now_ns
        try:
            message = replace(example, **values)
        except ValueError:
            continue
        try:
            codec.decode(codec.encode(message, codec.Timing(now_ns, now_ns)), topic.type, topic.max_bytes)
        except codec.DecodeError:
            continue
        return message
    return replace(example, stamp_ns=now_ns)


def _made(kind: type[Message], rng: Random) -> Message:
    """Generate a valid message from its declaration."""
    while True:
        with contextlib.suppress(codec.DecodeError):  # its fields contradict each other
            return codec.decode(message_corpus.frame(kind, rng), kind)[0]


def _value(base: Any, detail: Any, lengths: dict[str, int], now_ns: int, rng: Random) -> Any:
    if base is np.ndarray:
        dtype, dims = detail
        return _array(dtype, dims, lengths, rng)
    if base is tuple:
        return tuple(rng.choices(_TEXTS, k=rng.choice((0, 1, 20, MAX_ITEMS))))
    if isinstance(base, type) and issubclass(base, StrEnum):
        return rng.choice(list(base))
    if isinstance(detail, tuple):
        return rng.choice(detail)
    if base is bool:
        return rng.random() < 0.5
    if base is int:
        return max(-_LARGEST, min(rng.choice((now_ns + rng.choice(_AGES_NS), rng.choice(_INTS))), _LARGEST))
    return rng.choice(_TEXTS) if base is str else rng.choice(_FLOATS)


def _array(dtype: np.dtype[Any], dims: Dims, lengths: dict[str, int], rng: Random) -> Any:
    least, most = dims.lengths or (0, max(_FREE_LENGTHS))
    fits = [n for n in _FREE_LENGTHS if least <= n <= most] or [least]
    shape = [n if isinstance(n, int) else lengths.setdefault(n, rng.choice(fits)) for n in dims.shape]
    if shape == [4, 4]:
        return _pose(rng)
    if shape == [6, 6]:
        return _covariance(rng)
    return _filled(shape, dtype, dims, rng)


def _filled(shape: list[int], dtype: np.dtype[Any], dims: Dims, rng: Random) -> Any:
    if dtype.kind == "b":
        return np.full(shape, rng.random() < 0.5) if rng.random() < 0.7 else _drawn(rng).random(shape) < 0.5
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        most = limits.max if dims.most is None else dims.most
        if rng.random() < 0.3:
            return _drawn(rng).integers(max(limits.min, -most), most, shape, dtype, endpoint=True)
        return np.full(shape, rng.choice((0, 1, most, limits.min)), dtype)
    largest = float(np.finfo(dtype).max)
    values = [f for f in _FLOATS if abs(f) <= largest] + ([] if dims.finite else [*_WILD, math.nan, math.inf, -math.inf])
    if rng.random() < 0.3:
        return (_drawn(rng).normal(size=shape) * min(abs(rng.choice(_FLOATS)), 1e6)).astype(dtype)
    filled = np.full(shape, rng.choice(values), dtype)
    if filled.size and rng.random() < 0.3:
        filled.flat[rng.randrange(filled.size)] = rng.choice(values)
    return filled


def _pose(rng: Random) -> Any:
    """Return a pose (4, 4): far away, tilted or upside down, or nearly invalid."""
    T = np.eye(4)
    match rng.randrange(4):
        case 0:
            T[:3, 3] = rng.choice(_FLOATS)
        case 1:
            T[rng.randrange(3), 3] = rng.choice((0.05, -0.05, 1.0, 1e3, -1e3, 1e9))
        case 2:
            angle, (i, j) = rng.choice((0.02, 0.3, math.pi / 2, math.pi)), rng.choice(((0, 1), (1, 2), (2, 0)))
            T[[i, j], [i, j]], T[i, j], T[j, i] = math.cos(angle), -math.sin(angle), math.sin(angle)
        case _:
            T[:3, :3] *= 1.0 + 4e-5 * rng.choice((-1.0, 1.0))  # the largest accepted deviation from a rotation
    return T


def _covariance(rng: Random) -> Any:
    """Return an extreme covariance (6, 6).

    It is zero, negative, huge, asymmetric, or has mixed signs.
    """
    match rng.randrange(5):
        case 0:
            return np.zeros((6, 6))
        case 1:
            return np.eye(6) * rng.choice(_FLOATS)
        case 2:
            return np.full((6, 6), rng.choice(_FLOATS))
        case 3:
            return np.triu(np.full((6, 6), rng.choice((1e-6, 1.0, 1e12))))
        case _:
            return np.diag([rng.choice(_FLOATS) for _ in range(6)])


def _drawn(rng: Random) -> np.random.Generator:
    return np.random.default_rng(rng.randrange(1 << 32))
