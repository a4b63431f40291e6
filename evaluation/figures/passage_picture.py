"""Picture of a gap crossing: maps and plans at each stop, and the walked path."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.figures.layers_picture import UNSEEN
from sextant.evaluation.figures.summary import (
    draw_blocks,
    draw_course,
    draw_footholds,
    draw_ground,
    draw_paths,
    draw_table,
    extent_of,
    title,
    verdict,
)
from sextant.evaluation.figures.walk_picture import LEG_COLORS
from sextant.evaluation.report import Report
from sextant.evaluation.scoring.passage_metrics import steps_of
from sextant.evaluation.trace.trace import PlannedSection, Trace
from sextant.shared.files import whole_files
from sextant.shared.geometry import Array, apply, rotation_z, transform
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.wire.messages import UNKNOWN, PassageMap

_SIZE, _DPI, _FONT = (16.0, 15.0), 100, 13
_SECTIONS = ("#1f5fd0", "#8a2be2", "#00796b", "#b26a00", "#c2185b", "#455a64")  # colours, repeated from the seventh section on
_TRUE, _BAD, _MUTED = "#111111", "#b3261e", "#5f6368"
_BEFORE, _AFTER, _SIDE = 0.35, 0.35, 0.45  # [m] shown before the start, after the goal, and to both sides
_FURTHEST, _DEEPEST = 8, -5  # [cells] of the evaluation function beyond which its colour does not change
_ROWS = 6  # stops in the table
_SAME = 0.02  # [m] height difference below which ground counts as unchanged
_DASHES = (0, (5, 3))
_UNDER = 0.10  # [m] shown below the start's ground, in the side view


def draw(path: Path, report: Report, trace: Trace) -> None:
    """Draw a run over a gap.

    Args:
        path: Output file, 1600 x 1500 pixels; its suffix is the format.
        report: Report of the run.
        trace: Trace of the run, with planned sections.
    """
    figure = figure_of(report, trace)
    whole_files.make_folder(path.parent)
    whole_files.write_by_name(path, figure.savefig)


def figure_of(report: Report, trace: Trace) -> Any:
    """Return the picture as a figure."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"font.size": _FONT, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=_SIZE, dpi=_DPI, facecolor="white")
        title(figure, verdict(report, trace, None, most=1))
        planned, walked, aside = (
            figure.add_axes((0.070, bottom, 0.860, height))
            for bottom, height in ((0.627, 0.265), (0.325, 0.265), (0.230, 0.08))
        )
        _draw_planned(figure, planned, trace)
        _draw_walked(figure, walked, report, trace)
        box = walked.get_position()  # now with the map's proportions
        aside.set_position((box.x0, 0.230, box.width, 0.08))
        _draw_aside(aside, trace)
        _draw_sections(figure.add_axes((0.055, 0.015, 0.600, 0.165)), trace)
        draw_table(figure.add_axes((0.685, 0.015, 0.295, 0.165)), _numbers(report))
        figure.draw_without_rendering()  # while the font settings are active
    return figure


# -- top views


def _draw_planned(figure: Any, axes: Any, trace: Trace) -> None:
    """Draw the evaluation function, search trees, planned footholds and stances."""
    from matplotlib.collections import LineCollection

    _frame(axes, trace)
    images = [_draw_evaluation(axes, *strip) for strip in _strips([s.map for s in trace.sections if s.map is not None])]
    draw_blocks(axes, trace)
    for number, section in enumerate(trace.sections):
        plan, color = section.plan, _color(number)
        axes.add_collection(LineCollection(list(plan.tree_edges[..., :2]), colors=color, linewidths=0.5, alpha=0.55, zorder=3))
        if plan.state != "no way":
            _draw_way(axes, section, color)
            _draw_stance(axes, trace.profile, section, color)
    last = trace.sections[-1]
    if last.plan.state == "no way":  # earlier failures were followed by another look or other samples
        _draw_dead_end(axes, trace.profile, last, _color(len(trace.sections) - 1))
    ways = [s.plan for s in trace.sections if s.plan.state != "no way"]
    for leg, color in enumerate(LEG_COLORS):
        xy = np.concatenate([np.zeros((0, 2)), *(plan.footholds[plan.leg == leg, :2] for plan in ways)])
        axes.scatter(xy[:, 0], xy[:, 1], s=34, c=color, edgecolors="white", linewidths=0.7, zorder=6, label=LEGS[leg])
    axes.set_ylabel("planned:\nleft [m]")
    axes.tick_params(labelbottom=False)
    if images:
        _bar(figure, axes, images[-1])
    handles = [*axes.get_legend_handles_labels()[0], *_planned_legend(_color(0))]
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=9, frameon=False, fontsize=11, columnspacing=1.2
    )


