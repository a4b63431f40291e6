"""Masri 2016, chapters 3 and 5: the robot, the space of a leg, and the motions of his planner."""

import math
from functools import cache
from typing import Any

import numpy as np

from sextant.evaluation.baselines import masri_planner as his
from sextant.evaluation.theses import planner_table
from sextant.evaluation.theses.data import Data
from sextant.evaluation.theses.lotriet_swings import our_path
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.swing_clearance import descent_clearance
from sextant.services.planner.roadmap.roadmap import PassageStep
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.kinematics import body_inverse, leg_forward, leg_points
from sextant.shared.robot.profile import LEGS, RobotProfile

_BODY, _LEG = "#d9d9d9", "#333333"
_MAGENTA, _REJECTED, _REFINED, _BEFORE, _AFTER, _SPACE = "#cc79a7", "#d55e00", "#009e73", "#009e73", "#111111", "#56b4e9"
_SAMPLES = 20_000
_LIFT, _CLEAR = 0.05, 0.02  # [m] of the default swing, assumed, and over the ground (section 5.4.1)
_FRAMES = 200


def draw_robot(figure: Any, data: Data) -> list[str]:
    """Draw figures 3.1 and 3.2: the geometrical model from above and from ahead, with {body} in the middle."""
    profile = data.profile
    feet = profile.rest_feet()
    above, ahead = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    for leg, p in enumerate(leg_points(profile, body_inverse(profile, feet))):
        above.plot(p[:, 0], p[:, 1], "-o", color="#0072b2", lw=2.5, ms=4)
        side = 1 if p[-1, 1] > 0 else -1
        above.annotate(LEGS[leg], p[-1, :2], (0, 9 * side), textcoords="offset points", size=7.5, ha="center", va="center")
        ahead.plot(p[:, 1], p[:, 2], "-o", color="#0072b2", lw=2.0, ms=4)
    _draw_body(above, profile, np.zeros(3))
    width, height = profile.body.size[1], profile.body.size[2]
    ahead.fill(np.array([-1, 1, 1, -1]) * width / 2, np.array([-1, -1, 1, 1]) * height / 2, color=_BODY, ec=_LEG)
    above.margins(0.12)
    for axes, (x, y), words in ((above, (0.08, 0.0), ("x", "y")), (ahead, (0.08, 0.0), ("y", "z"))):
        axes.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->", "color": _REJECTED, "lw": 1.6})
        axes.annotate("", (y, x), (0, 0), arrowprops={"arrowstyle": "->", "color": _REJECTED, "lw": 1.6})
        axes.annotate(words[0], (x + 0.01, y), color=_REJECTED)
        axes.annotate(words[1], (y, x + 0.01), color=_REJECTED)
        axes.set_aspect("equal")
        axes.set_xlabel(("ahead x [m]", "left y [m]")[axes is ahead])
        axes.set_ylabel(("left y [m]", "up z [m]")[axes is ahead])
    return [" x ".join(f"{1e3 * size:.0f}" for size in profile.body.size) + " mm"]


def draw_space(figure: Any, data: Data) -> list[str]:
    """Draw figure 3.5: where the femur's and the tibia's ends can be within the limits of their servos."""
    profile = data.profile
    limits, links = profile.joint_limits[1], profile.links
    left, right = figure.subplots(1, 2)
    femur = np.linspace(float(limits[1, 0]), float(limits[1, 1]), 200)
    knee = np.stack([links.coxa + links.femur * np.cos(femur), links.femur * np.sin(femur)], axis=1)
    left.fill(*np.vstack([[links.coxa, 0.0], knee]).T, color=_MAGENTA, alpha=0.35, lw=0)
    rng = np.random.default_rng(0)
    q = np.column_stack([np.zeros(_SAMPLES), rng.uniform(limits[1:, 0], limits[1:, 1], (_SAMPLES, 2))])
    foot = leg_forward(q, links)
    right.plot(foot[:, 0], foot[:, 2], ".", ms=0.8, color=_MAGENTA)
    q = body_inverse(profile, profile.rest_feet())
    rest = apply(profile.T_coxa_body[1], leg_points(profile, q)[1])
    for axes, title in ((left, "end of the femur"), (right, "foot")):
        for (a, b), color in zip(((0, 1), (1, 2), (2, 3)), ("#d55e00", "#0072b2", "#009e73"), strict=True):
            axes.plot(rest[[a, b], 0], rest[[a, b], 2], "-o", color=color, lw=3, ms=4)
        axes.set_aspect("equal")
        axes.set_title(title)
        axes.set_xlabel("outward [m]")
        axes.set_ylabel("up [m]")
    spans = np.degrees(profile.joint_limits[:, :, 1] - profile.joint_limits[:, :, 0])
    return [
        ", ".join(f"{value:.0f}" for value in sorted(set(np.round(spans[:, 0]).tolist()))) + " deg",
        f"{spans[:, 1].min():.0f} to {spans[:, 1].max():.0f} deg",
        f"{spans[:, 2].min():.0f} to {spans[:, 2].max():.0f} deg",
    ]


