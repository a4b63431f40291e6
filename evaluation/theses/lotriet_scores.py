"""Lotriet 2024, chapter 6: his score as published and his search, on the ground of his test and on a walk's own map."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.baselines.lotriet import first_place, floor_height, squares
from sextant.evaluation.figures.layers_picture import UNSEEN, ground_colors
from sextant.evaluation.theses.data import Data, map_window
from sextant.evaluation.theses.stills import true_terrain
from sextant.evaluation.whole_maps.terrain_map import terrain_of
from sextant.services.mapper.footholds.foothold_score import published_score
from sextant.services.mapper.footholds.params import ScoreParams
from sextant.services.planner.locomotion.foothold_search import offsets_by_distance
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import TerrainMap

R = 0.01  # [m] cells
_KERNEL = 5  # [cells] n of (6.4), as in the baseline
_AREA = (0.6, 2.6), (-1.0, 1.0)  # [m] x and y of his test
_SEARCH = 0.06  # [m] half the edge of the search area
_NOMINAL, _CHOSEN, _OURS, _BOX = "#d55e00", "#009e73", "#cc79a7", "#0072b2"
_WORST = 3.0  # score at which the picture is white
# Nominal footholds of figure 6.8 by its text, on the ground of `lotriet_scoring` [m].
PICKS = {
    "middle left": (1.6, 0.45),
    "top right": (2.20, -0.378),
    "bottom right": (1.085, -0.46),
    "middle right": (1.6, -0.375),
    "top left": (2.2, 0.37),
    "bottom left": (1.06, 0.52),
}
# Of figure 6.10, on the map of a walk over `lotriet_walk_past`: on level floor, at the box, on the wedge, at the tray.
_WALKED_PICKS = ((0.75, 0.15), (1.2, -0.36), (1.66, 0.50), (2.10, 0.46), (1.0, 0.36))


def terms(elevation: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return slope and edge proximity (nx, ny) as published, with the weights of the baseline."""
    weights, sigma = ScoreParams(), ScoreParams().proximity_sigma / R
    slope = published_score(elevation, weights.slope / (8 * R), 0.0, kernel=_KERNEL, sigma=sigma)
    return slope, published_score(elevation, 0.0, weights.proximity * _KERNEL**2, kernel=_KERNEL, sigma=sigma)


def ground(name: str, seed: int) -> NDArray[np.float32]:
    """Return the true heights (n, m) [m] of the area of his test."""
    (x0, x1), (y0, y1) = _AREA
    n, m = round((x1 - x0) / R), round((y1 - y0) / R)
    return true_terrain(name, seed).raster(x0 + R / 2, y0 + R / 2, n, m, R).astype(np.float32)


