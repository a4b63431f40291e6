"""Time from a depth image to the plan that the legs execute, over live walks.

Each walk is `sextant run`, whose report has the percentiles of its images (`CaptureToPlan` in evaluation/report.py).
"""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.timing import machine

WANTED_MS = {"p50_ms": 60.0, "p90_ms": 90.0, "p99_ms": 150.0}  # [ms] targets on a machine without other work
_T_95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23)  # Student's t for 1 to 10 degrees of freedom, ...
_Z_95, _T_SLOPE = 1.96, 2.5  # ... and about z + slope / degrees for more
_NAMES = {"p50_ms": "median", "p90_ms": "90th percentile", "p99_ms": "99th percentile"}


class WalkError(Exception):
    """A walk has left no report; the message says why."""


@dataclass(frozen=True, slots=True)
class TimedWalk:
    """Times of one live walk."""

    seed: int
    success: bool
    too_slow: str  # why this computer counts as too slow, empty if it does not
    images: int  # depth images whose map reached the legs
    p50_ms: float
    p90_ms: float
    p99_ms: float
    load: float  # mean number of processes that wanted a core in the minute before the walk, this bench's own included


def measure(scenario: str, seeds: Sequence[int], folder: Path, say: Callable[[str], object]) -> tuple[TimedWalk, ...]:
    """Walk a scenario live, once with each seed.

    Args:
        scenario: Name or path of the course.
        seeds: Seed of each walk.
        folder: Folder for the files of the walks.
        say: Called with the result of each walk.

    Raises:
        WalkError: A walk left no report.
    """
    found: list[TimedWalk] = []
    for seed in seeds:
        out, load = folder / f"walk-{seed}", os.getloadavg()[0]
        words = (sys.executable, "-m", "sextant.deploy.cli", "run", scenario, "--seed", str(seed), "--out", str(out))
        done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        report = out / "report.json"
        if not report.exists():
            raise WalkError(f"the walk of seed {seed} left no report: {' / '.join(done.stderr.splitlines()[-2:])}")
        found.append(_timed(seed, json.loads(report.read_text(encoding="utf-8")), load))
        one = found[-1]
        say(f"seed {seed}: {one.p50_ms:.0f}, {one.p90_ms:.0f} and {one.p99_ms:.0f} ms, {one.images} images")
    return tuple(found)


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of values of separate walks, and its 95 % interval by Student's t; NaN for a single walk."""
    mean, degrees = float(np.mean(values)), len(values) - 1
    if degrees < 1:
        return mean, math.nan, math.nan
    t = _T_95[degrees - 1] if degrees <= len(_T_95) else _Z_95 + _T_SLOPE / degrees
    half = t * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return mean, mean - half, mean + half


def in_words(walks: Sequence[TimedWalk]) -> str:
    """Return the results as a Markdown table and a sentence."""
    lines = [
        "| of the images of a walk | ms, mean of the walks | 95 % interval | smallest to largest | wanted |",
        "|---|---|---|---|---|",
    ]
    for name, wanted in WANTED_MS.items():
        values = [getattr(walk, name) for walk in walks]
        mean, low, high = mean_interval(values)
        interval = "" if math.isnan(low) else f"{low:.0f} to {high:.0f}"
        lines.append(f"| {_NAMES[name]} | {mean:.0f} | {interval} | {min(values):.0f} to {max(values):.0f} | {wanted:.0f} |")
    loads, slow = [walk.load for walk in walks], sum(bool(walk.too_slow) for walk in walks)
    reached, images = sum(walk.success for walk in walks), sum(walk.images for walk in walks)
    late = f"; in {slow} the computer was too slow" if slow else ""
    lines += [
        "",
        f"{len(walks)} walks, {reached} at the goal, {images} images, at a load of {min(loads):.1f} to {max(loads):.1f} "
        f"processes{late}.",
    ]
    return "\n".join(lines)


def to_json(scenario: str, walks: Sequence[TimedWalk]) -> str:
    """Return the results as JSON."""
    table = {
        "machine": machine(),
        "scenario": scenario,
        "walks": [asdict(one) for one in walks],
    }
    return json.dumps(table, indent=1) + "\n"


def from_json(text: str) -> tuple[TimedWalk, ...]:
    """Read walks written by `to_json`."""
    return tuple(TimedWalk(**walk) for walk in json.loads(text)["walks"])


def _timed(seed: int, report: dict[str, Any], load: float) -> TimedWalk:
    times = report["capture_to_plan_ms"]
    p50, p90, p99 = (math.nan if times[name] is None else round(float(times[name]), 2) for name in ("p50", "p90", "p99"))
    return TimedWalk(seed, report["success"], report["too_slow"], times["images"], p50, p90, p99, round(load, 2))
