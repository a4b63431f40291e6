"""Difficulty curve: success over the parameter of a family of scenarios, and why walks fail.

Every finished walk is stored as by a campaign, so that a curve goes on where it stopped, also with further points.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from sextant.evaluation import report as reports
from sextant.evaluation.robot_check.ground_limits import find_ground_limits
from sextant.evaluation.trials.cluster import Cluster
from sextant.evaluation.trials.logistic_fit import LogisticFit, fit_success
from sextant.evaluation.trials.summary import Trials
from sextant.evaluation.trials.trials import Batch, Runner, run_batches
from sextant.shared.files import whole_files
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.family import NamedFamily, check_values
from sextant.shared.scenario.scenario import Scenario

FILE = "curve.json"
_WAITED = re.compile(r"^(?:the planner has been blocked for # s|planner, # to # s): ")  # it says that the walk ended, not why
_ALSO = re.compile(r"; .*")  # what else was reported at that time
_CELLS = re.compile(r" within # cm of its nominal place \(# cells: # ([^,)]*)[^)]*\)")  # the most frequent refusal is first
_PLACE = re.compile(r" ?\(stopped at # of # m\)| # m along")
_JOINT = re.compile(r"\b(?:left|right) (?:front|middle|rear) (coxa|femur|tibia)")
_LEG = re.compile(r"\b(?:the )?(?:left|right) (?:front|middle|rear)(?: leg)?")


@dataclass(frozen=True, slots=True)
class LegLimit:
    """Limit of the legs, as `sextant robot check` computes it: an upper bound."""

    passed: float  # largest value of the family's parameter that is passed
    refused: float | None  # smallest value that is not; None if all tried ones are passed
    reason: str  # why not


@dataclass(frozen=True, slots=True)
class Point:
    """Trials at one value of the parameter."""

    value: float
    trials: Trials


@dataclass(frozen=True, slots=True)
class Curve:
    """Success over difficulty of one family."""

    family: NamedFamily
    points: tuple[Point, ...]  # from easy to impossible
    legs: LegLimit | None  # None if no limit of the robot check is comparable

    def fit(self, at: Sequence[float] = ()) -> LogisticFit:
        """Return a logistic fit, with the success rates at some values."""
        rates = [point.trials.success for point in self.points]
        good, count = (np.array([getattr(rate, name) for rate in rates]) for name in ("successes", "n"))
        return fit_success(np.array([point.value for point in self.points]), good, count, np.array(at, dtype=np.float64))

    @property
    def robot(self) -> str:
        """Name of the robot's profile."""
        return self.points[0].trials.robot


def run_curve(
    family: NamedFamily,
    seeds: Iterable[int],
    jobs: int,
    out: Path,
    values: Sequence[float] = (),
    blind: bool = False,
    asked: Callable[[Scenario], Scenario] = lambda scenario: scenario,
    say: Callable[[str], None] = lambda _: None,
    run: Runner | None = None,
    cluster: Cluster | None = None,
) -> Curve:
    """Run trials at each value of a family's parameter, continuing earlier ones.

    Args:
        family: The family.
        seeds: Seeds of the walks at each value.
        jobs: Number of parallel processes.
        out: Folder with a folder per value.
        values: Values in place of the family's, from easy to impossible.
        blind: Walk without a map.
        asked: Returns the scenario to run for a scenario, for example with another robot or gait.
        say: Receives a line per seed.
        run: Function that runs one seed, in lockstep by default.
        cluster: Run on its workers instead of `jobs` processes.

    Raises:
        ValueError: The values neither rise nor fall.
        ConfigError: There is no scenario at one of the values.
    """
    chosen = tuple(values) or family.family.values
    check_values(chosen)
    scenarios = [asked(family.at(value)) for value in chosen]
    wanted, keep_in = sorted(set(seeds)), out / "campaign.jsonl"
    batches = [
        Batch(scenario, wanted, out / scenario.name.rpartition("@")[2], blind, say, run, keep_in)
        for value, scenario in zip(chosen, scenarios, strict=True)
    ]
    points = [Point(value, batch.trials()) for value, batch in zip(chosen, run_batches(batches, jobs, cluster), strict=True)]
    return Curve(family, tuple(points), _leg_limit(family, scenarios[0].robot))


