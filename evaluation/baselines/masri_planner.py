"""Masri's motion planner as published (2016, chapter 5), to compare with on the same strips.

It makes his tests only: reach, no foot under the body, front and rear feet outside of the body's ends, feet 6 cm apart, and
ground that carries a foot. It tests neither support nor loads nor collisions of legs. The thesis gives two numbers: the 6 cm,
and 2 cm under a swinging foot. The others are assumed, and were chosen on seeds 1000 to 1007. With them the search solves most
strips, and makes as many nodes as in his Table 6.1. Eq. (5.5) is taken as its text means it: progress lowers the weight.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.roadmap.roadmap import PassageStep, Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin
from sextant.shared.runtime.compiled import compiled

SECTIONS = 3  # plans for one crossing, as in his experiments
_ORDER = np.array([3, 2, 1, 4, 5, 0])  # of the pentapod gait: from rear to front on each side
_MOVES, _FOOTHOLDS = 8, 8  # m and n
_CYCLES = 14  # l
BODY_STEP = (0.0, 0.035)  # [m] d_bmin and d_bmax
BODY_ANGLE = math.radians(45.0)  # alpha
FOOT_STEP = (0.0, 0.25)  # [m] d_lmin and d_lmax
FOOT_ANGLE = math.radians(35.0)  # beta
_DRIFT = 0.12  # [m] Delta y
_STRONG, _WEAKEST = -2, -1  # [cells] of F: a sample is used unchanged, and a local minimum carries a foot
_APART = 0.06  # [m] between two feet
_BOUND = 5.0  # [cells] of F at -1
_DEPTH_FIRST = 10.0  # more than two weights differ: (5.6) chooses among the candidates of the current leg
_LIFT = 0.02  # [m] of a swinging foot over the ground
_LEAST_CLEARANCE = 0.03  # [m] over the higher end of a swing
_NODES, _BUDGET = 100_000, 24_000  # configurations and expansions of one search
_TRIES = 3  # searches for one section, with other samples


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """Result of planning a whole crossing, section by section."""

    steps: tuple[PassageStep, ...]  # of all sections; those that were found if it is not complete
    complete: bool  # whether the last one ends at the goal
    generated: tuple[int, ...]  # n_g of each section
    expanded: tuple[int, ...]  # n_e of each section


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Result of planning one section."""

    steps: tuple[PassageStep, ...]
    end: Stance | None  # None without a plan
    generated: int  # n_g
    expanded: int  # n_e


class _Strip(NamedTuple):
    """The ground, and how far to go."""

    elevation: NDArray[np.float32]  # (nx, ny) [m] {strip}
    evaluation: NDArray[np.int8]  # (nx, ny) [cells] F
    x0: float  # [m] of the first cell
    y0: float  # [m]
    cell: float  # [m] edge
    goal_x: float  # [m]


class _Robot(NamedTuple):
    """The legs and the trunk."""

    T_coxa_body: Array  # (6, 4, 4)
    links: tuple[float, float, float]  # [m] coxa, femur, tibia
    limits: Array  # (6, 3, 2) [rad]
    foot_radius: float  # [m]
    ends: NDArray[np.int64]  # (6,) 1 for front, -1 for rear, 0 for middle legs
    half_length: float  # [m] of the trunk
    half_width: float  # [m]


class _Tree(NamedTuple):
    """Configurations (n), and a heap of those that are open."""

    parent: NDArray[np.int64]
    leg: NDArray[np.int64]  # that made the step from the parent
    depth: NDArray[np.int64]
    body: Array  # (n, 3) [m] {strip}
    feet: Array  # (n, 6, 3) [m] {strip}
    weight: Array
    heap: NDArray[np.int64]


