"""Broken messages by the million, and what became of them."""

import contextlib
import ctypes
import gc
import logging
import mmap
import os
import resource
import struct
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from sextant.deploy.fuzz.broken import broken
from sextant.deploy.fuzz.target import Target
from sextant.deploy.fuzz.targets import targets

GROWTH_MB = 5.0  # that memory may grow by
MOST_CPU_S, MOST_MB = 30.0, 400.0  # of processor time and memory that one message may take
_WARM = 0.1  # share of the messages after which memory is looked at first: by then all is compiled and cached
_ROUND = 500  # messages for a target at a time
_TWISTED = 0.5  # share of them whose structure is whole
_KEPT = struct.Struct("<I")  # length of what was given
_LONGEST = 1 << 20  # [bytes] that a message may have, with all that is before it


@dataclass(slots=True)
class Outcome:
    """What became of the messages for one target."""

    target: str
    messages: int = 0
    taken: int = 0  # for good ones, though they were broken
    slowest_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Finding:
    """A message that was neither taken nor refused."""

    target: str
    error: str  # in words, and where
    data: bytes


@dataclass(slots=True)
class Found:
    """Of a run of messages."""

    outcomes: dict[str, Outcome] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    growth_mb: float = 0.0  # of this process's memory, from when all was warm to the end
    process: int = field(default_factory=os.getpid)


def names() -> tuple[str, ...]:
    """Of the targets."""
    return tuple(target.name for target in targets(Random(0)))


def fuzz(messages: int, seed: int, only: Sequence[str], newest: Path) -> Found:
    """Give broken messages to every target in turn.

    Args:
        messages: To all of them together.
        seed: Of how they are broken.
        only: Names of targets; empty for all.
        newest: File that holds the newest message at any time, for when it ends this process: name of its target, a line feed,
            its length (uint32, little-endian), itself.
    """
    logging.disable(logging.WARNING)  # they say what they refuse
    try:
        with _stderr_closed():
            return _fuzz(messages, Random(seed), only, newest)
    finally:
        logging.disable(logging.NOTSET)


@contextlib.contextmanager
def _stderr_closed() -> Iterator[None]:
    """Drop what libraries in C write to stderr about broken files."""
    before, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
        os.close(nothing)


def _fuzz(messages: int, rng: Random, only: Sequence[str], newest: Path) -> Found:
    chosen = [target for target in targets(rng) if not only or target.name in only]
    found = Found({target.name: Outcome(target.name) for target in chosen})
    known: set[tuple[str, str]] = set()
    warm_mb = 0.0
    with newest.open("w+b") as file:
        file.truncate(_LONGEST)
        with mmap.mmap(file.fileno(), 0) as kept:
            left = {target.name: messages // len(chosen) + (k < messages % len(chosen)) for k, target in enumerate(chosen)}
            while any(left.values()):
                for target in chosen:
                    count = min(_ROUND, left[target.name])
                    left[target.name] -= count
                    for finding in _round(target, count, found.outcomes[target.name], kept, rng):
                        where = (finding.target, finding.error)
                        if where not in known:
                            known.add(where)
                            found.findings.append(finding)
                if not warm_mb and sum(left.values()) <= (1 - _WARM) * messages:
                    warm_mb = _memory_mb()
    found.growth_mb = _memory_mb() - warm_mb
    return found


def give(target: str, data: bytes) -> bool:
    """Give a message to one target, as it is: whether it was taken.

    Raises:
        KeyError: No target has this name.
    """
    return {one.name: one for one in targets(Random(0))}[target].take(data)


def _round(target: Target, count: int, outcome: Outcome, kept: mmap.mmap, rng: Random) -> list[Finding]:
    findings: list[Finding] = []
    head = target.name.encode() + b"\n"
    for _ in range(count):
        data = rng.choice(target.examples)
        if rng.random() < _TWISTED:
            data = target.twisted(data, rng)
            if rng.random() < 0.2:
                data = broken(data, target.examples, rng)
        else:
            data = broken(data, target.examples, rng)
        kept[: len(head) + _KEPT.size + len(data)] = head + _KEPT.pack(len(data)) + data
        began, began_cpu, before_mb = time.perf_counter(), time.process_time(), _peak_mb()
        try:
            outcome.taken += target.take(data)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is what is looked for
            findings.append(Finding(target.name, _words(error), data))
        outcome.slowest_s = max(outcome.slowest_s, time.perf_counter() - began)
        if time.process_time() - began_cpu > MOST_CPU_S:
            findings.append(Finding(target.name, f"it took more than {MOST_CPU_S:g} s of processor time", data))
        if _peak_mb() - before_mb > MOST_MB:
            findings.append(Finding(target.name, f"it took more than {MOST_MB:g} MB of memory", data))
    outcome.messages += count
    return findings


def _words(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {Path(last.filename).name}, {last.name}, line {last.lineno}: {error!s:.200}"


def _peak_mb() -> float:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 * 1e-6


def _memory_mb() -> float:
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    resident = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return resident * mmap.PAGESIZE * 1e-6
