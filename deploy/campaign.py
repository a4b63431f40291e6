"""The same trials on every terrain that can be walked: the public table of how often it works."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy import trials as batches
from deploy.report import Report
from deploy.statistics import Rate, wilson
from deploy.trials import Run, Trials, in_words
from shared.config import ConfigError
from shared.scenario import HeightMap, Scenario, load_scenario

WALKED = ("flat", "slope", "stairs", "cobbles", "steps", "rubble", "stepping_stones", "ditch", "mixed", "stair_map")
_COLUMNS = (
    "terrain",
    "goal reached",
    "falls",
    "shut down",
    "cm/s",
    "missteps of steps, %",
    "tilt p95, deg",
    "height rms, mm",
    "slip p50, mm",
    "least margin, mm",
    "torque rms, N m",
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One terrain's trials, beside its blind baseline where that was run."""

    seeing: Trials
    blind: Trials | None = None


@dataclass(frozen=True, slots=True)
class Campaign:
    """The trials of many terrains, and what had to be left out."""

    entries: tuple[Entry, ...]
    left_out: tuple[str, ...]  # why, in words


@dataclass(frozen=True, slots=True)
class _Leaving:
    """Runs a seed in lockstep; one of them leaves its folder behind, pictures and all."""

    seed: int
    out: Path

    def __call__(self, scenario: Scenario, seed: int) -> Report:
        from deploy.lockstep_run import run_lockstep  # brings in every service

        return run_lockstep(scenario, seed, self.out if seed == self.seed else None)


def run_campaign(
    names: Sequence[str],
    seeds: Iterable[int],
    jobs: int,
    out: Path,
    blind: bool = False,
    asked: Callable[[Scenario], Scenario] = lambda scenario: scenario,
    say: Callable[[str], None] = lambda _: None,
    run: Run | None = None,
) -> Campaign:
    """Run the trials of every terrain in turn, going on where an earlier campaign in the same folder stopped.

    Args:
        names: Of the scenarios.
        seeds: Of each terrain's runs.
        jobs: How many at a time.
        out: Folder; each terrain has one of its own in it, the first seed's run with its pictures inside.
        blind: Run the baseline without a map, too.
        asked: Makes of a scenario what is walked in its place: by another robot, in another gait.
        say: Hears a line per seed.
        run: What runs one seed, in lockstep by default.
    """
    wanted = sorted(set(seeds))
    entries, left_out = [], []
    for name in names:
        scenario = asked(load_scenario(name))
        lacking = _lacking(scenario)
        if lacking:
            left_out.append(f"{name}: {lacking}")
            say(f"{name} is left out: {lacking}")
            continue
        folder = out / name
        say(f"{name}, {len(wanted)} seeds")
        runner = run or _Leaving(wanted[0], folder / f"seed-{wanted[0]}")
        seeing = batches.run_trials(scenario, wanted, jobs, folder, say=say, run=runner)
        baseline = None
        if blind:
            say(f"{name} without a map")
            runner = run or _Leaving(wanted[0], folder / f"seed-{wanted[0]}-blind")
            baseline = batches.run_trials(scenario, wanted, jobs, folder, blind=True, say=say, run=runner)
        (folder / "trials.json").write_text(batches.to_json(seeing, baseline), encoding="utf-8")
        entries.append(Entry(seeing, baseline))
        write(Campaign(tuple(entries), tuple(left_out)), out)
    return Campaign(tuple(entries), tuple(left_out))


def markdown(campaign: Campaign) -> str:
    """The campaign as one Markdown table, a row per terrain with its blind baseline below; median (worst) of the runs."""
    lines = [f"| {' | '.join(_COLUMNS)} |", "|---" * len(_COLUMNS) + "|"]
    for entry in campaign.entries:
        lines.append(_row(f"`{entry.seeing.scenario}`", entry.seeing))
        if entry.blind is not None:
            lines.append(_row(f"`{entry.blind.scenario}`, blind", entry.blind))
    seeing = [entry.seeing for entry in campaign.entries]
    together = wilson(sum(t.success.successes for t in seeing), sum(t.success.n for t in seeing))
    lines += ["", f"Together {_rate(together)} reached the goal. Median (worst) of the runs; missteps of all steps."]
    lines += [f"Made {words}." for words in sorted({t.made.words for t in seeing})]
    lines += [f"Left out: {words}." for words in campaign.left_out]
    return "\n".join(lines) + "\n"


def to_json(campaign: Campaign) -> str:
    """The campaign as JSON text: a table of trials per terrain, and what was left out."""
    terrains: dict[str, Any] = {e.seeing.scenario: json.loads(batches.to_json(e.seeing, e.blind)) for e in campaign.entries}
    return json.dumps({"terrains": terrains, "left_out": campaign.left_out}, indent=1, ensure_ascii=False) + "\n"


def write(campaign: Campaign, out: Path) -> None:
    """Write table.md and campaign.json."""
    (out / "table.md").write_text(markdown(campaign), encoding="utf-8")
    (out / "campaign.json").write_text(to_json(campaign), encoding="utf-8")


def _lacking(scenario: Scenario) -> str:
    """What of a scenario's files is not there, in words, or nothing."""
    for part in scenario.terrain:
        if isinstance(part, HeightMap):
            try:
                path = part.path(Path(scenario.folder))
            except ConfigError as error:
                return str(error)
            if not path.is_file():
                return f"no such file: {path}"
    return ""


def _row(name: str, t: Trials) -> str:
    cells = (
        name,
        _rate(t.success),
        str(t.falls),
        str(t.runs_with_shutdown),
        f"{100 * t.mean_speed_mps:.1f}" if t.success.successes else "-",
        f"{100 * t.missteps_per_step:.2f}",
        in_words(t.tilt_p95_deg, 1.0, ".2f"),
        in_words(t.height_rms_m, 1e3, ".1f"),
        in_words(t.slip_p50_m, 1e3, ".1f"),
        in_words(t.stability_margin_m, 1e3, ".0f"),
        in_words(t.torque_rms_nm, 1.0, ".2f"),
    )
    return f"| {' | '.join(cells)} |"


def _rate(rate: Rate) -> str:
    return f"{rate.successes} of {rate.n} ({100 * rate.low:.0f} to {100 * rate.high:.0f} %)"
