"""Fuzz all targets with millions of mutated messages, and collect the outcomes."""

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

from benchmarks.fuzz.mutators import broken
from benchmarks.fuzz.target import Target
from benchmarks.fuzz.targets import targets

GROWTH_MB = 5.0  # [MB] tolerated growth of memory
MOST_CPU_S, MOST_MB = 30.0, 400.0  # maximum processor time and memory for one message
_WARM = 0.1  # share of messages before the first memory measurement: by then all is compiled and cached
_ROUND = 500  # consecutive messages for one target
_TWISTED = 0.5  # share of messages with a valid structure
_KEPT = struct.Struct("<I")  # length of the stored message
_LONGEST = 1 << 20  # [bytes] maximum length of a message with its header


@dataclass(slots=True)
class Outcome:
    """Outcome of the messages for one target."""

    target: str
    messages: int = 0
    taken: int = 0  # accepted although mutated
    slowest_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Finding:
    """A message that was neither accepted nor refused."""

    target: str
    error: str  # the error as text, with its location
    data: bytes


@dataclass(slots=True)
class Found:
    """Results of a fuzzing run."""

    outcomes: dict[str, Outcome] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    growth_mb: float = 0.0  # growth of this process's memory after warm-up
    process: int = field(default_factory=os.getpid)


def names() -> tuple[str, ...]:
    """Return the names of the targets."""
    return tuple(target.name for target in targets(Random(0)))


def fuzz(messages: int, seed: int, only: Sequence[str], newest: Path) -> Found:
    """Give mutated messages to every target in turn.

    Args:
        messages: Total number of messages.
        seed: Random seed of the mutations.
        only: Names of targets; empty for all.
        newest: File that always holds the newest message, in case it crashes this process: name of its target, a line feed,
            its length (uint32, little-endian), the message.
    """
    logging.disable(logging.WARNING)  # targets log what they refuse
    try:
        with _stderr_closed():
            return _fuzz(messages, Random(seed), only, newest)
    finally:
        logging.disable(logging.NOTSET)


@contextlib.contextmanager
def _stderr_closed() -> Iterator[None]:
    """Drop messages about invalid files that C libraries write to stderr."""
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
    """Give an unchanged message to one target; return whether it was accepted.

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
        except Exception as error:  # noqa: BLE001 - any exception is a finding
            findings.append(Finding(target.name, _words(error), data))
        outcome.slowest_s = max(outcome.slowest_s, time.perf_counter() - began)
        if time.process_time() - began_cpu > MOST_CPU_S:
            findings.append(Finding(target.name, f"took more than {MOST_CPU_S:g} s of processor time", data))
        if _peak_mb() - before_mb > MOST_MB:
            findings.append(Finding(target.name, f"took more than {MOST_MB:g} MB of memory", data))
    outcome.messages += count
    return findings


def _words(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {Path(last.filename).name}, {last.name}, line {last.lineno}: {error!s:.200}"


def _peak_mb() -> float:
    """Return the peak memory [MB] of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 * 1e-6


def _memory_mb() -> float:
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    resident = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return resident * mmap.PAGESIZE * 1e-6
