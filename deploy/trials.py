"""Many runs of one scenario, a seed each: how often it succeeds, and how sure that is.

Every finished seed is a line of JSON in `trials.jsonl`, so a batch that was stopped goes on where it was. Lines of another
scenario, or of the same one changed since, or of another version of the program, are not counted.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from deploy import provenance
from deploy import report as reports
from deploy.provenance import Made
from deploy.report import Report
from deploy.statistics import Difference, Rate, difference, wilson
from deploy.workers import share_out
from shared import config
from shared.scenario import HeightMap, Scenario

_PACKAGES = ("shared", "services", "deploy")
Run = Callable[[Scenario, int], Report]


@dataclass(frozen=True, slots=True)
class Figure:
    """One quantity over the runs that measured it, NaN where none did."""

    median: float
    worst: float


@dataclass(frozen=True, slots=True)
class Trials:
    """What a batch came to."""

    scenario: str
    blind: bool
    success: Rate
    refusals: int  # runs that are a success because the robot stood and said why
    collisions: int  # runs in which it walked into something
    falls: int
    runs_with_shutdown: int
    mean_speed_mps: float  # of the successful runs
    block_touchdowns: Figure  # of a run, on raised blocks; the worst is the fewest
    missteps: Figure  # of a run, touchdowns on what is truly no foothold
    missteps_per_step: float  # [1] of all runs together
    tilt_p95_deg: Figure  # against the commanded attitude
    commanded_tilt_p95_deg: Figure
    height_error_m: Figure  # mean of a run, its size
    height_rms_m: Figure
    slip_p50_m: Figure  # per step
    stability_margin_m: Figure  # least of a run; the worst is the least
    torque_rms_nm: Figure  # of the worst joint
    height_oscillation_m: Figure
    final_pose_error: Figure  # [1] share of the way
    map_rmse_m: Figure  # of the whole course; see `deploy.report.CourseMap`
    map_off_edges_m: Figure
    map_bias_m: Figure  # its size
    map_edge_m: Figure
    map_coverage: Figure  # [1] the worst is the least
    real_time_factor: Figure  # with other jobs beside it
    failures: dict[str, int]  # reason without its figures -> runs, most frequent first
    failed_seeds: tuple[int, ...]
    made: Made


def run_trials(
    scenario: Scenario,
    seeds: Iterable[int],
    jobs: int,
    out: Path,
    blind: bool = False,
    say: Callable[[str], None] = lambda _: None,
    run: Run | None = None,
) -> Trials:
    """Run every seed that has not been run yet, each in lockstep.

    Args:
        scenario: The course and the way to walk it.
        seeds: Of the runs; each counts once.
        jobs: How many at a time, each in a process of its own; 1 runs them in this process.
        out: Folder for `trials.jsonl`.
        blind: Run the baseline without a map.
        say: Hears a line per seed.
        run: What runs one seed, `deploy.lockstep_run.run_lockstep` by default.

    Raises:
        ValueError: No seeds, no jobs, or a line of `trials.jsonl` that is none.
    """
    wanted = sorted(set(seeds))
    if not wanted or jobs < 1:
        raise ValueError(f"at least one seed and one job expected, found {len(wanted)} seeds and {jobs} jobs")
    scenario = replace(scenario, walk=replace(scenario.walk, blind=scenario.walk.blind or blind))
    out.mkdir(parents=True, exist_ok=True)
    path = out / "trials.jsonl"
    mark = fingerprint(scenario)
    done = {seed: entry for seed, entry in _read(path, mark).items() if seed in set(wanted)}
    if done:
        say(f"{len(done)} of {len(wanted)} seeds are done already; see {path}")
    left = [seed for seed in wanted if seed not in done]
    successes = sum(entry["report"]["success"] for entry in done.values())
    made_by = provenance.commit()
    with path.open("a", encoding="utf-8") as lines:
        tasks = [(scenario, seed) for seed in left]
        for report in share_out(run or _run_lockstep, tasks, min(jobs, len(left)), in_order=False):
            table = reports.as_table(report)
            entry = {"fingerprint": mark, "commit": made_by, "time": provenance.now(), "report": table}
            lines.write(json.dumps(entry, ensure_ascii=False) + "\n")
            lines.flush()
            done[report.seed] = entry
            successes += report.success
            say(_line(report, len(done), len(wanted), successes))
    made = Made.of([(entry.get("commit", ""), entry.get("time", "")) for entry in done.values()])
    return summarise(scenario.name, scenario.walk.blind, [done[seed]["report"] for seed in wanted], made)


def compare(seeing: Trials, blind: Trials) -> Difference:
    """How much more often the robot gets there with a map than without."""
    return difference(seeing.success, blind.success)


def summarise(name: str, blind: bool, tables: list[dict[str, Any]], made: Made) -> Trials:
    """What a batch came to, from its reports as tables, and what made them."""
    good = [t for t in tables if t["success"]]
    failures = Counter(_without_figures(t["reason"]) for t in tables if not t["success"])
    return Trials(
        scenario=name,
        blind=blind,
        success=wilson(len(good), len(tables)),
        refusals=sum(t["reason"] != reports.ARRIVED for t in good),
        collisions=sum(t.get("collisions", 0) > 0 for t in tables),
        falls=sum(t["falls"] > 0 for t in tables),
        runs_with_shutdown=sum(t["shutdowns"] > 0 for t in tables),
        mean_speed_mps=_over(np.mean, [t["speed_mps"] for t in good]),
        block_touchdowns=_figure([t["raised_block_touchdowns"] for t in tables], min),
        missteps=_figure([t["missteps"] for t in tables]),
        missteps_per_step=sum(t["missteps"] for t in tables) / max(sum(t["steps"] for t in tables), 1),
        tilt_p95_deg=_figure([t["tilt_deg"]["p95"] for t in tables]),
        commanded_tilt_p95_deg=_figure([t["commanded_tilt_deg"]["p95"] for t in tables]),
        height_error_m=_figure([_size(t["body_height_error_m"]["mean"]) for t in tables]),
        height_rms_m=_figure([t["body_height_error_m"]["rms"] for t in tables]),
        slip_p50_m=_figure([t["slip_m_per_step"]["p50"] for t in tables]),
        stability_margin_m=_figure([t["min_stability_margin_m"] for t in tables], min),
        torque_rms_nm=_figure([t["torque_nm"]["rms_worst_joint"] for t in tables]),
        height_oscillation_m=_figure([t["body_height_oscillation_m"] for t in tables]),
        final_pose_error=_figure([_share(t["pose_error_m"]["final"], t["distance_m"]) for t in tables]),
        map_rmse_m=_figure([t["course_map_m"]["rmse"] for t in tables]),
        map_off_edges_m=_figure([t["course_map_m"]["off_edges"] for t in tables]),
        map_bias_m=_figure([_size(t["course_map_m"]["bias"]) for t in tables]),
        map_edge_m=_figure([t["course_map_m"]["edge"] for t in tables]),
        map_coverage=_figure([t["course_map_m"]["coverage"] for t in tables], min),
        real_time_factor=_figure([t["real_time_factor"] for t in tables], min),
        failures=dict(sorted(failures.items(), key=lambda item: (-item[1], item[0]))),
        failed_seeds=tuple(t["seed"] for t in tables if not t["success"]),
        made=made,
    )


def to_json(trials: Trials, baseline: Trials | None = None) -> str:
    """A batch as JSON text, beside its blind baseline and the difference of the two when there is one."""
    table: dict[str, Any] = _plain(asdict(trials))
    if baseline is not None:
        table |= {"baseline": _plain(asdict(baseline)), "compared": _plain(asdict(compare(trials, baseline)))}
    return json.dumps(table, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def words(trials: Trials, baseline: Trials | None = None) -> str:
    """A batch in a few lines for people."""
    lines = [_rate_words(trials)]
    lines.append(
        f"  mean speed {_speed(trials.mean_speed_mps)}, falls {trials.falls}, walked into something {trials.collisions}, "
        f"with a servo shut down {trials.runs_with_shutdown}"
    )
    figures = (
        ("touchdowns on blocks", trials.block_touchdowns, 1.0, ".0f", ""),
        ("missteps", trials.missteps, 1.0, ".0f", ""),
        ("missteps of all steps", Figure(trials.missteps_per_step, float("nan")), 1e2, ".2f", " %"),
        ("tilt p95 off the command", trials.tilt_p95_deg, 1.0, ".2f", " deg"),
        ("commanded tilt p95", trials.commanded_tilt_p95_deg, 1.0, ".2f", " deg"),
        ("height error", trials.height_error_m, 1e3, ".1f", " mm"),
        ("height error, rms", trials.height_rms_m, 1e3, ".1f", " mm"),
        ("slip per step p50", trials.slip_p50_m, 1e3, ".1f", " mm"),
        ("least stability margin", trials.stability_margin_m, 1e3, ".0f", " mm"),
        ("torque rms of the worst joint", trials.torque_rms_nm, 1.0, ".2f", " N m"),
        ("height oscillation", trials.height_oscillation_m, 1e3, ".1f", " mm"),
        ("pose error at the end", trials.final_pose_error, 1e2, ".2f", " % of the way"),
        ("map of the course, rmse", trials.map_rmse_m, 1e3, ".1f", " mm"),
        ("map off edges, rmse", trials.map_off_edges_m, 1e3, ".1f", " mm"),
        ("map bias", trials.map_bias_m, 1e3, ".1f", " mm"),
        ("map edges", trials.map_edge_m, 1e3, ".1f", " mm"),
        ("ground in view known", trials.map_coverage, 1e2, ".1f", " %"),
        ("speed of computing", trials.real_time_factor, 1.0, ".1f", " x real time"),
    )
    lines.append("  median (worst) of a run:")
    for name, figure, unit, form, of in figures:
        if np.isfinite(figure.median):
            lines.append(f"    {name} {in_words(figure, unit, form)}{of}")
    lines += [f"  {count:3d} x {reason}" for reason, count in trials.failures.items()]
    if trials.failed_seeds:
        lines.append(f"  failed seeds: {', '.join(map(str, trials.failed_seeds))}")
    lines.append(f"  made {trials.made.words}")
    if baseline is not None:
        d = compare(trials, baseline)
        lines += words(baseline).splitlines()
        lines.append(
            f"difference {100 * d.difference:+.0f} points ({100 * d.low:+.0f} to {100 * d.high:+.0f}), 95 % intervals "
            + ("disjoint" if d.disjoint else "overlap")
        )
    return "\n".join(lines)


def in_words(figure: Figure, unit: float, form: str) -> str:
    """A figure as `median (worst)` in a unit, a dash where nothing was measured."""
    if not np.isfinite(figure.median):
        return "-"
    worst = f" ({unit * figure.worst:{form}})" if np.isfinite(figure.worst) else ""
    return f"{unit * figure.median:{form}}{worst}"


def fingerprint(scenario: Scenario) -> str:
    """Changes with whatever decides about a run but its seed: the scenario, the files that it names, and the program."""
    table = config.as_table(replace(scenario, folder="."))
    digest = hashlib.blake2s(json.dumps(table, sort_keys=True).encode() + _program(), digest_size=6)
    named = [part.path(Path(scenario.folder)) for part in scenario.terrain if isinstance(part, HeightMap)]
    for path in [*named, Path(scenario.robot)]:
        if path.is_file():
            digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def _program() -> bytes:
    """A digest of Sextant's code, profiles and scenarios."""
    digest = hashlib.blake2s()
    root = Path(__file__).parent.parent
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes())
    return digest.digest()


