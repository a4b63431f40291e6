"""Tables of results, written into pages at their marks, from the data in docs/ alone.

A mark is a comment with the files and the kind of table; the table replaces all up to the end mark:

    <!-- table: campaign.jsonl --of walks -->
    <!-- end of table -->

Kinds are those of `sextant trials table --of`; `--rows` keeps only the rows of the table. Other data have one table each, and
each file with the faults of a further robot is a row.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from benchmarks.access import access, strangers
from benchmarks.campaign import evidence, table
from benchmarks.campaign.part import load
from benchmarks.faults import overview
from benchmarks.faults import table as fault_table
from benchmarks.fuzz import table as fuzz_table
from benchmarks.page import page
from benchmarks.peers import (
    accuracy,
    kept,
    map_building,
    map_stages,
    passage,
    registration_speed,
    servo_packets,
    step_plans,
    timing,
)
from benchmarks.robot import (
    actuator_cycle,
    calibration,
    checksums,
    fleet,
    latency,
    link,
    naming,
    recording,
    servo_bus,
    size,
    slow_core,
    start,
)
from sextant.evaluation.theses import planner_table
from sextant.evaluation.trials import baselines_table, passage_table, results_store, table_text
from sextant.evaluation.trials.campaign_table import markdown, of_runs

DOCS = Path(__file__).parents[1]
_FAULTS = "faults_"  # and the name of a robot: the file of its faults
_MARK = re.compile(r"(<!-- table: ([^\n]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


class _Bench(Protocol):
    """A benchmark whose result is kept: reads it, and makes a table of it."""

    def from_json(self, text: str, /) -> Any: ...

    def in_words(self, found: Any, /) -> str: ...


def _of(bench: _Bench) -> Callable[[str], str]:
    return lambda text: bench.in_words(bench.from_json(text))


def _faults(text: str) -> str:
    return fault_table.markdown(fault_table.from_json(text))


_BENCHES: Mapping[str, _Bench] = {
    "strangers.json": strangers,
    "latency.json": latency,
    "fleet.json": fleet,
    "accuracy.json": accuracy,
    "cycle.json": actuator_cycle,
    "slow_core.json": slow_core,
    "start.json": start,
    "size.json": size,
    "bus.json": servo_bus,
    "checksums.json": checksums,
    "servos.json": servo_packets,
    "access.json": access,
    "page.json": page,
    "recording.json": recording,
    "calibration.json": calibration,
    "naming.json": naming,
    "maps.json": map_building,
}
_TABLES: Mapping[str, Callable[[str], str]] = MappingProxyType(
    {
        **{name: _of(bench) for name, bench in _BENCHES.items()},
        "cuts.json": lambda text: link.cuts_in_words(link.cuts_from_json(text)),
        "link_walks.json": lambda text: link.walks_in_words(link.walks_from_json(text)),
        "fuzz.json": lambda text: fuzz_table.markdown(fuzz_table.from_json(text)),
        "faults.json": _faults,
        "faults_camera.json": _faults,
        "faults_legs.json": _faults,
        "faults_live.json": _faults,
        "speed.json": lambda text: timing.in_words(timing.from_json(text, timing.Measured), registration_speed.HEADINGS),
        "stages.json": lambda text: map_stages.in_words(timing.from_json(text, map_stages.Measured)),
        "passage.json": lambda text: passage.in_words(timing.from_json(text, passage.Measured)),
        "plans.json": lambda text: timing.in_words(timing.from_json(text, timing.Measured), step_plans.HEADINGS),
        "table_6_1.json": lambda _: table_text.markdown(planner_table.content(*planner_table.read(DOCS / "table_6_1.json"))),
        "evidence.json": lambda _: table.page(load(), evidence.read()),
    }
)


def pages(folder: Path = DOCS.parent) -> dict[Path, str]:
    """Return the README and the pages of docs/ with tables, each with the tables that the data give.

    Args:
        folder: Folder of the README and of docs/.

    Raises:
        ValueError: A mark names no data, or no table of them.
    """
    texts = {path: path.read_text(encoding="utf-8") for path in (folder / "README.md", *sorted((folder / "docs").glob("*.md")))}
    return {path: filled(text) for path, text in texts.items() if _MARK.search(text)}


def filled(text: str) -> str:
    """Return a page with a table at each of its marks."""
    return _MARK.sub(lambda found: f"{found[1]}\n{_table(found[2].split())}\n\n{found[3]}", text)


def _table(words: list[str]) -> str:
    files = [word for word in words if word.endswith((".json", ".jsonl"))]
    missing = [name for name in files if not (DOCS / name).is_file()]
    if missing or not files:
        raise ValueError(f"a file in docs/ expected in a mark of a table, found {missing[0] if missing else 'none'}")
    if all(name.startswith(_FAULTS) and name not in _TABLES for name in files):
        robots = {name.removeprefix(_FAULTS).removesuffix(".json"): DOCS / name for name in files}
        return overview.markdown({robot: fault_table.from_json(path.read_text("utf-8")) for robot, path in robots.items()})
    if files[0] in _TABLES:
        text = (DOCS / files[0]).read_text(encoding="utf-8")
        return _made(files[0], _TABLES[files[0]](text).strip(), kept.origin(text))
    kind = words[words.index("--of") + 1] if "--of" in words else "walks"
    if kind == "baselines":  # of all files together
        return baselines_table.markdown(run for name in files for run in results_store.read(DOCS / name)).strip()
    texts = [_of_trials(DOCS / name, kind) for name in files]
    if "--rows" not in words:
        return "\n".join(texts)
    first, *others = ([row for row in text.splitlines() if row.startswith("|")] for text in texts)
    return "\n".join([*first, *(row for rows in others for row in rows[2:])])


def _made(name: str, text: str, machine: str) -> str:
    """Return a table with the commit that made a file, unless there are several or the table names it, and its machine."""
    part_of, on_file = {part.kept: key for key, part in load().items()}, evidence.read()
    origin = on_file.get(part_of.get(name, ""))
    if origin is None or len(origin.commits) != 1 or "Made at commit" in text:
        return text
    return f"{text}\n\nMade {origin.made.words}{machine and f', {machine}'}."


def _of_trials(path: Path, kind: str) -> str:
    runs = results_store.read(path)
    text = passage_table.markdown(runs) if kind == "sections" else markdown(of_runs(runs), kind)
    return text.strip()
