"""`sextant plot`: figures of recorded runs."""

import json
from pathlib import Path

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, complain, out_folder, say
from sextant.deploy.terminal.arguments import Choice, Parsed, argument, command, flag, option
from sextant.shared.spelling import hint

_SCALED = ("height", "tilt", "foot", "torque", "stability", "pose")  # figures that may have the width of a column


@command()
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
def plot(
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
        raise InputError("the folder of a run expected, found none; `sextant plot --list` lists the figures")
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
    folder = out_folder(out, "plot")
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
        complain(f"sextant plot: no data for {', '.join(missing)}; `sextant plot --list` shows what each figure needs")
    return FAILED if missing or not drawn else SUCCESS
