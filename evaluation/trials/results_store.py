"""Results store: finished runs on file, one line of JSON each.

Batches continue from it and tables are made from it, here or on another machine. A line holds the run's whole report (a batch's
`trials.jsonl`) or, for long-term storage, only the fields that a batch is summarised from (a campaign's `campaign.jsonl`). It
also records the program and the time, and a fingerprint that shows whether the result is still valid. Both kinds are read
alike.
"""

import contextlib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any, Self

from sextant.evaluation import report as reports
from sextant.evaluation.report import Passage, Warned
from sextant.shared.errors import SextantError
from sextant.shared.files.input_file import FileError, parse_json, read_bytes
from sextant.shared.files.whole_files import append_text, explained


class ResultsError(SextantError, ValueError):
    """A file of runs that cannot be read."""


_MAX_FILE_BYTES = 1 << 30
_MARKS = ("fingerprint", "commit", "time", "machine", "params")
_BEGINS = b'{"fingerprint":'  # every line of runs begins like this


_MOST_RANGES = 8  # of seeds that are listed
_NO_PASSAGE = Passage()


@dataclass(frozen=True, slots=True)
class Run:
    """The fields of a finished run that a batch is summarised from.

    The names are those of the report; NaN means not measured.
    """

    fingerprint: str  # of all that determines the run except its seed; see `sextant.evaluation.trials.trials.fingerprint`
    commit: str
    time: str  # UTC, ISO 8601
    scenario: str
    robot: str
    gait: str
    blind: bool
    seed: int
    success: bool
    reason: str
    falls: int
    shutdowns: int
    collisions: int
    steps: int
    missteps: int
    raised_block_touchdowns: int
    distance_m: float
    speed_mps: float
    tilt_p95_deg: float
    commanded_tilt_p95_deg: float
    height_mean_m: float
    height_rms_m: float
    height_oscillation_m: float
    slip_p50_m: float
    stability_margin_m: float
    torque_rms_nm: float
    final_pose_error_m: float
    map_rmse_m: float
    map_off_edges_m: float
    map_bias_m: float
    map_edge_m: float
    map_coverage: float
    real_time_factor: float
    passage: Passage = _NO_PASSAGE  # left out of the line of a run without a gap
    machine: str = ""  # that made it, if the line records it
    params: str = ""  # plug-ins, and parameters that differ from their defaults, as text
    warnings: tuple[Warned, ...] | None = None  # of the robot about itself; None in a line that does not record them

    @classmethod
    def of(cls, report: dict[str, Any], fingerprint: str, commit: str, time: str, machine: str = "", params: str = "") -> Self:
        """Create a run from a report as a table."""
        values = {name: _at(report, _PLACES.get(name, name)) for name in _NAMES if name not in _MARKS}
        marks = dict(zip(_MARKS, (fingerprint, commit, time, machine, params), strict=True))
        return cls._numbered(marks | values)

    @classmethod
    def read(cls, entry: dict[str, Any]) -> Self:
        """Create a run from a line on file as a table.

        Raises:
            ValueError: A field is missing or has another type.
        """
        report = entry.get("report")
        if isinstance(report, dict):
            report = {
                "params": {},
                "plugins": {},
                "deviation": {},
                "gait_choices": [],
                "hottest_servo_c": None,
                "warnings": None,
            } | report  # older reports do not have them
            report["passage"] = _with_tipped(report.get("passage"))
        entry = _LEFT_OUT | entry
        entry["passage"] = _with_tipped(entry["passage"])
        problems = (
            reports.check(entry, cls) if report is None else reports.check(report | {"warnings": report["warnings"] or []})
        )
        if problems:
            raise ValueError("; ".join(problems))
        if report is None:
            return cls._numbered({name: entry[name] for name in _NAMES})
        return cls.of(report, *(str(entry.get(name, "")) for name in _MARKS))

    @classmethod
    def _numbered(cls, values: dict[str, Any]) -> Self:
        numbered: dict[str, Any] = {name: float("nan") if value is None else value for name, value in values.items()}
        warnings = values["warnings"]
        told = None if warnings is None else tuple(Warned(**warned) for warned in warnings)
        return cls(**{**numbered, "passage": reports.passage_of(values["passage"]), "warnings": told})

    def line(self) -> dict[str, Any]:
        """Return the run as a table, without default values."""
        table: dict[str, Any] = reports.plain(self)
        return {name: value for name, value in table.items() if name not in _LEFT_OUT or value != _LEFT_OUT[name]}


def _with_tipped(passage: Any) -> Any:
    """Return the table of a passage; an older one lacks the number of tops that tipped."""
    return {"tipped": 0} | passage if isinstance(passage, dict) else passage


_LEFT_OUT = {"passage": reports.plain(_NO_PASSAGE), "machine": "", "params": "", "warnings": None}
_NAMES = tuple(field.name for field in fields(Run))
_PLACES = {  # path in a report, where it differs from the field's name
    "tilt_p95_deg": "tilt_deg.p95",
    "commanded_tilt_p95_deg": "commanded_tilt_deg.p95",
    "height_mean_m": "body_height_error_m.mean",
    "height_rms_m": "body_height_error_m.rms",
    "height_oscillation_m": "body_height_oscillation_m",
    "slip_p50_m": "slip_m_per_step.p50",
    "stability_margin_m": "min_stability_margin_m",
    "torque_rms_nm": "torque_nm.rms_worst_joint",
    "final_pose_error_m": "pose_error_m.final",
    "map_rmse_m": "course_map_m.rmse",
    "map_off_edges_m": "course_map_m.off_edges",
    "map_bias_m": "course_map_m.bias",
    "map_edge_m": "course_map_m.edge",
    "map_coverage": "course_map_m.coverage",
}


