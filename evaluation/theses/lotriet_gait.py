"""Lotriet 2024, section 5.3: gaits, a stride in both frames, and the choice of the swinging legs."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.baselines.lotriet import swinging
from sextant.evaluation.figures.walk_picture import LEG_COLORS
from sextant.evaluation.theses.data import Data
from sextant.evaluation.trace.trace import Trace
from sextant.services.planner.locomotion.gait import GAITS
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import GaitName

_SWINGS, _CARRIES = "#0072b2", "#d55e00"
_CYCLES = 2  # of each gait
_ORDER: tuple[GaitName, ...] = ("wave", "ripple", "tripod")
_DIRECTIONS = 720
_NAMES = [name.replace("middle", "mid") for name in LEGS]


def draw_gaits(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.4: which leg swings when."""
    panels = figure.subplots(1, len(_ORDER), sharey=True)
    for axes, name in zip(panels, _ORDER, strict=True):
        gait = GAITS[name]
        steps = len(gait.groups)
        for step in range(_CYCLES * steps):
            for leg in gait.groups[step % steps]:
                axes.barh(leg, 1.0 / steps, left=step / steps, height=0.8, color=_SWINGS)
        axes.set_xlim(0, _CYCLES)
        axes.set_xticks(range(_CYCLES + 1))
        axes.set_yticks(range(len(LEGS)), _NAMES)
        axes.invert_yaxis()
        axes.set_title(f"{name}: {steps} steps in a cycle")
        axes.set_xlabel("cycles (blue: swinging)")
    return [f"{GAITS[name].duty:.3f}" for name in _ORDER]


def draw_stride(figure: Any, data: Data, frame: str) -> list[str]:
    """Draw figures 5.5 and 5.6: the paths of the feet in one step, in {body} or {world}."""
    trace = data.run("lotriet_flat").trace
    span, swings = _step(trace)
    feet, seen_from_body = trace.feet[span], _in_body(trace, span)
    shown = seen_from_body if frame == "body" else feet
    sides = figure.subplots(2, 1, sharex=True, sharey=True)
    for axes, side, legs in zip(sides, ("right", "left"), ((0, 5, 4), (1, 2, 3)), strict=True):
        for leg in [k for k, name in enumerate(LEGS) if name.startswith(side)] or legs:
            path = 100 * shown[:, leg]
            style = {"color": _SWINGS if swings[leg] else _CARRIES, "lw": 2.0}
            axes.plot(path[:, 0], path[:, 2] - 100 * shown[:, :, 2].min(), **style)
            axes.plot(path[-1, 0], path[-1, 2] - 100 * shown[:, :, 2].min(), "o", ms=5, color=style["color"])
        axes.set_ylabel(f"{side} feet:\nheight [cm]")
        axes.grid(alpha=0.25)
    sides[1].set_xlabel(f"ahead in {{{frame}}} [cm]")
    handles = [sides[0].plot([], [], color=color, lw=2)[0] for color in (_SWINGS, _CARRIES)]
    sides[0].legend(handles, ["swinging", "supporting; a dot is where a foot ends"], loc="upper left", ncols=2)
    sides[0].set_ylim(top=1.45 * sides[0].get_ylim()[1])
    if frame == "body":
        return []
    ways = [np.linalg.norm((path[-1] - path[0])[swings, :2], axis=1).mean() for path in (feet, seen_from_body)]
    return [f"{ways[0] / ways[1]:.2f} times ({100 * ways[0]:.1f} and {100 * ways[1]:.1f} cm)"]


def draw_sextants(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.8: the sextants, and which legs swing for a direction in each."""
    rest = data.profile.rest_feet()
    angles = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    sets = np.array([_swings_for(angle, rest) for angle in angles])
    active = np.array([_active(angle, rest) for angle in angles])
    middle = float(np.arctan2(rest[1, 1], rest[1, 0]))
    one, all_ = figure.subplots(1, 2)
    _draw_robot(one, data, _swings_for(middle, rest))
    reach = 1.35 * float(np.linalg.norm(rest[:, :2], axis=1).max())
    borders = angles[np.flatnonzero(active != np.roll(active, 1))]
    for axes in (one, all_):
        for border in borders:
            axes.plot([0, reach * np.cos(border)], [0, reach * np.sin(border)], color="#777777", lw=0.8, ls=":")
        axes.set_aspect("equal")
        axes.set_xlabel("ahead [m]")
        axes.set_ylabel("left [m]")
    one.annotate("", 0.8 * reach * np.array([np.cos(middle), np.sin(middle)]), (0, 0), arrowprops={"arrowstyle": "->", "lw": 2})
    one.set_title(f"towards the {LEGS[1]} leg (blue: swinging)")
    for k, angle in enumerate(angles):
        color = LEG_COLORS[int(active[k])]
        wedge = np.array([angle, angle + 2 * np.pi / _DIRECTIONS])
        all_.fill([0, *(reach * np.cos(wedge))], [0, *(reach * np.sin(wedge))], color=color, alpha=0.45, lw=0)
    for leg in range(6):
        swings = sets[int(np.argmin(np.abs(_off(angles, float(np.arctan2(rest[leg, 1], rest[leg, 0]))))))]
        words = "+".join(str(k) for k in np.flatnonzero(swings))
        all_.annotate(f"{_NAMES[leg]}\n{words} swing", rest[leg, :2], ha="center", va="center", size=7)
    all_.set_title("active leg of each direction")
    return [", ".join(str(k) for k in np.flatnonzero(_swings_for(middle, rest)))]


def _swings_for(angle: float, rest: Array) -> NDArray[np.bool_]:
    found = swinging(np.array([np.cos(angle), np.sin(angle)]), rest, rest)
    assert found is not None
    return found


def _active(angle: float, rest: Array) -> int:
    middles = rest[:, :2] / np.linalg.norm(rest[:, :2], axis=1, keepdims=True)
    return int(np.argmax(middles @ [np.cos(angle), np.sin(angle)]))


def _off(angles: Array, angle: float) -> Array:
    return np.asarray((angles - angle + np.pi) % (2 * np.pi) - np.pi)


def _draw_robot(axes: Any, data: Data, swings: NDArray[np.bool_]) -> None:
    """Draw the resting robot from above."""
    length, width, _ = data.profile.body.size
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) * (length / 2, width / 2)
    axes.fill(corners[:, 0], corners[:, 1], color="#d9d9d9", ec="#333333")
    coxae, feet = data.profile.T_body_coxa[:, :2, 3], data.profile.rest_feet()
    for leg in range(6):
        color = _SWINGS if swings[leg] else _CARRIES
        axes.plot([coxae[leg, 0], feet[leg, 0]], [coxae[leg, 1], feet[leg, 1]], "-o", color=color, lw=2.5, ms=5)
        axes.annotate(str(leg), feet[leg, :2], (6, 4), textcoords="offset points", color=color, weight="bold")


def _step(trace: Trace) -> tuple[slice, NDArray[np.bool_]]:
    """Return the samples of a step in the middle of a walk, and the legs that swing in it."""
    free = ~trace.carrying[:, 0] & trace.walking
    begins = np.flatnonzero(free[1:] & ~free[:-1]) + 1
    begin = int(begins[len(begins) // 2])
    end = begin + int(np.argmin(free[begin:]))
    swings = (~trace.carrying[begin:end]).mean(axis=0) > 0.5
    return slice(begin, end), swings


def _in_body(trace: Trace, span: slice) -> Array:
    """Return the feet (n, 6, 3) [m] {body}."""
    return np.array([apply(inverse(T), feet) for T, feet in zip(trace.T[span], trace.feet[span], strict=True)])
