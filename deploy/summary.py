"""One picture of a run, for people, who look before they read: map, paths, footholds, and the walk over time."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deploy.layers_picture import UNSEEN, ground_colors
from deploy.map_metrics import Mosaic
from deploy.relief import shaded
from deploy.report import ARRIVED, Report
from deploy.trace import Trace
from deploy.walk_picture import LEG_COLORS
from shared.robot import LEGS

_SIZE = (16.0, 12.0)  # [in]
_DPI = 100
_FONT = 13  # [pt]
_GOOD, _BAD = "#1a7f37", "#b3261e"
_TRUE, _ESTIMATE, _REFERENCE, _ROUTE = "#111111", "#d01c8b", "#7f7f7f", "#1f5fd0"
_NO_FOOTHOLD, _HATCH = (0.70, 0.10, 0.08, 0.5), "#00000045"
_SIDE = 0.62  # [m] least of the map shown to both sides of the line
_BEFORE, _AFTER = 0.45, 0.45  # [m] of the map shown before the start and after the goal


def draw(path: Path, report: Report, trace: Trace) -> None:
    """Draw a run.

    Args:
        path: Of the picture, 1600 x 1200 pixels, in the format of its suffix.
        report: What it came to.
        trace: How it went; may be empty.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    look: Any = {
        "font.size": _FONT,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "hatch.linewidth": 0.8,
        "hatch.color": _HATCH,
    }
    with rc_context(look):
        figure = Figure(figsize=_SIZE, dpi=_DPI, facecolor="white")
        FigureCanvasAgg(figure)
        title(figure, report)
        ground = figure.add_axes((0.055, 0.505, 0.875, 0.40))
        _draw_map(figure, ground, report, trace)
        rows = [figure.add_axes((0.075, bottom, 0.575, 0.102)) for bottom in (0.290, 0.172, 0.054)]
        _draw_curves(rows, trace)
        draw_table(figure.add_axes((0.685, 0.025, 0.295, 0.385)), _numbers(report))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def title(figure: Any, report: Report) -> None:
    """The verdict in words, and what was walked."""
    walk = f"{report.scenario} · seed {report.seed} · {report.robot} · {report.gait}" + (" · blind" if report.blind else "")
    arrived = report.success and report.reason == ARRIVED
    verdict = "Goal reached" if arrived else "Rightly refused" if report.success else "Failed"
    words = "" if arrived else f": {report.reason}"
    facts = f" in {report.duration_s:.1f} s at {100 * report.speed_mps:.1f} cm/s" if arrived else ""
    lines = textwrap.wrap(verdict + words + facts, 100, max_lines=2, placeholder=" …")
    color = _GOOD if report.success else _BAD
    first, second = np.array([0.30, 0.744 if len(lines) == 1 else 0.996]) / figure.get_figheight()  # [in] from the top
    figure.text(0.055, 1 - first, "\n".join(lines), size=20 if len(lines) == 1 else 17, weight="bold", color=color, va="top")
    figure.text(0.055, 1 - second, walk, size=_FONT, color="#444444", va="top")


# -- the map


def _draw_map(figure: Any, axes: Any, report: Report, trace: Trace) -> None:
    low, high = _extent(trace)
    axes.set_facecolor(UNSEEN)  # never seen
    axes.set_aspect("equal", anchor="W")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    if trace.mosaic is not None:
        draw_ground(figure, axes, trace.mosaic, low, high)
    draw_blocks(axes, trace)
    draw_course(axes, trace)
    draw_footholds(axes, trace)
    draw_paths(axes, trace, report)
    axes.set_xlabel("ahead [m]", labelpad=1)
    axes.set_ylabel("left [m]")
    figure.legend(
        handles=_legend(report, trace),
        loc="upper left",
        bbox_to_anchor=(0.045, 0.468),
        ncols=7,
        frameon=False,
        fontsize=11,
        handletextpad=0.5,
        columnspacing=1.8,
        borderaxespad=0.0,
    )


