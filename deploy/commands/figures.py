"""`sextant figures`: figures of recorded runs, and those of the two theses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, complain, open_progress, out_folder, say
from sextant.deploy.terminal.arguments import Choice, Group, Parsed, argument, flag, option
from sextant.shared.spelling import hint

if TYPE_CHECKING:
    from sextant.evaluation.theses.inventory import Thesis

figures = Group("figures", "Draw the figures of recorded runs, or those of a thesis from new data.")
_SCALED = ("height", "tilt", "foot", "torque", "stability", "pose")  # figures that may have the width of a column


@figures.command("run")
@argument("runs", "folder of a run, or its recording; several are compared", "[RUN]...", nargs=-1)
@option("--what", "figure to draw; repeatable (default: all)", "NAME", multiple=True)
@flag("--list", "list the figures and exit", "listed")
@option("--format", "file format", into="suffix", type=Choice(("svg", "pdf", "png")), default="svg")
@option(
    "--width",
    f"width of the figures for a paper, e.g. 3.5in or 89mm (default: 12in); only of {', '.join(_SCALED)}",
    "SIZE",
    type=Parsed(options.width_in, "width"),
)
@flag("--csv", "also write the plotted data as NAME.csv", "data")
@option("--scenario", "scenario of an older recording, by name or TOML file, if sextant does not have it", "NAME", default="")
@options.out
@flag("--json", "print the numbers of the runs as JSON, not as a table", "as_json")
def figures_of_runs(
    runs: tuple[str, ...],
    what: tuple[str, ...],
    listed: bool,
    suffix: str,
    width: float | None,
    data: bool,
    scenario: str,
    out: str | None,
    as_json: bool,
) -> int:
    """Draw the figures of a recorded run, or compare several runs."""
    from sextant.evaluation.figures.run_figures import FIGURES, draw, misfit

    if listed:
        width = max(map(len, FIGURES))
        say("\n".join(f"{name:<{width}}  {kind.shows}" for name, kind in FIGURES.items()))
        return SUCCESS
    unknown = [name for name in what if name not in FIGURES]
    if unknown:
        raise InputError(f"--what: no figure {unknown[0]!r}; {hint(unknown[0], FIGURES)}")
    paths = [Path(run) for run in runs]
    if not paths:
        raise InputError("the folder of a run expected, found none; `sextant figures run --list` lists the figures")
    misfits = [words for name in what if (words := misfit(name, len(paths)))]
    if misfits:
        raise InputError(f"--what: {misfits[0]}")
    fixed = [name for name in what if width and not FIGURES[name].scales]
    if fixed:
        raise InputError(f"--width: {fixed[0]} has a fixed size; leave --width out, or draw {', '.join(_SCALED)}")
    from sextant.evaluation.figures.comparison_table import comparison, markdown
    from sextant.evaluation.figures.recorded_run import recorded_runs

    recorded = recorded_runs(paths, scenario)
    for path, run in zip(paths, recorded, strict=True):
        if run.cut_off:
            complain(f"warning: {path} is truncated; only its readable part is drawn")
    folder = out_folder(out, "figures")
    drawn: list[str] = []
    empty: list[str] = []
    for name in what or (_SCALED if width else FIGURES):
        (drawn if draw(name, recorded, folder / f"{name}.{suffix}", width, data) else empty).append(name)
    if as_json:
        say(json.dumps({run.name: run.numbers for run in recorded}, indent=1))
    elif len(recorded) > 1:
        say(markdown(comparison(recorded)))
    if not as_json and drawn:
        say(f"written to {folder}: {', '.join(f'{name}.{suffix}' for name in drawn)}{' and their data' * data}")
    missing = [name for name in empty if what]
    if missing:
        complain(
            f"sextant figures run: no data for {', '.join(missing)}; `sextant figures run --list` shows what each figure needs"
        )
    return FAILED if missing or not drawn else SUCCESS


def _of_thesis(function: Callable[..., int]) -> Callable[..., int]:
    """Add the options that the commands of both theses share."""
    for add in (
        options.as_json,
        options.out,
        options.jobs,
        options.count("--seed", 0, "first seed of the walks", lowest=0),
        flag("--list", "list the figures, with what each is drawn from or why it cannot be, and exit", "listed"),
        option("--only", "figure to draw, e.g. 8.2 or 'Table 6.1'; repeatable (default: all)", "NUMBER", multiple=True),
    ):
        function = add(function)
    return function


@figures.command("masri")
@_of_thesis
@options.count("--crossings", 25, "crossings of each layout in Table 6.1, with seeds from 0 up")
def figures_of_masri(
    only: tuple[str, ...], listed: bool, seed: int, jobs: int, out: str | None, as_json: bool, crossings: int
) -> int:
    """Draw the figures of Masri 2016 that data can make, next to his numbers.

    A folder that is given again keeps its walks and plans.
    """
    from sextant.evaluation.theses.masri import MASRI

    return _draw_thesis(MASRI, only, listed, seed, jobs, out, as_json, crossings)


@figures.command("lotriet")
@_of_thesis
def figures_of_lotriet(only: tuple[str, ...], listed: bool, seed: int, jobs: int, out: str | None, as_json: bool) -> int:
    """Draw the figures of Lotriet 2024 that data can make, next to his numbers.

    A folder that is given again keeps its walks.
    """
    from sextant.evaluation.theses.lotriet import LOTRIET

    return _draw_thesis(LOTRIET, only, listed, seed, jobs, out, as_json)


def _draw_thesis(
    thesis: "Thesis",
    only: tuple[str, ...],
    listed: bool,
    seed: int,
    jobs: int,
    out: str | None,
    as_json: bool,
    crossings: int = 1,
) -> int:
    """Draw figures of a thesis into a folder, and print its index."""
    from sextant.evaluation.theses import gallery
    from sextant.evaluation.theses.data import Data

    if listed:
        say("\n".join(f"{one.title:<12} {one.shows}: {one.why_not or one.ours}" for one in thesis.entries))
        return SUCCESS
    known = {one.number: one for one in thesis.entries}
    if unknown := [number for number in only if number not in known]:
        raise InputError(f"--only: no figure {unknown[0]!r}; {hint(unknown[0], known)}")
    entries = [known[number] for number in dict.fromkeys(only)] or list(thesis.entries)
    if undrawn := [one for one in entries if only and one.draw is None]:
        raise InputError(f"--only: {undrawn[0].title} cannot be drawn: {undrawn[0].why_not}")
    folder, progress = out_folder(out, thesis.name), open_progress(as_json)
    data = Data(folder, seed, crossings, progress.say)
    data.prepare(((walk, trial) for one in entries for walk in one.walks for trial in range(one.trials)), jobs)
    drawn = gallery.draw_all(thesis, entries, folder, data, progress.say)
    if as_json:
        say((folder / gallery.NUMBERS).read_text(encoding="utf-8"))
    else:
        say(f"written to {folder}: {gallery.INDEX}, {gallery.NUMBERS} and {drawn} figures")
    return SUCCESS
