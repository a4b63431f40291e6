"""Batches of fault injections, each at a different phase of the step.

Injections already made by the same program are not repeated. Every injection is a line of JSON in `faults.jsonl`.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

from benchmarks.faults.camera_walk import CameraWalk
from benchmarks.faults.cases import BY_NAME, Case
from benchmarks.faults.fault_run import SCENARIO, in_walks
from benchmarks.faults.live_walk import LiveWalk
from benchmarks.faults.lockstep_walk import FaultWalk
from benchmarks.faults.robot_cases import of_robot
from benchmarks.faults.walk_verdict import Outcome, score
from sextant.evaluation import provenance
from sextant.evaluation.trials import results_store
from sextant.evaluation.trials.environment import fingerprint, refuse_another_program
from sextant.shared.files import whole_files
from sextant.shared.files.input_file import FileError, parse_json, read_bytes
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.workers import share_out

FILE = "faults.jsonl"


@dataclass(frozen=True, slots=True)
class Injection:
    """One injection of a fault."""

    fault: str
    number: int  # determines the phase
    seed: int  # seed of the walk
    at_s: float  # [s] time in that walk
    phase: float  # [1] of the step
    servo: int  # ID of the servo, -1 for none
    outcome: Outcome
    commit: str = ""  # commit of the program, see `provenance.commit`


Runner = Callable[[str, tuple[int, ...], str], list[Injection]]


def run_faults(
    cases: Sequence[Case],
    phases: int,
    jobs: int,
    out: Path,
    say: Callable[[str], None] = lambda _: None,
    run: Runner | None = None,
    robot: str = SCENARIO.robot,
) -> list[Injection]:
    """Inject each fault at the given number of phases, except for stored results.

    Args:
        cases: The faults.
        phases: Number of injections of each fault.
        jobs: Number of concurrent walks, each in a separate process.
        out: Folder for `faults.jsonl`.
        say: Called with one line per walk.
        run: Injects a fault several times into walks of a robot; `inject` by default.
        robot: Robot profile by name, or path of a TOML file.

    Raises:
        ResultsError: The file there does not consist of complete lines.
        ChangedError: The program has changed since this process started.
    """
    refuse_another_program()
    whole_files.make_folder(out)
    path, mark = out / FILE, fingerprint(replace(SCENARIO, robot=robot))
    results_store.mend(path)
    done = {(one.fault, one.number): one for one in read(path, mark)}
    tasks = [(*task, robot) for case in cases for task in _tasks(case, phases, done)]
    left = sum(len(numbers) for _, numbers, _ in tasks)
    wanted = phases * len(cases)
    if left < wanted:
        say(f"{wanted - left} of {wanted} injections are already done; see {path}")
    commit = provenance.commit()
    for found in share_out(run or inject, tasks, min(jobs, len(tasks)), in_order=False):
        lines = []
        for one in (replace(one, commit=commit) for one in found):
            done[one.fault, one.number] = one
            entry = {"fingerprint": mark, "time": provenance.now(), "scenario": SCENARIO.name, **_plain(asdict(one))}
            lines.append(json.dumps(entry, ensure_ascii=False, separators=(",", ":")) + "\n")
        with whole_files.reported(say):
            whole_files.append_text(path, "".join(lines), durable=True)
        left -= len(found)
        say(f"[{wanted - left}/{wanted}] {found[0].fault}, {len(found)} phases")
    names = [case.name for case in cases]
    return [done[name, number] for name in names for number in range(phases)]


def inject(name: str, numbers: tuple[int, ...], robot: str = SCENARIO.robot) -> list[Injection]:
    """Inject a fault at several phases into walks of a robot, and score the results.

    Live walks are those of the default robot.
    """
    (case,) = of_robot([BY_NAME[name]], load_profile(robot))
    begin = LiveWalk if case.live else partial(CameraWalk if case.course else FaultWalk, robot=robot)
    return [
        Injection(name, number, seed, line.begin_s, line.phase, line.servo, score(line, case, profile))
        for number, seed, line, profile in in_walks(case, numbers, begin)
    ]


def read(path: Path, mark: str) -> Iterator[Injection]:
    """Yield the stored injections with a fingerprint; none if there is no file.

    An incomplete last line is skipped.

    Raises:
        ResultsError: A line is not an injection.
    """
    if not path.exists():
        return
    try:
        *lines, _ = read_bytes(path, 1 << 30).split(b"\n")
    except FileError as error:
        raise results_store.ResultsError(str(error)) from None
    for number, line in enumerate(lines, 1):
        try:
            entry = parse_json(path, line, number)
            if entry["fingerprint"] == mark:
                yield _injection(entry)
        except (ValueError, KeyError, TypeError) as error:
            words = f"{path}, line {number}: an injection as JSON expected, found {line[:60]!r} ({error}); remove the line"
            raise results_store.ResultsError(words) from None


def _tasks(case: Case, phases: int, done: Iterable[tuple[str, int]]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield groups of missing injections; each group shares one walk."""
    done = set(done)
    for first in range(0, phases, case.per_walk):
        numbers = tuple(range(first, min(first + case.per_walk, phases)))
        if any((case.name, number) not in done for number in numbers):
            yield case.name, numbers


def _plain(table: dict[str, Any]) -> dict[str, Any]:
    """Replace values that JSON cannot represent.

    A time that does not exist becomes null.
    """
    return {
        name: _plain(value) if isinstance(value, dict) else None if isinstance(value, float) and not isfinite(value) else value
        for name, value in table.items()
    }


def _injection(entry: dict[str, Any]) -> Injection:
    outcome = {f.name: _number(entry["outcome"][f.name]) for f in fields(Outcome)}
    values = {f.name: entry[f.name] for f in fields(Injection) if f.name != "outcome"}
    return Injection(**values, outcome=Outcome(**outcome))


def _number(value: Any) -> Any:
    return float("nan") if value is None else value
