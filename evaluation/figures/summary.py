"""Summary picture of a run: map, paths, footholds, and the walk over time."""

import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.figures import history_picture
from sextant.evaluation.figures.history_picture import ESTIMATE, TRUE
from sextant.evaluation.figures.layers_picture import UNSEEN, ground_colors
from sextant.evaluation.figures.relief import shaded
from sextant.evaluation.figures.walk_picture import LEG_COLORS
from sextant.evaluation.metrics.map_metrics import Mosaic
from sextant.evaluation.report import ARRIVED, CaptureToPlan, Report
from sextant.evaluation.scoring.failure_analysis import ENDED, MISSED, FailureMoment, decisive_moment, missed_by, refusal, signs
from sextant.evaluation.trace.status_log import StatusEvent
from sextant.evaluation.trace.touchdowns import Touchdowns
from sextant.evaluation.trace.trace import Touches, Trace
from sextant.shared.files import whole_files
from sextant.shared.geometry import apply
from sextant.shared.robot.profile import LEGS

_WIDTH, _DPI, _FONT = 16.0, 100, 13  # [in], [1/in], [pt]
_MAP, _LEGEND, _HISTORY = (3.3, 5.2), 0.75, (6.2, 7.6)  # [in] heights; the history's without and with a decisive moment
_LEFT, _RIGHT, _BAR = 0.055, 0.985, 0.06  # [1] of the width: the margins, and the width of the height scale
_GAP = 0.5  # [in] between the map's scale and the close-up
_LINE = 0.235  # [in] of a line of text
_GOOD, _BAD, _AMBER = "#1a7f37", "#b3261e", "#9a6700"
_ROUTE = "#1f5fd0"
_NO_FOOTHOLD, _HATCH = (0.70, 0.10, 0.08, 0.5), "#00000045"
_SIDE = 0.62  # [m] least part of the map shown to both sides of the line
_BEFORE, _AFTER = 0.45, 0.45  # [m] of the map shown before the start and after the goal
_AROUND = 0.42  # [m] shown to all sides of the body in the close-up
_OF_TRUTH = ("true", "misstep", "touchdowns raised", "falls", "pose error", "map error", "real-time")  # need ground truth
_LOOK_BACK = 3.0  # [s] before a fall in which the body has left its support


def draw(path: Path, report: Report, trace: Trace) -> None:
    """Draw a run: verdict, map with footholds, messages, and the walk over time.

    For a run that did not arrive, all parts mark the decisive moment; the picture also has a close-up and the precursors.

    Args:
        path: Output file, 1600 pixels wide; its suffix is the format.
        report: Report of the run.
        trace: Trace of the run; may be empty.
    """
    figure = figure_of(report, trace)
    whole_files.make_folder(path.parent)
    whole_files.write_by_name(path, figure.savefig)


