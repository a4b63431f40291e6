"""Foothold layers of a map: height, Lotriet's score, Masri's evaluation function."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.figures.walk_picture import LEG_COLORS
from sextant.shared.files import whole_files
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import TerrainMap

UNSEEN = "#e4e4e4"
_DPI = 100
_WIDTH = 18.0  # [in] of the three together
_ROOM = 0.06  # [m] around the known area
_LEAST_RELIEF = 0.015  # [m] least half range of the colours, so that level ground does not look mountainous
_WORST = 3.0  # score above which the colour does not change
_FURTHEST = 8  # [cells] outside, beyond which the colour does not change


def draw(path: Path, terrain: TerrainMap, T_world_way: Array | None = None) -> bool:
    """Draw the layers of a map.

    Args:
        path: Output file; its suffix is the format.
        terrain: The map.
        T_world_way: (n, 4, 4) poses of the path over it, or None.

    Returns:
        False if the map has no known cell; then there is no picture.
    """
    figure = figure_of(terrain, T_world_way)
    if figure is None:
        return False
    whole_files.make_folder(path.parent)
    whole_files.write_by_name(path, figure.savefig)
    return True


def figure_of(terrain: TerrainMap, T_world_way: Array | None = None, footholds: Sequence[Array] = ()) -> Any:
    """Return the layers as a figure, or None if the map has no known cell.

    `footholds` has for each leg the chosen footholds (k, 2 or 3) [m] {world}.
    """
    part = _known_part(terrain)
    if part is None:
        return None
    from matplotlib import rc_context
    from matplotlib.colors import TwoSlopeNorm
    from matplotlib.figure import Figure

    r = terrain.resolution
    low = terrain.origin + r * np.array([s.start for s in part]) - r / 2
    high = terrain.origin + r * np.array([s.stop for s in part]) - r / 2
    height, score = 100 * terrain.elevation[part], terrain.score[part]
    cells = terrain.evaluation[part].astype(np.float64)
    evaluation = np.where(np.isfinite(height), np.minimum(cells, _FURTHEST), np.nan)
    bottom, top = np.nanpercentile(height, [1, 99]).tolist()
    middle, half = (bottom + top) / 2, max((top - bottom) / 2, 100 * _LEAST_RELIEF)
    deepest = min(float(cells.min()), -1.0)
    share = float((high[1] - low[1]) / (high[0] - low[0]))
    tall = float(np.clip(_WIDTH / 3 * share, 2.5, 9.0)) + 1.2
    with rc_context({"font.size": 12}):
        figure = Figure(figsize=(_WIDTH, tall), dpi=_DPI, facecolor="white", layout="constrained")
        panels: list[tuple[str, NDArray[np.floating], Any, dict[str, Any]]] = [
            ("height [cm]", height, ground_colors(), {"vmin": middle - half, "vmax": middle + half}),
            ("score: a foothold up to 1", np.minimum(score, _WORST), "BrBG_r", {"norm": TwoSlopeNorm(1.0, 0.0, _WORST)}),
            ("evaluation [cells]: a foothold below 0", evaluation, "BrBG_r", {"norm": TwoSlopeNorm(0.0, deepest, _FURTHEST)}),
        ]
        for axes, (title, layer, colors, scale) in zip(np.atleast_1d(figure.subplots(1, 3)), panels, strict=True):
            axes.set_facecolor(UNSEEN)
            extent = (low[0], high[0], low[1], high[1])
            image = axes.imshow(layer.T, origin="lower", extent=extent, cmap=colors, interpolation="nearest", **scale)
            if T_world_way is not None and len(T_world_way):
                axes.plot(T_world_way[:, 0, 3], T_world_way[:, 1, 3], color="#d01c8b", lw=1.4)
            for places, color in zip(footholds, LEG_COLORS, strict=False):
                axes.scatter(places[:, 0], places[:, 1], s=22, c=color, edgecolors="white", linewidths=0.6, zorder=3)
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
            axes.set_title(title, size=13)
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
            figure.colorbar(image, ax=axes, shrink=0.85, pad=0.02).outline.set_visible(False)
        figure.suptitle(f"{terrain.stamp_ns * 1e-9:.1f} s · cells of {100 * r:g} cm · grey: not known well enough", size=12)
        figure.draw_without_rendering()  # while the font settings are active
    return figure


def _known_part(terrain: TerrainMap) -> tuple[slice, slice] | None:
    """Return the rows and columns of the known area, with a margin."""
    known = np.isfinite(terrain.elevation)
    if not known.any():
        return None
    room = round(_ROOM / terrain.resolution)
    found = []
    for axis, n in enumerate(known.shape):
        at = np.flatnonzero(known.any(axis=1 - axis))
        found.append(slice(max(int(at[0]) - room, 0), min(int(at[-1]) + 1 + room, n)))
    return found[0], found[1]


def ground_colors() -> Any:
    """Return a colour map for heights, from low to high."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("ground", ["#8fb3a6", "#c3d9c3", "#f6f3dc", "#ecd09a", "#c9965a"])
