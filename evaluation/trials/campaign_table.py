"""Success rates per terrain as a table, of a new campaign or of stored runs."""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sextant.evaluation.provenance import Made
from sextant.evaluation.trials import results_store, summary, table_text
from sextant.evaluation.trials.results_store import Run
from sextant.evaluation.trials.statistics import Rate, wilson
from sextant.evaluation.trials.summary import Passages, Trials, in_words
from sextant.evaluation.trials.table_text import Table
from sextant.shared.files import whole_files
from sextant.shared.scenario.scale import unscaled_name

# Courses of the public table in its order, with a description.
WALKED: Mapping[str, str] = {
    "flat": "level ground",
    "slope": "10 deg",
    "stairs": "five of 3 to 5 cm",
    "cobbles": "1 to 3 cm",
    "steps": "24 blocks of 1 to 4 cm, two stairs of 3 cm",
    "rubble": "blocks up to 5 cm, close together",
    "stepping_stones": "12 cm stones, 5 cm gaps, over an abyss",
    "ditch": "8 to 12 cm wide",
    "mixed": "ramps, rubble, stairs, stones in a row",
    "worn_stairs": "three of 4 to 5 cm, skewed and chipped",
}
# Gaps that are crossed on pillars, with a description.
PASSAGES: Mapping[str, str] = {
    "passage1": "two straight rows of three pillars",
    "passage2": "the middle ones further inward",
    "passage3": "three pillars and two, 10 cm apart",
    "passage_narrow": "pillars of 8 cm",
    "passage_heights": "pillars up to 3 cm higher or lower",
    "passage_gives_way": "a pillar that sinks under a foot",
    "passage_tipping": "pillars that tip near their edges",
    "pillar_field": "pillars strewn by the seed, with a way or without",
}
# Bridges that turn, bend, rise and fall, or become narrow, with a description.
BRIDGES: Mapping[str, str] = {
    "turned_pillars@10": "rows of pillars, 10 deg aside",
    "turned_pillars@20": "20 deg aside",
    "turned_pillars@30": "30 deg aside",
    "passage_bend": "in the shape of an S",
    "uneven_pillars@0.04": "pillars 4 cm higher and lower in turn",
    "pillar_width@0.07": "pillars of 7 cm",
    "two_bridges": "two of 60 cm, 65 cm apart",
}
# Disturbances during the walk, and the courses on which they occur.
TROUBLES: Mapping[str, str] = {
    "sun": "no depth for 10 s, twice",
    "legs": "a person crosses the view every 5 s",
    "sparse": "60 % of the pixels missing at random",
}
TROUBLED: Mapping[str, str] = {
    f"{course}+{trouble}": words for trouble, words in TROUBLES.items() for course in ("steps", "stairs", "cobbles")
}
# Levels of deviation of the robot from its profile; each walks all courses of the public table.
LEVELS: Mapping[str, Mapping[str, str]] = {
    level: {f"{course}+{level}": words for course, words in WALKED.items()} for level in ("mild", "usual", "harsh")
}
# Starts on other ground than a level floor, and long ways.
WAYS: Mapping[str, str] = {
    "start_rubble": "on rubble",
    "start_slope": "on a slope of 8 deg, any heading",
    "start_edge": "half a metre from two edges",
    "start_dark": "without a camera for 12 s",
    "far_goal": "14 m ahead, ten over blocks",
    "loop": "30 m around a square and back",
}
GROUPS: Mapping[str, Mapping[str, str]] = {
    "all": WALKED,
    "passages": PASSAGES,
    "bridges": BRIDGES,
    "troubles": TROUBLED,
    "ways": WAYS,
    **LEVELS,
}
_VALUE = re.compile(r"-?\d+(?:\.\d+)?")  # of the parameter in the name of a family's point
_NAMED: Mapping[str, str] = {name: words for group in GROUPS.values() for name, words in group.items()}
_OWN = {"foothold": "Sextant's foothold rule", "planner": "Sextant's step planner", "registration": "Sextant's registration"}
Columns = Mapping[str, Callable[[Trials], str]]  # heading -> cell
_WALKS: Columns = {
    "goal reached": lambda t: outcome(t),
    "falls": lambda t: str(t.falls),
    "shut down": lambda t: str(t.runs_with_shutdown),
    "cm/s": lambda t: f"{100 * t.mean_speed_mps:.1f}" if t.success.successes else "-",
    "missteps per 100 steps": lambda t: f"{100 * t.all_missteps / max(t.all_steps, 1):.2f} ({t.all_missteps} in {t.all_steps})",
    "tilt p95, deg": lambda t: in_words(t.tilt_p95_deg, 1.0, ".2f"),
    "height rms, mm": lambda t: in_words(t.height_rms_m, 1e3, ".1f"),
    "slip p50, mm": lambda t: in_words(t.slip_p50_m, 1e3, ".1f"),
    "least margin, mm": lambda t: in_words(t.stability_margin_m, 1e3, ".0f"),
    "torque rms, N m": lambda t: in_words(t.torque_rms_nm, 1.0, ".2f"),
}
_MISSTEPS: Columns = {
    "goal reached": lambda t: outcome(t),
    "missteps of a walk": lambda t: in_words(t.missteps, 1.0, ".0f"),
}
_WARNINGS: Columns = {
    "goal reached": lambda t: outcome(t),
    "walks with a warning": lambda t: _warned(t),
    "most frequent": lambda t: _most_frequent(t),
}
_MAPS: Columns = {
    "rmse, mm": lambda t: in_words(t.map_rmse_m, 1e3, ".1f"),
    "off edges, mm": lambda t: in_words(t.map_off_edges_m, 1e3, ".1f"),
    "bias, mm": lambda t: in_words(t.map_bias_m, 1e3, ".1f"),
    "edges, mm": lambda t: in_words(t.map_edge_m, 1e3, ".1f"),
    "coverage, %": lambda t: in_words(t.map_coverage, 1e2, ".1f"),
}
_PASSAGES: Columns = {
    "goal reached": lambda t: outcome(t),
    "falls": lambda t: str(t.falls),
    "feet off": lambda t: _of_passages(t, lambda p: f"{p.feet_off} of {p.pillar_touchdowns}"),
    "from the edge, mm": lambda t: _of_passages(t, lambda p: in_words(p.foothold_edge_m, 1e3, ".0f")),
    "p05, mm": lambda t: _of_passages(t, lambda p: in_words(p.foothold_edge_p05_m, 1e3, ".0f")),
    "stops": lambda t: _of_passages(t, lambda p: in_words(p.stops, 1.0, ".0f")),
    "n_g": lambda t: _of_passages(t, lambda p: in_words(p.generated, 1.0, ".0f")),
    "n_e": lambda t: _of_passages(t, lambda p: in_words(p.expanded, 1.0, ".0f")),
    "planning p50, ms": lambda t: _of_passages(t, lambda p: f"{p.planning_p50_ms:.1f}"),
    "p99, ms": lambda t: _of_passages(t, lambda p: f"{p.planning_p99_ms:.1f}"),
    "expansions/s": lambda t: _of_passages(t, lambda p: f"{p.expansions_per_s:.0f}"),
}
TABLES: Mapping[str, Columns] = {
    "walks": _WALKS,
    "reached": {},
    "missteps": _MISSTEPS,
    "maps": _MAPS,
    "passages": _PASSAGES,
    "warnings": _WARNINGS,
}


