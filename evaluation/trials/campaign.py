"""Campaign: the same trials on several terrains, in turn."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from sextant.evaluation.report import Report
from sextant.evaluation.trials.campaign_table import Campaign, Entry, write
from sextant.evaluation.trials.cluster import Cluster
from sextant.evaluation.trials.summary import Trials, to_json
from sextant.evaluation.trials.trials import Batch, Runner, run_batches
from sextant.shared.files import whole_files
from sextant.shared.files.config import ConfigError
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Scenario
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
    ways = (False, True) if blind else (False,)  # without a map
    folders: list[Path] = []
    batches: list[Batch] = []
    left_out: list[str] = []
    for name in names:
        scenario = asked(load_scenario(name))
        lacking = _lacking(scenario)
        if lacking:
            left_out.append(f"{name}: {lacking}")
            say(f"{name} is skipped: {lacking}")
            continue
        folders.append(out / name)
        for way in ways:
            pictures = _Leaving(wanted[0], folders[-1] / f"seed-{wanted[0]}{'-blind' * way}")
            runner = run or (pictures if cluster is None or cluster.local else None)
            batches.append(Batch(scenario, wanted, folders[-1], way, say, runner, keep_in))
    entries: list[Entry] = []
    found: list[Trials] = []
    for batch in run_batches(batches, jobs, cluster):
        found.append(batch.trials())
        if len(found) < len(ways):
            continue
        seeing, baseline = found[0], found[1] if blind else None
        with whole_files.reported(say):
            whole_files.write_text(folders[len(entries)] / "trials.json", to_json(seeing, baseline), durable=True)
            write(Campaign((*entries, Entry(seeing, baseline)), tuple(left_out)), out, table)
        entries.append(Entry(seeing, baseline))
        found.clear()
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
