"""Figures for a paper: the width of a column, and the plotted data as CSV."""

import csv
import io
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from typing import Any

import numpy as np

LOOK: Any = {"axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "sextant"}  # of every figure
_SMALLEST = 0.6  # least factor of text and lines, so that 12 pt becomes no less than 7.2 pt
_BASE_PT = 12.0  # [pt] size of text for which none is set


def fit(figure: Any, width_in: float) -> None:
    """Resize a figure to a width [in]; heights shrink less than widths, and text least.

    Legends get fewer columns where they would be wider than the figure.
    """
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

    width, height = figure.get_size_inches()
    share = width_in / width
    factor = min(max(share**0.5, _SMALLEST), 1.0)
    figure.set_size_inches(width_in, height * share**0.5)
    for text in figure.findobj(Text):
        text.set_fontsize(text.get_fontsize() * factor)
    for line in figure.findobj(Line2D):
        line.set_linewidth(line.get_linewidth() * factor)
    for axes in figure.axes:
        axes.tick_params(labelsize=_BASE_PT * factor)
        if axes.get_legend() is not None:
            _narrow_legend(axes, share / factor)


def _narrow_legend(axes: Any, share: float) -> None:
    """Draw the legend again with a share of its columns."""
    before = axes.get_legend()
    size = before.get_texts()[0].get_fontsize()
    columns = max(1, round(before._ncols * share))
    axes.legend(loc="upper left", ncols=columns, frameon=False, fontsize=size, handlelength=1.2, columnspacing=1.0)


def plotted(figure: Any) -> str:
    """Return the plotted lines and points as CSV, a row per point: panel, series, x, y.

    A panel is named by the label of its y axis, and by its title where two have the same label. A series is named by its label
    in the legend or its hidden label, which begins with an underscore, else by its number.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["panel", "series", "x", "y"])
    titled = Counter(axes.get_ylabel() for axes in figure.axes)
    title = ""
    for number, axes in enumerate(figure.axes, 1):
        title = axes.get_title() or title
        panel = axes.get_ylabel().replace("\n", " ") or str(number)
        panel += f", {title}" * (titled[axes.get_ylabel()] > 1)
        for count, (label, x, y) in enumerate(_series(axes), 1):
            name = str(count) if not label or label.startswith("_child") else label.removeprefix("_")
            writer.writerows([panel, name, f"{a:.9g}", f"{b:.9g}"] for a, b in zip(x, y, strict=True))
    return text.getvalue()


def _series(axes: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield label, x and y of each line, set of points and set of bars in the coordinates of the data."""
    for line in axes.get_lines():
        if line.get_transform() == axes.transData:  # not a limit across the whole panel
            yield line.get_label(), np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    for points in axes.collections:
        offsets: Any = np.ma.filled(np.ma.asarray(points.get_offsets(), float), np.nan)
        if points.get_offset_transform() == axes.transData and offsets.any():
            yield points.get_label(), offsets[:, 0], offsets[:, 1]
    for bars in axes.containers:
        patches = list(chain(bars.patches)) if hasattr(bars, "patches") else []
        if patches:
            middle = [bar.get_x() + bar.get_width() / 2 for bar in patches]
            yield bars.get_label(), np.array(middle), np.array([bar.get_height() for bar in patches])