def _planned_legend(color: str) -> list[Any]:
    from matplotlib.lines import Line2D

    lines = (("tree of body positions", 0.6), ("body", 2.0), ("stance at a section's end", 1.4))
    return [Line2D([], [], color=color, lw=width, label=label) for label, width in lines]


def _strips(maps: Sequence[PassageMap]) -> list[tuple[PassageMap, Array]]:
    """Return a map of each strip with the evaluation function (nx, ny) [cells].

    It combines all maps of the strip; NaN is unknown. A newer map takes precedence, except where the height is unchanged and an
    older map rated the cell as a better foothold: there the newer map has forgotten neighbouring cells.
    """
    strips: list[tuple[PassageMap, Array, Array]] = []
    for known in maps:
        cells = np.where(known.evaluation == UNKNOWN, np.nan, known.evaluation.astype(np.float64))
        heights = known.elevation.astype(np.float64)
        cells[np.isnan(heights)] = np.nan
        if strips and _lies_as(known, strips[-1][0]):
            _, before, was = strips.pop()
            same = np.abs(heights - was) < _SAME
            cells = np.where(np.isnan(cells) | (same & (before < cells)), before, cells)
            heights = np.where(np.isnan(heights), was, heights)
        strips.append((known, cells, heights))
    return [(known, cells) for known, cells, _ in strips]


def _lies_as(a: PassageMap, b: PassageMap) -> bool:
    same = a.elevation.shape == b.elevation.shape and a.resolution == b.resolution and a.heading == b.heading
    return same and np.array_equal(a.origin, b.origin)


def _draw_evaluation(axes: Any, known: PassageMap, cells: Array) -> Any:
    """Draw a strip's evaluation function at its place; unknown cells are transparent."""
    from matplotlib.colors import TwoSlopeNorm
    from matplotlib.transforms import Affine2D

    r, (nx, ny) = known.resolution, cells.shape
    extent = (-r / 2, r * nx - r / 2, -r / 2, r * ny - r / 2)
    scale: dict[str, Any] = {"cmap": _evaluation_colors(), "norm": TwoSlopeNorm(0.0, _DEEPEST, _FURTHEST)}
    image = axes.imshow(cells.T, origin="lower", extent=extent, interpolation="nearest", **scale)
    image.set_transform(Affine2D().rotate(known.heading).translate(*known.origin) + axes.transData)
    return image


def _evaluation_colors() -> Any:
    """Return a pale colour map, on which trees are visible.

    Footholds are green, darker where better; all other cells are sand-coloured.
    """
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("evaluation", ["#3fa796", "#d5eee9", "#fdf3e3", "#d3b48a"])


def _draw_way(axes: Any, section: PlannedSection, color: str, **style: Any) -> None:
    """Draw the body path from its starting position."""
    path = np.vstack([section.p[:2], section.plan.body[:, :2]])
    axes.plot(path[:, 0], path[:, 1], color=color, **{"lw": 2.0, "zorder": 5} | style)


def _draw_stance(axes: Any, profile: RobotProfile, section: PlannedSection, color: str, **style: Any) -> None:
    """Draw body and legs at a section's end, or the current stance without steps."""
    plan = section.plan
    feet = stance_at_end(section)
    T = transform(rotation_z(plan.heading), plan.body[-1] if len(plan.body) else section.p)
    half = np.array(profile.body.size) / 2
    corners = apply(T, np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]]) * half)
    axes.plot(corners[:, 0], corners[:, 1], color=color, **{"lw": 1.6, "zorder": 5} | style)
    coxae = apply(T, profile.T_body_coxa[:, :3, 3])
    for coxa, foot in zip(coxae, feet, strict=True):
        axes.plot([coxa[0], foot[0]], [coxa[1], foot[1]], color=color, **{"lw": 1.6, "alpha": 0.8, "zorder": 5} | style)