def _run_lockstep(scenario: Scenario, seed: int) -> Report:
    from deploy.lockstep_run import run_lockstep  # brings in every service

    return run_lockstep(scenario, seed)


def _read(path: Path, mark: str) -> dict[int, dict[str, Any]]:
    """Entries on file of one scenario, by seed: its report and what made it. A last line that was cut off counts as not run."""
    if not path.exists():
        return {}
    data = path.read_bytes()
    if data and not data.endswith(b"\n"):
        data = data[: data.rfind(b"\n") + 1]
        path.write_bytes(data)
    found: dict[int, dict[str, Any]] = {}
    for number, line in enumerate(data.split(b"\n")[:-1], 1):
        try:
            entry = json.loads(line)
        except ValueError:  # no text, or no JSON
            entry = None
        ours = isinstance(entry, dict) and entry.get("fingerprint") == mark
        if not isinstance(entry, dict) or "report" not in entry or (ours and reports.check(entry["report"])):
            raise ValueError(f"{path}, line {number}: a finished seed as JSON expected, found {line[:60]!r}; remove the line")
        if ours:
            found[entry["report"]["seed"]] = entry
    return found


def _line(report: Report, done: int, wanted: int, successes: int) -> str:
    arrived = report.success and report.reason == reports.ARRIVED
    verdict = "goal" if arrived else "good" if report.success else "FAIL"
    tail = f"{report.duration_s:5.1f} s  {100 * report.speed_mps:4.1f} cm/s" if arrived else report.reason
    return f"[{done:3d}/{wanted}] seed {report.seed:3d}  {verdict}  {tail}  ({successes} of {done})"


