"""Roadmap planner of Masri 2016, chapter 5.

It plans a section of single-leg steps across a strip, or reports why there is none.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.failure_reasons import TEST_NAMES, WHOLE_ROBOT, describe_fault, explain_failure
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.search_tables import ground_of, legs_of, rules_of, tree_of
from sextant.services.planner.roadmap.sections import (
    bare,
    foothold_heights,
    has_wide_places,
    hidden_behind,
    is_uneven,
    nearest_view,
)
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, rotation_z
from sextant.shared.robot.profile import RobotProfile

ATTEMPTS = 8  # attempts to plan a section with feet on all ground
_INWARD = (1, 0)  # [cells] of the attempts before them, on wide places
_BAND = 0.35  # [m] to either side of the middle line in which cells count
_MIN_SECTION_M = 0.05  # [m] minimum body travel of a section
_SPARE = 0.10  # [m] body travel planned beyond the end of a section that does not reach the goal
_RETREAT = 0.06  # [m] of the body before its furthest place
_VERGE = 0.06  # [m] of bare ground before a foot, from which the foot stands in bare ground and not at its edge


@dataclass(frozen=True, slots=True, eq=False)
class Stance:
    """A robot on six feet."""

    body: Array  # (3,) [m] {strip} body origin
    feet: Array  # (6, 3) [m] {strip} foot centres
    yaw: float = 0.0  # [rad] {strip} of the body


@dataclass(frozen=True, slots=True, eq=False)
class PassageStep:
    """Step of one leg with the body's motion; leg -1 if only the body moves."""

    leg: int
    touchdown: Array  # (3,) [m] {strip} foot centre
    clearance: float  # [m] over the higher end
    body: Array  # [m] {strip} body at the end of the step, (3,)
    margin: float  # [m] minimum support margin of the step
    yaw: float = 0.0  # [rad] {strip} of the body at the end of the step


@dataclass(frozen=True, slots=True, eq=False)
class SectionPlan:
    """A section that can be walked."""

    steps: tuple[PassageStep, ...]
    complete: bool  # whether it ends at the goal
    reason: str  # why it ends at this place
    generated: int  # n_g
    expanded: int  # n_e
    end: Stance


@dataclass(frozen=True, slots=True, eq=False)
class NoSection:
    """Reason why there is no section worth walking."""

    reason: str  # as text
    unseen: bool  # whether unknown ground is in the way: another look may help
    furthest: Stance
    generated: int
    expanded: int
    fails: dict[str, int]  # how often each test failed
    steps: tuple[PassageStep, ...] = ()  # to the furthest configuration, for display only; the robot does not execute them
    leg: int = WHOLE_ROBOT  # the leg whose test fails there, WHOLE_ROBOT for no single leg
    closer: SectionPlan | None = None  # a section towards the unknown ground, to a place from which more of it may be seen


