"""Masri 2016, chapter 6: the three layouts, the maps, the crossings and the planning times."""

from typing import Any

import numpy as np

from sextant.evaluation.figures.layers_picture import UNSEEN, ground_colors
from sextant.evaluation.figures.walk_picture import LEG_COLORS
from sextant.evaluation.theses import planner_table
from sextant.evaluation.theses.data import Data
from sextant.evaluation.theses.stills import draw_stills, stills, true_terrain
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.terrain import Pillars
from sextant.shared.wire.messages import UNKNOWN

TRIALS = 3  # of each scenario, as in the thesis
_AREA = (0.2, 2.2), (-0.6, 0.6)  # [m] x and y of the layouts
_MOST = 4  # pictures of a crossing


def draw_layouts(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.1: the three layouts from above."""
    (x0, x1), (y0, y1) = _AREA
    values = []
    panels = figure.subplots(1, len(planner_table.LAYOUTS), sharey=True)
    for axes, name in zip(panels, planner_table.LAYOUTS, strict=True):
        z = true_terrain(name, data.seed).raster(x0, y0, round(100 * (x1 - x0)), round(100 * (y1 - y0)), 0.01)
        image = axes.imshow(100 * z, origin="lower", extent=(y0, y1, x0, x1), cmap="gray", vmin=-45, vmax=8)
        axes.set_xlim(y1, y0)
        axes.set_title(name)
        axes.set_xlabel("left [m]")
        rows = [part for part in load_scenario(name).terrain if isinstance(part, Pillars)]
        values.append(f"{sum(len(part.xy) for part in rows)}")
    panels[0].set_ylabel("ahead [m]")
    figure.colorbar(image, ax=list(panels), label="height [cm]", shrink=0.8)
    (first, second), length = rows[-1].xy, rows[-1].length
    return [*values, f"{100 * (second[0] - first[0] - length):.0f} cm, and up to 1 cm more or less by the seed"]


def draw_start(figure: Any, data: Data, layout: str) -> list[str]:
    """Draw figures 6.2, 6.5 and 6.8: the robot in front of the gap."""
    begin = data.run(layout).begin
    draw_stills([figure.subplots()], stills(data.recording(layout), layout, data.seed, [begin], (960, 480)), [""])
    return []


def draw_crossing(figure: Any, data: Data, layout: str) -> list[str]:
    """Draw figures 6.3, 6.7 and 6.9: the robot where it plans, on the pillars, and at the end."""
    run = data.run(layout)
    planned = [1e-9 * section.plan.stamp_ns for section in run.trace.sections]
    end = float(run.trace.t[-1])
    times = sorted({*planned, 0.5 * (planned[0] + planned[-1] if len(planned) > 1 else planned[0] + end), end})[-_MOST:]
    titles = [("plans at " if t in planned else "") + f"{t:.0f} s" for t in times]
    axes = figure.subplots(1, len(times))
    draw_stills(np.atleast_1d(axes).tolist(), stills(data.recording(layout), layout, data.seed, times, (520, 400)), titles)
    reports = [data.run(layout, trial).report for trial in range(TRIALS)]
    return [
        f"{sum(one.success for one in reports)} of {TRIALS}, {sum(one.falls for one in reports)} falls",
        ", ".join(str(len(one.passage.sections)) for one in reports),
    ]


def draw_maps(figure: Any, data: Data, layout: str) -> list[str]:
    """Draw figures 6.4, 6.6 and 6.10: the map of the strip, its foothold map, and the planned footholds."""
    run = data.run(layout)
    section = max((one for one in run.trace.sections if one.map is not None), key=lambda one: len(one.plan.leg))
    known = section.map
    assert known is not None
    r, (nx, ny) = known.resolution, known.elevation.shape
    c, s = np.cos(known.heading), np.sin(known.heading)
    extent = (0.0, r * ny, 0.0, r * nx)
    foothold = np.where(known.evaluation == UNKNOWN, np.nan, (known.evaluation < 0).astype(float))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, layer, style, title in (
        (panels[0], 100 * known.elevation, {"cmap": ground_colors(), "vmin": -45, "vmax": 8}, "elevation"),
        (panels[1], foothold, {"cmap": "gray", "vmin": 0, "vmax": 1}, "foothold map and the planned footholds"),
    ):
        axes.set_facecolor("#9fc0e0" if axes is panels[1] else UNSEEN)
        image = axes.imshow(layer, origin="lower", extent=extent, interpolation="nearest", **style)
        axes.set_xlim(r * ny, 0.0)
        axes.set_title(title)
        axes.set_xlabel("left on the strip [m]")
        if axes is panels[0]:
            figure.colorbar(image, ax=axes, label="height [cm]", shrink=0.7)
    off = section.plan.footholds[:, :2] - known.origin
    along, across = off[:, 0] * c + off[:, 1] * s, off[:, 1] * c - off[:, 0] * s
    for leg, color in enumerate(LEG_COLORS):
        mine = section.plan.leg == leg
        panels[1].plot(across[mine], along[mine], "o", ms=4, color=color, mec="white", mew=0.5)
    panels[0].set_ylabel("along the strip [m]")
    edges = [data.run(layout, trial).report.passage.foothold_edge_m.median for trial in range(TRIALS)]
    return [f"{1e3 * float(np.median(edges)):.0f} mm from the edge; half a pillar is 50 mm"]


def draw_table(figure: Any, data: Data) -> list[str]:
    """Draw Table 6.1: his printed numbers, his planner here, and ours."""
    table = planner_table.content(*data.planned())
    axes = figure.subplots()
    axes.set_axis_off()
    rows = [[cell.strip("`") for cell in row] for row in table.rows]
    drawn = axes.table(
        [list(table.headings), *rows],
        loc="center",
        cellLoc="left",
        edges="horizontal",
        colWidths=(0.09, 0.23, 0.19, *3 * (0.163,)),
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(7.5)
    for (row, _), cell in drawn.get_celld().items():
        cell.set_height(1.0 / (len(rows) + 1))
        cell.set_linewidth(0.9 if row == 0 or (row - 1) % 6 == 5 else 0.15)
        if row == 0:
            cell.get_text().set(weight="bold", size=6.6)
    axes.set_title(table.notes[0], fontsize=7.5, y=-0.06)
    return []