def read(path: Path, fingerprint: str | None = None) -> list[Run]:
    """Read the runs on file, optionally of one fingerprint; none if there is no file.

    The file is not changed. A last line that is truncated, or is being written, counts as not run.

    Raises:
        ResultsError: A line is not a finished run (the message says which), or the file cannot be read.
    """
    *lines, tail = _lines(path)
    found: list[Run] = []
    for number, line in enumerate(lines, 1):
        try:
            found += _runs(line, fingerprint)
        except ValueError:
            raise _no_run(path, number, line) from None
    with contextlib.suppress(ValueError):
        found += _runs(tail, fingerprint)
    return found


def mend(path: Path) -> None:
    """Prepare a file for appending: complete or cut off an unfinished last line.

    A last line without a line break gets one if it is a run; otherwise it is removed.

    Raises:
        ResultsError: The file does not hold runs, so it was not changed; or it cannot be read.
        WriteError: It cannot be written.
    """
    *lines, tail = _lines(path)
    if not tail:
        return
    for number, line in enumerate(lines, 1):
        if not _is_run(line):
            raise _no_run(path, number, line)
    if _is_run(tail):
        append_text(path, "\n")
    elif tail.startswith(_BEGINS) or _BEGINS.startswith(tail):
        with explained(path):
            os.truncate(path, sum(len(line) + 1 for line in lines))
    else:
        raise _no_run(path, len(lines) + 1, tail)


def keep(path: Path, runs: Iterable[Run]) -> None:
    """Append runs to a file, a short line each.

    Raises:
        ResultsError: The existing file does not hold runs, or cannot be read.
        WriteError: The runs cannot be written; the file is unchanged.
    """
    mend(path)
    lines = [json.dumps(run.line(), ensure_ascii=False, separators=(",", ":")) + "\n" for run in runs]
    append_text(path, "".join(lines), durable=True)


def newest(runs: Iterable[Run]) -> tuple[list[list[Run]], int]:
    """Return batches of runs, and how many runs were left out.

    A batch has one scenario, robot and gait, one set of parameters, is sighted or blind, and has one fingerprint, that of its
    last run. Runs of an earlier program or an earlier form of the scenario are left out. A seed that is on file twice counts
    once.
    """
    batches: dict[tuple[str, str, str, bool, str], list[Run]] = {}
    for run in runs:
        batches.setdefault((run.scenario, run.robot, run.gait, run.blind, run.params), []).append(run)
    found, older = [], 0
    for batch in batches.values():
        last = max(batch, key=lambda run: run.time).fingerprint
        valid = {run.seed: run for run in batch if run.fingerprint == last}
        older += sum(run.fingerprint != last for run in batch)
        found.append([valid[seed] for seed in sorted(valid)])
    return found, older


def files(places: Sequence[Path]) -> list[Path]:
    """Return the files of runs at some places.

    A place is a file, or a folder with a campaign's or else a batch's file.

    Raises:
        ResultsError: There is none at one of the places, or it cannot be accessed.
    """
    found = []
    for place in places:
        try:
            candidates = (place / "campaign.jsonl", place / "trials.jsonl") if place.is_dir() else (place,)
            path = next((path for path in candidates if path.is_file()), None)
        except OSError as error:
            raise _unreadable(place, error) from None
        if path is None:
            raise ResultsError(f"{place}: a file of stored runs, or a folder with campaign.jsonl or trials.jsonl, expected")
        found.append(path)
    return found


def in_ranges(seeds: Iterable[int]) -> str:
    """Return seeds in rising order as text, such as `0 to 15, 17`; only their number and range if they are strewn."""
    known = list(seeds)
    ranges = [[seed for _, seed in run] for _, run in groupby(enumerate(known), lambda item: item[1] - item[0])]
    if len(ranges) > _MOST_RANGES:
        return f"{len(known)} between {known[0]} and {known[-1]}"
    return ", ".join(f"{one[0]} to {one[-1]}" if len(one) > 2 else ", ".join(map(str, one)) for one in ranges)


def _lines(path: Path) -> list[bytes]:
    """Return the lines of a file, then what follows its last line break.

    The last element is empty for a complete or missing file.
    """
    if not _exists(path):
        return [b""]
    try:
        return read_bytes(path, _MAX_FILE_BYTES).split(b"\n")
    except FileError as error:
        raise ResultsError(f"{error}; a readable file of stored runs expected") from None


def _runs(line: bytes, fingerprint: str | None) -> list[Run]:
    """Return the run of a line, or none if its fingerprint differs.

    Raises a ValueError if the line is not a run.
    """
    entry = _entry(line)
    return [Run.read(entry)] if fingerprint in (None, entry.get("fingerprint")) else []


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError as error:
        raise _unreadable(path, error) from None


def _entry(line: bytes) -> dict[str, Any]:
    entry = parse_json(Path(), line)
    if not isinstance(entry, dict) or ("report" not in entry and "scenario" not in entry):
        raise ValueError("no run")
    return entry


def _is_run(line: bytes) -> bool:
    """Return whether a line is a run, of this or another version of the program."""
    try:
        return bool(_entry(line))
    except ValueError:
        return False


def _no_run(path: Path, number: int, line: bytes) -> ResultsError:
    return ResultsError(f"{path}, line {number}: a finished seed as JSON expected, found {line[:60]!r}; remove the line")


def _unreadable(path: Path, error: OSError) -> ResultsError:
    return ResultsError(f"{path}: cannot be read ({error.strerror}); a readable file of stored runs expected")


def _at(table: dict[str, Any], place: str) -> Any:
    value: Any = table
    for key in place.split("."):
        value = value[key]
    return value