@dataclass(frozen=True, slots=True)
class Entry:
    """Trials of one terrain, robot and gait, and their blind baseline if it was run."""

    seeing: Trials
    blind: Trials | None = None


@dataclass(frozen=True, slots=True)
class Campaign:
    """The trials of many terrains, and what was left out."""

    entries: tuple[Entry, ...]
    left_out: tuple[str, ...]  # reasons, as text


def of_runs(runs: Iterable[Run]) -> Campaign:
    """Summarise runs on file as a campaign, in the public table's order.

    Blind runs without sighted ones form their own entry.
    """
    found, older = results_store.newest(runs)
    summaries = [summary.summarise(batch) for batch in found]
    places = {name: place for place, name in enumerate(_NAMED)}
    pairs: dict[tuple[int, str, float, str, str, str, str], list[Trials]] = {}
    for t in sorted(summaries, key=lambda t: t.blind):
        place = places.get(unscaled_name(t.scenario), len(places))
        pairs.setdefault((place, *_point_of(t.scenario), t.scenario, t.robot, t.gait, t.params), []).append(t)
    left_out = (f"{older} runs of an earlier program or scenario",) if older else ()
    return Campaign(tuple(Entry(*pairs[key]) for key in sorted(pairs)), left_out)


def _point_of(scenario: str) -> tuple[str, float]:
    """Return the family of a scenario and its value of the parameter, by which points are sorted; others have the value 0."""
    family, _, value = unscaled_name(scenario).partition("@")
    return (family, float(value)) if _VALUE.fullmatch(value) else (scenario, 0.0)


