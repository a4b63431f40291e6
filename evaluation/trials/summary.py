"""Summary of a batch of trials: the success rate, and the median and the worst of what its runs measured."""

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sextant.evaluation import report as reports
from sextant.evaluation.provenance import Made
from sextant.evaluation.trials.results_store import Run
from sextant.evaluation.trials.statistics import Difference, Rate, difference, wilson

_LISTED = 8  # warnings


@dataclass(frozen=True, slots=True)
class Figure:
    """One quantity over the runs that measured it; NaN if none did."""

    median: float
    worst: float


@dataclass(frozen=True, slots=True)
class Passages:
    """Results of a batch in which a gap was crossed on pillars."""

    feet_off: int  # of all runs
    pillar_touchdowns: int
    foothold_edge_m: Figure  # median of a run; the worst is the least
    foothold_edge_p05_m: Figure  # 5th percentile of a run; the worst is the least
    stops: Figure  # stops for planning per run
    generated: Figure  # nodes of a section, Masri's n_g
    expanded: Figure  # expanded nodes, Masri's n_e
    planning_p50_ms: float  # over all sections; failed searches count with their full time
    planning_p99_ms: float
    expansions_per_s: float  # of all sections together
    passable: int  # grounds that have a way, where the seed decides
    crossed: int  # runs on passable grounds that reached the goal
    impassable: int
    entered_in_vain: int  # runs on impassable grounds that stepped on a pillar
    undecided: int  # grounds that the search cannot decide, if it decides others


@dataclass(frozen=True, slots=True)
class Trials:
    """Results of a batch."""

    scenario: str
    robot: str
    gait: str
    blind: bool
    seeds: tuple[int, ...]
    success: Rate
    refusals: int  # successful runs in which the robot stopped and gave the reason
    collisions: int  # runs with a collision
    falls: int
    runs_with_shutdown: int
    mean_speed_mps: float  # of the successful runs
    block_touchdowns: Figure  # of a run, on raised blocks; the worst is the fewest
    missteps: Figure  # of a run, touchdowns off the true footholds
    all_missteps: int  # of all runs
    all_steps: int  # of all runs, each of a group of legs: with the tripod gait three touchdowns
    tilt_p95_deg: Figure  # against the commanded attitude
    commanded_tilt_p95_deg: Figure
    height_error_m: Figure  # absolute mean of a run
    height_rms_m: Figure
    slip_p50_m: Figure  # per step
    stability_margin_m: Figure  # least of a run; the worst is the least
    torque_rms_nm: Figure  # of the worst joint
    height_oscillation_m: Figure
    final_pose_error: Figure  # [1] share of the distance
    map_rmse_m: Figure  # of the whole course; see `sextant.evaluation.report.CourseMap`
    map_off_edges_m: Figure
    map_bias_m: Figure  # absolute value
    map_edge_m: Figure
    map_coverage: Figure  # [1] the worst is the least
    real_time_factor: Figure  # while other jobs run
    failures: dict[str, int]  # reason without its numbers -> runs, most frequent first
    failed_seeds: tuple[int, ...]
    made: Made
    params: str = ""  # plug-ins, and parameters that differ from their defaults, as text
    passages: Passages | None = None  # None if no run planned to cross a gap, or had one to cross
    with_warnings: int | None = None  # runs in which the robot warned about itself; None if a run does not record it
    warnings: dict[str, int] = field(default_factory=dict)  # warning without its numbers -> runs, most frequent first


def compare(seeing: Trials, blind: Trials) -> Difference:
    """Return the difference of the success rates with and without a map."""
    return difference(seeing.success, blind.success)


