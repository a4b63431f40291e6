"""Masri's Table 6.1 again: his planner and ours on the true ground of his three layouts, next to the printed numbers.

Both plan the same three sections, each a third of the way, from the same stance; ours also the whole way at once, as it does
on a walk. n_g counts the nodes of the graph and n_e the different nodes that are expanded, as he counts. Our search tests a
node only when it expands it; his tests every node before.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sextant.evaluation.baselines.masri_planner import SECTIONS, MasriPlanner
from sextant.evaluation.scoring.passage_truth import gap_begins, stance_at, strip_from
from sextant.evaluation.trace.course import Course
from sextant.evaluation.trials.passage_table import HARDWARE, THESIS
from sextant.evaluation.trials.table_text import Table
from sextant.services.planner.gap_crossing.params import GapApproachParams
from sextant.services.planner.gap_crossing.strip_survey import BEHIND
from sextant.services.planner.roadmap.params import BareGroundParams, PassageSettings
from sextant.services.planner.roadmap.roadmap import PassageStep, Roadmap, SectionPlan, Stance
from sextant.services.planner.roadmap.sections import goal_behind
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.files import config
from sextant.shared.files.input_file import read_json
from sextant.shared.geometry import Array, transform
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.stopwatch import stopwatch_ns
from sextant.shared.scenario.loading import load_scenario

MASRI, SEXTANT, WHOLE = "Masri 2016", "Sextant", "Sextant, whole way"
_MOST_SECTIONS = 6  # of one crossing
PLANNERS = (MASRI, SEXTANT, WHOLE)
LAYOUTS = tuple(THESIS)


@dataclass(frozen=True, slots=True)
class Planned:
    """Plan of one crossing."""

    layout: str
    seed: int  # of the ground and of the samples
    planner: str
    crossed: bool
    generated: tuple[int, ...]  # n_g of each section that was searched
    expanded: tuple[int, ...]  # n_e
    ms: tuple[float, ...]  # time
    steps: int  # of legs and of the body
    margin_m: float = math.nan  # least support margin of a crossing, negative if the centre of mass leaves its standing feet


@dataclass(frozen=True, slots=True)
class _Kept:
    """Content of a file."""

    made: str
    crossings: tuple[Planned, ...]


@dataclass(frozen=True, slots=True)
class Task:
    """A crossing to plan."""

    field: StripMap
    stance: Stance
    goal_x: float  # [m] {strip}

    def goals(self, sections: int = SECTIONS) -> Array:
        """Return the goals (n,) [m] {strip} of sections of one length."""
        return np.linspace(float(self.stance.body[0]), self.goal_x, sections + 1)[1:]


def task_of(layout: str, seed: int) -> Task:
    """Return the crossing of a layout on its true ground; the seed moves the pillars a little."""
    scenario = load_scenario(layout)
    profile = load_profile(scenario.robot)
    height = profile.stance.height_or_own(scenario.walk.body_height)
    course = Course(scenario, seed)
    course.lay(transform(np.eye(3), np.array([*scenario.start.xy, height])), 0.0)
    near = gap_begins(course, scenario.goal.distance) - GapApproachParams().start_distance_m - BEHIND
    field = strip_from(course, near, height)
    goal_x = goal_behind(field, BEHIND, scenario.goal.distance - near, BareGroundParams())
    if goal_x is None:
        raise ValueError(f"a scenario with a gap expected, found {layout}")
    return Task(field, stance_at(profile, BEHIND, height), goal_x)


def measure(seeds: Sequence[int], say: Callable[[str], object] = lambda _: None) -> list[Planned]:
    """Plan each crossing with both planners; both have been compiled before."""
    scenario = load_scenario(LAYOUTS[0])
    profile = load_profile(scenario.robot)
    height = profile.stance.height_or_own(scenario.walk.body_height)
    his, ours = MasriPlanner(profile), Roadmap(profile, PassageSettings(body_height=height))
    first = task_of(LAYOUTS[0], 0)
    _by_masri(his, first, 0), _by_sextant(ours, first, 0)
    found = []
    for layout in LAYOUTS:
        for seed in seeds:
            task = task_of(layout, seed)
            for name, (steps, crossed, counts) in (
                (MASRI, _by_masri(his, task, seed)),
                (SEXTANT, _by_sextant(ours, task, seed)),
                (WHOLE, _by_sextant(ours, task, seed, sections=1)),
            ):
                margin = round(min(step.margin for step in steps), 4) if crossed else math.nan
                generated, expanded, ms = (tuple(column) for column in zip(*counts, strict=True))
                found.append(Planned(layout, seed, name, crossed, generated, expanded, ms, len(steps), margin))
        say(f"{layout}: {len(seeds)} crossings planned by both planners")
    return found


_Counts = tuple[int, int, float]  # n_g, n_e and ms of a section
_Found = tuple[list[PassageStep], bool, list[_Counts]]  # steps, whether they cross, and each section


def _by_masri(planner: MasriPlanner, task: Task, seed: int) -> _Found:
    steps: list[PassageStep] = []
    counts: list[_Counts] = []
    stance = task.stance
    for section, goal in enumerate(task.goals()):
        began = stopwatch_ns()
        found = planner.plan_section(task.field, stance, float(goal), SECTIONS * (seed + 1) + section)
        counts.append((found.generated, found.expanded, _since_ms(began)))
        if found.end is None:
            return steps, False, counts
        steps += found.steps
        stance = found.end
    return steps, True, counts


def _by_sextant(roadmap: Roadmap, task: Task, seed: int, sections: int = SECTIONS) -> _Found:
    """Plan each section; one that ends before its goal is followed by another, as on a walk."""
    steps: list[PassageStep] = []
    counts: list[_Counts] = []
    stance = task.stance
    goals = task.goals(sections).tolist()
    while goals and len(counts) < _MOST_SECTIONS:
        began = stopwatch_ns()
        roadmap.begin(task.field, stance, goals[0], SECTIONS * (seed + 1) + len(counts))
        found = roadmap.grow(10**9)
        counts.append((roadmap.generated, roadmap.expanded_nodes, _since_ms(began)))
        if not isinstance(found, SectionPlan):
            break
        steps += found.steps
        stance = found.end
        goals = goals[found.complete :]
    return steps, not goals, counts


def _since_ms(began_ns: int) -> float:
    return round(1e-6 * (stopwatch_ns() - began_ns), 3)


# -- as a table


def content(found: Sequence[Planned], made: str = "") -> Table:
    """Return the table; medians of a section over the seeds, or over his three trials."""
    rows: list[list[str]] = []
    for layout in LAYOUTS:
        printed = THESIS[layout]
        here = [[one for one in found if (one.layout, one.planner) == (layout, name)] for name in PLANNERS]
        numbers: dict[str, list[list[float]]] = {
            "n_g": [[section.generated for section in trial] for trial in printed],
            "n_e": [[section.expanded for section in trial] for trial in printed],
            "t, ms": [[1e3 * section.seconds for section in trial] for trial in printed],
        }
        rows.append([f"`{layout}`", "crossings", f"{len(printed)} of {len(printed)}", *map(_crossed, here)])
        for name, key in (("n_g", "generated"), ("n_e", "expanded"), ("t, ms", "ms")):
            columns: list[list[Sequence[float]]] = [[getattr(one, key) for one in planned] for planned in here]
            rows.append(["", f"{name} of each section", _medians(numbers[name]), *map(_medians, columns)])
        rows.append(["", "least support margin, cm", "-", *map(_margin, here)])
        rows.append(["", "centre of mass leaves its feet", "-", *map(_outside, here)])
    seeds = sorted({one.seed for one in found})
    notes = [
        f"Medians; the printed ones of his three trials, by {HARDWARE}. Here seeds {seeds[0]} to {seeds[-1]}, on one core."
        if seeds
        else "No crossing was planned.",
        *([f"Made {made}."] if made else []),
    ]
    headings = ["layout", "", "Masri 2016, Table 6.1", "his planner, here", "Sextant, his sections", "Sextant, whole way"]
    return Table(headings, rows, notes)


def to_json(found: Sequence[Planned], made: str) -> str:
    """Return the crossings as JSON, which `read` reads again."""
    tables = [{key: value for key, value in asdict(one).items() if value == value} for one in found]  # without NaN
    lines = ",\n".join(json.dumps(table, separators=(",", ":")) for table in tables)
    return f'{{"made": {json.dumps(made)}, "crossings": [\n{lines}\n]}}\n'


def read(path: Path) -> tuple[list[Planned], str]:
    """Return the crossings of a file, and what made them as text.

    Raises:
        FileError: The file cannot be read.
        ConfigError: It has another content.
    """
    kept = config.build(read_json(path), _Kept, str(path))
    return list(kept.crossings), kept.made


def _crossed(planned: Sequence[Planned]) -> str:
    return f"{sum(one.crossed for one in planned)} of {len(planned)}"


def _medians(trials: Sequence[Sequence[float]]) -> str:
    """Return the median of each section; a section that was not reached does not count."""
    sections = [[trial[k] for trial in trials if len(trial) > k] for k in range(max(map(len, trials), default=0))]
    values = [float(np.median(section)) for section in sections if section]
    return ", ".join(f"{value:.1f}" if value < 10.0 else f"{value:.0f}" for value in values)


def _margin(planned: Sequence[Planned]) -> str:
    margins = [one.margin_m for one in planned if one.crossed]
    return f"{100 * min(margins):.1f}" if margins else "-"


def _outside(planned: Sequence[Planned]) -> str:
    margins = [one.margin_m for one in planned if one.crossed]
    return f"in {sum(margin < 0.0 for margin in margins)} of {len(margins)}"
