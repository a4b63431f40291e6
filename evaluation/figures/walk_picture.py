"""The plots of Lotriet 2024, chapter 8: body height, tilt, and paths of the feet.

The feet are shown from above and from the side.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.figures.thesis_figures import TESTS, Measured, Published, side_by_side
from sextant.evaluation.report import Report
from sextant.evaluation.trace.trace import Trace
from sextant.shared.files import whole_files
from sextant.shared.robot.profile import LEGS

LEG_COLORS = ("#d55e00", "#0072b2", "#56b4e9", "#332288", "#cc79a7", "#e69f00")  # distinguishable for most colour-blind readers
_SIZE, _DPI = (16.0, 15.0), 100
_TABLE = 2.2  # [in] extra height for the thesis' figures
_TRUE, _REFERENCE, _GROUND = "#111111", "#7f7f7f", "#8c6d46"
_THESIS = "#1a7f37"
_ROLL, _PITCH = "#0072b2", "#d55e00"


def draw(path: Path, report: Report, trace: Trace) -> bool:
    """Draw the plots of a run.

    Args:
        path: Output file, 1600 x 1500 pixels; its suffix is the format. It is taller for a test of the thesis, which adds a
            table of the thesis' figures.
        report: Report of the run.
        trace: Trace of the run.

    Returns:
        False if the robot never walked; then there is no picture.
    """
    if not trace.walking.any():
        return False
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"font.size": 13, "axes.spines.top": False, "axes.spines.right": False}):
        published = TESTS.get(report.scenario)
        size = _SIZE if published is None else (_SIZE[0], _SIZE[1] + _TABLE)
        ratios = (1.0, 1.0, 0.9, 1.5, 0.9) if published is None else (1.0, 1.0, 0.9, 1.5, 0.9, 0.9)
        figure = Figure(figsize=size, dpi=_DPI, facecolor="white", layout="constrained")
        height, tilt, foot, above, aside, *below = figure.subplots(len(ratios), 1, height_ratios=ratios).tolist()
        walk = f"{report.scenario}, seed {report.seed}, {report.robot}, {report.manner}"
        figure.suptitle(f"{walk}: {report.reason}", size=15)
        draw_height(height, trace)
        draw_tilt(tilt, trace)
        draw_one_foot(foot, trace, steadiest_leg(trace))
        draw_from_above(above, trace)
        draw_from_aside(aside, trace)
        if published is not None:
            _as_published(height, tilt, below[0], trace, published)
        whole_files.make_folder(path.parent)
        whole_files.write_by_name(path, figure.savefig)
    return True


def steadiest_leg(trace: Trace) -> int:
    """Return the leg with the least lateral motion, as Lotriet chose for Fig. 8.7."""
    feet = trace.feet[trace.walking, :, 1]
    return int(np.argmin(np.ptp(feet, axis=0)))


def draw_height(axes: Any, trace: Trace) -> None:
    """Draw body height over time, while walking."""
    axes.plot(trace.t, 100 * trace.height_reference, color=_REFERENCE, lw=2.5, label="commanded")
    axes.plot(trace.t, 100 * trace.p_true[:, 2], color=_TRUE, lw=1.2, label="true")
    axes.set_ylabel("body height [cm]")
    _as_it_walked(axes, trace)
    _zoom(axes, 100 * np.concatenate([trace.p_true[trace.walking, 2], trace.height_reference[trace.walking]]), 2.0)


def draw_tilt(axes: Any, trace: Trace) -> None:
    """Draw roll and pitch over time, while walking."""
    for k, (name, color) in enumerate((("roll", _ROLL), ("pitch", _PITCH))):
        reference = np.degrees(trace.attitude_reference[:, k])
        axes.plot(trace.t, reference, color=color, lw=2.5, alpha=0.35, label=f"{name}, commanded")
        axes.plot(trace.t, np.degrees(trace.attitude[:, k]), color=color, lw=1.0, label=f"{name}, true")
    axes.set_ylabel("tilt [deg]")
    axes.set_xlabel("simulated time [s]")
    _as_it_walked(axes, trace)
    both = np.concatenate([trace.attitude[trace.walking].ravel(), trace.attitude_reference[trace.walking].ravel()])
    _zoom(axes, np.degrees(both), 2.0)


def _as_it_walked(axes: Any, trace: Trace) -> None:
    walked = trace.t[trace.walking]
    axes.set_xlim(walked[0] - 0.5, walked[-1] + 0.5)
    axes.grid(alpha=0.25)
    axes.legend(loc="upper left", ncols=4, frameon=False, fontsize=11)


def _as_published(height: Any, tilt: Any, table: Any, trace: Trace, published: Published) -> None:
    """Add the thesis' figures as lines, and a table that compares them with the run."""
    if published.height_error_m is not None:
        level = 100 * (trace.height_reference + published.height_error_m)
        height.plot(trace.t, level, color=_THESIS, lw=1.5, ls="--", label="with the thesis' constant error")
        height.set_ylim(bottom=min(height.get_ylim()[0], float(np.nanmin(level)) - 0.5))
    for limit, style in ((published.tilt_deg, "--"), (published.jumps_deg, ":")):
        for sign in (-1, 1) if limit is not None else ():
            label = "thesis, mostly below" if style == "--" else "thesis, jumps"
            tilt.axhline(sign * (limit or 0.0), color=_THESIS, lw=1.5, ls=style, label=label if sign > 0 else None)
    for axes in (height, tilt):
        axes.legend(loc="upper left", ncols=6, frameon=False, fontsize=11)
    table.set_axis_off()
    cells = [("", f"thesis, section {published.section}", "here"), *side_by_side(published, Measured.of(trace))]
    drawn = table.table(cells, loc="center", cellLoc="left", edges="horizontal", colWidths=(0.4, 0.25, 0.25))
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(13)
    drawn.scale(1.0, 1.5)


