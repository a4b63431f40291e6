"""Trials: many runs of one scenario, one seed each.

Every finished seed is a line of JSON in `trials.jsonl`, so an interrupted batch continues where it stopped. Lines of another
scenario, of an earlier form of this scenario, or of another version of the program are not counted.
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sextant.evaluation import params, provenance
from sextant.evaluation import report as reports
from sextant.evaluation.report import Report
from sextant.evaluation.trials import results_store
from sextant.evaluation.trials.cluster import Cluster
from sextant.evaluation.trials.environment import as_json, check_environment, environment, fingerprint, refuse_another_program
from sextant.evaluation.trials.results_store import Run
from sextant.evaluation.trials.summary import Trials, summarise
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files import config, whole_files
from sextant.shared.runtime.stopwatch import stopwatch_ns
from sextant.shared.runtime.workers import share_out
from sextant.shared.scenario.scenario import Scenario

_BUSY = 0.85  # [1] CPU time of the walks over their elapsed time below which other work delayed them
Runner = Callable[[Scenario, int], Report]


class Timed(NamedTuple):
    """Result of one walk."""

    report: Report
    elapsed_s: float
    cpu_s: float
    machine: str


class Batch:
    """Trials of one scenario: the seeds that have no result yet, and the results so far.

    Results are stored as they come, and summarised in the order of their seeds.
    """

    def __init__(
        self,
        scenario: Scenario,
        seeds: Iterable[int],
        out: Path,
        blind: bool = False,
        say: Callable[[str], None] = lambda _: None,
        run: Runner | None = None,
        keep_in: Path | None = None,
    ):
        """Read the results on file, and check the grounds of the other seeds. The arguments are those of `run_trials`."""
        self.wanted = sorted(set(seeds))
        if not self.wanted:
            raise ValueError("at least one seed expected, found 0 seeds")
        refuse_another_program()
        self.scenario = replace(scenario, walk=replace(scenario.walk, blind=scenario.walk.blind or blind))
        whole_files.make_folder(out)
        self._path, self._keep_in, self._say = out / "trials.jsonl", keep_in, say
        self._mark, self._made_by = fingerprint(self.scenario), provenance.commit()
        self._done = _done(self._path, keep_in, self._mark, self.wanted)
        self.left = [seed for seed in self.wanted if seed not in self._done]
        check_grounds(self.scenario, self.left)
        results_store.mend(self._path)
        self.tasks = [(run or _run_lockstep, self.scenario, seed) for seed in self.left]
        self._elapsed_s: list[float] = []
        self._cpu_s: list[float] = []

    @property
    def is_complete(self) -> bool:
        """Whether every seed has a result."""
        return len(self._done) == len(self.wanted)

    def announce(self, processes: int) -> None:
        """Say how many seeds are done and how many walks follow."""
        if len(self.left) < len(self.wanted):
            done = len(self.wanted) - len(self.left)
            self._say(f"{done} of {len(self.wanted)} seeds are already done; see {self._keep_in or self._path}")
        if self.left:
            walks = f"{len(self.left)} walks, {min(processes, len(self.left))} at a time"
            self._say(f"{self.scenario.name}: {walks}; a line follows for each walk that ends")

    def store(self, result: Timed, processes: int, name: str = "") -> None:
        """Store the result of a walk, and say it in a line that begins with a name."""
        report, walk_s, walk_cpu_s, machine = result
        marks = {"fingerprint": self._mark, "commit": self._made_by, "time": provenance.now(), "machine": machine}
        if changed := params.changes_in_words(self.scenario):
            marks["params"] = changed
        entry = marks | {"report": reports.as_table(report)}
        done = self._done
        done[report.seed] = Run.read(entry)
        with whole_files.reported(self._say):
            whole_files.append_text(self._path, json.dumps(entry, ensure_ascii=False) + "\n", durable=True)
            if self._keep_in is not None:
                results_store.keep(self._keep_in, [done[report.seed]])
        self._elapsed_s.append(walk_s)
        self._cpu_s.append(walk_cpu_s)
        to_go_s = float(np.mean(self._elapsed_s)) * (len(self.wanted) - len(done)) / min(processes, len(self.left))
        successes = sum(one.success for one in done.values())
        line = _line(report, len(done), len(self.wanted), successes)
        self._say(f"{name}{line}  took {walk_s:.0f} s{_to_go(to_go_s)}")
        if self.is_complete and sum(self._cpu_s) < _BUSY * sum(self._elapsed_s) - 1.0:
            took = f"a walk took {np.mean(self._elapsed_s):.0f} s, of which {np.mean(self._cpu_s):.0f} s of CPU time"
            self._say(f"{name}{took}: the machine was busy with other work, which delays results and does not change them")

    def trials(self) -> Trials:
        """Return the summary of all seeds."""
        return summarise([self._done[seed] for seed in self.wanted])


def run_batches(batches: Sequence[Batch], jobs: int, cluster: Cluster | None = None) -> Iterator[Batch]:
    """Run batches with the same processes, and yield each in its turn once it is complete.

    While the last walks of a batch run, the other processes already walk for the next one.

    Raises:
        ValueError: No jobs.
        ChangedError: The program has changed since this process first ran trials, so the walks may be by two versions.
    """
    if jobs < 1:
        raise ValueError(f"at least one job expected, found {jobs} jobs")
    processes = max(cluster.size, 1) if cluster else jobs
    results = _shared_out(batches, processes) if cluster is None else _on_cluster(batches, cluster)
    for turn, batch in enumerate(batches):
        refuse_another_program()
        batch.announce(processes)
        while not batch.is_complete:
            number, result = next(results)
            batches[number].store(result, processes, f"{batches[number].scenario.name}: " if number != turn else "")
        yield batch
    next(results, None)  # ends the processes


def _shared_out(batches: Sequence[Batch], processes: int) -> Iterator[tuple[int, Timed]]:
    """Yield number of the batch and result of each walk."""
    tasks = [(number, *task) for number, batch in enumerate(batches) for task in batch.tasks]
    return share_out(_timed, tasks, min(processes, len(tasks)), in_order=False)


def _on_cluster(batches: Sequence[Batch], cluster: Cluster) -> Iterator[tuple[int, Timed]]:
    """Yield number of the batch and result of each walk, one batch after the other: workers are checked for its scenario."""
    for number, batch in enumerate(batches):
        if batch.left:
            tasks, names = [(number, *task) for task in batch.tasks], [f"seed {seed}" for seed in batch.left]
            of_check = environment(batch.scenario), as_json(batch.scenario)
            yield from cluster.share_out(_timed, tasks, check_environment, of_check, names)


def run_trials(
    scenario: Scenario,
    seeds: Iterable[int],
    jobs: int,
    out: Path,
    blind: bool = False,
    say: Callable[[str], None] = lambda _: None,
    run: Runner | None = None,
    keep_in: Path | None = None,
    cluster: Cluster | None = None,
) -> Trials:
    """Run every seed that has no result yet, each in lockstep.

    Results are stored as they come, and summarised in the order of their seeds.

    Args:
        scenario: The course and how to walk it.
        seeds: Seeds of the runs; duplicates count once.
        jobs: Number of parallel processes; 1 runs in this process.
        out: Folder for `trials.jsonl`.
        blind: Run the baseline without a map.
        say: Receives a line before the first run, and one per seed with its duration and an estimate of the time to go.
        run: Function that runs one seed, `sextant.evaluation.lockstep.lockstep_run.run_lockstep` by default.
        keep_in: A file that also gets a short line of every run, and whose runs count as done; see
            `sextant.evaluation.trials.results_store`.
        cluster: Run on its workers instead of `jobs` processes.

    Raises:
        ValueError: No seeds, no jobs, or an invalid line on file.
        ClusterError: The cluster has not finished all runs. Those that it has finished are stored.
        ConfigError: The ground of a seed cannot be built. No run has begun then.
        ChangedError: The program has changed since this process first ran trials, so new processes would run another version.
    """
    (batch,) = run_batches([Batch(scenario, seeds, out, blind, say, run, keep_in)], jobs, cluster)
    return batch.trials()


def check_grounds(scenario: Scenario, seeds: Iterable[int]) -> None:
    """Build the ground of each seed, so that a seed without one is known before the first walk.

    Raises:
        ConfigError: The ground of a seed cannot be built; the text names all such seeds and the primitive.
    """
    failed: dict[str, list[int]] = {}
    for seed in seeds:
        try:
            build_terrain(scenario, np.random.default_rng([seed, 0]))
        except config.ConfigError as error:
            failed.setdefault(error.problems[0], []).append(seed)
    if failed:
        found = sorted(seed for some in failed.values() for seed in some)
        words = f"no ground for seed{'s' * (len(found) > 1)} {results_store.in_ranges(found)}, so no walk was started"
        raise config.ConfigError(f"scenario {scenario.name}", [f"{words}; {next(iter(failed))}"])


def _timed(number: int, run: Runner, scenario: Scenario, seed: int) -> tuple[int, Timed]:
    """Run a seed of a batch; return the number of the batch and the result."""
    began_ns, cpu_s = stopwatch_ns(), sum(os.times()[:4])
    report = run(scenario, seed)
    return number, Timed(report, (stopwatch_ns() - began_ns) * 1e-9, sum(os.times()[:4]) - cpu_s, provenance.machine())


def _to_go(seconds: float) -> str:
    """Return how long the remaining walks take, as text; empty at the end."""
    if not seconds:
        return ""
    return f", some {seconds:.0f} s to go" if seconds < 120 else f", some {seconds / 60:.0f} min to go"


def _run_lockstep(scenario: Scenario, seed: int) -> Report:
    from sextant.evaluation.lockstep.lockstep_run import run_lockstep  # imports every service

    return run_lockstep(scenario, seed)


def _done(path: Path, keep_in: Path | None, mark: str, wanted: Iterable[int]) -> dict[int, Run]:
    """Return the wanted runs on file, by seed.

    Runs that are only in the batch's own file are appended to `keep_in`.
    """
    here = {run.seed: run for run in results_store.read(path, mark)}
    if keep_in is not None:
        there = {run.seed: run for run in results_store.read(keep_in, mark)}
        results_store.keep(keep_in, [run for seed, run in here.items() if seed not in there])
        here |= there
    return {seed: here[seed] for seed in wanted if seed in here}


def _line(report: Report, done: int, wanted: int, successes: int) -> str:
    arrived = report.success and report.reason == reports.ARRIVED
    verdict = "goal" if arrived else "good" if report.success else "FAIL"
    tail = f"{report.duration_s:5.1f} s  {100 * report.speed_mps:4.1f} cm/s" if arrived else report.reason
    return f"[{done:3d}/{wanted}] seed {report.seed:3d}  {verdict}  {tail}  ({successes} of {done})"
