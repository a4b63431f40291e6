"""Masri's Table 6.1 with our results: planning effort at every stop.

It has the first trials of his three scenarios, ours next to his.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sextant.evaluation.provenance import Made
from sextant.evaluation.report import Section
from sextant.evaluation.trials import results_store, table_text
from sextant.evaluation.trials.results_store import Run
from sextant.evaluation.trials.table_text import Table


@dataclass(frozen=True, slots=True)
class Published:
    """A section of a trial as the thesis reports it."""

    generated: int  # n_g
    expanded: int  # n_e
    seconds: float  # t


def _trial(*sections: tuple[int, int, float]) -> tuple[Published, ...]:
    return tuple(Published(*section) for section in sections)


TRIALS = 3
# Masri 2016, Table 6.1: by scenario, then by trial and section.
THESIS: Mapping[str, tuple[tuple[Published, ...], ...]] = {
    "passage1": (
        _trial((1111, 71, 0.117), (776, 92, 0.082), (644, 222, 0.099)),
        _trial((1184, 81, 0.113), (1260, 224, 0.171), (781, 56, 0.082)),
        _trial((533, 68, 0.076), (445, 102, 0.057), (464, 95, 0.049)),
    ),
    "passage2": (
        _trial((666, 71, 0.089), (790, 122, 0.112), (936, 294, 0.147)),
        _trial((611, 74, 0.088), (703, 73, 0.076), (503, 137, 0.068)),
        _trial((841, 90, 0.097), (429, 148, 0.070), (827, 140, 0.104)),
    ),
    "passage3": (
        _trial((933, 77, 0.104), (1267, 1069, 0.270), (3715, 2380, 1.416)),
        _trial((1092, 83, 0.117), (2943, 2407, 0.743), (3300, 2146, 1.151)),
        _trial((1133, 118, 0.140), (3301, 2669, 0.964), (1083, 457, 0.214)),
    ),
}
HARDWARE = "an Odroid U3 (Exynos 4412 Prime, Cortex-A9, 1.7 GHz)"  # Masri 2016, section 2.4 and Table 2.4


def content(runs: Iterable[Run]) -> Table:
    """Return the table: our first trials, the thesis in parentheses.

    It has a row per trial and section. A dash marks a section that a scenario does not have.
    """
    batches = _trials_of(runs)
    headings = ["trial", "section", *(f"`{name}` {figure}" for name in THESIS for figure in ("n_g", "n_e", "t, s"))]
    rows = [row for trial in range(TRIALS) for row in _rows(batches, trial)]
    return Table(headings, rows, _footnotes(batches))


def markdown(runs: Iterable[Run]) -> str:
    """Format the table in Markdown; see `content`."""
    return table_text.markdown(content(runs))


def _trials_of(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """Return the first sighted trials by seed of each scenario, newest program only."""
    found, _ = results_store.newest(run for run in runs if run.scenario in THESIS and not run.blind and not run.params)
    return {batch[0].scenario: batch[:TRIALS] for batch in found}


def _rows(batches: Mapping[str, Sequence[Run]], trial: int) -> list[list[str]]:
    ours = {name: batches[name][trial].passage.sections if trial < len(batches.get(name, ())) else () for name in THESIS}
    count = max(len(sections) for sections in (*ours.values(), *(THESIS[name][trial] for name in THESIS)))
    rows = []
    for section in range(count):
        cells = [str(trial + 1), str(section + 1)]
        for name in THESIS:
            cells += _cells(ours[name], THESIS[name][trial], section)
        rows.append(cells)
    return rows


def _cells(ours: Sequence[Section], theirs: Sequence[Published], section: int) -> list[str]:
    """Return n_g, n_e and t of a section, ours and the thesis'."""
    here, there = ["-"] * 3, ["-"] * 3
    if section < len(ours):
        own = ours[section]
        here = [str(own.generated), str(own.expanded), f"{own.planning_ms / 1e3:.3f}"]
    if section < len(theirs):
        published = theirs[section]
        there = [str(published.generated), str(published.expanded), f"{published.seconds:.3f}"]
    return [f"{a} ({b})" for a, b in zip(here, there, strict=True)]


def _footnotes(batches: Mapping[str, Sequence[Run]]) -> list[str]:
    some = [run for batch in batches.values() for run in batch]
    machines = sorted({run.machine or "an unknown machine" for run in some})
    seeds = "; ".join(f"{name} {', '.join(_named(run) for run in batch)}" for name, batch in sorted(batches.items()))
    made = Made.of([(run.commit, run.time) for run in some])
    return [
        f"Nodes generated n_g, expanded n_e, and the time t of planning; in parentheses Masri 2016, Table 6.1, by {HARDWARE}.",
        *([f"Here one core of {', '.join(machines)}; seeds of {seeds}. Made {made.words}."] if some else []),
    ]


def _named(run: Run) -> str:
    return str(run.seed) if run.success else f"{run.seed} (failed)"
