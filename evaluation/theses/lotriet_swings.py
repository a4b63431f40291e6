"""Lotriet 2024, section 5.4: the sixth-order arc, the flow function as published, and ours on the same swings.

Lengths are in millimetres: only with them his step height parameter of 2.0 gives the step height of 10 cm of section 8.1.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sextant.evaluation.theses.data import Data
from sextant.services.actuator.locomotion.sixth_order_arc import SixthOrderArc, on_arc
from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.shared.geometry import Array

_STRIDE, _RISE = 150.0, 50.0  # [mm] of the examples; the rise is assumed
_HIS, _OURS, _OLD = "#0072b2", "#d55e00", "#7f7f7f"
_STEP = 0.05  # [mm] of the integration
_LONGEST = 20_000  # steps of it
_CASES = ((1.0, 0.0), (2.0, 0.0), (2.0, 20.0), (2.0, 40.0))  # step height parameter Ch [1], and q [mm]
_SHADES = ("#9ecae1", "#4292c6", "#2171b5", "#08306b")
_FRAMES = 400


def sigmoid(y: Array | float, q: float) -> Array:
    """Return S(y) with y and q in [mm], eq. (5.26)."""
    off = np.asarray(y, dtype=np.float64) - q
    return np.asarray(0.515 * off / (1.0 + np.abs(off)) - 0.505)


def published_slope(x: float, y: float, v_h: float, q: float) -> float:
    """Return the rise per way towards the target, eq. (5.23) to (5.25), the latter with the x that its print lost.

    x is the horizontal distance to the target, and y the height over it [mm].
    """
    return -y / x + v_h + abs(float(sigmoid(y, q))) * x


def published_path(start: tuple[float, float], target: tuple[float, float], v_h: float, q: float, until: float = 0.0) -> Array:
    """Follow the flow from a start to a target, both (ahead, up) [mm]; return the path (n, 2).

    `until` is the share of the horizontal way at which it ends.
    """
    x, y = target[0] - start[0], start[1] - target[1]
    end = max(until * x, _STEP)
    path = [start]
    while x > end and len(path) < _LONGEST:
        slope = published_slope(x, y, v_h, q)
        ahead = _STEP / math.hypot(1.0, slope)
        x, y = x - ahead, y + slope * ahead
        path.append((target[0] - x, target[1] + y))
    return np.array([*path, target] if until == 0.0 else path)


def our_path(start: tuple[float, float], targets: Sequence[tuple[float, float]], clearance: float) -> Array:
    """Return the path (n, 2) [mm] of our swing; the second target takes the place of the first halfway."""
    foot, aim = _points(start), [_points(target) for target in targets]
    swing = Swing(foot, aim[0], np.array([1e-3 * clearance]))
    path = [foot[0].copy()]
    for k in range(_FRAMES):
        target = aim[0] if k < _FRAMES // 2 else aim[-1]
        path.append(swing.update(target, k / _FRAMES, 1.0 / _FRAMES)[0].copy())
    return 1e3 * np.array(path)[:, [0, 2]]


def draw_arc(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.11: the sixth-order arc through its three points."""
    axes = figure.subplots()
    path = _arc((0.0, 0.0), (_STRIDE, 0.0), 100.0, np.linspace(0.0, 1.0, 200))
    axes.plot(*path.T, color=_OLD, lw=2)
    for place, name in ((path[0], "$q_i$"), (np.array([_STRIDE / 2, 100.0]), "$q_m$"), (path[-1], "$q_f$")):
        axes.plot(*place, "o", color="#111111", ms=5)
        axes.annotate(name, place, (6, 4), textcoords="offset points", size=11)
    _label(axes)
    off = float(np.abs(_arc((0.0, 0.0), (_STRIDE, 0.0), 100.0, np.array([0.5]))[0] - [_STRIDE / 2, 100.0]).max())
    return [f"{off:.3f} mm"]