def summarise(runs: Sequence[Run]) -> Trials:
    """Summarise at least one run.

    All runs have the same scenario, robot, gait and parameters, and are all sighted or all blind.
    """
    good = [run for run in runs if run.success]
    failures = Counter(reports.without_figures(run.reason) for run in runs if not run.success)
    warnings = Counter(kind for run in runs for kind in {_kind_of(one.words) for one in run.warnings or ()})
    first = runs[0]
    return Trials(
        scenario=first.scenario,
        robot=first.robot,
        gait=first.gait,
        blind=first.blind,
        seeds=tuple(run.seed for run in runs),
        success=wilson(len(good), len(runs)),
        refusals=sum(run.reason != reports.ARRIVED for run in good),
        collisions=sum(run.collisions > 0 for run in runs),
        falls=sum(run.falls > 0 for run in runs),
        runs_with_shutdown=sum(run.shutdowns > 0 for run in runs),
        mean_speed_mps=_over(np.mean, [run.speed_mps for run in good]),
        block_touchdowns=_figure([run.raised_block_touchdowns for run in runs], min),
        missteps=_figure([run.missteps for run in runs]),
        all_missteps=sum(run.missteps for run in runs),
        all_steps=sum(run.steps for run in runs),
        tilt_p95_deg=_figure([run.tilt_p95_deg for run in runs]),
        commanded_tilt_p95_deg=_figure([run.commanded_tilt_p95_deg for run in runs]),
        height_error_m=_figure([abs(run.height_mean_m) for run in runs]),
        height_rms_m=_figure([run.height_rms_m for run in runs]),
        slip_p50_m=_figure([run.slip_p50_m for run in runs]),
        stability_margin_m=_figure([run.stability_margin_m for run in runs], min),
        torque_rms_nm=_figure([run.torque_rms_nm for run in runs]),
        height_oscillation_m=_figure([run.height_oscillation_m for run in runs]),
        final_pose_error=_figure([_share(run.final_pose_error_m, run.distance_m) for run in runs]),
        map_rmse_m=_figure([run.map_rmse_m for run in runs]),
        map_off_edges_m=_figure([run.map_off_edges_m for run in runs]),
        map_bias_m=_figure([abs(run.map_bias_m) for run in runs]),
        map_edge_m=_figure([run.map_edge_m for run in runs]),
        map_coverage=_figure([run.map_coverage for run in runs], min),
        real_time_factor=_figure([run.real_time_factor for run in runs], min),
        failures=_most_frequent_first(failures),
        failed_seeds=tuple(run.seed for run in runs if not run.success),
        made=Made.of([(run.commit, run.time) for run in runs]),
        params=first.params,
        passages=_passages(runs),
        with_warnings=None if any(run.warnings is None for run in runs) else sum(bool(run.warnings) for run in runs),
        warnings=_most_frequent_first(warnings),
    )


def _kind_of(warning: str) -> str:
    """Return a warning without its numbers, and without the feet that slip."""
    return reports.without_figures("slipping" if warning.startswith("slipping: ") else warning)


