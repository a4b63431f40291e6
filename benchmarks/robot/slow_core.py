"""Live walk whose actuator gets a share of a core, as on a slower computer.

A control group of Linux grants the actuator's process that share of each 5 ms. Its real-time priority is taken away, because
the limit does not hold for it.
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from benchmarks.peers import kept

_CGROUPS = Path("/sys/fs/cgroup")
_PERIOD_US = 5000  # a share of a longer period would stop the process for longer than a slow processor does
_LEAST_US = 1000  # shortest quota that Linux accepts
_LOOK_S = 0.2
_STARTS_WITHIN_S = 120.0  # [s] in which the actuator must start


class SlowCoreError(Exception):
    """The walk cannot be measured; the message says why."""


@dataclass(frozen=True, slots=True)
class SlowWalk:
    """A walk whose actuator had a share of a core."""

    share: float  # of a core
    success: bool
    reason: str
    period_p50_ms: float  # time between two control cycles
    period_p99_ms: float
    missed: int  # skipped cycles
    cores: float  # mean use of a core by the actuator's process


class CpuQuota:
    """Control group whose processes get a share of a core, by version 1 or 2 of the interface."""

    def __init__(self, share: float, cgroups: Path = _CGROUPS):
        """Name a new group.

        Args:
            share: Share of a core, at least 0.2.
            cgroups: Folder in which the control groups are mounted.
        """
        self._quota_us = round(share * _PERIOD_US)
        if self._quota_us < _LEAST_US:
            raise SlowCoreError(f"a share of at least {_LEAST_US / _PERIOD_US:g} of a core expected, found {share:g}")
        self._root = cgroups
        self._is_v2 = (cgroups / "cgroup.controllers").exists()
        self.folder = (cgroups if self._is_v2 else cgroups / "cpu") / f"sextant-{os.getpid()}"

    def __enter__(self) -> Self:
        try:
            if self._is_v2:
                (self._root / "cgroup.subtree_control").write_text("+cpu", encoding="ascii")
            self.folder.mkdir()
            if self._is_v2:
                self._write("cpu.max", f"{self._quota_us} {_PERIOD_US}")
            else:
                self._write("cpu.cfs_period_us", str(_PERIOD_US))
                self._write("cpu.cfs_quota_us", str(self._quota_us))
        except OSError as error:
            raise SlowCoreError(
                f"a control group in {self.folder.parent} expected, found {error.strerror}; run this as root on Linux"
            ) from error
        return self

    def __exit__(self, _type: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None) -> None:
        """Remove the group, which is empty once its processes have ended."""
        if self.folder.exists():
            self.folder.rmdir()

    def hold(self, pid: int) -> None:
        """Limit a process."""
        for task in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setscheduler(int(task.name), os.SCHED_OTHER, os.sched_param(0))
        self._write("cgroup.procs", str(pid))

    def _write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(text, encoding="ascii")


def measure(scenario: str, seed: int, share: float, folder: Path) -> SlowWalk:
    """Walk live over a course, and hold the actuator to a share of a core.

    Args:
        scenario: Name or path of the course.
        seed: Random seed.
        share: Share of a core.
        folder: Folder for the walk's files.

    Raises:
        SlowCoreError: There is no such control group, or the walk did not start.
    """
    command = [sys.executable, "-m", "sextant.deploy.cli", "run", scenario, "--seed", str(seed), "--out", str(folder / "walk")]
    with (
        CpuQuota(share) as quota,
        (folder / "walk.log").open("wb") as log,
        subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT) as run,
    ):
        try:
            cores = _hold(run, quota)
            run.wait()
        finally:
            run.terminate()
    try:
        report = json.loads((folder / "walk" / "report.json").read_text(encoding="utf-8"))
    except OSError:
        raise SlowCoreError(f"the walk has left no report; its output is in {folder / 'walk.log'}") from None
    period = report["stages_ms"]["actuator.cycle"]
    missed = report["missed_beats"].get("actuator", 0)
    return SlowWalk(share, report["success"], report["reason"], period["p50"], period["p99"], missed, cores)


def actuator_of(parent: int) -> int:
    """Return the process id of the actuator that a run has started, or 0."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().decode("utf-8", "replace").split("\0")
        except OSError:
            continue  # it has ended
        if "sextant.services.actuator" in words and words[-3:-1] == ["--parent", str(parent)]:
            return int(folder.name)
    return 0


def _hold(run: "subprocess.Popen[bytes]", quota: CpuQuota) -> float:
    """Limit the actuator of a run until it ends; return its mean use of a core."""
    until_s = time.monotonic() + _STARTS_WITHIN_S
    while not (pid := actuator_of(run.pid)):
        if run.poll() is not None or time.monotonic() > until_s:
            raise SlowCoreError("the run has started no actuator; `sextant doctor` checks what it needs")
        time.sleep(_LOOK_S)
    quota.hold(pid)
    began_s, used_s = time.monotonic(), _used_s(pid)
    cores = 0.0
    while (now_used_s := _used_s(pid)) >= 0.0:
        cores = (now_used_s - used_s) / max(time.monotonic() - began_s, _LOOK_S)
        time.sleep(_LOOK_S)
    return cores


def _used_s(pid: int) -> float:
    """Return the processor time [s] of a process; -1 once it has ended."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return -1.0
    return -1.0 if words[0] == "Z" else (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def in_words(found: SlowWalk) -> str:
    """Return the result as Markdown."""
    walked = "at its goal" if found.success else f"failed: {found.reason}"
    return "\n".join(
        (
            "| share of a core | between two cycles p50, ms | p99, ms | cycles skipped | used, of a core | the robot |",
            "|---|---|---|---|---|---|",
            f"| {found.share:g} | {found.period_p50_ms:.1f} | {found.period_p99_ms:.1f} | {found.missed} | {found.cores:.2f} "
            f"| {walked} |",
        )
    )


def to_json(found: SlowWalk) -> str:
    """Return the result as JSON."""
    return kept.to_json(found)


def from_json(text: str) -> SlowWalk:
    """Read a result written by `to_json`."""
    return kept.from_json(text, SlowWalk)
