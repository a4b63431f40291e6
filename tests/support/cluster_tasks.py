"""Tasks and checks for workers of a cluster; workers import them by name."""

import os
import signal
import threading
from dataclasses import dataclass
from pathlib import Path

from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.evaluation.report import Report
from sextant.shared.scenario.scenario import Scenario


@dataclass(frozen=True)
class Fatal:
    """Runs a seed; some seeds kill their worker, as a lack of memory does."""

    folder: str  # for a mark of each death
    seeds: tuple[int, ...]
    deaths: int = 1  # of a seed, before it runs
    walks: bool = False  # in lockstep

    def __call__(self, scenario: Scenario, seed: int) -> Report:
        for death in range(self.deaths * (seed in self.seeds)):
            if _first(Path(self.folder) / f"{seed}-{death}"):
                os.kill(os.getpid(), signal.SIGKILL)
        return run_lockstep(scenario, seed) if self.walks else _report(scenario, seed)


def passes() -> str:
    return ""


def refuses_first(mark: str) -> str:
    """Refuse the first worker that asks."""
    return f"numpy 1.0 in process {os.getpid()}" if _first(Path(mark)) else ""


def process(_task: int) -> int:
    return os.getpid()


def fails(task: int) -> int:
    return 1 // task


def first_alone(task: int) -> int:
    """Return at once for the first task; the others last until their process ends."""
    if task:
        threading.Event().wait()
    return task


def _report(scenario: Scenario, seed: int) -> Report:
    good = seed % 2 == 0
    reason = "goal reached" if good else "fell 0.40 m along"
    return Report(scenario.name, seed, scenario.robot, "tripod", False, good, reason, 2.5, 25.0, 0.1, int(not good), 0, 40)


def _first(mark: Path) -> bool:
    """Return whether no process has been here before."""
    try:
        os.close(os.open(mark, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True