class Roadmap:
    """Grows trees of configurations from a stance towards a place along the strip.

    The same input and seed give the same plan. The duration of a search has a long tail. So a tree that finds nothing in its
    share of the budget is replaced by a new one with other samples.
    """

    def __init__(self, profile: RobotProfile, settings: PassageSettings | None = None):
        """Allocate memory for the configurations of a robot."""
        self._profile, self._settings = profile, settings or PassageSettings()
        self._legs = legs_of(profile, self._settings)
        self._straight, self._turning = (rules_of(profile, self._settings, turning) for turning in (False, True))
        self._rules = self._straight
        self._tree = tree_of(self._settings.nodes)
        self._nearest_view = nearest_view(profile.camera, self._straight.height)
        self._hidden: Array = np.zeros(0)  # [m] {strip} begins of unknown ground behind higher ground
        self._field: StripMap | None = None

    @property
    def edges(self) -> Array:
        """Return the edges (n, 2, 3) [m] {strip} of the current tree, for display.

        They are the body places at both ends of every proven step.
        """
        n = int(self._tree.counts[roadmap_search.NODES])
        proven = np.flatnonzero((self._tree.state[:n] == roadmap_search.PROVEN) & (self._tree.parent[:n] >= 0))
        return np.stack([self._tree.body[self._tree.parent[proven]], self._tree.body[proven]], axis=1)

    @property
    def expanded(self) -> int:
        """Return the number of expansions so far (n_e)."""
        return self._expanded_before + int(self._tree.counts[roadmap_search.EXPANDED])

    @property
    def generated(self) -> int:
        """Return the number of generated configurations so far (n_g)."""
        return self._generated_before + int(self._tree.counts[roadmap_search.NODES])

    @property
    def expanded_nodes(self) -> int:
        """Return the number of different configurations that were expanded so far, each counted once.

        `expanded` counts each expansion of a configuration, and each one that fails its tests.
        """
        n = int(self._tree.counts[roadmap_search.NODES])
        return self._nodes_before + int(np.count_nonzero(self._tree.state[:n] == roadmap_search.PROVEN))

    def sampled(self, rng: np.random.Generator, n: int) -> list[Stance]:
        """Return n random stances of the current tree, for the benchmark."""
        return [self._stance(int(node)) for node in rng.integers(0, int(self._tree.counts[roadmap_search.NODES]), n)]

    def attempts(self, field: StripMap) -> tuple[int | None, ...]:
        """Return what to try in turn on a strip, each with another seed: the `inward` of `begin`.

        On wide places, feet first stand only in the middle, where the ground bears best: a pillar may tip under a load at its
        edge (Masri 2016, section 6.4.1).
        """
        is_wide = has_wide_places(field, self._settings.bare_ground, self._settings.central_cells)
        return (*(_INWARD if is_wide else ()), *(None,) * ATTEMPTS)

    def begin(
        self, field: StripMap, stance: Stance, goal_x: float, seed: int, turning: bool = False, inward: int | None = None
    ) -> None:
        """Start a new search.

        Args:
            field: The strip.
            stance: Stance of the robot.
            goal_x: [m] {strip} goal of the body.
            seed: Random seed of the samples.
            turning: Whether the body may turn; otherwise it faces along the strip.
            inward: [cells] If given, feet stand only in the middle of ground, this far inside of the middle's border.

        Raises:
            ValueError: The stance has wrong shapes or feet that are not finite.
        """
        if stance.body.shape != (3,) or stance.feet.shape != (6, 3) or not np.isfinite(stance.feet).all():
            raise ValueError(f"a body (3,) and finite feet (6, 3) expected, found {stance.body.shape} and {stance.feet.shape}")
        self._field, self._rules = field, self._turning if turning else self._straight
        if inward is not None:
            border = self._settings.central_cells
            self._rules = self._rules._replace(strong=border, wide=border, weakest=border, central=-border, inward=inward)
        self._hidden = np.zeros(0)
        if is_uneven(field, self._settings.uneven_m):
            sway, moves = self._settings.sway_m, self._settings.uneven_body_moves
            self._rules = self._rules._replace(sway=sway, move_samples=moves, uneven=True)
            self._hidden = hidden_behind(field, foothold_heights(field)[0] + self._settings.uneven_m, _BAND)
        self._outcome: SectionPlan | NoSection | None = None
        self._ground = ground_of(field)
        self._goal_x, self._max_body_x = goal_x, self._end_of_the_known(field, stance)
        self._yaw = round(stance.yaw / self._rules.yaw_step) if turning else 0
        self._root = self._repaired(stance)
        self._tree.random[0] = np.uint64((seed * 2654435761 + 88172645463325252) % (2**64 - 1) + 1)
        self._tries = self._expanded_before = self._generated_before = self._nodes_before = 0
        self._fails = np.zeros(roadmap_search.TESTS, dtype=np.int64)
        self._best: _Furthest | None = None
        self._plant()

    def grow(self, expansions: int) -> SectionPlan | NoSection | None:
        """Continue the search; return None while it is undecided.

        It is undecided while nothing is found and the budget is not used up. `expansions` limits this call.

        Raises:
            ValueError: `begin` was not called.
        """
        if self._field is None:
            raise ValueError("no search has begun; call begin() first")
        counts, budget = self._tree.counts, self._settings.budget
        while self._outcome is None and expansions > 0:
            if self._blame:
                self._outcome = self._no_way(self._blame, False, self._reached(0), self._blamed)
                break
            portion = min(expansions, budget - self.expanded, self._share() - int(counts[roadmap_search.EXPANDED]))
            expansions -= roadmap_search.grow(self._tree, self._ground, self._legs, self._rules, portion)
            ended = counts[roadmap_search.QUEUED] == 0 or counts[roadmap_search.EXPANDED] >= self._share()
            if counts[roadmap_search.GOAL] >= 0:
                self._outcome = self._crossing(int(counts[roadmap_search.GOAL]))
            elif self.expanded >= budget:
                self._note_furthest()
                self._outcome = self._nothing_found()
            elif ended:
                self._note_furthest()
                self._expanded_before, self._generated_before = self.expanded, self.generated
                self._nodes_before = self.expanded_nodes
                self._tries += 1
                self._plant()
        return self._outcome

    def _share(self) -> int:
        """Return the expansions of the current tree before another one replaces it.

        The number doubles with every second tree.
        """
        return int(self._settings.patience * 2 ** (self._tries // 2))

    def _plant(self) -> None:
        """Reset the tree to its root."""
        tree = self._tree
        tree.counts[:] = 0
        tree.counts[roadmap_search.GOAL] = -1
        tree.counts[roadmap_search.NODES] = tree.counts[roadmap_search.QUEUED] = 1
        tree.fails[:], tree.visits[:], tree.table[:] = 0, 0, -1
        tree.root[:], tree.body[0], tree.foot[0] = self._root.feet, self._root.body, roadmap_search.ROOT_FOOT
        tree.parent[0], tree.leg[0], tree.depth[0], tree.state[0], tree.cost[0] = -1, -1, 0, roadmap_search.PROVEN, 0.0
        tree.yaw[0] = self._yaw
        tree.goal[0] = min(self._goal_x, self._max_body_x)
        tree.key[0], tree.queued[0], tree.turn[0] = 0.0, 0, 0

    def _end_of_the_known(self, field: StripMap, stance: Stance) -> float:
        """Return the largest x [m] {strip} of the body for which the front feet stay on known ground; inf if all is known."""
        front = float((self._legs.rest[:, 0]).max())
        known = field.known_until(float(stance.feet[:, 0].max()), _BAND)
        return np.inf if known >= field.elevation.shape[0] * field.resolution - 1e-9 else known - front - 0.03

    def _repaired(self, stance: Stance) -> Stance:
        """Return the stance with its body shifted so that all legs hold it.

        The shift is limited by the settings. If no shift helps, the reason is kept in `_blame`.
        """
        self._blame, self._blamed, self._shift = "", WHOLE_ROBOT, np.zeros(3)
        found, R_strip_level = np.zeros(7, dtype=np.int64), rotation_z(self._yaw * self._rules.yaw_step)
        feet, level = stance.feet @ R_strip_level, stance.body @ R_strip_level
        roadmap_search.faults(self._legs, self._rules, roadmap_search.WITHOUT_RESERVE, feet, level, found)
        if not found.any():
            return stance
        first = found.copy()
        for limits in (roadmap_search.WITH_RESERVE, roadmap_search.WITHOUT_RESERVE):  # the reserve is for the next steps
            for shift in _shifts(self._settings.max_repair_m, 0.005):
                roadmap_search.faults(self._legs, self._rules, limits, feet, level + shift, found)
                if not found.any():
                    self._shift = R_strip_level @ shift
                    return replace(stance, body=stance.body + self._shift)
        if np.count_nonzero(first[:6]) == 1 and not first[6]:
            return stance  # the next step of that leg repairs it
        self._blame, self._blamed = describe_fault(first, self._settings.max_repair_m), int(np.flatnonzero(first)[0])
        return stance

    def _crossing(self, goal: int) -> SectionPlan | NoSection:
        """Return the section to a configuration."""
        x, known = float(self._tree.body[goal, 0]), self._max_body_x - float(self._root.body[0])
        seen = f"the ground is known only for {known:.2f} m ahead"
        if x >= self._goal_x - 1e-9:
            return self._section(goal, True, "at the goal")
        if x < self._root.body[0] + _MIN_SECTION_M:
            return self._no_way(seen, True, self._reached(goal))
        end = self._before(goal, _SPARE)  # so that the section does not end in a dead end
        if self._tree.body[end, 0] < self._root.body[0] + _MIN_SECTION_M:
            end = goal
        if x >= self._tree.goal[0] - 1e-9:
            return self._section(end, False, seen)
        return self._section(end, False, f"planned {self._settings.cycles} gait cycles, the limit for one section")

    def _nothing_found(self) -> NoSection:
        """Return the result when the budget is used up or everything was tried."""
        best = self._best
        assert best is not None
        assert self._field is not None
        stance, strokes = best.stance, self._legs.stroke.sum(axis=1)
        why = explain_failure(best.fails, stance.body, stance.feet, strokes, self._field, stance.yaw)
        no_way = self._no_way(why.words, why.unseen or best.looks_behind, best, why.leg)
        if not best.looks_behind and (not why.unseen or not best.retreat or self._ventures(best.retreat)):
            return no_way
        return replace(
            no_way, closer=SectionPlan(best.retreat, False, why.words, self.generated, self.expanded, best.retreat_stance)
        )

    def _ventures(self, steps: tuple[PassageStep, ...]) -> bool:
        """Return whether steps lead a robot from the near side into bare ground.

        Bare ground carries a foot only in some places. It is visible from the near side, so a stance in the middle of it
        without a path onwards has no benefit.
        """
        assert self._field is not None
        rows, x0, resolution = bare(self._field, self._settings.bare_ground), self._field.first_cell[0], self._field.resolution

        def within(x: float) -> bool:
            row = min(max(round((x - x0) / resolution), 0), len(rows) - 1)
            return bool(rows[max(row - round(_VERGE / resolution), 0) : row + 1].all())

        if any(within(float(foot[0])) for foot in self._root.feet):
            return False
        return any(within(float(step.touchdown[0])) for step in steps if step.leg >= 0)

    def _note_furthest(self) -> None:
        """Keep the furthest configuration of this tree if it is the furthest of all trees."""
        tree = self._tree
        self._fails += tree.fails[0].sum(axis=1)
        furthest = int(tree.counts[roadmap_search.FURTHEST])
        if self._best is not None and tree.body[furthest, 0] <= self._best.stance.body[0]:
            return
        self._best = self._reached(furthest)

    def _reached(self, node: int) -> "_Furthest":
        """Return a configuration, with the failed tests of the furthest stance."""
        tree = self._tree
        behind = next((n for n in self._views_behind(node) if self._is_worth(n)), -1)
        # The stance for another look is a little before the last reached one, which may be a dead end.
        back = behind if behind >= 0 else self._before(node, _RETREAT)
        retreat = self._steps(back) if self._is_worth(back) else ()
        stance, fails = self._stance(node), tree.fails[1].copy()
        return _Furthest(stance, fails, self._steps(node), retreat, self._stance(back), behind >= 0)

    def _is_worth(self, node: int) -> bool:
        """Return whether a section to a configuration is worth walking."""
        return bool(self._tree.body[node, 0] >= self._root.body[0] + _MIN_SECTION_M)

    def _views_behind(self, node: int) -> Iterator[int]:
        """Yield configurations on the path to a node that are near enough to see ground hidden behind higher ground."""
        x = float(self._tree.body[node, 0])
        for begin in self._hidden:
            way = x - (float(begin) - self._nearest_view)
            if way >= _RETREAT:
                yield self._before(node, way)

    def _section(self, node: int, complete: bool, reason: str) -> SectionPlan:
        return SectionPlan(self._steps(node), complete, reason, self.generated, self.expanded, self._stance(node))

    def _no_way(self, reason: str, unseen: bool, furthest: "_Furthest", leg: int = WHOLE_ROBOT) -> NoSection:
        fails = self._fails if self._best is not None else self._tree.fails[0].sum(axis=1)
        counts = {TEST_NAMES[test]: int(fails[test]) for test in range(1, roadmap_search.TESTS) if fails[test]}
        return NoSection(reason, unseen, furthest.stance, self.generated, self.expanded, counts, furthest.steps, leg)

    def _stance(self, node: int) -> Stance:
        feet = np.array([self._foot(node, leg) for leg in range(6)])
        return Stance(self._tree.body[node].copy(), feet, self._yaw_at(node))

    def _yaw_at(self, node: int) -> float:
        """Return the yaw [rad] {strip} of the body in a configuration."""
        return float(self._tree.yaw[node]) * self._rules.yaw_step

    def _foot(self, node: int, leg: int) -> Array:
        code, ground = int(self._tree.foot[node, leg]), self._ground
        if code == roadmap_search.ROOT_FOOT:
            return np.array(self._tree.root[leg])
        i, j = divmod(code, ground.evaluation.shape[1])
        z = float(ground.elevation[i, j]) + self._profile.foot.radius
        return np.array([ground.x0 + i * ground.resolution, ground.y0 + j * ground.resolution, z])

    def _steps(self, node: int) -> tuple[PassageStep, ...]:
        """Return the steps from the root."""
        steps = [self._step(n) for n in self._back(node)][::-1]
        if self._shift.any():
            body = self._tree.body[0].copy()
            steps.insert(0, PassageStep(roadmap_search.ALL_STAND, body, 0.0, body, self._settings.margin_m, self._yaw_at(0)))
        return tuple(steps)

    def _before(self, node: int, way: float) -> int:
        """Return the configuration `way` [m] of body travel before a node on its path."""
        x = self._tree.body[:, 0]
        return next((n for n in self._back(node) if x[n] <= x[node] - way), 0)

    def _back(self, node: int) -> Iterator[int]:
        while self._tree.parent[node] >= 0:
            yield node
            node = int(self._tree.parent[node])

    def _step(self, node: int) -> PassageStep:
        tree, leg = self._tree, int(self._tree.leg[node])
        touchdown = self._foot(node, leg) if leg >= 0 else tree.body[node].copy()
        body, lift, margin = tree.body[node].copy(), float(tree.lift[node]), float(tree.margin[node])
        return PassageStep(leg, touchdown, lift, body, margin, self._yaw_at(node))


@dataclass(frozen=True, slots=True, eq=False)
class _Furthest:
    """Furthest configuration of all trees."""

    stance: Stance
    fails: NDArray[np.int64]  # (tests, 7) failed tests there
    steps: tuple[PassageStep, ...]  # to the furthest stance
    retreat: tuple[PassageStep, ...]  # to a stance before it, from which more may be seen
    retreat_stance: Stance
    looks_behind: bool  # whether ground that is hidden behind higher ground may be seen from that stance


def _shifts(most: float, step: float) -> Iterator[Array]:
    """Yield body shifts [m] up to a length, the shortest first."""
    n = int(most / step + 1e-6)
    grid = step * np.array(np.meshgrid(*[np.arange(-n, n + 1)] * 2, indexing="ij")).reshape(2, -1).T
    length = np.linalg.norm(grid, axis=1)
    for k in np.argsort(length, kind="stable"):
        if 0.0 < length[k] <= most + 1e-9:
            yield np.array([*grid[k], 0.0])