def content(campaign: Campaign, table: str = "walks", seeds: bool = False) -> Table:
    """Return a campaign as a table, a row per terrain: median (worst).

    Args:
        campaign: The campaign.
        table: Name of a table in TABLES. `reached` has the blind baseline in a column; the others have it in a separate row.
        seeds: Add a column with the seeds, which are also in the notes.
    """
    if table == "reached":
        headings = ["course", "goal reached", "with the map switched off"]
        rows = [_reached(campaign, entry) for entry in campaign.entries]
    else:
        headings = ["terrain", *TABLES[table]]
        rows = [[_ticked(_name(campaign, t)), *(cell(t) for cell in TABLES[table].values())] for t in _walked(campaign)]
    if seeds:
        headings.append("seeds")
        for row, t in zip(rows, _walked(campaign) if table != "reached" else _sighted(campaign), strict=True):
            row.append(results_store.in_ranges(t.seeds))
    return Table(headings, rows, _footnotes(campaign, table))


def markdown(campaign: Campaign, table: str = "walks") -> str:
    """Format a campaign as a Markdown table; see `content`."""
    return table_text.markdown(content(campaign, table))


def to_json(campaign: Campaign) -> str:
    """Format a campaign as JSON: trials per terrain, and what was left out."""
    terrains: dict[str, Any] = {
        _name(campaign, entry.seeing): json.loads(summary.to_json(entry.seeing, entry.blind)) for entry in campaign.entries
    }
    return json.dumps({"terrains": terrains, "left_out": campaign.left_out}, indent=1, ensure_ascii=False) + "\n"


def write(campaign: Campaign, out: Path, table: str = "walks") -> None:
    """Write table.md, which is the table of TABLES with that name, and campaign.json."""
    whole_files.write_text(out / "table.md", markdown(campaign, table))
    whole_files.write_text(out / "campaign.json", to_json(campaign), durable=True)


def course_in_words(scenario: str, name: str = "") -> str:
    """Return the name of a row, by default the scenario, in Markdown, with the description of its course."""
    words = _NAMED.get(scenario, "")
    return _ticked(name or scenario) + (f": {words}" if words else "")


def _reached(campaign: Campaign, entry: Entry) -> list[str]:
    course = course_in_words(entry.seeing.scenario, _name(campaign, entry.seeing))
    return [course, outcome(entry.seeing), outcome(entry.blind) if entry.blind else ""]


def _walked(campaign: Campaign) -> list[Trials]:
    return [t for entry in campaign.entries for t in (entry.seeing, entry.blind) if t is not None]


def _sighted(campaign: Campaign) -> list[Trials]:
    return [entry.seeing for entry in campaign.entries]


def _name(campaign: Campaign, t: Trials) -> str:
    """Return a row's name: the terrain, with robot, gait and plug-in where they vary, and changed parameters."""
    rows = _sighted(campaign)
    robots, gaits = {row.robot for row in rows}, {row.gait for row in rows}
    words = [t.robot] * (len(robots) > 1) + [t.gait] * (len(gaits) > 1) + ["blind"] * t.blind
    replaced = {kind for row in rows for kind in _replaced(row)} - _replaced(t)
    words += [_OWN[kind] for kind in sorted(replaced)] + ([t.params] if t.params else [])
    return ", ".join([t.scenario, *words])