class MasriPlanner:
    """Plans a crossing in three sections of equal length."""

    def __init__(self, profile: RobotProfile) -> None:
        """Prepare for a robot, and compile."""
        self._profile = profile
        mounts, (length, width, _) = profile.T_body_coxa[:, 0, 3], profile.body.size
        self._robot = _Robot(
            profile.T_coxa_body,
            (profile.links.coxa, profile.links.femur, profile.links.tibia),
            profile.joint_limits,
            profile.foot.radius,
            (np.sign(mounts) * (np.abs(mounts) > length / 4)).astype(np.int64),
            length / 2,
            width / 2,
        )
        parent, leg, depth, heap = np.zeros((4, _NODES), dtype=np.int64)
        self._tree = _Tree(parent, leg, depth, np.zeros((_NODES, 3)), np.zeros((_NODES, 6, 3)), np.zeros(_NODES), heap)

    def plan(self, field: StripMap, stance: Stance, goal_x: float, seed: int = 1) -> Crossing:
        """Plan from a stance to a body at x = `goal_x` [m] {strip}."""
        steps: list[PassageStep] = []
        generated, expanded = [], []
        span = (goal_x - float(stance.body[0])) / SECTIONS
        for section in range(SECTIONS):
            goal = goal_x if section == SECTIONS - 1 else float(stance.body[0]) + span
            found = self.plan_section(field, stance, goal, SECTIONS * seed + section)
            generated.append(found.generated)
            expanded.append(found.expanded)
            steps += found.steps
            if found.end is None:
                return Crossing(tuple(steps), False, tuple(generated), tuple(expanded))
            stance = found.end
        return Crossing(tuple(steps), True, tuple(generated), tuple(expanded))

    def plan_section(self, field: StripMap, stance: Stance, goal_x: float, seed: int) -> Section:
        """Plan one section, from a stance to a body at x = `goal_x` [m] {strip}."""
        counts = np.zeros(2, dtype=np.int64)
        for attempt in range(_TRIES):
            last = self._search(field, stance, goal_x, counts, _TRIES * seed + attempt)
            if last >= 0:
                end = Stance(self._tree.body[last].copy(), self._tree.feet[last].copy())
                return Section(tuple(self._steps_to(field, last)), end, int(counts[0]), int(counts[1]))
        return Section((), None, int(counts[0]), int(counts[1]))

    def _search(self, field: StripMap, stance: Stance, goal_x: float, counts: NDArray[np.int64], seed: int) -> int:
        """Return the index of the configuration at the goal, -1 without one."""
        self._tree.body[0], self._tree.feet[0] = stance.body, stance.feet
        strip = _Strip(field.elevation, field.evaluation, *field.first_cell, field.resolution, goal_x)
        return int(search(strip, self._robot, self._tree, counts, seed))

    def _steps_to(self, field: StripMap, node: int) -> list[PassageStep]:
        """Return the steps from the root to a configuration."""
        way = []
        while node > 0:
            way.append(node)
            node = int(self._tree.parent[node])
        return [self._step(field, node) for node in reversed(way)]

    def _step(self, field: StripMap, node: int) -> PassageStep:
        before, leg = int(self._tree.parent[node]), int(self._tree.leg[node])
        foot, touchdown, body = self._tree.feet[before, leg], self._tree.feet[node, leg], self._tree.body[node]
        standing = np.delete(self._tree.feet[before], leg, axis=0)[:, :2]
        centre = resting_centre_of_mass(self._profile)[:2]
        margin = min(support_margin(standing, place[:2] + centre) for place in (self._tree.body[before], body))
        return PassageStep(leg, touchdown.copy(), self._clearance(field, foot, touchdown), body.copy(), margin)

    def _clearance(self, field: StripMap, foot: Array, touchdown: Array) -> float:
        """Return the height [m] over both ends that keeps a swinging foot 2 cm above the ground (section 5.4.1)."""
        way = foot[:2] + np.linspace(0.0, 1.0, 20)[:, None] * (touchdown - foot)[:2]
        i, j = np.rint((way - field.first_cell) / field.resolution).astype(int).T
        inside = (i >= 0) & (j >= 0) & (i < field.top.shape[0]) & (j < field.top.shape[1])
        highest = float(field.top[i[inside], j[inside]].max(initial=-np.inf))
        over = highest + _LIFT + self._profile.foot.radius - max(float(foot[2]), float(touchdown[2]))
        return min(max(over, _LEAST_CLEARANCE), self._profile.stance.max_lift)