def draw_second_rise(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.12: the arc that is computed again halfway rises again; ours do not."""
    axes = figure.subplots()
    target, later = (_STRIDE, 0.0), (_STRIDE + 40.0, 0.0)
    first = _arc((0.0, 0.0), target, 100.0, np.linspace(0.0, 0.5, 100))
    again = _arc(tuple(first[-1]), later, 100.0, np.linspace(0.0, 1.0, 200))
    axes.plot(
        *_arc((0.0, 0.0), target, 100.0, np.linspace(0.5, 1.0, 100)).T, color=_OLD, lw=1, ls=":", label="without a change"
    )
    axes.plot(*np.vstack([first, again]).T, color=_OLD, lw=2, label="sixth-order arc, computed again")
    kept = _our_arc((0.0, 0.0), (target, later), 100.0)
    axes.plot(*kept.T, color="#cc79a7", lw=1.6, label="arc 'sixth_order' here")
    axes.plot(*our_path((0.0, 0.0), (target, later), 100.0).T, color=_OURS, lw=1.6, label="flow here")
    _mark(axes, [(0.0, 0.0), target, later])
    _label(axes, room=1.45)
    return []


def draw_field(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.13: the directions of the flow around a target."""
    q, v_h = 20.0, 2.0
    axes = figure.subplots()
    ahead, up = np.meshgrid(np.arange(-160.0, -3.0, 9.0), np.arange(-60.0, 150.0, 9.0))
    slope = np.vectorize(lambda x, y: published_slope(-x, y, v_h, q))(ahead, up)
    length = np.hypot(1.0, slope)
    axes.quiver(ahead, up, 1.0 / length, slope / length, color="#7f7f7f", scale=42, width=0.0022)
    for start in ((-150.0, 0.0), (-150.0, -50.0), (-110.0, 60.0)):
        axes.plot(*published_path(start, (0.0, 0.0), v_h, q).T, color=_HIS, lw=1.8)
        axes.plot(*start, "o", color=_HIS, ms=5)
    axes.plot(0.0, 0.0, "s", color="#111111", ms=6)
    axes.axhline(q, color=_OURS, lw=1.0, ls="--")
    axes.annotate(f"q = {q:g} mm", (-42, q - 12), color=_OURS, bbox={"fc": "white", "ec": "none", "pad": 1})
    axes.set_xlabel("ahead of the target [mm]")
    axes.set_ylabel("over the target [mm]")
    return []


def draw_sigmoid(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.14: S over the height, for some q."""
    axes, y = figure.subplots(), np.linspace(-60.0, 100.0, 800)
    for q, color in zip((0.0, 20.0, 40.0), _SHADES[1:], strict=True):
        axes.plot(y, sigmoid(y, q), color=color, lw=1.8, label=f"q = {q:g} mm")
    axes.set_xlabel("height over the target y [mm]")
    axes.set_ylabel("S(y)")
    axes.grid(alpha=0.25)
    axes.legend(loc="lower right")
    low, high = (float(sigmoid(y, 20.0)[k]) for k in (0, -1))
    return [f"{low:.2f} to {high:.2f}"]


def draw_paths(figure: Any, data: Data, rise: float) -> list[str]:
    """Draw figures 5.15 to 5.17: paths for some parameters, to a target at a height [mm] over the start."""
    axes, target = figure.subplots(), (_STRIDE, rise)
    tops = []
    for (v_h, q), color in zip(_CASES, _SHADES, strict=True):
        path = published_path((0.0, 0.0), target, v_h, q)
        axes.plot(*path.T, color=color, lw=1.6, label=f"published, Ch = {v_h:g}, q = {q:g} mm")
        tops.append(float(path[:, 1].max()) - max(rise, 0.0))
    clearance = tops[1]
    ours = our_path((0.0, 0.0), (target,), clearance)
    axes.plot(*ours.T, color=_OURS, lw=2.0, label=f"here, clearance {clearance:.0f} mm")
    _mark(axes, [(0.0, 0.0), target])
    _label(axes, room=1.5)
    return []


def draw_changed_target(figure: Any, data: Data, rises: tuple[float, float], shift: float) -> list[str]:
    """Draw figures 5.18 and 5.19: the target moves when half of the way is done.

    `rises` are its heights [mm] before and after, and `shift` is how far [mm] it moves ahead.
    """
    axes, v_h, q = figure.subplots(), 2.0, 20.0
    first, second = (_STRIDE, rises[0]), (_STRIDE + shift, rises[1])
    begun = published_path((0.0, 0.0), first, v_h, q, until=0.5)
    path = np.vstack([begun, published_path(tuple(begun[-1]), second, v_h, q)])
    axes.plot(*published_path((0.0, 0.0), first, v_h, q).T, color=_HIS, lw=1.0, ls=":", label="published, without a change")
    axes.plot(*path.T, color=_HIS, lw=1.8, label="published")
    axes.plot(*begun[-1], "D", color=_HIS, ms=5)
    top = float(published_path((0.0, 0.0), first, v_h, q)[:, 1].max()) - max(rises[0], 0.0)
    axes.plot(*our_path((0.0, 0.0), (first, second), top).T, color=_OURS, lw=1.8, label=f"here, clearance {top:.0f} mm")
    _mark(axes, [(0.0, 0.0), first, second])
    _label(axes, room=1.45)
    return []


def _arc(start: tuple[float, ...], end: tuple[float, float], top: float, shares: Array) -> Array:
    """Return places (n, 2) on the sixth-order arc that passes `top` over its higher end halfway."""
    q_i, q_f = np.array(start), np.array(end)
    q_m = np.array([(start[0] + end[0]) / 2, max(start[1], end[1]) + top])
    return np.array([on_arc(q_i, q_m, q_f, float(share)) for share in shares])


def _our_arc(start: tuple[float, float], targets: Sequence[tuple[float, float]], clearance: float) -> Array:
    foot, aim = _points(start), [_points(target) for target in targets]
    arc = SixthOrderArc(foot, aim[0], np.array([1e-3 * clearance]))
    path = [foot[0].copy()]
    for k in range(_FRAMES):
        target = aim[0] if k < _FRAMES // 2 else aim[-1]
        path.append(arc.update(target, k / _FRAMES, 1.0 / _FRAMES)[0].copy())
    return 1e3 * np.array(path)[:, [0, 2]]


def _points(place: tuple[float, float]) -> Array:
    """Return a place (ahead, up) [mm] as (1, 3) [m]."""
    return np.array([[1e-3 * place[0], 0.0, 1e-3 * place[1]]])


def _mark(axes: Any, places: Sequence[tuple[float, float]]) -> None:
    """Mark the start, the target, and the target after its change."""
    for (x, y), marker in zip(places, ("o", "s", "^"), strict=False):
        axes.plot(x, y, marker, color="#111111", ms=6, zorder=5)
    for before, after in pairwise(places[1:]):
        axes.annotate("", after, before, arrowprops={"arrowstyle": "->", "ls": ":", "color": "#111111"})


def _label(axes: Any, room: float = 1.15) -> None:
    low, high = axes.get_ylim()
    axes.set_ylim(low, low + room * (high - low))
    axes.set_xlabel("ahead [mm]")
    axes.set_ylabel("up [mm]")
    axes.grid(alpha=0.25)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", ncols=2, columnspacing=1.0, handlelength=1.6)
