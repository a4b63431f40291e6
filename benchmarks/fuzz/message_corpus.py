"""Generate frames of a message from its declaration, as seeds for fuzzing."""

from enum import StrEnum
from random import Random
from typing import Any

import numpy as np

from sextant.shared.wire import codec
from sextant.shared.wire.codec import Timing
from sextant.shared.wire.messages import Health, Message, schema

_LONGEST = 6  # maximum of a free length
_TRIES = 20  # attempts to get consistent fields
_INTS = (0, 1, 3, 255, 2000, 10**9, 10**18)
_FLOATS = (0.0, 0.02, 0.5, 1.0, 4.0, 1e3)
_TEXTS = ("", "walking", "no fresh plan came for 0.2 s", "linker Vorderlauf")


def frame(kind: type[Message], rng: Random) -> bytes:
    """Return a frame of a message.

    It is valid if an attempt succeeds. Otherwise only the consistency of its fields is wrong.
    """
    for _ in range(_TRIES):
        values = _values(kind, rng)
        try:
            return codec.encode(kind(**values), Timing(10**9, 10**9 + 1))
        except ValueError:
            continue
    unchecked = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(unchecked, name, value)
    return codec.encode(unchecked, Timing(10**9, 10**9 + 1))


def _values(kind: type[Message], rng: Random) -> dict[str, Any]:
    lengths: dict[str, int] = {}
    values = {name: _value(base, detail, lengths, rng) for name, base, detail in schema(kind)}
    if kind is Health:  # one number for each name
        values |= {names: tuple(rng.choices(_TEXTS, k=lengths[of])) for names, of in (("stages", "stage"), ("inputs", "input"))}
    return values


def _value(base: Any, detail: Any, lengths: dict[str, int], rng: Random) -> Any:
    if base is np.ndarray:
        dtype, dims = detail
        least, most = dims.lengths or (0, _LONGEST)
        shape = [
            n if isinstance(n, int) else lengths.setdefault(n, rng.randint(least, min(most, _LONGEST))) for n in dims.shape
        ]
        if shape == [4, 4] and dtype.kind == "f":
            return np.eye(4, dtype=dtype)
        highest = 2 if dtype.kind == "b" else min(5, (dims.most or 4) + 1)
        return np.array([rng.randrange(highest) for _ in range(int(np.prod(shape)))]).reshape(shape).astype(dtype)
    if base is tuple:
        return tuple(rng.choices(_TEXTS, k=rng.randrange(3)))
    if isinstance(base, type) and issubclass(base, StrEnum):
        return rng.choice(list(base))
    if isinstance(detail, tuple):
        return rng.choice(detail)
    if base is bool:
        return rng.random() < 0.5
    return rng.choice(_TEXTS if base is str else _INTS if base is int else _FLOATS)
