"""Campaign: the same trials on several terrains, one after the other."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from sextant.evaluation.report import Report
from sextant.evaluation.trials import trials as batches
from sextant.evaluation.trials.campaign_table import Campaign, Entry, write
from sextant.evaluation.trials.cluster import Cluster
from sextant.evaluation.trials.trials import Runner
from sextant.shared.files import whole_files
from sextant.shared.files.config import ConfigError
from sextant.shared.scenario.scenario import Scenario, load_scenario
from sextant.shared.scenario.terrain import HeightMap


@dataclass(frozen=True, slots=True)
class _Leaving:
    """Runs a seed in lockstep; the run of `seed` also writes its folder with pictures."""

    seed: int
    out: Path

    def __call__(self, scenario: Scenario, seed: int) -> Report:
        from sextant.evaluation.lockstep.lockstep_run import run_lockstep  # imports every service

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
    cluster: Cluster | None = None,
) -> Campaign:
    """Run the trials of every terrain in turn, continuing an earlier campaign.

    Args:
        names: Names of the scenarios.
        seeds: Seeds of each terrain's runs.
        jobs: Number of parallel processes.
        out: Folder with a folder per terrain, in which the run of the first seed leaves its pictures. Every run has a line in
            its `campaign.jsonl`; runs that are there already, from here or elsewhere, are not repeated.
        blind: Also run the baseline without a map.
        asked: Returns the scenario to run for a scenario, for example with another robot or gait.
        say: Receives a line per seed.
        run: Function that runs one seed, in lockstep by default.
        table: Name of the table to write, of `sextant.evaluation.trials.campaign_table.TABLES`.
        cluster: Run on its workers instead of `jobs` processes. Those of other machines leave no pictures.
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
            say(f"{name} is skipped: {lacking}")
            continue
        folder = out / name

        def trials_of(blind: bool, end: str, scenario: Scenario = scenario, folder: Path = folder) -> batches.Trials:
            pictures = _Leaving(wanted[0], folder / f"seed-{wanted[0]}{end}") if cluster is None or cluster.local else None
            runner = run or pictures
            return batches.run_trials(scenario, wanted, jobs, folder, blind, say, runner, keep_in, cluster)

        seeing = trials_of(False, "")
        baseline = None
        if blind:
            say("now the same seeds without a map")
            baseline = trials_of(True, "-blind")
        entries.append(Entry(seeing, baseline))
        with whole_files.reported(say):
            whole_files.write_text(folder / "trials.json", batches.to_json(seeing, baseline), durable=True)
            write(Campaign(tuple(entries), tuple(left_out)), out, table)
    return Campaign(tuple(entries), tuple(left_out))


def _lacking(scenario: Scenario) -> str:
    """Return which file of a scenario is missing, as text, or an empty string."""
    for part in scenario.terrain:
        if isinstance(part, HeightMap):
            try:
                path = part.path(Path(scenario.folder))
            except ConfigError as error:
                return str(error)
            if not path.is_file():
                return f"no such file: {path}"
    return ""
