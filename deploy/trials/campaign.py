"""The same trials on every terrain that can be walked, one after the other."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from sextant.deploy.judging.report import Report
from sextant.deploy.trials import batch as batches
from sextant.deploy.trials.batch import Runner
from sextant.deploy.trials.campaign_table import Campaign, Entry, write
from sextant.shared.files import whole_files
from sextant.shared.files.config import ConfigError
from sextant.shared.scenario.scenario import HeightMap, Scenario, load_scenario


@dataclass(frozen=True, slots=True)
class _Leaving:
    """Runs a seed in lockstep; one of them leaves its folder behind, pictures and all."""

    seed: int
    out: Path

    def __call__(self, scenario: Scenario, seed: int) -> Report:
        from sextant.deploy.runs.lockstep_run import run_lockstep  # brings in every service

        return run_lockstep(scenario, seed, self.out if seed == self.seed else None)


def run_campaign(
    names: Iterable[str],
    seeds: Iterable[int],
    jobs: int,
    out: Path,
    blind: bool = False,
    asked: Callable[[Scenario], Scenario] = lambda scenario: scenario,
    say: Callable[[str], None] = lambda _: None,
    run: Runner | None = None,
    table: str = "walks",
) -> Campaign:
    """Run the trials of every terrain in turn, going on where an earlier campaign in the same folder stopped.

    Args:
        names: Of the scenarios.
        seeds: Of each terrain's runs.
        jobs: How many at a time.
        out: Folder; each terrain has one of its own in it, the first seed's run with its pictures inside. Every run
            has a line in its `campaign.jsonl`; those that have one already, from here or elsewhere, are not run again.
        blind: Run the baseline without a map, too.
        asked: Makes of a scenario what is walked in its place: by another robot, in another gait.
        say: Hears a line per seed.
        run: What runs one seed, in lockstep by default.
        table: Which table of them is written, of `sextant.deploy.trials.campaign_table.TABLES`.
    """
    wanted, keep_in = sorted(set(seeds)), out / "campaign.jsonl"
    whole_files.make_folder(out)
    entries: list[Entry] = []
    left_out: list[str] = []
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
        seeing = batches.run_trials(scenario, wanted, jobs, folder, say=say, run=runner, keep_in=keep_in)
        baseline = None
        if blind:
            say(f"{name} without a map")
            runner = run or _Leaving(wanted[0], folder / f"seed-{wanted[0]}-blind")
            baseline = batches.run_trials(scenario, wanted, jobs, folder, blind=True, say=say, run=runner, keep_in=keep_in)
        entries.append(Entry(seeing, baseline))
        with whole_files.reported(say):
            whole_files.write_text(folder / "trials.json", batches.to_json(seeing, baseline), durable=True)
            write(Campaign(tuple(entries), tuple(left_out)), out, table)
    return Campaign(tuple(entries), tuple(left_out))


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