def causes(trials: Trials) -> dict[str, int]:
    """Return the causes of the failures, and how many walks each of them ended."""
    found: Counter[str] = Counter()
    for reason, count in trials.failures.items():
        found[common_cause(reason)] += count
    return dict(found.most_common())


def common_cause(reason: str) -> str:
    """Return a reason without leg, place, wait and numbers of cells, so that equal causes count together."""
    cause = _ALSO.sub("", _PLACE.sub("", _CELLS.sub(r", most cells \1", _WAITED.sub("", reason))))
    return _LEG.sub("a leg", _JOINT.sub(r"a \1", cause))


def words(curve: Curve) -> str:
    """Format a curve as text: a line per point with its most frequent failures, then where success falls to half."""
    family = curve.family.family
    first = curve.points[0].trials
    title = [f"{curve.family.name}: {family.about}", curve.robot, *(["without a map"] * first.blind), family.parameter]
    lines = [", ".join(title)]
    for point in curve.points:
        rate, failures = point.trials.success, list(causes(point.trials).items())
        interval = f"{rate.successes} of {rate.n} ({100 * rate.low:.0f} to {100 * rate.high:.0f} %)"
        why = "; ".join(f"{count} x {reason}" for reason, count in failures[:3])
        lines.append(f"{_shown(curve, point.value):>10}  {interval:>24}  {why}".rstrip())
    lines.append(half_in_words(curve))
    lines += [legs_in_words(curve)] if curve.legs else []
    return "\n".join([*lines, f"made {first.made.words}"])


def half_in_words(curve: Curve) -> str:
    """Return where success falls to half, as text."""
    middle, low, high = curve.fit().half
    ends = sorted((curve.points[0].value, curve.points[-1].value))
    interval = f"95 %: {_number(curve, low)} to {_shown(curve, high)}"
    if not ends[0] <= middle <= ends[1]:
        return f"success falls to half outside of the points, near {_shown(curve, middle)} ({interval})"
    return f"success falls to half at {_shown(curve, middle)} ({interval})"


def legs_in_words(curve: Curve) -> str:
    """Return what the legs alone pass, as text."""
    assert curve.legs is not None
    passed = f"the legs alone pass {_shown(curve, curve.legs.passed)} (robot check)"
    if curve.legs.refused is None:
        return f"{passed}, the largest that was tried"
    return f"{passed}; at {_shown(curve, curve.legs.refused)}: {curve.legs.reason}"


def to_json(curves: Sequence[Curve]) -> str:
    """Format curves of one family as JSON, with and without a map."""
    family = curves[0].family.family
    table: dict[str, Any] = {
        "family": curves[0].family.name,
        "about": family.about,
        "parameter": family.parameter,
        "unit": family.unit,
        "scale": family.scale,
        "legs": reports.plain(curves[0].legs) if curves[0].legs else None,
        "curves": [_table(curve) for curve in curves],
    }
    return json.dumps(table, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write(curves: Sequence[Curve], out: Path) -> None:
    """Write curve.json."""
    whole_files.write_text(out / FILE, to_json(curves), durable=True)


def _table(curve: Curve) -> dict[str, Any]:
    middle, low, high = curve.fit().half
    points = [
        {"value": point.value, "causes": causes(point.trials), "trials": reports.plain(point.trials)} for point in curve.points
    ]
    return {"blind": curve.points[0].trials.blind, "half": {"value": middle, "low": low, "high": high}, "points": points}


def _leg_limit(family: NamedFamily, robot: str) -> LegLimit | None:
    """Return the robot check's limit in units of the family's parameter."""
    if not family.family.limit:
        return None
    found = getattr(find_ground_limits(load_profile(robot)), family.family.limit)
    unit = degrees if family.family.limit == "slope" else float
    return LegLimit(unit(found.passed), None if found.refused is None else unit(found.refused), found.reason)


def _number(curve: Curve, value: float) -> str:
    return f"{curve.family.family.scale * value:.3g}"


def _shown(curve: Curve, value: float) -> str:
    return f"{_number(curve, value)} {curve.family.family.unit}".rstrip()