def draw_body_motion(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.2: the samples of the body's motion."""
    x, y = _cone(his.BODY_STEP, his.BODY_ANGLE)
    axes = figure.subplots()
    _draw_robot(axes, data.profile, np.zeros(3), data.profile.rest_feet(), _LEG)
    axes.hexbin(x, y, gridsize=24, cmap="Blues", mincnt=1, alpha=0.9)
    _label(axes)
    return []


def draw_foot_motion(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.3: the samples of the left front foot's motion."""
    feet = data.profile.rest_feet()
    x, y = _cone(his.FOOT_STEP, his.FOOT_ANGLE)
    axes = figure.subplots()
    _draw_robot(axes, data.profile, np.zeros(3), feet, _LEG)
    image = axes.hexbin(feet[0, 0] + x, feet[0, 1] + y, gridsize=30, cmap="Blues", mincnt=1, alpha=0.9)
    figure.colorbar(image, ax=axes, label=f"samples of {_SAMPLES}", shrink=0.8)
    _label(axes)
    return []


def draw_reach(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.4: a swing whose points are moved into the space of the leg."""
    profile = data.profile
    axes = figure.subplots()
    nearest, farthest = _ways(profile, 1)
    angle = np.linspace(-math.pi / 2, math.pi / 2, 200)
    for radius, alpha in ((farthest, 0.30), (nearest, 1.0)):
        color = _SPACE if radius == farthest else "white"
        axes.fill(profile.links.coxa + radius * np.cos(angle), radius * np.sin(angle), color=color, alpha=alpha, lw=0)
    ground, start, end = -0.105, 0.10, farthest + profile.links.coxa - 0.055
    default = np.array(
        [[start, ground], [start, ground + _LIFT], [(start + end) / 2, ground + 0.10], [end, ground + 0.09], [end, ground]]
    )
    high = default + np.array([[0, 0], [0, 0], [0, 0], [0.045, 0.105], [0, 0]])
    refined = np.array([_into(p, profile.links.coxa, nearest, farthest) for p in high])
    axes.plot(*high.T, "-o", color=_REJECTED, lw=1.6, ms=4, label="default, rejected")
    axes.plot(*refined.T, "-o", color=_REFINED, lw=1.8, ms=4, label="nearest points in reach")
    axes.axhline(ground, color="#111111", lw=2)
    axes.plot(0.0, 0.0, "P", color="#0072b2", ms=9, label="origin of the leg")
    axes.set_aspect("equal")
    axes.set_ylim(-0.16, 0.12)
    axes.set_xlim(-0.02, 0.30)
    axes.set_xlabel("outward [m]")
    axes.set_ylabel("up [m]")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return []


def draw_proximity(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.5: a swing that is raised over the ground, and ours over the same ground."""
    x = np.linspace(0.0, 0.16, 200)
    ground = np.where((x > 0.055) & (x < 0.105), 0.06, 0.0)
    axes = figure.subplots()
    axes.fill_between(x, ground, -0.02, color="#d9c3a0")
    axes.plot(x, ground, color="#111111", lw=1.6)
    start, end = np.array([0.02, 0.0]), np.array([0.14, 0.0])
    top = 0.04

    def path(height: float) -> Array:
        return np.array([start, [start[0], height], [(start[0] + end[0]) / 2, height + 0.01], [end[0], height], end])

    axes.plot(*path(top).T, "-o", color=_REJECTED, lw=1.6, ms=4, label="default, rejected")
    while _least_clearance(path(top), x, ground) < _CLEAR:
        top += 0.001
    axes.plot(*path(top).T, "-o", color=_REFINED, lw=1.8, ms=4, label="raised in steps")
    foot, target = (np.array([[place[0], 0.0, 0.0]]) for place in (start, end))
    under = np.interp(np.linspace(start[0], end[0], _FRAMES), x, ground)[:, None]
    clearance = max(float(under.max()) + StepParams().path_margin_m, float(descent_clearance(under, foot, target, _CLEAR)[0]))
    shown = 1e-3 * our_path(tuple(1e3 * start), [tuple(1e3 * end)], 1e3 * clearance)
    axes.plot(*shown.T, color="#0072b2", lw=1.8, label=f"here, clearance {100 * clearance:.1f} cm")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("z [m]")
    axes.legend(loc="upper left", ncols=3)
    axes.set_ylim(-0.02, 0.15)
    return [f"{100 * _least_clearance(path(top), x, ground):.1f} cm; ours {100 * _least_clearance(shown, x, ground):.1f} cm"]


def draw_configurations(figure: Any, data: Data) -> list[str]:
    """Draw figure 5.6: consecutive configurations of a plan, in which a front leg makes a step."""
    before, steps, k = _front_step(data.seed)
    step = steps[k]
    axes = figure.subplots()
    profile = data.profile
    body0, feet0 = before
    _draw_robot(axes, profile, body0, feet0, _BEFORE, fill=False)
    feet1 = feet0.copy()
    feet1[step.leg] = step.touchdown
    for share in (0.25, 0.5, 0.75):
        body, feet = body0 + share * (step.body - body0), feet0.copy()
        feet[step.leg] = feet0[step.leg] + share * (step.touchdown - feet0[step.leg])
        _draw_robot(axes, profile, body, feet, _MAGENTA, fill=False, only=step.leg)
    _draw_robot(axes, profile, step.body, feet1, _AFTER, fill=False)
    for color, label in ((_BEFORE, "before"), (_MAGENTA, "leg in the step"), (_AFTER, "after")):
        axes.plot([], [], color=color, lw=2, label=label)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    _label(axes)
    return []


@cache
def _front_step(seed: int) -> tuple[tuple[Array, Array], list[PassageStep], int]:
    """Return the stance before a long step of a front leg in his plan of the first layout, the steps, and its index."""
    from sextant.evaluation.baselines.masri_planner import MasriPlanner
    from sextant.shared.robot.profiles import load_profile

    task = planner_table.task_of(planner_table.LAYOUTS[0], seed)
    found = MasriPlanner(load_profile("phantomx_mk2")).plan(task.field, task.stance, task.goal_x)
    steps = list(found.steps)
    body, feet = task.stance.body, task.stance.feet.copy()
    longest, at, stance = -1.0, 0, (body, feet.copy())
    for k, step in enumerate(steps):
        length = float(np.linalg.norm(step.touchdown - feet[step.leg]))
        if step.leg in (0, 1) and length > longest:
            longest, at, stance = length, k, (body, feet.copy())
        feet[step.leg], body = step.touchdown, step.body
    return stance, steps, at


def _cone(step: tuple[float, float], angle: float) -> tuple[Array, Array]:
    """Return samples of a motion, eq. (5.1) to (5.4): uniform in length, normal in angle within its limits."""
    rng = np.random.default_rng(0)
    length = step[0] + (step[1] - step[0]) * rng.random(_SAMPLES)
    turned = rng.normal(0.0, angle / 2.0, 3 * _SAMPLES)
    turned = turned[np.abs(turned) <= angle][:_SAMPLES]
    return length * np.cos(turned), length * np.sin(turned)


def _ways(profile: RobotProfile, leg: int) -> tuple[float, float]:
    """Return the shortest and longest distance [m] of a foot from the femur's axis."""
    femur, tibia = profile.links.femur, profile.links.tibia
    folded, stretched = float(profile.joint_limits[leg, 2, 0]), min(float(profile.joint_limits[leg, 2, 1]), 0.0)
    return tuple(math.sqrt(femur**2 + tibia**2 + 2 * femur * tibia * math.cos(q)) for q in (folded, stretched))  # type: ignore[return-value]


def _into(p: Array, coxa: float, nearest: float, farthest: float) -> Array:
    """Return the nearest point in reach of a point (2,) [m]: outward and up."""
    off = p - [coxa, 0.0]
    length = float(np.linalg.norm(off))
    return np.asarray([coxa, 0.0] + off * min(max(length, nearest), farthest) / max(length, 1e-9))


def _least_clearance(path: Array, x: Array, ground: Array) -> float:
    """Return the least height [m] of a path (n, 2) over the ground, away from its ends."""
    s = np.linspace(0.0, len(path) - 1.0, 600)
    k = np.minimum(s.astype(int), len(path) - 2)
    p = path[k] + (s - k)[:, None] * (path[k + 1] - path[k])
    inner = (p[:, 0] > path[0, 0] + 0.005) & (p[:, 0] < path[-1, 0] - 0.005)
    return float((p[inner, 1] - np.interp(p[inner, 0], x, ground)).min())


def _draw_body(axes: Any, profile: RobotProfile, body: Array, color: str = _LEG, fill: bool = True) -> None:
    length, width, _ = profile.body.size
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) * (length / 2, width / 2) + body[:2]
    if fill:
        axes.fill(corners[:, 0], corners[:, 1], color=_BODY)
    axes.plot(corners[:, 0], corners[:, 1], color=color, lw=1.4)


def _draw_robot(
    axes: Any, profile: RobotProfile, body: Array, feet: Array, color: str, fill: bool = True, only: int | None = None
) -> None:
    """Draw a robot from above; its feet (6, 3) are in the frame of the picture. `only` draws a single leg."""
    if only is None:
        _draw_body(axes, profile, body, color, fill)
    for leg in range(6) if only is None else (only,):
        coxa = body[:2] + profile.T_body_coxa[leg, :2, 3]
        axes.plot([coxa[0], feet[leg, 0]], [coxa[1], feet[leg, 1]], "-o", color=color, lw=1.8, ms=3.5)


def _label(axes: Any) -> None:
    axes.set_aspect("equal")
    axes.set_xlabel("ahead [m]")
    axes.set_ylabel("left [m]")