def _replaced(t: Trials) -> set[str]:
    """Return the kinds of algorithms that plug-ins replace."""
    return {kind for kind in _OWN if f", {kind} " in f", {t.params}"}


def _ticked(name: str) -> str:
    """Format a row's name in Markdown, with the terrain as code."""
    terrain, comma, rest = name.partition(",")
    return f"`{terrain}`{comma}{rest}"


def _footnotes(campaign: Campaign, table: str) -> list[str]:
    walked = _walked(campaign)
    sighted = [t for t in walked if not t.blind and not t.refusals]
    words = []
    if len({(t.robot, t.gait, t.params) for t in sighted}) == 1:  # otherwise the sum is of no robot
        together = wilson(sum(t.success.successes for t in sighted), sum(t.success.n for t in sighted))
        words.append(f"Together {_rate(together)} reached the goal.")
    words += ["Median (worst) of the runs."] if table not in ("reached", "warnings") else []
    words += ["In parentheses: missteps in steps of a group of legs."] if table == "walks" else []
    words += [_warnings_in_words(walked)] if table == "warnings" else []
    return [
        " ".join([*words, _seeds_in_words(campaign, walked)]),
        *(words for t in walked for words in _of_ways(t)),
        *(f"Made {made.words}." for made in Made.joined(t.made for t in walked)),
        *(f"Left out: {words}." for words in campaign.left_out),
    ]


def _warnings_in_words(walked: Sequence[Trials]) -> str:
    """Return in how many walks the robot warned about itself, of those that record it."""
    known = [t for t in walked if t.with_warnings is not None]
    warned = sum(t.with_warnings or 0 for t in known)
    return f"Warnings in {warned} of {sum(t.success.n for t in known)} walks; # stands for a number."


def _seeds_in_words(campaign: Campaign, walked: Sequence[Trials]) -> str:
    """Return which seeds the rows have, those of most rows first."""
    rows: dict[str, list[Trials]] = {}
    for t in walked:
        rows.setdefault(results_store.in_ranges(t.seeds), []).append(t)
    most, *others = sorted(rows, key=lambda seeds: -len(rows[seeds])) or [""]
    if len(others) == 1 and rows[others[0]] == [t for t in walked if t.blind]:
        return f"Seeds {most}, blind {others[0]}."
    words = [f"{seeds} of {', '.join(_ticked(_name(campaign, t)) for t in rows[seeds])}" for seeds in others]
    return f"Seeds {'; '.join([most, *words])}." if most else ""


def _of_ways(t: Trials) -> Iterable[str]:
    """Yield a footnote about grounds of which some are passable and some are not."""
    p = t.passages
    if p is not None and p.passable + p.impassable:
        crossed, entered = wilson(p.crossed, p.passable), wilson(p.entered_in_vain, p.impassable)
        undecided = f"; of {p.undecided} the search cannot tell" if p.undecided else ""
        yield f"`{t.scenario}`: crossed {_rate(crossed)} that have a way, entered {_rate(entered)} that have none{undecided}."


def outcome(t: Trials) -> str:
    """Return the success rate, and the kind of success if it is not arrival."""
    either = t.passages is not None and t.passages.impassable > 0
    return _rate(t.success) + (", or rightly refused" if either else ", rightly refused" if t.refusals else "")


def _warned(t: Trials) -> str:
    """Return the walks in which the robot warned about itself; a dash if a walk does not record it."""
    return "-" if t.with_warnings is None else f"{t.with_warnings} of {t.success.n}"


def _most_frequent(t: Trials) -> str:
    """Return the most frequent warning and its walks."""
    return next((f"{words} ({count})" for words, count in t.warnings.items()), "-")


def _of_passages(t: Trials, cell: Callable[[Passages], str]) -> str:
    return "-" if t.passages is None else cell(t.passages)


def _rate(rate: Rate) -> str:
    return f"{rate.successes} of {rate.n} ({100 * rate.low:.0f} to {100 * rate.high:.0f} %)"
