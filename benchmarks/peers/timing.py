"""Common parts of the timing benchmarks: core, processor time, spread, output.

Methods take turns on every input, so a slow phase of the machine affects all of them. Time is the processor time of the process
on its core: interruptions by other processes do not count.
"""

import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from sextant.shared.geometry import Array

# fmt: off
_PACKAGES = (
    "numpy", "numba", "opencv-python-headless", "scipy", "scikit-image", "open3d", "small-gicp", "genz-icp", "kiss-icp", "ompl",
    "pyserial", "dynamixel-sdk",
)
# fmt: on

Made = TypeVar("Made")


@dataclass(frozen=True, slots=True)
class Spread:
    """Median of numbers, and the range of the middle eight of ten."""

    median: float
    p10: float
    p90: float

    @classmethod
    def of(cls, values: Array) -> "Spread":
        """Compute the spread of numbers (n,)."""
        p10, median, p90 = np.percentile(values, [10, 50, 90]).tolist()
        return cls(median, p10, p90)


@dataclass(frozen=True, slots=True)
class Timing:
    """One method at one job."""

    stage: str
    case: str  # scene or size
    method: str
    ms: Spread
    ratio: Spread  # its time relative to that of the first method of the job, input by input
    figures: Mapping[str, float] = field(default_factory=dict)  # further figures, with units in their names


class Race:
    """All methods at one job.

    Each processes every input, in an order that starts with a different method each time.
    """

    def __init__(self, stage: str, case: str, warm: int = 0):
        """Name the job; the first `warm` inputs after each start are not timed."""
        self.stage, self.case = stage, case
        self._warm = warm
        self._methods: dict[str, Callable[..., Any]] = {}
        self._done = 0
        self._ms: dict[str, list[float]] = {}

    def start(self, methods: Mapping[str, Callable[..., Any]]) -> None:
        """Start methods, and end earlier ones; the first is the reference for the others."""
        self._methods = dict(methods)
        self._done = 0
        for name in methods:
            self._ms.setdefault(name, [])

    def run(self, *work: Any) -> dict[str, Any]:
        """Return the result of each method for one input."""
        names = list(self._methods)
        first = self._done % len(names)
        out = {}
        for name in names[first:] + names[:first]:
            began = time.process_time_ns()
            out[name] = self._methods[name](*work)
            took = time.process_time_ns() - began
            if self._done >= self._warm:
                self._ms[name].append(1e-6 * took)
        self._done += 1
        return out

    def ms(self, method: str) -> Array:
        """Return the times (n,) [ms] of a method, in the order of the inputs."""
        return np.array(self._ms[method])

    def timings(self, figures: Mapping[str, Mapping[str, float]]) -> list[Timing]:
        """Return the timings of all methods, with their figures."""
        return held_against_first(self.stage, self.case, {name: self.ms(name) for name in self._ms}, figures)


def held_against_first(
    stage: str, case: str, ms: Mapping[str, Array], figures: Mapping[str, Mapping[str, float]]
) -> list[Timing]:
    """Compare times (n,) [ms] of several methods at the same n inputs."""
    first = next(iter(ms.values()))
    return [Timing(stage, case, name, Spread.of(t), Spread.of(t / first), figures.get(name, {})) for name, t in ms.items()]


@contextmanager
def one_core() -> Iterator[None]:
    """Restrict all threads of this process and its children to one core, if possible."""
    before: set[int] = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    opencv = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        _hold_to(set(sorted(before)[-1:]))
        yield
    finally:
        _hold_to(before)
        cv2.setNumThreads(opencv)


def _hold_to(cores: set[int]) -> None:
    for task in Path("/proc/self/task").iterdir() if cores else ():
        try:
            os.sched_setaffinity(int(task.name), cores)
        except ProcessLookupError:
            continue  # the thread has ended meanwhile


def installed(makers: Mapping[str, Callable[..., Made]], *arguments: Any) -> tuple[dict[str, Made], list[str]]:
    """Return the created objects, and which makers failed and why, as text."""
    made, missing = {}, []
    for name, maker in makers.items():
        try:
            made[name] = maker(*arguments)
        except ModuleNotFoundError as error:
            missing.append(f"{name}: {error}; pip install -e '.[bench]' installs it")
        except ImportError as error:  # it is installed, but one of its dependencies is not
            missing.append(f"{name}: {error}")
    return made, missing


def machine() -> dict[str, str]:
    """Return a description of the machine."""
    model = platform.processor() or platform.machine()
    about = Path("/proc/cpuinfo")
    for line in about.read_text(encoding="utf-8").splitlines() if about.exists() else ():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    out = {"processor": model, "cores": f"{os.cpu_count()}, one used", "system": f"{platform.system()} {platform.machine()}"}
    out["python"] = platform.python_version()
    for package in _PACKAGES:
        try:
            out[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return out


def machine_in_words() -> str:
    """Return a description of the machine in one line."""
    about = machine()
    return f"{about['processor']}, one core, Python {about['python']}, NumPy {about['numpy']}"


def in_words(timings: Sequence[Timing], missing: Sequence[str], headings: Mapping[str, tuple[str, float, int]]) -> str:
    """Return the timings as Markdown, accuracy before time.

    Headings map a figure to its heading, factor and digits.
    """
    lines = [machine_in_words(), "time of the core, median (10th to 90th percentile); ratio to the first of each group"]
    columns = "".join(f"{heading:>12}" for heading, _, _ in headings.values())
    wide = max(22, *(len(t.method) + 2 for t in timings))
    lines.append(f"{'stage':<18}{'case':<16}{'method':<{wide}}{columns}{'ms':>28}{'ratio':>28}")
    for t in timings:
        ms = f"{t.ms.median:.2f} ({t.ms.p10:.2f} to {t.ms.p90:.2f})"
        ratio = f"{t.ratio.median:.2f} ({t.ratio.p10:.2f} to {t.ratio.p90:.2f})"
        line = f"{t.stage:<18}{t.case:<16}{t.method:<{wide}}"
        for name, (_, factor, digits) in headings.items():
            line += f"{factor * t.figures[name]:>12.{digits}f}" if name in t.figures else f"{'':>12}"
        lines.append(f"{line}{ms:>28}{ratio:>28}")
    lines += [f"not measured: {words}" for words in missing]
    return "\n".join(lines)


def parts_in_words(parts_ms: Mapping[str, float]) -> str:
    """Return the parts of a total in one line."""
    return "frame to layers: " + ", ".join(f"{name} {ms:.2f} ms" for name, ms in parts_ms.items())


def to_json(timings: Sequence[Timing], missing: Sequence[str], **more: Any) -> str:
    """Return the timings as JSON, with further entries `more`."""
    rows = [
        {"stage": t.stage, "case": t.case, "method": t.method, "ms": asdict(t.ms), "ratio": asdict(t.ratio), **t.figures}
        for t in timings
    ]
    table = {"machine": machine(), "timings": rows, "missing": list(missing), **more}
    return json.dumps(_rounded(table), indent=1) + "\n"


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list) else value