def draw_one_foot(axes: Any, trace: Trace, leg: int) -> None:
    """Draw one foot's path from the side, above the ground."""
    feet = trace.feet[trace.walking, leg]
    axes.plot(feet[:, 0], 100 * trace.ground[trace.walking, leg], color=_GROUND, lw=2.0, label="ground under it")
    lowest = 100 * (feet[:, 2] - trace.profile.foot.radius)
    axes.plot(feet[:, 0], lowest, color=LEG_COLORS[leg], lw=1.3, label=f"{LEGS[leg]} foot")
    _side_view(axes, trace, leg)


def draw_from_above(axes: Any, trace: Trace) -> None:
    """Draw paths and touchdowns of all feet from above, and the body path."""
    from matplotlib.collections import PolyCollection

    if len(trace.blocks):
        axes.add_collection(PolyCollection(list(trace.blocks), facecolors="#f2ece2", edgecolors=_GROUND, linewidths=0.7))
    for leg, color in enumerate(LEG_COLORS):
        feet = trace.feet[trace.walking, leg]
        axes.plot(feet[:, 0], feet[:, 1], color=color, lw=0.9)
    axes.plot(trace.p_true[trace.walking, 0], trace.p_true[trace.walking, 1], color=_TRUE, lw=2.0)
    down = trace.touchdowns
    axes.scatter(down.p[:, 0], down.p[:, 1], s=34, c=[LEG_COLORS[k] for k in down.leg], edgecolors="white", zorder=3)
    axes.set_ylabel("feet from above:\nleft [m]")
    feet = trace.feet[trace.walking]
    axes.set_xlim(*_ahead(trace))
    axes.set_ylim(feet[..., 1].min() - 0.05, feet[..., 1].max() + 0.05)
    axes.set_aspect("equal", adjustable="box")


def draw_from_aside(axes: Any, trace: Trace) -> None:
    """Draw the paths of all feet from the side."""
    for leg, color in enumerate(LEG_COLORS):
        feet = trace.feet[trace.walking, leg]
        axes.plot(feet[:, 0], 100 * (feet[:, 2] - trace.profile.foot.radius), color=color, lw=0.9, label=LEGS[leg])
    _side_view(axes, trace, None)


def _side_view(axes: Any, trace: Trace, leg: int | None) -> None:
    feet = trace.feet[trace.walking] if leg is None else trace.feet[trace.walking, leg]
    axes.set_xlim(*_ahead(trace))
    _zoom(axes, 100 * (feet[..., 2].ravel() - trace.profile.foot.radius), 4.0)
    axes.set_ylabel("one foot's\nheight [cm]" if leg is not None else "feet from the side:\nheight [cm]")
    axes.set_xlabel("ahead [m]")
    axes.grid(alpha=0.25)
    axes.legend(loc="upper left", ncols=6, frameon=False, fontsize=11)


def _ahead(trace: Trace) -> tuple[float, float]:
    x = trace.feet[trace.walking, :, 0]
    return float(x.min()) - 0.05, float(x.max()) + 0.05


def _zoom(axes: Any, values: NDArray[np.float64], least: float) -> None:
    """Set limits that show nearly all values, with room for a legend above."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [0.2, 99.8]).tolist()
    spare = max(least - (high - low), 0.0) / 2 + 0.08 * (high - low)
    axes.set_ylim(low - spare, high + spare + 0.25 * (high - low + 2 * spare))