@compiled
def search(strip: _Strip, robot: _Robot, tree: _Tree, counts: NDArray[np.int64], seed: int) -> int:
    """Grow a tree of configurations from node 0; return the node at the goal, or -1.

    The candidate of the current leg with the lowest weight is expanded. If none is left, the search goes back by one step.

    Args:
        strip: The ground.
        robot: The robot.
        tree: Memory; body and feet of node 0 are the start.
        counts: (2,) generated and expanded nodes, to which those of this search are added.
        seed: Of the samples.
    """
    np.random.seed(seed)  # noqa: NPY002 - compiled code has its own generator
    start_x, start_y = tree.body[0, 0], tree.body[0, 1]
    tree.parent[0], tree.depth[0], tree.weight[0], tree.heap[0] = -1, 0, 0.0, 0
    open_nodes, nodes, expanded = 1, 1, 0
    moved, goal = np.zeros(3), np.zeros(3)
    while open_nodes > 0 and expanded < _BUDGET:
        node = tree.heap[0]
        open_nodes -= 1
        tree.heap[0] = tree.heap[open_nodes]
        _sink(tree.heap, open_nodes, tree.weight)
        expanded += 1
        if tree.depth[node] >= 6 * _CYCLES:
            continue
        leg = _ORDER[tree.depth[node] % 6]
        for _ in range(_MOVES):  # (5.1) and (5.2)
            step, angle = _between(BODY_STEP[0], BODY_STEP[1]), _within(BODY_ANGLE)
            moved[:] = tree.body[node]
            moved[0] += step * math.cos(angle)
            moved[1] += step * math.sin(angle)
            if abs(moved[1] - start_y) > _DRIFT or not _others_stand(robot, tree.feet[node], leg, moved):
                continue
            for _ in range(_FOOTHOLDS):  # (5.3) and (5.4)
                step, angle = _between(FOOT_STEP[0], FOOT_STEP[1]), _within(FOOT_ANGLE)
                goal[:] = tree.feet[node, leg]
                goal[0] += step * math.cos(angle)
                goal[1] += step * math.sin(angle)
                value = _put_on_ground(strip, robot.foot_radius, goal)
                if value >= 0 or not _may_land(robot, tree.feet[node], leg, moved, goal):
                    continue
                if nodes == len(tree.parent):
                    _count(counts, nodes, expanded)
                    return -1
                tree.parent[nodes], tree.leg[nodes], tree.depth[nodes] = node, leg, tree.depth[node] + 1
                tree.body[nodes], tree.feet[nodes], tree.feet[nodes, leg] = moved, tree.feet[node], goal
                progress = (moved[0] - start_x) / (strip.goal_x - start_x)
                safety = max(value / _BOUND, -1.0)
                tree.weight[nodes] = safety - progress - _DEPTH_FIRST * tree.depth[nodes]  # (5.5) as meant
                if moved[0] >= strip.goal_x:
                    _count(counts, nodes + 1, expanded)
                    return nodes
                tree.heap[open_nodes] = nodes
                open_nodes += 1
                _rise(tree.heap, open_nodes - 1, tree.weight)
                nodes += 1
    _count(counts, nodes, expanded)
    return -1


@compiled
def _others_stand(robot: _Robot, feet: Array, leg: int, body: Array) -> bool:
    """Return whether all legs but one may stand and reach their feet from a body (3,) [m] {strip} (section 5.1.1)."""
    stand = True
    for other in range(6):
        stand = stand and (other == leg or _stands(robot, other, feet[other] - body))
    return stand


@compiled
def _may_land(robot: _Robot, feet: Array, leg: int, body: Array, goal: Array) -> bool:
    """Return whether a leg may stand at a goal (3,) [m] {strip}, reaches it, and keeps away from the others (section 5.2.1)."""
    for other in range(6):
        off_x, off_y = goal[0] - feet[other, 0], goal[1] - feet[other, 1]
        if other != leg and math.sqrt(off_x * off_x + off_y * off_y) < _APART:
            return False
    return _stands(robot, leg, goal - body)


@compiled
def _put_on_ground(strip: _Strip, foot_radius: float, foot: Array) -> int:
    """Move a foot (3,) [m] {strip} onto the ground that carries it, and return F there [cells], 0 if there is none."""
    i, j = int(np.rint((foot[0] - strip.x0) / strip.cell)), int(np.rint((foot[1] - strip.y0) / strip.cell))
    i, j = _carrying(strip.evaluation, i, j)
    if i < 0:
        return 0
    foot[0], foot[1] = strip.x0 + i * strip.cell, strip.y0 + j * strip.cell
    foot[2] = strip.elevation[i, j] + foot_radius
    return int(strip.evaluation[i, j])


