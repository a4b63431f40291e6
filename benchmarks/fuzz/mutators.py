"""Mutations of bytes and of structured values.

This module is pure.
"""

from collections.abc import Callable, Sequence
from random import Random
from typing import Any

_MOST = 4  # maximum number of mutations
_LONGEST_RUN = 32  # [bytes]
_RUNS = (
    b"\0",
    b"\xff",
    b"\x7f",
    b"\x80",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\xc1",
    b"\x91" * 3000,
    b"[" * 3000,
    b"\n",
    b'"',
)
_ODD: tuple[Any, ...] = (
    *(0, -1, 1, 255, 2**31, 2**32 - 1, 2**63 - 1, -(2**63), 2**64 - 1),
    *(0.0, -0.0, 1e308, -1e308, 5e-324, float("nan"), float("inf")),
    *("", "x" * 300, "\0", "\ud7ff", "x" * 9000, b"", b"\xff" * 40),
    *(None, True, False, [], [[]], [0] * 300, [[[[[[[[]]]]]]]]),
)


def broken(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Apply one or a few mutations to bytes; pieces are spliced in from `others`."""
    for _ in range(rng.randint(1, _MOST)):
        data = rng.choice(_WAYS)(data, others, rng)
    return data


def odd(values: list[Any], rng: Random) -> list[Any]:
    """Replace, insert or remove a value in nested lists."""
    out = list(values)
    at = rng.randrange(len(out)) if out else 0
    if out and isinstance(out[at], list) and out[at] and rng.random() < 0.7:
        out[at] = odd(out[at], rng)
    elif out and rng.random() < 0.15:
        del out[at]
    elif rng.random() < 0.15:
        out.insert(at, rng.choice(_ODD))
    elif out:
        out[at] = rng.choice(_ODD)
    return out


def odd_table(table: dict[str, Any], rng: Random) -> dict[str, Any]:
    """Replace, remove or rename a value in a table."""
    out = dict(table)
    key = rng.choice(list(out) or ["type"])
    change = rng.random()
    if change < 0.15:
        out.pop(key, None)
    elif change < 0.3:
        out[rng.choice(("", "type", "press", "walk", key + "s"))] = out.get(key)
    elif isinstance(out.get(key), list) and change < 0.7:
        out[key] = odd(out[key], rng)
    else:
        out[key] = rng.choice(_ODD)
    return out


def _bits(data: bytes, _: Sequence[bytes], rng: Random) -> bytes:
    out = bytearray(data)
    for _time in range(rng.randint(1, 8)):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _overwritten(data: bytes, _: Sequence[bytes], rng: Random) -> bytes:
    at, run = rng.randint(0, len(data)), rng.choice(_RUNS)
    return data[:at] + run + data[at + len(run) :]


def _inserted(data: bytes, _: Sequence[bytes], rng: Random) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + rng.choice((rng.choice(_RUNS), rng.randbytes(rng.randint(1, _LONGEST_RUN)))) + data[at:]


def _removed(data: bytes, _: Sequence[bytes], rng: Random) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + data[at + rng.randint(1, _LONGEST_RUN) :]


def _repeated(data: bytes, _: Sequence[bytes], rng: Random) -> bytes:
    at = rng.randint(0, len(data))
    end = at + rng.randint(1, _LONGEST_RUN)
    return data[:end] + data[at:end] * rng.randint(1, 4) + data[end:]


def _cut(data: bytes, _: Sequence[bytes], rng: Random) -> bytes:
    return data[: rng.randint(0, len(data))]


def _spliced(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    other = rng.choice(others)
    return data[: rng.randint(0, len(data))] + other[rng.randint(0, len(other)) :]


_WAYS: tuple[Callable[[bytes, Sequence[bytes], Random], bytes], ...] = (
    _bits,
    _bits,
    _overwritten,
    _inserted,
    _removed,
    _repeated,
    _cut,
    _spliced,
)