def stance_at_end(section: PlannedSection) -> Array:
    """Return foot centres (6, 3) [m] {start} at a section's end.

    They are the last foothold of each leg, or its starting position.
    """
    feet = section.feet.copy()
    for leg, foothold in zip(section.plan.leg, section.plan.footholds, strict=True):
        if leg < len(LEGS):
            feet[leg] = foothold
    return feet


def _draw_dead_end(axes: Any, profile: RobotProfile, section: PlannedSection, color: str) -> None:
    """Draw how far a failed search came.

    It draws path, footholds and stance, and the foot or body that fails a test.
    """
    plan = section.plan
    _draw_way(axes, section, _MUTED, lw=1.4, ls=_DASHES)
    _draw_stance(axes, profile, section, _MUTED, lw=1.3, ls=_DASHES)
    for leg, leg_color in enumerate(LEG_COLORS):
        xy = plan.footholds[plan.leg == leg, :2]
        axes.scatter(xy[:, 0], xy[:, 1], s=20, facecolors="none", edgecolors=leg_color, linewidths=1.0, alpha=0.8, zorder=6)
    axes.scatter(plan.failure_point[:, 0], plan.failure_point[:, 1], s=150, c=_BAD, marker="X", edgecolors="white", zorder=8)
    for place in plan.failure_point:
        style: dict[str, Any] = {"textcoords": "offset points", "color": _BAD, "size": 11, "weight": "bold", "zorder": 9}
        axes.annotate("stopped here", place[:2], (9, 6), **style)
    along = np.array([np.cos(plan.heading), np.sin(plan.heading)])
    across = np.array([-along[1], along[0]])
    middle = plan.origin + plan.furthest * along
    ends = np.stack([middle - _SIDE * across, middle + _SIDE * across])
    axes.plot(ends[:, 0], ends[:, 1], color=color, lw=2.0, ls=_DASHES, zorder=7)
    words = f"furthest {100 * plan.furthest:.0f} of {100 * plan.goal:.0f} cm"
    axes.annotate(words, ends[0], (4, 4), textcoords="offset points", color=color, size=11, weight="bold", zorder=9)


def _draw_walked(figure: Any, axes: Any, report: Report, trace: Trace) -> None:
    """Draw the mapped heights, the true pillars, and the paths of feet and body."""
    low, high = _frame(axes, trace)
    if trace.mosaic is not None:
        draw_ground(figure, axes, trace.mosaic, low, high)
    draw_blocks(axes, trace)
    draw_course(axes, trace)
    draw_footholds(axes, trace)
    draw_paths(axes, trace, report)
    axes.set_ylabel("walked:\nleft [m]")
    axes.tick_params(labelbottom=False)


def _frame(axes: Any, trace: Trace) -> tuple[Array, Array]:
    """Set up a top view; return its corners [m] {start}."""
    low, high = extent_of(trace, _BEFORE, _AFTER, _SIDE)
    axes.set_facecolor(UNSEEN)
    axes.set_aspect("equal", anchor="W")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    return low, high


def _bar(figure: Any, axes: Any, image: Any) -> None:
    axes.set_xlim(axes.get_xlim())
    figure.draw_without_rendering()  # the map keeps its proportions, so its position is known only now
    box = axes.get_position()
    bar = figure.colorbar(image, cax=figure.add_axes((box.x1 + 0.008, box.y0, 0.010, box.height)))
    bar.set_label("evaluation [cells]:\na foothold below 0", size=11)
    bar.ax.tick_params(labelsize=10)
    bar.outline.set_visible(False)


# -- side view


