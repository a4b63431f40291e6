"""Goals reached by Sextant, by itself without its map, and by published planners, on the same courses and seeds."""

from collections.abc import Iterable

from sextant.evaluation.provenance import Made
from sextant.evaluation.trials import results_store, table_text
from sextant.evaluation.trials.campaign_table import course_in_words, of_runs, outcome
from sextant.evaluation.trials.results_store import Run
from sextant.evaluation.trials.summary import Trials
from sextant.evaluation.trials.table_text import Table

OURS, BLIND = "Sextant", "without its map"


def content(runs: Iterable[Run]) -> Table:
    """Return the table: a row per course, a column per method; an empty cell was not run.

    Robots and gaits other than those of most courses are named in the row.
    """
    campaign = of_runs(runs)
    walked = [t for entry in campaign.entries for t in (entry.seeing, entry.blind) if t is not None]
    methods = sorted({_method(t) for t in walked}, key=lambda name: (name != OURS, name != BLIND, name))
    courses: dict[tuple[str, str, str], dict[str, Trials]] = {}
    for t in walked:
        courses.setdefault((t.scenario, t.robot, t.gait), {})[_method(t)] = t
    several = len({place[1:] for place in courses}) > 1
    rows = []
    for (scenario, robot, gait), of_method in courses.items():
        row = course_in_words(scenario) + (f", {robot}, {gait}" if several else "")
        rows.append([row, *(_cell(of_method.get(name)) for name in methods)])
    seeds: dict[str, list[str]] = {}
    for name in methods:
        found = {results_store.in_ranges(t.seeds) for t in walked if _method(t) == name}
        seeds.setdefault("; ".join(sorted(found)), []).append(name)
    notes = [
        "Seeds " + ", ".join(f"{of} of {' and '.join(names)}" for of, names in seeds.items()) + "." if seeds else "No runs.",
        *(f"Made {made.words}." for made in Made.joined(t.made for t in walked)),
        *(f"Left out: {words}." for words in campaign.left_out),
    ]
    return Table(["course", *methods], rows, notes)


def markdown(runs: Iterable[Run]) -> str:
    """Format the table in Markdown; see `content`."""
    return table_text.markdown(content(runs))


def _method(t: Trials) -> str:
    """Return the plug-ins and parameters of trials, or whose own they are."""
    return ", ".join(filter(None, (t.params, BLIND * t.blind))) or OURS


def _cell(t: Trials | None) -> str:
    if t is None:
        return ""
    falls = f", {t.falls} fell" if t.falls else ""
    return f"{outcome(t)}{falls}"