def figure_of(report: Report, trace: Trace, truth: bool = True) -> Any:
    """Return the picture as a figure.

    Without ground truth it shows neither the goal nor whether it was reached.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    look: Any = {
        "font.size": _FONT,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "hatch.linewidth": 0.8,
        "hatch.color": _HATCH,
    }
    moment = decisive_moment(report, trace)
    if moment is not None and not truth and moment.words == ENDED:  # every recording ends this way
        moment = None
    low, high = extent_of(trace)
    share = float((high[1] - low[1]) / (high[0] - low[0]))
    wide = _WIDTH * (_RIGHT - _LEFT - _BAR)  # [in] for the map and the close-up, which is a square
    map_height = wide * share if moment is None else (wide - _GAP) * share / (1 + share)
    map_height = float(np.clip(map_height, *_MAP))
    room = (wide if moment is None else wide - _GAP - map_height) / _WIDTH
    near = map_height / _WIDTH
    lines = verdict(report, trace, moment) if truth else _without_verdict(report, trace, moment)
    above = head_height(lines)
    history = _HISTORY[moment is not None]
    tall = above + 0.25 + map_height + 0.5 + _LEGEND + 0.25 + history + 0.6
    with rc_context(look):
        figure = Figure(figsize=(_WIDTH, tall), dpi=_DPI, facecolor="white")
        title(figure, lines)
        bottom = 1 - (above + 0.25 + map_height) / tall
        ground = figure.add_axes((_LEFT, bottom, room, map_height / tall))
        told = history_picture.told_in_words(trace, moment)
        _draw_map(figure, ground, report, trace, moment, told, truth)
        if moment is not None:
            _draw_near(figure.add_axes((_RIGHT - near, bottom, near, map_height / tall)), report, trace, moment, (low, high))
        _draw_legend(figure, report, trace, truth, 1 - (above + 0.25 + map_height + 0.5) / tall)
        numbers = [row for row in _numbers(report) if truth or not row[0].startswith(_OF_TRUTH)]
        box = (0.085, 0.6 / tall, 0.565, history / tall)
        history_picture.draw(figure, box, trace, moment, moment_color(report), told, truth)
        draw_words(figure, (0.685, 0.45 / tall, 0.30, (history + 0.30) / tall), trace, moment, told, numbers)
    return figure


def moment_color(report: Report) -> str:
    """Return the colour of the decisive moment: red, or amber for a correct refusal."""
    return _AMBER if report.success else _BAD


# -- text


def verdict(report: Report, trace: Trace, moment: FailureMoment | None, most: int = 4) -> list[tuple[str, float, str]]:
    """Return the lines at the top with size [pt] and colour.

    They give the result, the reason in at most `most` lines, and the leg to look at.
    """
    arrived = report.success and report.reason == ARRIVED
    word = "Goal reached" if arrived else "Rightly refused" if report.success else "Failed"
    color = _GOOD if report.success else _BAD
    found: list[tuple[str, float, str]] = []
    if arrived:
        found.append((f"{word} in {report.duration_s:.1f} s at {100 * report.speed_mps:.1f} cm/s", 20.0, color))
    elif len(report.reason) <= 78:
        found.append((f"{word}: {report.reason}", 20.0, color))
    else:
        found.append((f"{word} {report.distance_m:.2f} m along, after {report.duration_s:.1f} s", 20.0, color))
        found += [(line, 13.0, color) for line in textwrap.wrap(report.reason, 142, max_lines=most, placeholder=" …")]
    refused = refusal(trace) if moment is not None else None
    if refused is not None and refused.words not in report.reason:
        words = f"The planner: {refused.words}"
        found += [(line, 13.0, "#222222") for line in textwrap.wrap(words, 142, max_lines=2, placeholder=" …")]
    if moment is not None and (words := _whose(trace, moment)):
        found.append((words, 13.0, "#222222"))
    own = replace(report, gait=steps_walked(trace)) if trace.sections else report  # a gap crossing has its own steps
    walk = f"{report.scenario} · seed {report.seed} · {report.robot} · {own.manner}"
    found.append((walk, float(_FONT), "#5f6368"))
    return found


def steps_walked(trace: Trace) -> str:
    """Return the number of steps by legs in swing, most frequent first."""
    counts = Counter(int(np.count_nonzero(plan.swing)) for _, plan in trace.plans if plan.swing.any())
    kinds = (f"{count} steps with {legs} leg{'s' if legs > 1 else ''} in swing" for legs, count in counts.most_common())
    return ", ".join(kinds) or "no steps"


def _without_verdict(report: Report, trace: Trace, moment: FailureMoment | None) -> list[tuple[str, float, str]]:
    """Return the lines at the top of a run without ground truth.

    They give the estimated distance and why the robot stopped.
    """
    words = f"Walked {report.distance_m:.2f} m" if trace.walking.any() else "Never walked"
    found = [(f"{words}, by its own estimate", 20.0, "#222222")]
    refused = refusal(trace) if moment is not None else None
    if refused is not None:
        words = f"The planner: {refused.words}"
        found += [(line, 13.0, _AMBER) for line in textwrap.wrap(words, 142, max_lines=4, placeholder=" …")]
    return [*found, (f"{report.robot} · {report.reason}", float(_FONT), "#5f6368")]


def _whose(trace: Trace, moment: FailureMoment) -> str:
    """Return which leg to look at and why; empty if none stands out."""
    of_leg = [sign for sign in signs(trace, moment) if sign.leg == moment.leg and sign.t < moment.t]
    if moment.leg < 0 or not of_leg:
        return ""
    ago = moment.t - of_leg[-1].t
    return f"Look at the {LEGS[moment.leg]} leg: {of_leg[-1].words}" + (f", {ago:.1f} s before." if ago >= 0.05 else ".")


def head_height(lines: Sequence[tuple[str, float, str]]) -> float:
    """Return the height [in] of the lines at the top."""
    return 0.25 + sum(_spacing(size) for _, size, _ in lines)


def _spacing(size: float) -> float:
    return size / 72 * 1.42


def title(figure: Any, lines: Sequence[tuple[str, float, str]]) -> None:
    """Draw the lines at the top."""
    y = 0.25
    for text, size, color in lines:
        at = 1 - y / figure.get_figheight()
        figure.text(_LEFT, at, text, size=size, weight="bold" if size > _FONT else None, color=color, va="top")
        y += _spacing(size)


def draw_words(
    figure: Any,
    box: tuple[float, float, float, float],
    trace: Trace,
    moment: FailureMoment | None,
    told: Sequence[StatusEvent],
    numbers: Sequence[tuple[str, str]],
) -> None:
    """Draw precursors and messages and, in the remaining space, the figures."""
    left, bottom, width, height = box
    tall = figure.get_figheight()
    room = height * tall  # [in]
    y = 0.0
    paragraphs: list[tuple[str, str, list[str]]] = []
    if moment is not None and (led := signs(trace, moment)):
        paragraphs.append(("Signs before it", "time", [f"{sign.t - moment.t:+.1f} s\t{sign.words}" for sign in led]))
    if told:
        paragraphs.append(("Reports of the services", "flag", [f"{k}\t{c.who}: {c.words}" for k, c in enumerate(told, 1)]))
    spare = room - _LINE * 1.25 * 6 - 1.3 * _LINE * len(paragraphs)  # for all text
    for heading, kind, rows_ in paragraphs:
        figure.text(left, bottom + height - y / tall, heading, size=13, weight="bold", va="top", color="#222222")
        y += 1.3 * _LINE
        indent = 0.052 if kind == "time" else 0.026
        for row in rows_:
            mark, words = row.split("\t", 1)
            lines = textwrap.wrap(words, round((width - indent) / 0.0050), max_lines=4, placeholder=" …") or [""]
            if spare < len(lines) * _LINE:
                figure.text(left + indent, bottom + height - y / tall, "…", size=11, va="top")
                y += _LINE
                break
            at = bottom + height - y / tall
            if kind == "flag":
                middle = at - 0.5 * _LINE / tall
                figure.text(
                    left + 0.008,
                    middle,
                    mark,
                    size=10,
                    weight="bold",
                    color="white",
                    ha="center",
                    va="center",
                    bbox={"boxstyle": "circle,pad=0.22", "fc": _BAD, "ec": "white", "lw": 0.8},
                )
            else:
                figure.text(left + 0.046, at, mark, size=11, va="top", ha="right", color="#5f6368")
            figure.text(left + indent, at, "\n".join(lines), size=11, va="top", color="#222222", linespacing=1.3)
            y += len(lines) * 0.87 * _LINE + 0.05
            spare -= len(lines) * 0.87 * _LINE + 0.05
        y += 0.12
    fitting = min(len(numbers), int((room - y) / (1.25 * _LINE)))
    if fitting > 0:
        taken = min(fitting * 0.42, room - y) / tall
        draw_table(figure.add_axes((left, bottom + height - y / tall - taken, width, taken)), numbers[:fitting])


# -- map


def _draw_map(
    figure: Any, axes: Any, report: Report, trace: Trace, moment: FailureMoment | None, told: Sequence[StatusEvent], truth: bool
) -> None:
    low, high = extent_of(trace)
    axes.set_facecolor(UNSEEN)  # colour of unseen ground
    axes.set_aspect("equal", anchor="W")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    if trace.mosaic is not None:
        draw_ground(figure, axes, trace.mosaic, low, high)
    draw_blocks(axes, trace)
    if truth:
        draw_course(axes, trace)
    draw_footholds(axes, trace)
    draw_paths(axes, trace, report)
    draw_flags(axes, trace, told)
    draw_moment(axes, report, moment)
    axes.set_xlabel("ahead [m]", labelpad=1)
    axes.set_ylabel("left [m]")


def _draw_legend(figure: Any, report: Report, trace: Trace, truth: bool, top: float) -> None:
    handles = legend_handles([trace], f"misstep ({report.missteps})")
    figure.legend(
        handles=[handle for handle in handles if truth or not str(handle.get_label()).startswith(_OF_TRUTH)],
        loc="upper left",
        bbox_to_anchor=(0.045, top),
        ncols=7,
        frameon=False,
        fontsize=11,
        handletextpad=0.5,
        columnspacing=1.6,
        borderaxespad=0.0,
    )


def extent_of(
    trace: Trace, before: float = _BEFORE, after: float = _AFTER, side: float = _SIDE
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners [m] {start} of the map.

    It contains the course with margins [m], and the whole path of the robot.
    """
    low, high = np.array([-before, -side]), np.array([trace.goal_distance + after, side])
    if len(trace.t):
        path = trace.p_true[:, :2]
        low = np.minimum(low, path.min(axis=0) - 0.3)
        high = np.maximum(high, path.max(axis=0) + 0.3)
    return low, high


