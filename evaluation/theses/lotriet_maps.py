"""Lotriet 2024, sections 3.3 and 4.6: the simulation, and the walk past objects with its map and its pose estimates."""

from typing import Any

import numpy as np

from sextant.evaluation.figures.layers_picture import UNSEEN, ground_colors
from sextant.evaluation.theses.data import Data
from sextant.evaluation.theses.stills import camera_picture, draw_stills, stills, true_terrain

_PAST = "lotriet_walk_past"
_AREA = (-0.3, 2.8), (-0.9, 0.9)  # [m] x and y
_SHARES = {"start": 0.02, "middle": 0.5, "end": 0.98}  # [1] of the walk
_PATH = "#d01c8b"


def draw_simulation(figure: Any, data: Data) -> list[str]:
    """Draw figure 3.5: the simulated robot."""
    run = data.run("lotriet_stairs")
    last = float(run.trace.t[run.trace.walking][-1])
    picture = stills(data.recording("lotriet_stairs"), "lotriet_stairs", data.seed, [0.5 * (run.begin + last)], (960, 540))
    draw_stills([figure.subplots()], picture, [""])
    return []


def draw_setup(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.4: the objects from above, and the path of the robot."""
    trace = data.run(_PAST).trace
    axes = figure.subplots()
    (x0, x1), (y0, y1) = _AREA
    z = true_terrain(_PAST, data.seed).raster(x0, y0, round(100 * (x1 - x0)), round(100 * (y1 - y0)), 0.01)
    image = axes.imshow(100 * z.T, origin="lower", extent=(x0, x1, y0, y1), cmap=ground_colors(), vmin=-4, vmax=14)
    axes.plot(trace.p_true[:, 0], trace.p_true[:, 1], color=_PATH, lw=1.8)
    axes.annotate("path of the body", (0.3, 0.04), color=_PATH)
    for name, place in (("piggybank", (1.0, 0.68)), ("box", (1.2, -0.68)), ("wedge", (1.66, 0.68)), ("tray", (2.1, 0.76)),
                        ("stone", (2.1, -0.72))):  # fmt: skip
        axes.annotate(name, place, ha="center")
    axes.set_xlabel("ahead [m]")
    axes.set_ylabel("left [m]")
    figure.colorbar(image, ax=axes, label="height [cm]", shrink=0.7)
    return []


def draw_map(figure: Any, data: Data, moment: str) -> list[str]:
    """Draw figures 4.5 to 4.7: what the camera shows at a moment of the walk, and the map of then."""
    trace, maps = data.run(_PAST).trace, data.maps(_PAST)
    walked = np.flatnonzero(trace.walking)
    k = int(walked[round(_SHARES[moment] * (len(walked) - 1))])
    began_ns = maps[0].stamp_ns - round(1e9 * trace.t[0])
    terrain = min(maps, key=lambda one: abs(1e-9 * (one.stamp_ns - began_ns) - trace.t[k]))
    picture, axes = figure.subplots(1, 2, width_ratios=(1.0, 1.35))
    draw_stills([picture], [camera_picture(true_terrain(_PAST, data.seed), trace.profile, trace.T[k])], ["camera"])
    r, (nx, ny) = terrain.resolution, terrain.elevation.shape
    low = terrain.origin - r / 2
    axes.set_facecolor(UNSEEN)
    extent = (low[0], low[0] + r * nx, low[1], low[1] + r * ny)
    image = axes.imshow(100 * terrain.elevation.T, origin="lower", extent=extent, cmap=ground_colors(), vmin=-4, vmax=14)
    axes.plot(*trace.p_true[k, :2], "o", color=_PATH, ms=5)
    axes.set_xlim(*_AREA[0])
    axes.set_ylim(*_AREA[1])
    axes.set_title(f"map after {trace.t[k] - trace.t[walked[0]]:.0f} s of walking")
    axes.set_xlabel("ahead [m]")
    axes.set_ylabel("left [m]")
    figure.colorbar(image, ax=axes, label="height [cm]", shrink=0.6)
    return []


def draw_poses(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.8: the pose estimates of the walk in space, and their error."""
    run = data.run(_PAST)
    trace = run.trace
    grid = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.1))
    space = figure.add_subplot(grid[1], projection="3d")
    p = trace.p_estimate
    space.plot(p[:, 0], p[:, 1], 100 * p[:, 2], ".", ms=2, color="#333333")
    space.plot(*(p[0] * (1, 1, 100)), "o", color="#0072b2", label="start")
    space.plot(*(p[-1] * (1, 1, 100)), "o", color="#d55e00", label="end")
    space.set_xlabel("ahead [m]")
    space.set_ylabel("left [m]")
    space.set_zlabel("up [cm]")
    space.set_ylim(-0.3, 0.3)
    space.set_zlim(100 * p[:, 2].mean() - 1.5, 100 * p[:, 2].mean() + 1.5)
    space.locator_params(nbins=4)
    space.set_box_aspect((2.2, 1.1, 0.8), zoom=0.92)
    space.legend(loc="upper left", ncols=2)
    error = figure.add_subplot(grid[0])
    error.plot(trace.t_estimate - run.begin, 1e3 * trace.pose_error, color="#0072b2", lw=1.2)
    error.set_xlabel("simulated time since the first step [s]")
    error.set_ylabel("error of the position [mm]")
    error.grid(alpha=0.25)
    error.set_ylim(bottom=0)
    rate = float(1.0 / np.median(np.diff(trace.t_estimate)))
    jump = float(np.linalg.norm(np.diff(p, axis=0), axis=1).max())
    return [f"{rate:.0f} Hz", f"at most {1e3 * jump:.0f} mm"]
