"""Common parts of the timing benchmarks: core, processor time, spread, output.

Methods take turns on every input, so a slow phase of the machine affects all of them. Time is the processor time of the process
on its core: interruptions by other processes do not count.
"""

import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from sextant.shared.files import config
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

    @property
    def words(self) -> str:
        """Text with three digits."""
        return f"{_shown(self.median)} ({_shown(self.p10)} to {_shown(self.p90)})"


def _shown(value: float) -> str:
    return f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2}f}"


@dataclass(frozen=True, slots=True)
class Timing:
    """One method at one job."""

    stage: str
    case: str  # scene or size
    method: str
    ms: Spread
    ratio: Spread  # its time relative to that of the first method of the job, input by input
    inputs: int  # that were timed
    figures: dict[str, float] = field(default_factory=dict)  # further figures, with units in their names


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
    return [
        Timing(stage, case, name, Spread.of(t), Spread.of(t / first), len(t), dict(figures.get(name, {})))
        for name, t in ms.items()
    ]


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
    out = {"processor": model, "cores": str(os.cpu_count()), "system": f"{platform.system()} {platform.machine()}"}
    out["python"] = platform.python_version()
    for package in _PACKAGES:
        try:
            out[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return out


def machine_in_words(about: Mapping[str, str] | None = None) -> str:
    """Return a description of this machine, or of another by its `machine`, in one line."""
    about = about or machine()
    return f"{about['processor']}, one core, Python {about['python']}, NumPy {about['numpy']}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Results of one run, and where they were made."""

    timings: tuple[Timing, ...]
    missing: tuple[str, ...] = ()  # what could not be timed, and why
    machine: dict[str, str] = field(default_factory=machine)
    load: tuple[float, ...] = field(default_factory=os.getloadavg)  # of the last 1, 5 and 15 minutes


def in_words(measured: Measured, headings: Mapping[str, tuple[str, float, int]]) -> str:
    """Return the timings as Markdown, accuracy before time.

    Headings map a figure to its heading, factor and digits.
    """
    rows, several = measured.timings, len({t.stage for t in measured.timings}) > 1
    columns = ["job" if several else "case", "method", *(heading for heading, _, _ in headings.values())]
    columns += ["ms", "ratio of the time", "n"]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for t in rows:
        cells = [f"{t.stage}, {t.case}" if several else t.case, t.method]
        for name, (_, factor, digits) in headings.items():
            cells.append(f"{factor * t.figures[name]:.{digits}f}" if name in t.figures else "")
        lines.append(f"| {' | '.join([*cells, t.ms.words, t.ratio.words, str(t.inputs)])} |")
    load = ", ".join(f"{one:.1f}" for one in measured.load)
    lines += [
        "",
        "Processor time of n inputs: median (10th to 90th percentile), and the ratio to the first method's at each input.",
        f"{machine_in_words(measured.machine)}; load of the last 1, 5 and 15 minutes {load}.",
    ]
    return "\n".join(lines + [f"Not measured: {words}." for words in measured.missing])


def to_json(measured: Measured) -> str:
    """Return the results as JSON, numbers with five digits."""
    return json.dumps(_rounded(config.as_table(measured)), indent=1) + "\n"


M = TypeVar("M", bound=Measured)


def from_json(text: str, schema: type[M]) -> M:
    """Return the results of `to_json`.

    Raises:
        ConfigError: They are no results of this kind.
    """
    return config.build(json.loads(text), schema, schema.__module__)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list) else value
