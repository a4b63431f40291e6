"""`sextant plot`: figures of recorded runs."""

import argparse
import json
from pathlib import Path

from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, complain, out_folder, say
from sextant.shared.spelling import hint


def plot(arguments: argparse.Namespace) -> int:
    """`sextant plot`: draw the figures of one run, or compare several."""
    from sextant.deploy.figures.run_figures import FIGURES, draw, misfit

    if arguments.list:
        width = max(map(len, FIGURES))
        say("\n".join(f"{name:<{width}}  {kind.shows}" for name, kind in FIGURES.items()))
        return SUCCESS
    unknown = [name for name in arguments.what or () if name not in FIGURES]
    if unknown:
        raise InputError(f"--what: no figure {unknown[0]!r}; {hint(unknown[0], FIGURES)}")
    paths = [Path(run) for run in arguments.run]
    if not paths:
        raise InputError("the folder of a run expected, found none; `sextant plot --list` lists the figures")
    misfits = [words for name in arguments.what or () if (words := misfit(name, len(paths)))]
    if misfits:
        raise InputError(f"--what: {misfits[0]}")
    from sextant.deploy.figures.comparison_table import comparison, markdown
    from sextant.deploy.figures.recorded_run import recorded_run

    runs = [recorded_run(path, arguments.scenario) for path in paths]
    for path, run in zip(paths, runs, strict=True):
        if run.cut_off:
            complain(f"warning: {path} is truncated; only its readable part is drawn")
    folder = out_folder(arguments, "plot")
    drawn: list[str] = []
    empty: list[str] = []
    for name in arguments.what or FIGURES:
        file = folder / f"{name}.{arguments.format}"
        (drawn if draw(name, runs, file) else empty).append(name)
    if arguments.json:
        say(json.dumps({run.name: run.numbers for run in runs}, indent=1))
    elif len(runs) > 1:
        say(markdown(comparison(runs)))
    if not arguments.json and drawn:
        say(f"written to {folder}: {', '.join(f'{name}.{arguments.format}' for name in drawn)}")
    missing = [name for name in empty if arguments.what]
    if missing:
        complain(f"sextant plot: no data for {', '.join(missing)}; `sextant plot --list` shows what each figure needs")
    return FAILED if missing or not drawn else SUCCESS