def _extent(trace: Trace) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners [m] {start} of what is shown: the course, and wherever the robot went."""
    low, high = np.array([-_BEFORE, -_SIDE]), np.array([trace.goal_distance + _AFTER, _SIDE])
    if len(trace.t):
        path = trace.p_true[:, :2]
        low = np.minimum(low, path.min(axis=0) - 0.3)
        high = np.maximum(high, path.max(axis=0) + 0.3)
    return low, high


def draw_ground(figure: Any, axes: Any, mosaic: Mosaic, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    """The mapped ground between two corners [m] {start}, with its scale beside."""
    nx, ny = mosaic.elevation.shape
    first = mosaic.origin - mosaic.resolution / 2
    last = first + mosaic.resolution * np.array([nx, ny])
    extent = (first[0], last[0], first[1], last[1])
    shown = mosaic.elevation[_cells(mosaic, low, high)]
    known = shown[np.isfinite(shown)]
    bottom, top = np.percentile(known, [1, 99]).tolist() if len(known) else (0.0, 0.0)
    middle, half = (bottom + top) / 2, max((top - bottom) / 2, 0.015)  # level ground is not to look like mountains
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
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    figure.canvas.draw()  # the map keeps its proportions, so only now its place is known
    box = axes.get_position()
    bar = figure.colorbar(image, cax=figure.add_axes((box.x1 + 0.008, box.y0, 0.010, box.height)))
    bar.set_label("mapped height [cm]" + (", where no colour is seen" if mosaic.color is not None else ""), size=11)
    bar.ax.tick_params(labelsize=10)
    bar.outline.set_visible(False)


def _cells(mosaic: Mosaic, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[slice, slice]:
    first = np.maximum(np.floor((low - mosaic.origin) / mosaic.resolution), 0).astype(int)
    last = np.maximum(np.ceil((high - mosaic.origin) / mosaic.resolution), 0).astype(int)
    return slice(first[0], last[0]), slice(first[1], last[1])


def draw_blocks(axes: Any, trace: Trace) -> None:
    """Outlines of the true blocks."""
    from matplotlib.collections import PolyCollection

    if len(trace.blocks):
        axes.add_collection(
            PolyCollection(list(trace.blocks), facecolors="none", edgecolors="#222222", linewidths=0.9, zorder=2)
        )


def draw_course(axes: Any, trace: Trace) -> None:
    """Start and goal."""
    goal, side = trace.goal_distance, trace.corridor
    axes.plot([goal, goal], [-side, side], color=_GOOD, lw=4, solid_capstyle="butt", zorder=5)
    axes.annotate("goal", (goal, side), (0, 4), textcoords="offset points", color=_GOOD, weight="bold", ha="center", zorder=9)
    axes.plot(0, 0, marker="o", ms=9, mfc="white", mec=_TRUE, mew=2, zorder=8)
    axes.annotate("start", (0, 0), (-9, 0), textcoords="offset points", weight="bold", ha="right", va="center", zorder=9)


def draw_footholds(axes: Any, trace: Trace) -> None:
    """Where feet came down, by leg; those that were moved, and those that were mistaken."""
    downs = trace.touchdowns
    for leg, color in enumerate(LEG_COLORS):
        xy = downs.p[downs.leg == leg]
        axes.scatter(xy[:, 0], xy[:, 1], s=36, c=color, edgecolors="white", linewidths=0.7, zorder=6)
    moved = downs.p[downs.moved]
    axes.scatter(moved[:, 0], moved[:, 1], s=105, facecolors="none", edgecolors=_TRUE, linewidths=1.3, zorder=6)
    missed = downs.p[downs.misstep]
    axes.scatter(missed[:, 0], missed[:, 1], s=75, c=_BAD, marker="x", linewidths=2.2, zorder=7)


def draw_paths(axes: Any, trace: Trace, report: Report) -> None:
    """Where the body went, in truth and by its own estimate, and where it was to go."""
    for corners in trace.routes:
        axes.plot(corners[:, 0], corners[:, 1], color=_ROUTE, lw=1.1, alpha=0.8, zorder=3)
    axes.plot(trace.p_estimate[:, 0], trace.p_estimate[:, 1], color=_ESTIMATE, lw=1.6, ls=(0, (4, 2)), zorder=5)
    axes.plot(trace.p_true[:, 0], trace.p_true[:, 1], color=_TRUE, lw=2.0, zorder=4)
    if len(trace.t):
        end = trace.p_true[-1]
        color = _GOOD if report.success else _BAD
        axes.plot(end[0], end[1], marker="o" if report.success else "X", ms=13, mfc=color, mec="white", mew=1.5, zorder=8)


def _legend(report: Report, trace: Trace) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def dot(label: str, **look: Any) -> Line2D:
        chosen: dict[str, Any] = {"marker": "o", "ms": 7, "mec": "white"} | look
        return Line2D([], [], ls="", label=label, **chosen)

    legs = [dot(name, mfc=color) for name, color in zip(LEGS, LEG_COLORS, strict=True)]
    rest = [
        dot("foothold moved", mfc="none", mec=_TRUE, ms=10, mew=1.3),
        dot(f"misstep ({report.missteps})", marker="x", mec=_BAD, mew=2.2),
        Patch(facecolor="none", edgecolor="#222222", label="true blocks"),
        Patch(facecolor=_NO_FOOTHOLD, label="no foothold by the map"),
        Patch(facecolor="#c3d9c3", hatch="///", lw=0, label="assumed, not seen"),
        Patch(facecolor=UNSEEN, label="never seen"),
    ]
    paths = [
        Line2D([], [], color=_TRUE, lw=2, label="true path"),
        Line2D([], [], color=_ESTIMATE, lw=1.6, ls=(0, (4, 2)), label="estimated path"),
    ]
    if trace.routes:
        paths.append(Line2D([], [], color=_ROUTE, lw=1.1, label="planned ways"))
    # A legend fills its columns first; these are its two rows.
    return paths + [handle for pair in zip(legs, rest, strict=True) for handle in pair]


# -- over time


def _draw_curves(rows: list[Any], trace: Trace) -> None:
    height, tilt, torque = rows
    height.plot(trace.t, 100 * trace.height_reference, color=_REFERENCE, lw=2.5, label="commanded")
    height.plot(trace.t, 100 * trace.p_true[:, 2], color=_TRUE, lw=1.2, label="true")
    height.plot(trace.t_estimate, 100 * trace.p_estimate[:, 2], color=_ESTIMATE, lw=1.0, ls=(0, (4, 2)), label="estimated")
    _zoom(height, [100 * trace.height_reference, 100 * trace.p_true[:, 2]], least=2.0)
    height.set_ylabel("body\nheight [cm]")
    height.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=3, frameon=False, fontsize=11, borderaxespad=0.0)
    tilt.plot(trace.t, np.degrees(trace.tilt), color="#0072b2", lw=1.2)
    tilt.set_ylabel("tilt off\ncommand [°]")
    _zoom(tilt, [np.degrees(trace.tilt)], least=1.0, floor=0.0)
    torque.plot(trace.t, trace.torque_worst, color="#d55e00", lw=0.9)
    stall = trace.profile.servo.stall_torque
    torque.axhline(stall, color=_BAD, lw=1.2, ls=":")
    torque.annotate("stall", (1.0, stall), xycoords=("axes fraction", "data"), ha="right", va="bottom", color=_BAD, size=11)
    torque.set_ylim(0.0, 1.2 * stall)
    torque.set_ylabel("highest\ntorque [N m]")
    torque.set_xlabel("simulated time [s]", labelpad=2)
    end = float(trace.t[-1]) if len(trace.t) else 1.0
    for axes in rows:
        axes.set_xlim(0.0, max(end, 1e-3))
        axes.grid(alpha=0.25)
        for begin, until in _spans(trace):
            axes.axvspan(begin, until, color="#0072b2", alpha=0.06, lw=0)
        if axes is not torque:
            axes.tick_params(labelbottom=False)


def _zoom(axes: Any, curves: list[NDArray[np.float64]], least: float, floor: float | None = None) -> None:
    """Limits that show nearly all of the curves; what a fall adds to them would hide the walk."""
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    if not len(values):
        return
    low, high = np.percentile(values, [0.5, 99.5]).tolist()
    low = low if floor is None else floor
    spare = max(least - (high - low), 0.0) / 2 + 0.08 * (high - low)
    axes.set_ylim(low - (spare if floor is None else 0.0), high + (spare if floor is None else 2 * spare))


def _spans(trace: Trace) -> list[tuple[float, float]]:
    """When it walked [s]; pauses of less than half a second do not interrupt a walk."""
    walking = np.flatnonzero(trace.walking)
    if not len(walking):
        return []
    breaks = np.flatnonzero(np.diff(trace.t[walking]) > 0.5)
    begins = walking[np.concatenate([[0], breaks + 1])]
    ends = walking[np.concatenate([breaks, [len(walking) - 1]])]
    return list(zip(trace.t[begins].tolist(), trace.t[ends].tolist(), strict=True))


# -- in numbers


def draw_table(axes: Any, rows: Sequence[tuple[str, str]]) -> None:
    """Rows of a name and a value."""
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
        ("real-time factor", _n(r.real_time_factor)),
    ]


def _n(value: float, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def _mm(value: float, sign: str = "") -> str:
    return f"{1000 * value:{sign}.1f}" if np.isfinite(value) else "–"
