"""Folder of a thesis' figures: a PNG and an SVG of each, an index in Markdown, and all numbers in figures.json."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sextant.evaluation.figures import paper
from sextant.evaluation.provenance import commit
from sextant.evaluation.theses.data import Data
from sextant.evaluation.theses.inventory import Entry, Thesis
from sextant.evaluation.trials import table_text
from sextant.evaluation.trials.table_text import Table
from sextant.shared.files import whole_files
from sextant.shared.files.input_file import FileError, read_json

INDEX, NUMBERS = "README.md", "figures.json"
_ROW_IN, _HEAD_IN = 0.19, 0.30  # [in] height of a row of the table below a figure, and of its head
_DPI = 160
_MOST_POINTS = 1000  # that an SVG holds as vectors
_SUFFIXES = ("png", "svg")


Ours = Mapping[str, tuple[str, ...]]  # number of a drawn figure -> our values of its printed numbers


def draw_all(
    thesis: Thesis, entries: Sequence[Entry], folder: Path, data: Data, say: Callable[[str], object] = lambda _: None
) -> int:
    """Draw some entries of a thesis into a folder, and write its index; return how many were drawn.

    Args:
        thesis: The thesis.
        entries: Those to draw; entries without data are only listed.
        folder: Output folder; figures of other entries in it stay, also in the index.
        data: Walks, maps and plans.
        say: Receives progress.
    """
    whole_files.make_folder(folder)
    drawn: dict[str, tuple[str, ...]] = {}
    for entry in entries:
        if entry.draw is None:
            continue
        drawn[entry.number] = draw(entry, folder, data)
        say(f"{entry.title}: {entry.shows}")
    found = {**_kept(thesis, folder), **drawn}
    whole_files.write_text(folder / NUMBERS, to_json(thesis, found, data))
    whole_files.write_text(folder / INDEX, index(thesis, found))
    return len(drawn)


def draw(entry: Entry, folder: Path, data: Data) -> tuple[str, ...]:
    """Draw one entry as PNG and SVG, its numbers below it; return our values."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    assert entry.draw is not None
    width, height = entry.size
    rows = len(entry.printed)
    below = (_HEAD_IN + _ROW_IN * (rows + 1)) * (rows > 0)
    with rc_context(paper.LOOK | {"font.size": 9, "axes.titlesize": 9, "legend.fontsize": 8, "legend.frameon": False}):
        figure = Figure(figsize=(width, height + below), dpi=_DPI, facecolor="white", layout="constrained")
        if rows:
            parts: Any = figure.subfigures(2, 1, height_ratios=(height, below))
            above, under = parts
            ours = tuple(entry.draw(above, data))
            _draw_numbers(under, entry, ours)
        else:
            ours = tuple(entry.draw(figure, data))
        if len(ours) != rows:
            raise ValueError(f"{entry.title}: {rows} values expected, found {len(ours)}")
        _rasterize_clouds(figure)
        for suffix in _SUFFIXES:
            undated: Any = {"Date": None} if suffix == "svg" else None
            path = folder / f"{entry.name}.{suffix}"
            whole_files.write_by_name(path, partial(figure.savefig, metadata=undated))
    return ours


def index(thesis: Thesis, found: Ours) -> str:
    """Return the index: each figure with its picture, or the reason why there is none, and all numbers."""
    rows = [_row(entry, entry.number in found) for entry in thesis.entries]
    listed = table_text.markdown(Table(["", "shows", "picture", "our data, or why there is no picture"], rows))
    numbers = [
        [entry.title, printed.quantity, printed.value, here]
        for entry in thesis.entries
        for printed, here in zip(entry.printed, found.get(entry.number, ()), strict=False)
    ]
    compared = table_text.markdown(Table(["", "quantity", "thesis", "here"], numbers))
    return f"# {thesis.title}\n\n{listed}\n## Numbers\n\n{compared}\nMade at commit {commit() or 'unknown'}.\n"


def to_json(thesis: Thesis, found: Ours, data: Data) -> str:
    """Return the inventory and the numbers as JSON."""
    entries = [
        {
            "number": entry.number,
            "shows": entry.shows,
            "files": _files(entry) if entry.number in found else [],
            "ours": entry.ours,
            "why_not": entry.why_not,
            "numbers": [
                {"quantity": printed.quantity, "thesis": printed.value, "here": here}
                for printed, here in zip(entry.printed, found.get(entry.number, ()), strict=False)
            ],
        }
        for entry in thesis.entries
    ]
    return json.dumps({"thesis": thesis.title, "commit": commit(), "seed": data.seed, "figures": entries}, indent=1) + "\n"


def _kept(thesis: Thesis, folder: Path) -> Ours:
    """Return our values of the figures that the folder holds already."""
    try:
        table = read_json(folder / NUMBERS)
        before = {one["number"]: tuple(str(row["here"]) for row in one["numbers"]) for one in table["figures"]}
    except (FileError, KeyError, TypeError):  # none, or another file
        return {}
    return {
        entry.number: before[entry.number]
        for entry in thesis.entries
        if len(before.get(entry.number, ())) == len(entry.printed) and all((folder / file).exists() for file in _files(entry))
    }


def _files(entry: Entry) -> list[str]:
    return [f"{entry.name}.{suffix}" for suffix in _SUFFIXES]


def _row(entry: Entry, drawn: bool) -> list[str]:
    picture = ", ".join(f"[{file.rpartition('.')[2]}]({file})" for file in _files(entry)) if drawn else "-"
    return [entry.title, entry.shows, picture, entry.why_not or entry.ours]


def _rasterize_clouds(figure: Any) -> None:
    """Let an SVG hold clouds of points and surfaces as pictures; as vectors they would take megabytes."""
    for axes in figure.axes:
        if axes.name == "3d":  # only the whole of it can be a picture
            axes.set_rasterized(True)
            continue
        for one in axes.collections:
            one.set_rasterized(len(one.get_offsets()) > _MOST_POINTS)
        for line in axes.lines:
            line.set_rasterized(line.get_linestyle() == "None" and len(line.get_xdata()) > _MOST_POINTS)


def _draw_numbers(figure: Any, entry: Entry, ours: Sequence[str]) -> None:
    """Draw the printed numbers next to ours."""
    axes = figure.subplots()
    axes.set_axis_off()
    rows = [(printed.quantity, printed.value, here) for printed, here in zip(entry.printed, ours, strict=True)]
    cells = [("", "thesis", "here"), *rows]
    longest = [max(len(row[k]) for row in cells) + 3 for k in range(3)]
    widths = [length / sum(longest) for length in longest]
    drawn = axes.table(cells, loc="center", cellLoc="left", edges="horizontal", colWidths=widths)
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(8)
    for (row, _), cell in drawn.get_celld().items():
        cell.set_height(1.0 / (len(rows) + 1))
        cell.set_linewidth(0.5)
        if row == 0:
            cell.get_text().set_weight("bold")
