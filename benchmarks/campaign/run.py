"""Run of a part of the campaign: its commands, one after the other, and what they leave."""

import contextlib
import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.campaign.evidence import Evidence, stamped
from benchmarks.campaign.part import DOCS, ROOT, Part
from sextant.evaluation import provenance
from sextant.evaluation.trials import results_store
from sextant.shared.errors import SextantError
from sextant.shared.files import whole_files

_LIMIT_BROKEN = 1  # exit status of a command that ran, and found that a limit was not kept
_STDERR = 2  # file descriptor: what commands print is progress, and no part of the campaign's own result
_TO_END_S = 120.0  # for a command that was interrupted, to write what it has found


class PartError(SextantError, RuntimeError):
    """A part that could not be run."""


def run(part: Part, out: Path, workers: str, until: float, say: Callable[[str], None]) -> Evidence | None:
    """Run the commands of a part, keep the result in docs/, and return its origin.

    Commands that continue in their folder are not repeated from the beginning.

    Args:
        part: Part to run.
        out: Folder of the part.
        workers: Text such as `--jobs 2` for the commands that divide their work.
        until: Time on `time.monotonic` at which the running command is interrupted; then nothing is kept.
        say: Reports progress.

    Returns:
        The origin of the result, or None if the time did not suffice.

    Raises:
        PartError: A command failed, or the code changed meanwhile.
    """
    commit, begun, passed, spent = provenance.commit(), provenance.now(), True, _children_s()
    steps = part.steps(out, workers)
    for step in steps:
        say(f"$ {step.line}")
        status = _status(step.words, until)
        if status is None:
            return None
        if status not in (0, _LIMIT_BROKEN):
            raise PartError(f"{step.line}: exit status 0 or {_LIMIT_BROKEN} expected, found {status}")
        passed &= status == 0
    if provenance.commit() != commit:
        raise PartError(f"the code of commit {commit} expected until the end, found {provenance.commit()}; run the part again")
    _keep(part, [step.folder for step in steps])
    hours = round((_children_s() - spent) / 3600, 2)
    evidence = Evidence((commit,), begun, provenance.now(), provenance.machine(), "", hours, passed)
    return stamped(_of_runs(part, evidence), part)


def _status(words: list[str], until: float) -> int | None:
    """Run a command and return its exit status, or None if it was interrupted at a time."""
    around = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(words, cwd=ROOT, env=around, stdout=_STDERR, start_new_session=True)
    try:
        return process.wait(None if until == float("inf") else max(until - time.monotonic(), 0.0))
    except subprocess.TimeoutExpired:
        return None
    finally:
        _end(process)


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Interrupt a command that still runs, as Ctrl-C does."""
    for number in (signal.SIGINT, signal.SIGKILL):
        if process.poll() is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_TO_END_S)


def _keep(part: Part, folders: list[Path]) -> None:
    """Copy what the commands left to docs/."""
    kept = DOCS / part.kept
    if not part.of_trials:
        if not (folders[0] / part.result).exists():
            raise PartError(f"{folders[0] / part.result} expected, found none; the output of the command states the cause")
        whole_files.write_text(kept, (folders[0] / part.result).read_text(encoding="utf-8"), durable=True)
        return
    runs = [run for path in results_store.files(folders) for run in results_store.read(path)]
    batches, _ = results_store.newest(runs)
    fresh = kept.with_suffix(".new")
    fresh.unlink(missing_ok=True)
    results_store.keep(fresh, [run for batch in batches for run in batch])
    fresh.replace(kept)


def _of_runs(part: Part, evidence: Evidence) -> Evidence:
    """Return evidence with the commits and times of the runs, which may have been made before."""
    if not part.of_trials:
        return evidence
    return of_file(DOCS / part.kept, evidence)


def of_file(path: Path, evidence: Evidence) -> Evidence:
    """Return evidence with the commits, times and machines of the runs on file."""
    runs = results_store.read(path)
    made = provenance.Made.of([(run.commit, run.time) for run in runs])
    machines = ", ".join(sorted({run.machine for run in runs if run.machine})) or evidence.machine
    return Evidence(made.commits, made.first, made.last, machines, "", evidence.core_hours, evidence.passed)


def _children_s() -> float:
    """Return the processor time [s] of all ended child processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
