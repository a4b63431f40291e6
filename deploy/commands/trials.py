"""`sextant trials`: many seeds of one scenario or of all, and result tables."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sextant.deploy.commands import options
from sextant.deploy.commands.common import SUCCESS, InputError, open_progress, out_folder, say, say_if_it_compiles
from sextant.deploy.terminal.arguments import Choice, Parsed, argument, command, flag, option, options_of
from sextant.deploy.terminal.interrupts import explained_interrupts
from sextant.shared.files import whole_files

if TYPE_CHECKING:
    from sextant.evaluation.trials.cluster import Cluster

_GROUPS = ("all", "passages", "bridges", "troubles", "ways", "mild", "usual", "harsh")


@dataclass(frozen=True, slots=True)
class Place:
    """Workers, output folder and format of trials."""

    jobs: int
    cluster: str
    out: str | None
    as_json: bool

    def check(self) -> None:
        """Check the cluster's address, and that Dask is installed.

        Raises:
            InputError: It is no address, or jobs are given too.
        """
        if not self.cluster:
            return
        if self.jobs != 1:
            raise InputError("one of --jobs and --cluster expected, found both; local:N starts N workers")
        from sextant.evaluation.trials.cluster import checked_address

        try:
            checked_address(self.cluster)
        except ValueError as error:
            raise InputError(f"--cluster: {error}") from None
        import distributed  # noqa: F401 - its absence is reported before anything else happens

    @contextlib.contextmanager
    def workers(self, say: Callable[[str], None]) -> "Iterator[Cluster | None]":
        """Open the cluster, if an address is given.

        Raises:
            ClusterError: There is no such cluster.
        """
        if not self.cluster:
            yield None
            return
        from sextant.evaluation.trials.cluster import open_cluster

        with open_cluster(self.cluster, say) as cluster:
            yield cluster


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Whether trials find a difficulty curve, and at which values of the family's parameter."""

    curve: bool
    at: str

    def check(self) -> None:
        """Check that values are given only with a curve.

        Raises:
            InputError: They are not, or they are no values.
        """
        if self.at and not self.curve:
            raise InputError("--at: values for --curve expected, found none; add --curve")
        self.values()

    def values(self) -> tuple[float, ...]:
        """Return the values, none for those of the family.

        Raises:
            InputError: They are not numbers that rise or fall.
        """
        from sextant.shared.scenario.family import check_values

        if not self.at:
            return ()
        try:
            found = tuple(float(word) for word in self.at.split(","))
            check_values(found)
        except ValueError:
            raise InputError(f"--at: rising or falling numbers A,B,... expected, found {self.at[:60]!r}") from None
        return found


curve = options_of(
    Difficulty,
    "curve",
    flag("--curve", "find success over difficulty: SCENARIO is a family with one parameter, see docs/trials.md"),
    option(
        "--at", "values of the parameter of --curve, from easy to impossible (default: the family's)", "A,B,...", default=""
    ),
)
place = options_of(
    Place,
    "place",
    options.jobs,
    option(
        "--cluster",
        "Dask scheduler whose workers run the trials, e.g. tcp://10.0.0.1:8786; or local:N for N workers on this machine",
        "ADDRESS",
        default="",
    ),
    option("--out", "folder to write to; seeds stored there are not run again", "DIR"),
    options.as_json,
)