def _most_frequent_first(counts: Mapping[str, int]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _passages(runs: Sequence[Run]) -> Passages | None:
    passages = [run.passage for run in runs]
    sections = [section for passage in passages for section in passage.sections]
    looked = any(passage.passable is not None for passage in passages)
    if not sections and not looked:
        return None
    times = [section.planning_ms for section in sections]
    seconds = sum(times) / 1e3
    return Passages(
        feet_off=sum(passage.feet_off for passage in passages),
        pillar_touchdowns=sum(passage.pillar_touchdowns for passage in passages),
        foothold_edge_m=_figure([passage.foothold_edge_m.median for passage in passages], min),
        foothold_edge_p05_m=_figure([passage.foothold_edge_m.p05 for passage in passages], min),
        stops=_figure([float(len(passage.sections)) for passage in passages]),
        generated=_figure([float(section.generated) for section in sections]),
        expanded=_figure([float(section.expanded) for section in sections]),
        planning_p50_ms=_over(np.median, times),
        planning_p99_ms=_over(lambda known: np.percentile(known, 99), times),
        expansions_per_s=sum(section.expanded for section in sections) / seconds if seconds > 0 else float("nan"),
        passable=sum(passage.passable is True for passage in passages),
        crossed=sum(run.success and run.passage.passable is True for run in runs),
        impassable=sum(passage.passable is False for passage in passages),
        entered_in_vain=sum(passage.passable is False and passage.pillar_touchdowns > 0 for passage in passages),
        undecided=sum(passage.passable is None for passage in passages) if looked else 0,
    )


def to_json(trials: Trials, baseline: Trials | None = None) -> str:
    """Format a batch as JSON, with its blind baseline and their difference if given."""
    table: dict[str, Any] = reports.plain(trials)
    if baseline is not None:
        table |= {"baseline": reports.plain(baseline), "compared": reports.plain(compare(trials, baseline))}
    return json.dumps(table, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def words(trials: Trials, baseline: Trials | None = None) -> str:
    """Format a batch as a few lines of text."""
    lines = [_rate_words(trials)]
    lines.append(
        f"  mean speed {_speed(trials.mean_speed_mps)}, falls {trials.falls}, collisions {trials.collisions}, "
        f"with a servo shut down {trials.runs_with_shutdown}, missteps {trials.all_missteps} in {trials.all_steps} steps"
    )
    figures = (
        ("touchdowns on blocks", trials.block_touchdowns, 1.0, ".0f", ""),
        ("missteps", trials.missteps, 1.0, ".0f", ""),
        ("tilt p95 off the command", trials.tilt_p95_deg, 1.0, ".2f", " deg"),
        ("commanded tilt p95", trials.commanded_tilt_p95_deg, 1.0, ".2f", " deg"),
        ("height error", trials.height_error_m, 1e3, ".1f", " mm"),
        ("height error, rms", trials.height_rms_m, 1e3, ".1f", " mm"),
        ("slip per step p50", trials.slip_p50_m, 1e3, ".1f", " mm"),
        ("least stability margin", trials.stability_margin_m, 1e3, ".0f", " mm"),
        ("torque rms of the worst joint", trials.torque_rms_nm, 1.0, ".2f", " N m"),
        ("range of the body's height", trials.height_oscillation_m, 1e3, ".1f", " mm"),
        ("pose error at the end", trials.final_pose_error, 1e2, ".2f", " % of the way"),
        ("map of the course, rmse", trials.map_rmse_m, 1e3, ".1f", " mm"),
        ("map off edges, rmse", trials.map_off_edges_m, 1e3, ".1f", " mm"),
        ("map bias", trials.map_bias_m, 1e3, ".1f", " mm"),
        ("map edges", trials.map_edge_m, 1e3, ".1f", " mm"),
        ("ground in view known", trials.map_coverage, 1e2, ".1f", " %"),
        ("speed of simulation", trials.real_time_factor, 1.0, ".1f", " x real time"),
    )
    lines.append("  median (worst) of a run:")
    for name, figure, unit, form, of in figures:
        if np.isfinite(figure.median):
            lines.append(f"    {name} {in_words(figure, unit, form)}{of}")
    lines += _passage_words(trials.passages) if trials.passages is not None else []
    lines += [f"  {count:3d} x {reason}" for reason, count in trials.failures.items()]
    if trials.failed_seeds:
        lines.append(f"  failed seeds: {', '.join(map(str, trials.failed_seeds))}")
    lines += [f"  {count:3d} x warning: {words}" for words, count in list(trials.warnings.items())[:_LISTED]]
    if len(trials.warnings) > _LISTED:
        lines.append(f"  and {len(trials.warnings) - _LISTED} rarer warnings")
    lines.append(f"  made {trials.made.words}")
    if baseline is not None:
        d = compare(trials, baseline)
        lines += words(baseline).splitlines()
        lines.append(
            f"difference {100 * d.difference:+.0f} points ({100 * d.low:+.0f} to {100 * d.high:+.0f}), 95 % intervals "
            + ("disjoint" if d.disjoint else "overlap")
        )
    return "\n".join(lines)


def _passage_words(p: Passages) -> list[str]:
    edge = f"{in_words(p.foothold_edge_m, 1e3, '.0f')} mm, p05 {in_words(p.foothold_edge_p05_m, 1e3, '.0f')} mm"
    lines = [
        f"  feet off a pillar {p.feet_off}, touchdowns on pillars {p.pillar_touchdowns}; from the nearest edge {edge}",
        f"  planned {in_words(p.stops, 1.0, '.0f')} times; of a section n_g {in_words(p.generated, 1.0, '.0f')}, "
        f"n_e {in_words(p.expanded, 1.0, '.0f')}, p50 {p.planning_p50_ms:.1f} ms, p99 {p.planning_p99_ms:.1f} ms, "
        f"{p.expansions_per_s:.0f} expansions/s",
    ]
    if p.passable + p.impassable:
        lines.append(
            f"  passable {p.passable}, of which crossed {p.crossed}; impassable {p.impassable}, "
            f"of which entered {p.entered_in_vain}; undecided {p.undecided}"
        )
    return lines


def in_words(figure: Figure, unit: float, form: str) -> str:
    """Format a figure as `median (worst)` in a unit; a dash if nothing was measured."""
    if not np.isfinite(figure.median):
        return "-"
    worst = f" ({unit * figure.worst:{form}})" if np.isfinite(figure.worst) else ""
    return f"{unit * figure.median:{form}}{worst}"


def _rate_words(trials: Trials) -> str:
    r = trials.success
    what = ", ".join([trials.scenario, *(["blind"] * trials.blind), *([trials.params] if trials.params else [])])
    interval = f"95 %: {100 * r.low:.0f} to {100 * r.high:.0f} %"
    did = "rightly refused" if trials.refusals else "reached the goal"
    return f"{what}: {r.successes} of {r.n} {did}, {100 * r.rate:.0f} % ({interval})"


def _figure(values: Sequence[float], worst: Callable[[list[float]], float] = max) -> Figure:
    return Figure(_over(np.median, values), _over(worst, values))


def _share(error: float, way: float) -> float:
    return error / abs(way) if way else float("nan")


def _over(reduce: Callable[[list[float]], Any], values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(reduce(known)) if known else float("nan")


def _speed(speed_mps: float) -> str:
    """Format a speed as text; a dash without a successful run."""
    return f"{100 * speed_mps:.1f} cm/s" if math.isfinite(speed_mps) else "-"