@compiled
def _count(counts: NDArray[np.int64], generated: int, expanded: int) -> None:
    """Add generated and expanded nodes."""
    counts[0] += generated
    counts[1] += expanded


@compiled
def _between(least: float, most: float) -> float:
    """Return a random number of a uniform distribution, (5.1) and (5.3)."""
    return least + (most - least) * float(np.random.random())  # noqa: NPY002


@compiled
def _within(most: float) -> float:
    """Return a normal random number within -most and most, twice its standard deviation."""
    while True:
        value = float(np.random.normal(0.0, most / 2.0))  # noqa: NPY002
        if abs(value) <= most:
            return value


@compiled
def _carrying(evaluation: NDArray[np.int8], i: int, j: int) -> tuple[int, int]:
    """Return the cell to which a sample moves (section 5.2.1), -1 and -1 for none."""
    nx, ny = evaluation.shape
    if not (0 <= i < nx and 0 <= j < ny):
        return -1, -1
    while evaluation[i, j] > _STRONG:  # greedy search of the closest local minimum
        best_i, best_j = i, j
        for a in range(max(i - 1, 0), min(i + 2, nx)):
            for b in range(max(j - 1, 0), min(j + 2, ny)):
                if evaluation[a, b] < evaluation[best_i, best_j]:
                    best_i, best_j = a, b
        if best_i == i and best_j == j:
            break
        i, j = best_i, best_j
    return (i, j) if -127 <= evaluation[i, j] <= _WEAKEST else (-1, -1)


@compiled
def _stands(robot: _Robot, leg: int, foot: Array) -> bool:
    """Return whether a leg may stand at a foot (3,) [m] {body}, and reaches it within its joint limits.

    It may not stand under the trunk, and front and rear legs not behind their end of it.
    """
    if abs(foot[0]) < robot.half_length and abs(foot[1]) < robot.half_width:
        return False
    if robot.ends[leg] != 0 and robot.ends[leg] * foot[0] < robot.half_length:
        return False
    coxa, femur, tibia = robot.links
    T, limits = robot.T_coxa_body[leg], robot.limits[leg]
    x = T[0, 0] * foot[0] + T[0, 1] * foot[1] + T[0, 2] * foot[2] + T[0, 3]
    y = T[1, 0] * foot[0] + T[1, 1] * foot[1] + T[1, 2] * foot[2] + T[1, 3]
    z = T[2, 0] * foot[0] + T[2, 1] * foot[1] + T[2, 2] * foot[2] + T[2, 3]
    out = math.sqrt(x * x + y * y) - coxa
    cosine = (out * out + z * z - (femur * femur + tibia * tibia)) / (2.0 * femur * tibia)
    if abs(cosine) > 1.0:
        return False
    sine = -math.sqrt(1.0 - cosine * cosine)
    along, across = femur + tibia * cosine, tibia * sine
    q0, q2 = math.atan2(y, x), math.atan2(sine, cosine)
    q1 = math.atan2(z * along - out * across, out * along + z * across)
    inside = limits[0, 0] <= q0 <= limits[0, 1] and limits[1, 0] <= q1 <= limits[1, 1]
    return bool(inside and limits[2, 0] <= q2 <= limits[2, 1])


@compiled
def _rise(heap: NDArray[np.int64], at: int, weight: Array) -> None:
    """Move a new entry of a binary heap up to its place."""
    while at > 0:
        above = (at - 1) // 2
        if weight[heap[above]] <= weight[heap[at]]:
            return
        heap[above], heap[at] = heap[at], heap[above]
        at = above


@compiled
def _sink(heap: NDArray[np.int64], size: int, weight: Array) -> None:
    """Move the first entry of a binary heap down to its place."""
    at = 0
    while True:
        least = at
        for below in (2 * at + 1, 2 * at + 2):
            if below < size and weight[heap[below]] < weight[heap[least]]:
                least = below
        if least == at:
            return
        heap[least], heap[at] = heap[at], heap[least]
        at = least