def _completed(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Return the groups, families and scenarios that a shell can complete a word to."""
    from sextant.shared.scenario.loading import family_names

    words = [word for word in (*_GROUPS, *family_names()) if word.startswith(incomplete)]
    return list(dict.fromkeys((*words, *options.scenarios(context, parameter, incomplete))))


@command()
@argument(
    "scenario",
    f"scenario name, FAMILY@VALUE or TOML file; or a group: {', '.join(_GROUPS)}",
    "SCENARIO",
    shell_complete=_completed,
)
@options.variant
@option(
    "--seeds",
    "seeds from A to B, B not included; or commit:N, N seeds derived from the hash of the commit, not chosen by hand",
    "A:B",
    type=Parsed(options.any_seeds, "seeds"),
    required=True,
)
@flag("--blind", "also run the baseline without a map, and compare")
@curve
@place
def trials(scenario: str, variant: options.Variant, seeds: Sequence[int], blind: bool, curve: Difficulty, place: Place) -> int:
    """Run a scenario in lockstep with many seeds: success rate with 95 % interval.

    `sextant trials table` prints tables of stored trials without running anything; see `sextant trials table --help`.
    """
    place.check()
    curve.check()
    if curve.curve and variant.scaled:
        raise InputError("--curve finds the lengths that a robot passes as they are; leave --scaled out")
    if curve.curve:
        return _curve(scenario, variant, seeds, blind, curve.values(), place)
    if scenario in _GROUPS:
        return _campaign(scenario, variant, seeds, blind, place)
    course = variant.load(scenario)
    folder = out_folder(place.out, f"trials-{course.name}")
    from sextant.evaluation.trials.summary import to_json, words
    from sextant.evaluation.trials.trials import run_trials

    hear = open_progress(place.as_json)
    say_if_it_compiles(hear)
    baseline = None
    with explained_interrupts(lambda: _kept(folder, "trials.jsonl")), place.workers(hear.say) as cluster:
        seeing = run_trials(course, seeds, place.jobs, folder, say=hear.say, cluster=cluster)
        if blind:
            hear.say("now the same seeds without a map")
            baseline = run_trials(course, seeds, place.jobs, folder, blind=True, say=hear.say, cluster=cluster)
    text = to_json(seeing, baseline)
    say(text.rstrip("\n") if place.as_json else words(seeing, baseline))
    whole_files.write_text(folder / "trials.json", text, durable=True)
    if not place.as_json:
        say(f"written to {folder}: trials.json, trials.jsonl")
    return SUCCESS


def _kept(folder: Path, name: str) -> str:
    """Return what interrupted trials have kept, and how to go on."""
    path = folder / name
    count = path.read_bytes().count(b"\n") if path.exists() else 0
    if not count:
        return f"no walk had ended, so {folder} has no result; run the command again"
    return f"{count} walks are kept in {path}; the same command with --out {folder} goes on with the seeds that are left"


def _curve(
    name: str, variant: options.Variant, seeds: Sequence[int], blind: bool, values: Sequence[float], place: Place
) -> int:
    """Find the difficulty curve of a family, and draw it."""
    from sextant.evaluation.trials import curve as curves
    from sextant.evaluation.trials.curve_picture import draw_curves
    from sextant.shared.scenario.loading import load_family

    family = load_family(name)
    folder = out_folder(place.out, f"curve-{family.name}")
    hear, found = open_progress(place.as_json).say, []
    say_if_it_compiles(open_progress(place.as_json))
    with explained_interrupts(lambda: _kept(folder, "campaign.jsonl")), place.workers(hear) as cluster:
        for without in (False, True)[: 1 + blind]:
            hear("the same without a map" if without else f"{family.name}: {family.family.about}")
            found.append(
                curves.run_curve(family, seeds, place.jobs, folder, values, without, variant.applied(), hear, cluster=cluster)
            )
    say(curves.to_json(found).rstrip("\n") if place.as_json else "\n\n".join(map(curves.words, found)))
    curves.write(found, folder)
    draw_curves(found, folder / "curve")
    if not place.as_json:
        say(f"written to {folder}: curve.json, curve.png, curve.svg, campaign.jsonl, and a folder per value")
    return SUCCESS


def _campaign(group: str, variant: options.Variant, seeds: Sequence[int], blind: bool, place: Place) -> int:
    """Run a group of scenarios, and print one table of all of them."""
    from sextant.evaluation.trials import campaign_table as tables
    from sextant.evaluation.trials import results_store
    from sextant.evaluation.trials.campaign import run_campaign
    from sextant.evaluation.trials.passage_table import markdown as sections

    passages = group == "passages"
    folder = out_folder(place.out, f"trials-{group}")
    hear = open_progress(place.as_json).say
    table = "passages" if passages else "walks"
    with explained_interrupts(lambda: _kept(folder, "campaign.jsonl")), place.workers(hear) as cluster:
        found = run_campaign(
            tables.GROUPS[group], seeds, place.jobs, folder, blind, variant.applied(), hear, table=table, cluster=cluster
        )
    say(tables.to_json(found).rstrip("\n") if place.as_json else tables.markdown(found, table))
    if passages and not place.as_json:
        say(sections(results_store.read(folder / "campaign.jsonl")))
    tables.write(found, folder, table)
    if not place.as_json:
        say(f"written to {folder}: table.md, campaign.json, campaign.jsonl, and a folder per terrain")
    return SUCCESS


@command("trials table", hidden=True)
@argument(
    "kept",
    "output folder of trials, or its campaign.jsonl; parts of a campaign are combined",
    "RESULTS...",
    nargs=-1,
    required=True,
)
@option(
    "--of",
    "content: walks, goals reached, those next to other planners, missteps, warnings, map errors, passages, or their sections",
    type=Choice(("walks", "reached", "baselines", "missteps", "warnings", "maps", "passages", "sections")),
    default="walks",
)
@option(
    "--format",
    "Markdown, CSV, or a LaTeX tabular with booktabs",
    into="style",
    type=Choice(("markdown", "csv", "latex")),
    default="markdown",
)
@option("--columns", "columns to print, by their headings without units (default: all)", "A,B,...", default="")
@flag("--json", "print all of it as JSON", "as_json")
def table(kept: tuple[str, ...], of: str, style: str, columns: str, as_json: bool) -> int:
    """Print a table of stored trials without running anything."""
    from sextant.evaluation.trials import baselines_table, passage_table, results_store
    from sextant.evaluation.trials import campaign_table as tables
    from sextant.evaluation.trials.table_text import FORMATS, selected

    if as_json and (columns or style != "markdown"):
        other = "--columns" if columns else f"--format {style}"
        raise InputError(f"one of --json and {other} expected, found both")
    paths = results_store.files([Path(place) for place in kept])
    runs = [run for path in paths for run in results_store.read(path)]
    if not runs:
        raise InputError(f"no finished run in {', '.join(map(str, paths))}")
    if as_json:
        say(tables.to_json(tables.of_runs(runs)).rstrip("\n"))
        return SUCCESS
    seeds = bool(columns) or style == "csv"
    own = {"sections": passage_table.content, "baselines": baselines_table.content}
    found = own[of](runs) if of in own else tables.content(tables.of_runs(runs), of, seeds)
    found = selected(found, columns.split(",")) if columns else found
    say(FORMATS[style](found).rstrip("\n"))
    return SUCCESS