def draw_ground(figure: Any, axes: Any, mosaic: Mosaic, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    """Draw the mapped ground between two corners [m] {start}, with its scale."""
    image = draw_cells(axes, mosaic, low, high)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    figure.draw_without_rendering()  # the map keeps its proportions, so its position is known only now
    box = axes.get_position()
    bar = figure.colorbar(image, cax=figure.add_axes((box.x1 + 0.008, box.y0, 0.010, box.height)))
    bar.set_label("mapped height [cm]" + (", where no colour is seen" if mosaic.color is not None else ""), size=11)
    bar.ax.tick_params(labelsize=10)
    bar.outline.set_visible(False)


def draw_cells(axes: Any, mosaic: Mosaic, low: NDArray[np.float64], high: NDArray[np.float64]) -> Any:
    """Draw the mapped ground; return the image of its heights.

    The colours cover the heights between two corners [m] {start}.
    """
    nx, ny = mosaic.elevation.shape
    first = mosaic.origin - mosaic.resolution / 2
    last = first + mosaic.resolution * np.array([nx, ny])
    extent = (first[0], last[0], first[1], last[1])
    shown = mosaic.elevation[_cells(mosaic, low, high)]
    known = shown[np.isfinite(shown)]
    bottom, top = np.percentile(known, [1, 99]).tolist() if len(known) else (0.0, 0.0)
    middle, half = (bottom + top) / 2, max((top - bottom) / 2, 0.015)  # level ground must not look mountainous
    image = axes.imshow(
        100 * mosaic.elevation.T,
        origin="lower",
        extent=extent,
        cmap=ground_colors(),
        vmin=100 * (middle - half),
        vmax=100 * (middle + half),
        interpolation="nearest",
        zorder=0,
    )
    x = mosaic.origin[0] + mosaic.resolution * np.arange(nx)
    y = mosaic.origin[1] + mosaic.resolution * np.arange(ny)
    seen = np.isfinite(mosaic.elevation)
    if mosaic.color is not None:
        colored = np.zeros((ny, nx, 4), dtype=np.uint8)
        colored[..., :3] = shaded(mosaic.color, mosaic.elevation, mosaic.resolution).swapaxes(0, 1)
        colored[..., 3] = 255 * (mosaic.color.any(axis=-1) & np.isfinite(mosaic.elevation)).T
        axes.imshow(colored, origin="lower", extent=extent, interpolation="nearest", zorder=0.5)
    tint = np.zeros((ny, nx, 4))
    tint[(mosaic.unacceptable & seen & ~mosaic.assumed).T] = _NO_FOOTHOLD
    axes.imshow(tint, origin="lower", extent=extent, interpolation="nearest", zorder=1)
    if (mosaic.assumed & seen).any():
        axes.contourf(x, y, (mosaic.assumed & seen).T.astype(float), levels=[0.5, 1.5], colors="none", hatches=["//"], zorder=1)
    return image


def _cells(mosaic: Mosaic, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[slice, slice]:
    first = np.maximum(np.floor((low - mosaic.origin) / mosaic.resolution), 0).astype(int)
    last = np.maximum(np.ceil((high - mosaic.origin) / mosaic.resolution), 0).astype(int)
    return slice(first[0], last[0]), slice(first[1], last[1])


def draw_blocks(axes: Any, trace: Trace) -> None:
    """Draw outlines of the true blocks, and mark those that give way."""
    from matplotlib.collections import PolyCollection

    if len(trace.blocks):
        axes.add_collection(
            PolyCollection(list(trace.blocks), facecolors="none", edgecolors="#222222", linewidths=0.9, zorder=2)
        )
    for corners in trace.blocks[trace.weak]:
        axes.fill(*corners.T, facecolor="none", edgecolor=_BAD, hatch="xx", lw=1.6, zorder=4)
        axes.annotate("gives way", corners.max(axis=0), (2, 2), textcoords="offset points", color=_BAD, size=11, zorder=9)


def draw_course(axes: Any, trace: Trace) -> None:
    """Draw start and goal."""
    goal, side = trace.goal_distance, trace.corridor
    axes.plot([goal, goal], [-side, side], color=_GOOD, lw=4, solid_capstyle="butt", zorder=5)
    axes.annotate("goal", (goal, side), (0, 4), textcoords="offset points", color=_GOOD, weight="bold", ha="center", zorder=9)
    axes.plot(0, 0, marker="o", ms=9, mfc="white", mec=TRUE, mew=2, zorder=8)
    axes.annotate("start", (0, 0), (-9, 0), textcoords="offset points", weight="bold", ha="right", va="center", zorder=9)


def draw_footholds(axes: Any, trace: Trace, size: float = 36.0) -> None:
    """Draw touchdowns by leg, and mark special ones.

    Marked are moved footholds, missed targets, missteps, and touchdowns without ground.
    """
    downs = trace.touchdowns
    for leg, color in enumerate(LEG_COLORS):
        xy = downs.p[downs.leg == leg]
        axes.scatter(xy[:, 0], xy[:, 1], s=size, c=color, edgecolors="white", linewidths=0.7, zorder=6)
    moved = downs.p[downs.moved]
    axes.scatter(moved[:, 0], moved[:, 1], s=3 * size, facecolors="none", edgecolors=TRUE, linewidths=1.3, zorder=6)
    for k in np.flatnonzero(missed_by(trace) > MISSED):
        wanted, found = downs.chosen[k], downs.p[k]
        axes.plot([wanted[0], found[0]], [wanted[1], found[1]], color=_BAD, lw=1.4, zorder=6)
        axes.scatter(*wanted[:2], s=1.3 * size, marker="D", facecolors="none", edgecolors=_BAD, linewidths=1.4, zorder=6)
    missed = downs.p[downs.misstep]
    axes.scatter(missed[:, 0], missed[:, 1], s=2 * size, c=_BAD, marker="x", linewidths=2.2, zorder=7)
    felt = trace.no_ground.p
    axes.scatter(felt[:, 0], felt[:, 1], s=2 * size, marker="v", facecolors="none", edgecolors=_BAD, linewidths=1.6, zorder=7)


def draw_flags(axes: Any, trace: Trace, told: Sequence[StatusEvent]) -> None:
    """Draw numbered flags where the robot was when it complained.

    Flags at the same place are combined.
    """
    if not len(trace.t):
        return
    low, high = axes.get_ylim()
    flags: list[tuple[NDArray[np.float64], list[int]]] = []
    for number, complaint in enumerate(told, 1):
        k = min(int(np.searchsorted(trace.t, complaint.begin)), len(trace.t) - 1)
        place = trace.p_true[k, :2]
        near = [numbers for other, numbers in flags if np.linalg.norm(place - other) < 0.07 * (high - low)]
        if near:
            near[0].append(number)
        else:
            flags.append((place, [number]))
    for place, numbers in flags:
        at = (float(place[0]), float(place[1]) + 0.085 * (high - low))
        history_picture.flag(axes, at, ",".join(map(str, numbers)))


def draw_moment(axes: Any, report: Report, moment: FailureMoment | None) -> None:
    """Mark the place of the decisive moment."""
    if moment is not None:
        axes.plot(*moment.p, marker="X", ms=14, mfc=moment_color(report), mec="white", mew=1.5, zorder=9)


def _draw_near(axes: Any, report: Report, trace: Trace, moment: FailureMoment, colors: tuple[Any, Any]) -> None:
    """Draw the robot at the decisive moment.

    It shows loaded legs, the support polygon, and the next footholds.
    """
    k = _instant(trace, moment)
    t = float(trace.t[k])
    middle = trace.p_true[k, :2]
    axes.set_facecolor(UNSEEN)
    axes.set_aspect("equal", adjustable="box", anchor="E")
    if trace.mosaic is not None:
        draw_cells(axes, trace.mosaic, *colors)
    draw_blocks(axes, trace)
    draw_footholds(axes, _until(trace, t), 55.0)
    feet, carrying = trace.feet[k], trace.carrying[k]
    body = apply(trace.T[k], _outline(trace.profile.body.size))
    axes.fill(body[:, 0], body[:, 1], facecolor="#ffffffb0", edgecolor=TRUE, lw=1.8, zorder=7)
    support = _around(feet[carrying, :2])
    if len(support) > 2:
        axes.fill(support[:, 0], support[:, 1], facecolor="#1a7f3722", edgecolor=_GOOD, lw=1.2, ls="--", zorder=5)
    coxae = apply(trace.T[k], trace.profile.T_body_coxa[:, :3, 3])
    wanted = _wanted(trace, t)
    for leg, color in enumerate(LEG_COLORS):
        line = np.stack([coxae[leg], feet[leg]])
        axes.plot(line[:, 0], line[:, 1], color=_BAD if leg == moment.leg else "#444444", lw=3.0, zorder=7)
        fill = color if carrying[leg] else "white"
        axes.scatter(*feet[leg, :2], s=150, c=fill, edgecolors=color, linewidths=2.5, zorder=8)
        if leg in wanted:
            place = wanted[leg]
            axes.plot([feet[leg, 0], place[0]], [feet[leg, 1], place[1]], color=color, lw=1.2, ls=":", zorder=7)
            axes.scatter(*place[:2], s=110, marker="D", facecolors="none", edgecolors=color, linewidths=2.0, zorder=8)
    centre = trace.p_true[k]
    axes.scatter(*centre[:2], s=60, marker="+", c=TRUE, linewidths=2.0, zorder=9)
    if moment.leg >= 0:
        out = feet[moment.leg, :2] - middle
        at = (14 * np.sign(out[0]), 14 * np.sign(out[1]))
        style: dict[str, Any] = {"color": _BAD, "weight": "bold", "size": 12, "ha": "center", "zorder": 10}
        axes.annotate(LEGS[moment.leg], feet[moment.leg, :2], (0.0, at[1]), textcoords="offset points", va="center", **style)
    axes.set_xlim(middle[0] - _AROUND, middle[0] + _AROUND)
    axes.set_ylim(middle[1] - _AROUND, middle[1] + _AROUND)
    ago = moment.t - t
    when = f"{ago:.1f} s before it {moment.words}" if ago > 0.05 else f"as it {moment.words}"
    if moment.words.endswith("shut down"):
        when = f"as the {moment.words}"
    axes.set_title(when, size=12, weight="bold", color=moment_color(report), loc="right")
    axes.set_xlabel("filled: carries · empty: does not · ◇ wanted", size=11, labelpad=1)


def _instant(trace: Trace, moment: FailureMoment) -> int:
    """Return the sample to show: of a fall, where the body left its support."""
    k = min(int(np.searchsorted(trace.t, moment.t)), len(trace.t) - 1)
    if moment.words != "fell":
        return k
    left = [sign.t for sign in signs(trace, moment) if "left its support" in sign.words and moment.t - sign.t < _LOOK_BACK]
    return int(np.searchsorted(trace.t, left[-1])) if left else k


def _until(trace: Trace, t: float) -> Trace:
    """Return the run with the touchdowns of the last seconds before a time."""
    downs, felt = trace.touchdowns, trace.no_ground
    kept, known = (downs.t <= t) & (downs.t > t - _LOOK_BACK), felt.t <= t
    chosen = Touchdowns(**{field.name: getattr(downs, field.name)[kept] for field in fields(downs)})
    return replace(trace, touchdowns=chosen, no_ground=Touches(felt.t[known], felt.leg[known], felt.p[known]))


def _wanted(trace: Trace, t: float) -> dict[int, NDArray[np.float64]]:
    """Return leg -> touchdown [m] {start} of the newest plan at a time."""
    made = [plan for at, plan in trace.plans if at <= t]
    if not made:
        return {}
    return {int(leg): made[-1].touchdown[leg] for leg in np.flatnonzero(made[-1].swing)}


def _outline(size: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.asarray(np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * np.array(size) / 2)


def _around(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (n, 2) sorted by angle around their mean."""
    if not len(points):
        return points
    out = points - points.mean(axis=0)
    return np.asarray(points[np.argsort(np.arctan2(out[:, 1], out[:, 0]))])


def draw_paths(axes: Any, trace: Trace, report: Report) -> None:
    """Draw the true, estimated and planned paths of the body."""
    for corners in trace.routes:
        axes.plot(corners[:, 0], corners[:, 1], color=_ROUTE, lw=1.1, alpha=0.8, zorder=3)
    axes.plot(trace.p_estimate[:, 0], trace.p_estimate[:, 1], color=ESTIMATE, lw=1.6, ls=(0, (4, 2)), zorder=5)
    axes.plot(trace.p_true[:, 0], trace.p_true[:, 1], color=TRUE, lw=2.0, zorder=4)
    if len(trace.t):
        end = trace.p_true[-1]
        axes.plot(end[0], end[1], marker="o", ms=13, mfc=_GOOD if report.success else _BAD, mec="white", mew=1.5, zorder=8)


def legend_handles(traces: Iterable[Trace], misstep: str = "misstep") -> list[Any]:
    """Return the legend's handles of walks on the map: paths, legs, then every other mark that is drawn."""
    from matplotlib.patches import Patch

    shown = list(traces)
    handles = [_line("true path", color=TRUE, lw=2), _line("estimated path", color=ESTIMATE, lw=1.6, ls=(0, (4, 2)))]
    if any(trace.routes for trace in shown):
        handles.append(_line("planned paths", color=_ROUTE, lw=1.1))
    handles += [_dot(name, mfc=color) for name, color in zip(LEGS, LEG_COLORS, strict=True)]
    handles += [
        _dot("foothold moved", mfc="none", mec=TRUE, ms=10, mew=1.3),
        _dot(misstep, marker="x", mec=_BAD, mew=2.2),
    ]
    if any(len(trace.no_ground.t) for trace in shown):
        handles.append(_dot("found no ground", marker="v", mfc="none", mec=_BAD, mew=1.6))
    if any((missed_by(trace) > MISSED).any() for trace in shown):
        handles.append(_dot("missed the chosen foothold", marker="D", mfc="none", mec=_BAD, mew=1.4))
    return [
        *handles,
        Patch(facecolor="none", edgecolor="#222222", label="true blocks"),
        Patch(facecolor=_NO_FOOTHOLD, label="no foothold by the map"),
        Patch(facecolor="#c3d9c3", hatch="///", lw=0, label="assumed, not seen"),
        Patch(facecolor=UNSEEN, label="never seen"),
    ]


def _dot(label: str, **look: Any) -> Any:
    return _line(label, **{"ls": "", "marker": "o", "ms": 7, "mec": "white"} | look)


def _line(label: str, **look: Any) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **look)


# -- numbers


def draw_table(axes: Any, rows: Sequence[tuple[str, str]]) -> None:
    """Draw rows of a name and a value."""
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    for k, (name, value) in enumerate(rows):
        y = 1.0 - (k + 0.5) / len(rows)
        if k % 2 == 0:
            axes.axhspan(y - 0.5 / len(rows), y + 0.5 / len(rows), color="#f1f1f1", lw=0)
        axes.text(0.02, y, name, va="center", size=12, color="#333333")
        axes.text(0.98, y, value, va="center", ha="right", size=12, weight="bold")


def _numbers(r: Report) -> list[tuple[str, str]]:
    return [
        ("distance · time · speed", f"{r.distance_m:.2f} m · {r.duration_s:.1f} s · {100 * r.speed_mps:.1f} cm/s"),
        ("steps · touchdowns", f"{r.steps} · {r.touchdowns}"),
        ("touchdowns raised · on blocks", f"{r.raised_touchdowns} · {r.raised_block_touchdowns}"),
        ("missteps", f"{r.missteps}"),
        ("falls · servos shut down", f"{r.falls} · {r.shutdowns}"),
        ("tilt p95 · max", f"{_n(r.tilt_deg.p95)} · {_n(r.tilt_deg.max)}°"),
        ("height error mean · rms", f"{_mm(r.body_height_error_m.mean, sign='+')} · {_mm(r.body_height_error_m.rms)} mm"),
        ("torque p95 · max · rms", f"{_n(r.torque_nm.p95)} · {_n(r.torque_nm.max)} · {_n(r.torque_nm.rms_worst_joint)} N m"),
        ("slip per step p50 · p95", f"{_mm(r.slip_m_per_step.p50)} · {_mm(r.slip_m_per_step.p95)} mm"),
        ("least stability margin", f"{_mm(r.min_stability_margin_m)} mm"),
        ("pose error rms · final", f"{_mm(r.pose_error_m.rms)} · {_mm(r.pose_error_m.final)} mm"),
        ("map error rmse · bias", f"{_mm(r.map_error_m.rmse)} · {_mm(r.map_error_m.bias, sign='+')} mm"),
        ("ground ahead known", f"{_n(100 * r.map_error_m.coverage, 0)} %"),
        ("image to plan p50 · p90 · p99", _latency(r.capture_to_plan_ms)),
        ("real-time factor", _n(r.real_time_factor)),
    ]


def _latency(t: CaptureToPlan) -> str:
    return f"{_n(t.p50, 0)} · {_n(t.p90, 0)} · {_n(t.p99, 0)} ms"


def _n(value: float, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def _mm(value: float, sign: str = "") -> str:
    return f"{1000 * value:{sign}z.1f}" if np.isfinite(value) else "–"  # z: never minus zero
