"""Figures of the theses for one run, and comparisons of several runs.

A figure is a row of the table `FIGURES`: its description and its drawing function.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.figures import layers_picture, paper, passage_picture, summary, walk_picture
from sextant.evaluation.figures.comparison_table import comparison
from sextant.evaluation.figures.recorded_run import RecordedRun
from sextant.evaluation.figures.walk_picture import LEG_COLORS
from sextant.shared.files import whole_files
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS

Runs = Sequence[RecordedRun]

RUN_COLORS = ("#0072b2", "#d55e00", "#1a7f37", "#cc79a7", "#8a6d00", "#56b4e9")  # repeated from the seventh run on
_LIMIT = "#b3261e"
_WIDTH, _DPI = 12.0, 100  # [in], [1/in]
WINDOW_S = 4.0  # [s] window of the worst, or mean, value where single values would be too dense
_ASIDE = 0.92 * _WIDTH  # [in] width of a panel
_SHORTEST_S = 1e-3  # minimum length of a time axis; a run may have a single moment
_TICKS = 6  # largest number of ticks; without this limit the layout would not converge
_LEGEND_ROW, _COLUMNS = 0.24, 6  # [in] height of a row of the legend below the maps, and its columns
_SINCE_STEP = "simulated time since the first step [s]"
_ROOM = 0.3  # [m] around a walk in a map


@dataclass(frozen=True, slots=True)
class Plot:
    """One kind of figure."""

    shows: str  # description
    draw: Callable[[Runs], Any]  # returns a figure, or None if these runs have nothing to show
    least: int = 1  # least number of runs
    most: int | None = None  # largest number of runs; None for any number
    scales: bool = False  # whether it may have the width of a column


def draw(name: str, runs: Runs, path: Path, width_in: float | None = None, data: bool = False) -> bool:
    """Draw a figure of some runs.

    Args:
        name: One of `FIGURES`.
        runs: At least one.
        path: Output file; its suffix is the format: svg, pdf or png. The same runs give the same file, byte for byte.
        width_in: Width [in], for a figure that scales; None for the width of a page.
        data: Also write the plotted lines and points, next to it as CSV.

    Returns:
        Whether these runs had anything to show.
    """
    from matplotlib import rc_context

    with rc_context(paper.LOOK | {"font.size": 12}):
        figure = None if misfit(name, len(runs)) else FIGURES[name].draw(runs)
        if figure is None:
            return False
        if width_in is not None:
            paper.fit(figure, width_in)
        whole_files.make_folder(path.parent)
        if data:
            whole_files.write_text(path.with_suffix(".csv"), paper.plotted(figure))
        undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(path.suffix[1:])
        whole_files.write_by_name(path, partial(figure.savefig, metadata=undated))
    return True


def misfit(name: str, runs: int) -> str:
    """Return why a figure does not suit a number of runs; empty if it does."""
    kind = FIGURES[name]
    if runs < kind.least:
        return f"{name} compares runs, at least {kind.least} expected, found {runs}"
    if kind.most is not None and runs > kind.most:
        return f"{name} shows one run, found {runs}; give one run at a time"
    return ""


# -- over time


def _height(runs: Runs) -> Any:
    """Draw Lotriet 2024, figures 8.2, 8.4 and 8.7, top."""
    return _over_time(runs, walk_picture.draw_height, _overlaid_height, "body height [cm]")


def _overlaid_height(axes: Any, run: RecordedRun, color: str) -> None:
    trace, t = run.trace, run.trace.t - run.begin
    axes.plot(t, 100 * trace.height_reference, color=color, lw=2.5, alpha=0.3, label=f"_{run.name}, commanded")
    axes.plot(t, 100 * trace.p_true[:, 2], color=color, lw=1.1, label=_label(run))


def _tilt(runs: Runs) -> Any:
    """Draw Lotriet 2024, figures 8.2 and 8.4, centre, and 8.7, bottom."""
    return _over_time(runs, walk_picture.draw_tilt, _overlaid_tilt, f"tilt off the command [deg],\nworst within {WINDOW_S:g} s")


def _overlaid_tilt(axes: Any, run: RecordedRun, color: str) -> None:
    trace = run.trace
    axes.plot(trace.t - run.begin, np.degrees(worst(trace.tilt, trace.t)), color=color, lw=1.3, label=_label(run))


def _torque(runs: Runs) -> Any:
    figure, axes = _sheet(3.6)
    for run, color in _colored(runs):
        trace = run.trace
        if len(runs) == 1:
            axes.plot(trace.t - run.begin, trace.torque_worst, color=color, lw=0.5, alpha=0.45, label="of an instant")
        axes.plot(trace.t - run.begin, _rms(trace.torque_worst, trace.t), color=color, lw=1.5, label=_label(run))
    _stall(axes, runs)
    return _in_time(figure, axes, runs, f"highest torque [N m],\nrms of {WINDOW_S:g} s")


def _stability(runs: Runs) -> Any:
    walked = _walked(runs)
    if not walked:
        return None
    figure, axes = _sheet(3.6)
    for run, color in _colored(walked):
        least = -worst(-1000 * run.margin, run.trace.t)
        axes.plot(run.trace.t - run.begin, least, color=color, lw=1.3, label=_label(run))
    _limit(axes, 0.0, "outside the support")
    axes.set_ylim(top=1.2 * axes.get_ylim()[1])  # room for the legend
    return _in_time(figure, axes, walked, f"stability margin [mm],\nleast within {WINDOW_S:g} s")


def _pose(runs: Runs) -> Any:
    """Draw Lotriet 2024, figure 4.8, with the true path."""
    walked = _walked(runs)
    if not walked:
        return None
    figure, (path, error) = _sheets(2, 6.4)
    for run, color in _colored(walked):
        trace = run.trace
        path.plot(trace.p_true[:, 0], 100 * trace.p_true[:, 1], color=color, lw=2.5, alpha=0.35, label=f"{run.name}, true")
        path.plot(trace.p_estimate[:, 0], 100 * trace.p_estimate[:, 1], color=color, lw=1.0, label=f"{run.name}, estimated")
        error.plot(trace.t_estimate - run.begin, 1000 * trace.pose_error, color=color, lw=1.2, label=_label(run))
    path.set_xlabel("ahead [m]")
    path.set_ylabel("left [cm]\n(wide: true, thin: estimated)")
    path.locator_params(axis="y", nbins=_TICKS)
    path.grid(alpha=0.25)
    error.set_ylim(bottom=0.0)
    return _in_time(figure, error, walked, "pose error [mm]")


def _over_time(
    runs: Runs, of_one: Callable[[Any, Any], None], overlaid: Callable[[Any, RecordedRun, str], None], label: str
) -> Any:
    """Draw one run alone, or several overlaid from their first step on."""
    walked = _walked(runs)
    if not walked:
        return None
    figure, axes = _sheet(3.6)
    if len(walked) == 1:
        of_one(axes, replace(walked[0].trace, t=walked[0].trace.t - walked[0].begin))
        axes.set_xlabel(_SINCE_STEP)
        axes.set_title(_title(walked[0]), size=12)
        return figure
    for run, color in _colored(walked):
        overlaid(axes, run, color)
    low, high = _limits(axes)
    axes.set_ylim(low, high)
    return _in_time(figure, axes, walked, label)


def _limits(axes: Any) -> tuple[float, float]:
    """Return limits that show nearly all data from the first step on.

    Outliers, as of a fall, would otherwise hide the walk.
    """
    drawn = [line.get_ydata()[line.get_xdata() >= 0.0] for line in axes.get_lines()]
    values = np.concatenate([y[np.isfinite(y)] for y in drawn])
    low, high = np.percentile(values, [0.5, 99.5]).tolist()
    spare = 0.1 * (high - low) + 0.05
    return low - spare, high + 2 * spare


def worst(values: Array, t: Array) -> Array:
    """Return the moving maximum (n,) over a window centred at each time [s].

    NaN values are ignored.
    """
    highest = _windows(np.where(np.isfinite(values), values, -np.inf), t, -np.inf).max(axis=1)
    return np.where(np.isfinite(values), highest, np.nan)


def _rms(values: Array, t: Array) -> Array:
    """Return the moving root mean square over the same window."""
    return np.asarray(np.sqrt(np.nanmean(_windows(values**2, t, np.nan), axis=1)))


def _windows(values: Array, t: Array, beyond: float) -> Array:
    """Return the values (n, m) around each of (n,) values, padded with `beyond`."""
    half = round(WINDOW_S / 2 / float(np.median(np.diff(t)))) if len(t) > 1 else 0
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, half, constant_values=beyond), 2 * half + 1)


# -- feet


def _foot(runs: Runs) -> Any:
    """Draw Lotriet 2024, figures 8.2 and 8.4, bottom."""

    def one(axes: Any, run: RecordedRun) -> None:
        walk_picture.draw_one_foot(axes, run.trace, walk_picture.steadiest_leg(run.trace))

    return _below_each_other(_walked(runs), one, 2.8)


def _feet(runs: Runs) -> Any:
    """Draw Lotriet 2024, figure 8.6."""
    walked = _walked(runs)
    if not walked:
        return None
    ratios = [tall for run in walked for tall in (_ASIDE * _tall(run.trace.feet[run.trace.walking]) + 0.6, 2.4)]
    figure, rows = _sheets(2 * len(walked), sum(ratios), ratios=ratios)
    for run, above, aside in zip(walked, rows[::2], rows[1::2], strict=True):
        walk_picture.draw_from_above(above, run.trace)
        walk_picture.draw_from_aside(aside, run.trace)
        above.set_title(_title(run, len(walked) > 1), size=12)
    return figure


def _tall(places: Array) -> float:
    """Return width over length of the area of some positions (..., 2 or 3) [m]."""
    size = np.ptp(places.reshape(-1, places.shape[-1])[:, :2], axis=0) + 0.1
    return float(size[1] / size[0])


def _footholds(runs: Runs) -> Any:
    """Draw Masri 2016, figures 6.3, 6.7 and 6.9: the walk on the map, from above."""
    shown = [run for run in runs if run.trace.mosaic is not None and len(run.trace.t)]
    if not shown:
        return None
    corners = [_corners(run) for run in shown]
    tall = [_ASIDE * float((high - low)[1] / (high - low)[0]) + 1.0 for low, high in corners]
    handles = summary.legend_handles(run.trace for run in shown)
    below = _LEGEND_ROW * (math.ceil(len(handles) / _COLUMNS) + 1)
    full = sum(tall) + below
    figure, rows = _sheets(len(shown), full, ratios=tall, layout=None)
    figure.subplots_adjust(left=0.08, right=0.90, top=1 - 0.4 / full, bottom=(below + 0.4) / full, hspace=0.4)
    for run, axes, (low, high) in zip(shown, rows, corners, strict=True):
        trace = run.trace
        assert trace.mosaic is not None
        axes.set_facecolor(layers_picture.UNSEEN)
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_title(_title(run, len(shown) > 1), size=12)
        axes.set_xlabel("ahead [m]")
        axes.set_ylabel("left [m]")
        summary.draw_ground(figure, axes, trace.mosaic, low, high)
        summary.draw_blocks(axes, trace)
        if not run.own_words:  # the goal of such a run is unknown
            summary.draw_course(axes, trace)
        summary.draw_footholds(axes, trace)
        summary.draw_paths(axes, trace, run.report)
    figure.legend(handles=handles, loc="lower center", ncols=_COLUMNS, frameon=False, fontsize=10, columnspacing=1.2)
    return figure


def _corners(run: RecordedRun) -> tuple[Array, Array]:
    trace = run.trace
    xy = np.concatenate([trace.p_true[:, :2], trace.feet[..., :2].reshape(-1, 2), [[0.0, 0.0], [trace.goal_distance, 0.0]]])
    return xy.min(axis=0) - _ROOM, xy.max(axis=0) + _ROOM


def _joints(runs: Runs) -> Any:
    """Draw the root mean square torque of each joint."""
    walked = _walked(runs)
    if not walked:
        return None
    figure, axes = _sheet(3.6)
    width = 0.8 / len(walked)
    place = np.arange(18) + 0.6 * np.repeat(np.arange(6), 3)
    for k, (run, color) in enumerate(_colored(walked)):
        left = place - 0.4 + width * k
        axes.bar(left, run.torque_rms.ravel(), width, align="edge", color=color, label=_label(run))
        axes.plot(
            left + width / 2, run.torque_p95.ravel(), ls="", marker="_", color="#111111", ms=max(4, 16 // len(walked)),
            label=f"_{run.name}, 95 %",
        )  # fmt: skip
    axes.set_xticks(place, [joint for _ in LEGS for joint in JOINTS], size=9)
    for leg, (name, color) in enumerate(zip(LEGS, LEG_COLORS, strict=True)):
        axes.annotate(name, (float(place[3 * leg + 1]), 0), (0, -30), textcoords="offset points", ha="center", color=color)
    _stall(axes, runs)
    axes.set_ylabel("torque of a walk [N m]\n(bar: rms, dash: 95 %)")
    axes.locator_params(axis="y", nbins=_TICKS)
    axes.set_title(_title(walked[0]) if len(walked) == 1 else "", size=12)
    if len(walked) > 1:
        axes.legend(loc="upper left", ncols=3, frameon=False, fontsize=10)
    return figure


# -- maps and plans


def _layers(runs: Runs) -> Any:
    """Draw Lotriet 2024, figures 6.7 and 6.9; Masri 2016, figure 4.10."""
    if runs[0].terrain is None:
        return None
    trace = runs[0].trace
    way = np.tile(np.eye(4), (len(trace.p_estimate), 1, 1))
    way[:, :3, 3] = trace.p_estimate
    downs = trace.touchdowns
    footholds = np.where(np.isfinite(downs.chosen), downs.chosen, downs.p)  # the targets, which are on the robot's own map
    return layers_picture.figure_of(runs[0].terrain, way, [footholds[downs.leg == leg] for leg in range(len(LEGS))])


def _summary(runs: Runs) -> Any:
    return summary.figure_of(runs[0].report, runs[0].trace, truth=not runs[0].own_words)


def _passage(runs: Runs) -> Any:
    """Draw Masri 2016, chapter 6: the plan at each stop, and the walked path."""
    if not runs[0].trace.sections:
        return None
    return passage_picture.figure_of(runs[0].report, runs[0].trace)


def _table(runs: Runs) -> Any:
    header, *rows = comparison(runs)
    figure, axes = _sheet(0.5 + 0.36 * (len(rows) + 1))
    axes.set_axis_off()
    share = 0.7 / (len(header) - 1)
    cells = axes.table([header, *rows], loc="center", cellLoc="left", edges="horizontal", colWidths=[0.3] + [share] * len(runs))
    cells.auto_set_font_size(False)
    cells.set_fontsize(11)
    cells.scale(1.0, 1.6)
    for k, (_, color) in enumerate(_colored(runs), 1):
        cells[0, k].get_text().set(color=color, weight="bold")
    return figure


FIGURES = MappingProxyType(
    {
        "summary": Plot("one-page summary: verdict, signs before it, map, reports; of one run", _summary, most=1),
        "height": Plot("body height over time, as Lotriet's figures 8.2, 8.4 and 8.7", _height, scales=True),
        "tilt": Plot("roll and pitch over time, as there; for several runs the deviation from the command", _tilt, scales=True),
        "foot": Plot("path of one foot over the ground from the side, as Lotriet's figures 8.2 and 8.4", _foot, scales=True),
        "feet": Plot("all feet from above and from the side, as Lotriet's figure 8.6", _feet),
        "torque": Plot("highest torque of all joints over time", _torque, scales=True),
        "joints": Plot("torque of each joint", _joints),
        "stability": Plot("stability margin over time", _stability, scales=True),
        "pose": Plot(
            "estimated and true path, and the error of the estimate over time, after Lotriet's figure 4.8", _pose, scales=True
        ),
        "footholds": Plot("walk from above on the robot's map: path, footholds, missteps, after Masri's chapter 6", _footholds),
        "layers": Plot("footholds on the last map: height, Lotriet's score, Masri's evaluation; of one run", _layers, most=1),
        "passage": Plot("plan at each stop of a passage, and the walk; of one run", _passage, most=1),
        "table": Plot("table of numbers", _table, least=2),
    }
)


# -- common parts


def _sheet(height: float) -> tuple[Any, Any]:
    figure, rows = _sheets(1, height)
    return figure, rows[0]


def _sheets(
    rows: int, height: float, ratios: Sequence[float] | None = None, layout: Literal["constrained"] | None = "constrained"
) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, facecolor="white", layout=layout)
    axes: NDArray[Any] = np.atleast_1d(figure.subplots(rows, 1, height_ratios=ratios))
    return figure, axes.tolist()


def _below_each_other(runs: Runs, one: Callable[[Any, RecordedRun], None], height: float) -> Any:
    if not runs:
        return None
    figure, rows = _sheets(len(runs), height * len(runs))
    for run, axes in zip(runs, rows, strict=True):
        one(axes, run)
        axes.set_title(_title(run, len(runs) > 1), size=12)
    return figure


def _in_time(figure: Any, axes: Any, runs: Runs, label: str) -> Any:
    """Label a figure over time, and return it."""
    stepped = any(run.trace.walking.any() for run in runs)
    axes.set_xlabel(_SINCE_STEP if stepped else "simulated time [s]")
    axes.set_ylabel(label)
    axes.locator_params(axis="y", nbins=_TICKS)
    axes.grid(alpha=0.25)
    last = max(float(run.trace.t[-1]) - run.begin for run in runs if len(run.trace.t))
    axes.set_xlim(-0.5 if stepped else 0.0, max(last, _SHORTEST_S))
    if len(runs) == 1:
        axes.set_title(_title(runs[0]), size=12)
    else:
        axes.legend(loc="upper left", ncols=3, frameon=False, fontsize=10)
    return figure


def _stall(axes: Any, runs: Runs) -> None:
    """Draw the stall torque of each robot, with its name if there are several."""
    limits = {run.report.robot: float(run.trace.profile.servos.stall_torque.max()) for run in runs}
    for robot, stall in limits.items():
        _limit(axes, stall, "stall" if len(limits) == 1 else f"stall of {robot}")
    axes.set_ylim(0.0, 1.2 * max(limits.values()))


def _limit(axes: Any, value: float, word: str) -> None:
    axes.axhline(value, color=_LIMIT, lw=1.2, ls=":")
    axes.annotate(word, (1.0, value), xycoords=("axes fraction", "data"), ha="right", va="bottom", color=_LIMIT, size=11)


def _walked(runs: Runs) -> list[RecordedRun]:
    return [run for run in runs if run.trace.walking.any()]


def _colored(runs: Runs) -> list[tuple[RecordedRun, str]]:
    return [(run, RUN_COLORS[k % len(RUN_COLORS)]) for k, run in enumerate(runs)]


def _label(run: RecordedRun) -> str:
    return run.name + ("" if run.report.success else " (failed)")


def _title(run: RecordedRun, named: bool = False) -> str:
    """Return scenario, seed, robot, gait, plug-ins and result of a run; also its name if `named`."""
    r = run.report
    if run.own_words:
        return f"{run.name}, {r.robot}: {r.reason}"
    what = f"{r.scenario}, seed {r.seed}, {r.robot}, {replace(r, plugins=run.numbers.get('plugins', {})).manner}"
    return f"{run.name}: " * named + what + f": {r.reason}"[:110]