def draw_slope_slice(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.1: the slope score over a slice of ground."""
    return _draw_slice(figure, 0, "slope score $S_g$")


def draw_proximity_slice(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.2: the edge proximity score over the same slice."""
    return _draw_slice(figure, 1, "edge proximity\nscore $S_p$")


def _draw_slice(figure: Any, term: int, label: str) -> list[str]:
    x = np.arange(120) * R
    z = np.interp(x, [0.25, 0.45, 0.60, 0.601, 0.90, 0.901], [0.0, 0.06, 0.06, 0.0, 0.0, 0.03])
    elevation = np.repeat(z.astype(np.float32)[:, None], 20, axis=1)
    score = terms(elevation)[term][:, 10]
    below, above = figure.subplots(2, 1, sharex=True)
    below.fill_between(100 * x, 100 * z, -1, color="#d9c3a0")
    below.set_ylabel("height [cm]")
    above.plot(100 * x, score, color=_BOX, lw=1.6)
    above.axhline(1.0, color=_NOMINAL, lw=1, ls="--")
    above.annotate("a foothold up to 1", (1.0, 1.05), color=_NOMINAL)
    above.set_ylabel(label)
    above.set_xlabel("x [cm]")
    return []


def draw_search(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.3: the order of his search in squares, and of ours by distance."""
    his, ours = figure.subplots(1, 2)
    offsets = np.rint(offsets_by_distance(3 * R, R) / R).astype(int)
    for axes, cells, title in ((his, squares(2), "his: square by square"), (ours, offsets, "here: by distance")):
        inside = [tuple(cell) for cell in cells.tolist() if max(map(abs, cell)) <= 2]
        order = {cell: k for k, cell in enumerate(inside)}
        picture = np.array([[order.get((i, j), np.nan) for j in range(-2, 3)] for i in range(-2, 3)])
        axes.imshow(picture, cmap="Blues", origin="lower", extent=(-2.5, 2.5, -2.5, 2.5), alpha=0.6)
        for (i, j), k in order.items():
            axes.annotate(str(k + 1), (j, i), ha="center", va="center", size=8)
        axes.set_title(title)
        axes.set_xlabel("cells")
    return [f"{len(squares(2))} cells"]


def draw_floor(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.4: footholds on the stairs, his floor height of them, and the height that our robot holds."""
    trace = data.run("lotriet_stairs").trace
    downs, latest = trace.touchdowns, np.zeros(6)
    floors = []
    for leg, p in zip(downs.leg, downs.p, strict=True):
        latest[leg] = p[2] - trace.profile.foot.radius
        floors.append(floor_height(latest))
    axes = figure.subplots()
    begin = float(trace.t[np.argmax(trace.walking)])
    t = downs.t - begin
    axes.scatter(t, 100 * (downs.p[:, 2] - trace.profile.foot.radius), s=12, color="#7f7f7f", label="footholds")
    axes.step(t, 100 * np.array(floors), where="post", color=_BOX, lw=1.6, label="floor: mean of the three highest feet")
    height = 9.0  # [cm] of the walk, section 8.1
    axes.step(t, 100 * np.array(floors) + height, where="post", color=_BOX, lw=1.2, ls="--", label="his body height over it")
    walking = trace.walking
    axes.plot(trace.t[walking] - begin, 100 * trace.height_reference[walking], color=_NOMINAL, lw=1.6, label="commanded here")
    axes.set_xlabel("simulated time since the first step [s]")
    axes.set_ylabel("height [cm]")
    axes.grid(alpha=0.25)
    axes.legend(loc="upper left")
    return []


def draw_terrain(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.5: the ground in three dimensions, and as a height map."""
    z = ground("lotriet_scoring", data.seed)
    (x0, x1), (y0, y1) = _AREA
    solid = figure.add_subplot(1, 2, 1, projection="3d")
    x, y = np.meshgrid(np.linspace(x0, x1, z.shape[0]), np.linspace(y0, y1, z.shape[1]), indexing="ij")
    solid.plot_surface(x, y, 100 * z, cmap=ground_colors(), rstride=2, cstride=2, lw=0, antialiased=False, vmin=-8, vmax=16)
    solid.set_box_aspect((2, 2, 0.35), zoom=1.15)
    solid.view_init(42, -125)
    solid.set_zticks([0, 10])
    solid.set_xlabel("x [m]")
    solid.set_ylabel("y [m]")
    solid.set_zlabel("height [cm]")
    flat = figure.add_subplot(1, 2, 2)
    image = _show(flat, 100 * z, cmap=ground_colors(), vmin=-8, vmax=16)
    figure.colorbar(image, ax=flat, label="height [cm]", shrink=0.8)
    return []


def draw_terms(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.6: slope and edge proximity apart."""
    panels = figure.subplots(1, 2)
    for axes, score, title in zip(
        panels, terms(ground("lotriet_scoring", data.seed)), ("slope", "edge proximity"), strict=True
    ):
        image = _show(axes, score, cmap="gray", vmin=0, vmax=_WORST)
        axes.set_title(title)
    figure.colorbar(image, ax=list(panels), label="score: a foothold up to 1", shrink=0.8)
    return []


def draw_score(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.7: the sum of both, and the score of Sextant."""
    z = ground("lotriet_scoring", data.seed)
    his, ours = figure.subplots(1, 2)
    image = _show(his, sum(terms(z)), cmap="gray", vmin=0, vmax=_WORST)
    his.set_title("as published")
    _show(ours, _known(data, z).score, cmap="gray", vmin=0, vmax=_WORST)
    ours.set_title("here: with roughness and margin")
    figure.colorbar(image, ax=[his, ours], label="score: a foothold up to 1", shrink=0.8)
    return []


def draw_picks(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.8: nominal footholds, and those that his search chooses."""
    z = ground("lotriet_scoring", data.seed)
    scored = _scored(_known(data, z))
    axes = figure.subplots()
    image = _show(axes, scored.score, cmap="gray", vmin=0, vmax=_WORST)
    values = []
    for name, xy in PICKS.items():
        place = _draw_pick(axes, scored, np.array(xy))
        values.append("none" if place is None else f"{_moved(place, xy)}, ground at {100 * place[2]:.1f} cm")
        style = {"fc": "black", "ec": "none", "pad": 1, "alpha": 0.8}
        axes.annotate(name, (xy[1], xy[0] + 0.22), ha="center", va="center", color="#ffd54f", size=7, bbox=style)
    figure.colorbar(image, ax=axes, label="score as published: a foothold up to 1", shrink=0.8)
    _pick_legend(axes)
    return values


def draw_walked_map(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.9: the map of a walk, and its score as published."""
    terrain = _walked(data)
    z = map_window(terrain, terrain.elevation, *_AREA).astype(np.float32)
    heights, score = figure.subplots(1, 2)
    image = _show(heights, 100 * z, cmap=ground_colors(), vmin=-4, vmax=14)
    figure.colorbar(image, ax=heights, label="height [cm]", shrink=0.7)
    scored = _show(score, sum(terms(z)), cmap="gray", vmin=0, vmax=_WORST)
    figure.colorbar(scored, ax=score, label="score as published", shrink=0.7)
    return []


def draw_walked_picks(figure: Any, data: Data) -> list[str]:
    """Draw figure 6.10: nominal footholds on the score of a walk's map."""
    scored = _scored(_walked(data))
    axes = figure.subplots()
    image = _show(axes, map_window(scored, scored.score, *_AREA), cmap="gray", vmin=0, vmax=_WORST)
    for xy in _WALKED_PICKS:
        _draw_pick(axes, scored, np.array(xy))
    figure.colorbar(image, ax=axes, label="score as published: a foothold up to 1", shrink=0.8)
    _pick_legend(axes)
    return []


def _walked(data: Data) -> TerrainMap:
    """Return the map in the middle of the walk, when most objects are on it."""
    maps = data.maps("lotriet_walk_past")
    return maps[len(maps) // 2]


def _known(data: Data, z: NDArray[np.float32]) -> TerrainMap:
    """Return the terrain map of exact heights."""
    return terrain_of(data.profile, z, R, (_AREA[0][0] + R / 2, _AREA[1][0] + R / 2))


def _scored(terrain: TerrainMap) -> TerrainMap:
    """Return a map with the published score."""
    return TerrainMap(
        terrain.stamp_ns,
        terrain.resolution,
        terrain.origin,
        terrain.elevation,
        terrain.variance,
        np.asarray(sum(terms(terrain.elevation)), dtype=np.float32),
        terrain.assumed,
        terrain.evaluation,
    )


def _draw_pick(axes: Any, scored: TerrainMap, xy: Array) -> Array | None:
    """Draw a nominal foothold, its search area, and the chosen place."""
    from matplotlib.patches import Rectangle

    place = first_place(scored, xy)
    corner = (xy[1] - _SEARCH, xy[0] - _SEARCH)
    axes.add_patch(Rectangle(corner, 2 * _SEARCH, 2 * _SEARCH, fill=False, ec=_BOX, lw=1.3))
    axes.plot(xy[1], xy[0], "o", color=_NOMINAL, ms=5)
    if place is not None:
        axes.plot(place[1], place[0], "o", color=_CHOSEN, ms=5)
    return place


def _pick_legend(axes: Any) -> None:
    marks = ((_NOMINAL, "nominal"), (_CHOSEN, "chosen"))
    handles = [axes.plot([], [], "o", color=color, label=label)[0] for color, label in marks]
    handles.append(axes.plot([], [], color=_BOX, label="search area")[0])
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)


def _moved(place: Array, xy: tuple[float, float]) -> str:
    off = place[:2] - xy
    return "stays" if np.abs(off).max() <= R / 2 + 1e-9 else f"moved by {100 * float(np.linalg.norm(off)):.1f} cm"


def _show(axes: Any, layer: Any, **style: Any) -> Any:
    """Show a layer (n, m) of the area from above, ahead upward and left to the left."""
    (x0, x1), (y0, y1) = _AREA
    axes.set_facecolor(UNSEEN)
    image = axes.imshow(layer, origin="lower", extent=(y0, y1, x0, x1), interpolation="nearest", **style)
    axes.set_xlim(y1, y0)  # left is left
    axes.set_xlabel("left [m]")
    axes.set_ylabel("ahead [m]")
    return image