def _rate_words(trials: Trials) -> str:
    r = trials.success
    what = f"{trials.scenario}, blind" if trials.blind else trials.scenario
    interval = f"95 %: {100 * r.low:.0f} to {100 * r.high:.0f} %"
    did = "rightly refused" if trials.refusals else "reached the goal"
    return f"{what}: {r.successes} of {r.n} {did}, {100 * r.rate:.0f} % ({interval})"


def _without_figures(reason: str) -> str:
    """A reason with its numbers taken out, so that alike ones count together."""
    out = "".join("#" if c.isdigit() else c for c in reason)
    while "##" in out or "#.#" in out:
        out = out.replace("#.#", "#").replace("##", "#")
    return out


def _figure(values: list[float | None], worst: Callable[[list[float]], float] = max) -> Figure:
    return Figure(_over(np.median, values), _over(worst, values))


def _size(value: float | None) -> float | None:
    return None if value is None else abs(value)


def _share(error: float | None, way: float | None) -> float | None:
    return None if error is None or not way else error / abs(way)


def _over(reduce: Callable[[list[float]], Any], values: list[float | None]) -> float:
    known = [v for v in values if v is not None]
    return float(reduce(known)) if known else float("nan")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, float):
        return round(value, 6) + 0.0 if np.isfinite(value) else None
    return list(value) if isinstance(value, tuple) else value


def _speed(speed_mps: float) -> str:
    """A speed in words; without a successful run there is none."""
    return f"{100 * speed_mps:.1f} cm/s" if math.isfinite(speed_mps) else "-"