def _draw_aside(axes: Any, trace: Trace) -> None:
    """Draw heights along the path: strips, feet, planned and walked body."""
    for section in trace.sections:
        if section.map is not None:
            x, top = _skyline(section.map)
            axes.fill_between(x, 100 * top, -100, color="#d9c3a0", lw=0, zorder=1)
    walking = trace.walking
    for leg, color in enumerate(LEG_COLORS):
        feet = trace.feet[walking, leg]
        axes.plot(feet[:, 0], 100 * (feet[:, 2] - trace.profile.foot.radius), color=color, lw=0.7, zorder=3)
    axes.plot(trace.p_true[:, 0], 100 * trace.p_true[:, 2], color=_TRUE, lw=1.8, zorder=4)
    for number, section in enumerate(trace.sections):
        body = section.plan.body
        axes.plot(body[:, 0], 100 * body[:, 2], color=_color(number), lw=1.4, ls=(0, (4, 2)), zorder=5)
    highest = float(trace.p_true[:, 2].max()) if len(trace.t) else 0.1
    low, high = extent_of(trace, _BEFORE, _AFTER, _SIDE)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(-100 * _UNDER, 100 * (highest + 0.03))
    axes.set_xlabel("ahead [m]", labelpad=1)
    axes.set_ylabel("height\n[cm]")
    axes.grid(alpha=0.25)


def _skyline(known: PassageMap) -> tuple[Array, NDArray[np.floating]]:
    """Return a strip's x positions (n,) [m] {start} and highest ground (n,) [m]."""
    seen = np.isfinite(known.elevation)
    top = np.where(seen.any(axis=1), np.where(seen, known.elevation, -np.inf).max(axis=1), np.nan)
    middle = known.resolution * (known.elevation.shape[1] - 1) / 2
    x = known.origin[0] + known.resolution * np.arange(len(top)) * np.cos(known.heading) - middle * np.sin(known.heading)
    return x, top


# -- text and numbers


def _draw_sections(axes: Any, trace: Trace) -> None:
    """Draw a table of the last stops, and below it why the last one ended."""
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    columns = (
        (0.00, "stop"),
        (0.08, "came to"),
        (0.22, "n_g"),
        (0.33, "n_e"),
        (0.44, "time"),
        (0.56, "steps"),
        (0.66, "gets to"),
    )
    shown = list(enumerate(trace.sections))[-_ROWS:]
    last = trace.sections[-1].plan
    said = textwrap.wrap(last.reason, 96, max_lines=3, placeholder=" …")
    spacing = 1.0 / max(len(shown) + len(said) + 1, 7)
    rows = [
        ("#666666", [name for _, name in columns]),
        *((_color(number), _cells(number, section)) for number, section in shown),
    ]
    for row, (color, cells) in enumerate(rows):
        for (x, _), cell in zip(columns, cells, strict=True):
            axes.text(x, 1.0 - (row + 0.5) * spacing, cell, size=12, weight="bold" if row else None, color=color, va="center")
    for row, line in enumerate(said, len(rows)):
        color = _BAD if last.state == "no way" else "#333333"
        axes.text(0.0, 1.0 - (row + 0.5) * spacing, line, size=12, color=color, va="center")


def _cells(number: int, section: PlannedSection) -> list[str]:
    plan = section.plan
    reach = f"{100 * plan.furthest:.0f} of {100 * plan.goal:.0f} cm"
    time = f"{plan.planning_ms:.1f} ms" if plan.planning_ms < 1000 else f"{plan.planning_ms / 1e3:.1f} s"
    counts = [str(plan.generated_nodes), str(plan.expanded_nodes), time, str(steps_of(plan))]
    return [str(number + 1), plan.state, *counts, reach]


def _numbers(r: Report) -> list[tuple[str, str]]:
    edge = r.passage.foothold_edge_m
    distance = f"{1e3 * edge.median:.0f} · {1e3 * edge.p05:.0f} mm" if np.isfinite(edge.median) else "–"
    return [
        ("distance · time", f"{r.distance_m:.2f} m · {r.duration_s:.0f} s"),
        ("steps · touchdowns", f"{r.steps} · {r.touchdowns}"),
        ("on pillars · off them", f"{r.passage.pillar_touchdowns} · {r.passage.feet_off}"),
        ("from the edge median · p05", distance),
        ("falls · servos shut down", f"{r.falls} · {r.shutdowns}"),
        (
            "least stability margin",
            f"{1e3 * r.min_stability_margin_m:.0f} mm" if np.isfinite(r.min_stability_margin_m) else "–",
        ),
        ("tilt p95 · max", f"{r.tilt_deg.p95:.2f} · {r.tilt_deg.max:.2f}°" if np.isfinite(r.tilt_deg.p95) else "–"),
    ]


def _color(number: int) -> str:
    return _SECTIONS[number % len(_SECTIONS)]
