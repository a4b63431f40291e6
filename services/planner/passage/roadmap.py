"""The roadmap planner of Masri 2016, chapter 5: a section of single-leg steps across a strip, or why there is none."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from services.planner.passage import search
from services.planner.passage.field import Field
from services.planner.passage.reasons import WORDS, fault_in_words, in_words
from services.planner.passage.settings import PassageSettings
from services.planner.passage.tables import ground_of, legs_of, rules_of, tree_of
from shared.geometry import Array
from shared.robot import RobotProfile

_LIT = 0.3  # [1] share of a row of cells across that is known, below which the known ground ends
_BAND = 0.35  # [m] either side of the middle line in which it counts
_WORTH = 0.05  # [m] of the body's way that a section must bring


@dataclass(frozen=True, slots=True, eq=False)
class Stance:
    """A robot on six feet, its yaw that of the strip."""

    body: Array  # (3,) [m] {strip} body origin
    feet: Array  # (6, 3) [m] {strip} foot centres


@dataclass(frozen=True, slots=True, eq=False)
class PassageStep:
    """One leg's step and the body's way meanwhile; leg -1 where only the body moves."""

    leg: int
    touchdown: Array  # (3,) [m] {strip} foot centre
    clearance: float  # [m] over the higher end
    body: Array  # (3,) [m] {strip} at its end
    margin: float  # [m] of support, the least of the step


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """A section that can be walked."""

    steps: tuple[PassageStep, ...]
    complete: bool  # whether it ends at the goal
    reason: str  # why it ends where it does, in words
    generated: int  # n_g
    expanded: int  # n_e
    end: Stance


@dataclass(frozen=True, slots=True, eq=False)
class NoWay:
    """Why there is no section worth walking."""

    reason: str  # in words
    unseen: bool  # whether unknown ground stands in its way: another look may help
    furthest: Stance
    generated: int
    expanded: int
    fails: dict[str, int]  # how often each test failed


class Roadmap:
    """Grows a tree of configurations from a stance towards a place along the strip. Same input and seed: same plan."""

    def __init__(self, profile: RobotProfile, settings: PassageSettings | None = None):
        """Make room for a robot's configurations."""
        self._profile, self._settings = profile, settings or PassageSettings()
        self._legs, self._rules = legs_of(profile, self._settings), rules_of(profile, self._settings)
        self._tree = tree_of(self._settings.nodes)
        self._exhaustive = False
        self._field: Field | None = None
        self._outcome: Crossing | NoWay | None = None

    @property
    def edges(self) -> Array:
        """(n, 2, 3) [m] {strip} body places at both ends of every step that was proven, for the picture."""
        n = int(self._tree.counts[search.NODES])
        proven = np.flatnonzero((self._tree.state[:n] == search.PROVEN) & (self._tree.parent[:n] >= 0))
        return np.stack([self._tree.body[self._tree.parent[proven]], self._tree.body[proven]], axis=1)

    @property
    def expanded(self) -> int:
        """n_e so far."""
        return int(self._tree.counts[search.EXPANDED])

    def begin(self, field: Field, stance: Stance, goal_x: float, seed: int, exhaustive: bool = False) -> None:
        """Start anew.

        Args:
            field: The strip.
            stance: Where the robot stands.
            goal_x: [m] {strip} where its body shall be.
            seed: Of the samples.
            exhaustive: Try every motion of the lattice and every foothold instead of samples; for `passable`.

        Raises:
            ValueError: A stance that is none.
        """
        if stance.body.shape != (3,) or stance.feet.shape != (6, 3) or not np.isfinite(stance.feet).all():
            raise ValueError(f"a body (3,) and finite feet (6, 3) expected, found {stance.body.shape} and {stance.feet.shape}")
        self._field, self._exhaustive, self._outcome = field, exhaustive, None
        self._rules = rules_of(self._profile, self._settings, exhaustive)
        self._ground = ground_of(field, self._settings, exhaustive)
        self._goal_x = goal_x
        self._seen_to = self._end_of_the_known(field, stance)
        tree, root = self._tree, self._repaired(stance)
        used = int(tree.counts[search.NODES])
        tree.counts[:] = 0
        tree.counts[search.GOAL] = -1
        tree.counts[search.NODES] = 1
        tree.fails[:], tree.table[:] = 0, -1
        tree.foot[: used + 1] = search.ROOT_FOOT
        tree.root[:], tree.body[0] = root.feet, root.body
        tree.parent[0], tree.leg[0], tree.depth[0], tree.state[0], tree.cost[0] = -1, -1, 0, search.PROVEN, 0.0
        tree.random[0] = np.uint64((seed * 2654435761 + 88172645463325252) % (2**64 - 1) + 1)
        tree.goal[0] = min(goal_x, self._seen_to)
        tree.key[0], tree.queued[0], tree.turn[0] = 0.0, 0, 0
        tree.counts[search.QUEUED] = 1

    def grow(self, expansions: int) -> Crossing | NoWay | None:
        """Go on for so many expansions; None while the budget is not used up and nothing is found.

        Raises:
            ValueError: Nothing was begun.
        """
        if self._field is None:
            raise ValueError("a search that was begun expected: call begin() first")
        if self._outcome is not None:
            return self._outcome
        left = self._settings.budget - self.expanded if not self._exhaustive else expansions
        if not self._blame:
            search.grow(self._tree, self._ground, self._legs, self._rules, min(expansions, left), self._exhaustive)
        count = self._tree.counts
        spent = count[search.QUEUED] == 0 or (self.expanded >= self._settings.budget and not self._exhaustive)
        if count[search.GOAL] >= 0 or spent or self._blame:
            self._outcome = self._conclude()
        return self._outcome

    def _end_of_the_known(self, field: Field, stance: Stance) -> float:
        """How far [m] {strip} the body may go before its front feet step on what is not known."""
        front = float((self._legs.rest[:, 0]).max())
        known = field.known_until(float(stance.feet[:, 0].max()), _BAND, _LIT)
        return np.inf if known >= field.elevation.shape[0] * field.resolution - 1e-9 else known - front - 0.03

    def _repaired(self, stance: Stance) -> Stance:
        """The stance with its body moved by no more than allowed so that all legs hold it; notes what cannot be helped."""
        self._blame, self._shift = "", np.zeros(3)
        found = np.zeros(7, dtype=np.int64)
        search.faults(self._legs, self._rules, 1, stance.feet, stance.body, found)
        if not found.any():
            return stance
        first = found.copy()
        for strict in (0, 1):  # with all that is spared for the steps to come, or just so
            for shift in _shifts(self._settings.repair, 0.005):
                body = stance.body + shift
                search.faults(self._legs, self._rules, strict, stance.feet, body, found)
                if not found.any():
                    self._shift = shift
                    return replace(stance, body=body)
        if np.count_nonzero(first[:6]) == 1 and not first[6]:
            return stance  # that leg's own step repairs it
        self._blame = fault_in_words(first, self._settings.repair)
        return stance

    def _conclude(self) -> Crossing | NoWay:
        """What came of it."""
        count, tree = self._tree.counts, self._tree
        generated, expanded = int(count[search.NODES]), int(count[search.EXPANDED])
        goal, furthest = int(count[search.GOAL]), int(count[search.FURTHEST])
        if goal >= 0:
            complete = self._goal_x <= tree.goal[0] + 1e-9
            reason = "at the goal" if complete else f"the ground is known to {self._seen_to:.2f} m only"
            return Crossing(self._steps(goal), complete, reason, generated, expanded, self._stance(goal))
        fails = tree.fails[0].sum(axis=1)
        counts = {WORDS[test]: int(fails[test]) for test in range(1, search.TESTS) if fails[test]}
        at_end = tree.depth[furthest] >= self._rules.depth
        if at_end and tree.body[furthest, 0] - tree.body[0, 0] >= _WORTH:
            reason = f"so far in {self._settings.cycles} cycles of the gait"
            return Crossing(self._steps(furthest), False, reason, generated, expanded, self._stance(furthest))
        reason, unseen = self._blame, False
        if not reason:
            spent = count[search.QUEUED] > 0
            reason, unseen = in_words(
                tree.fails[1], self._stance(furthest).body, self._stance(furthest).feet, self._field, spent
            )
        return NoWay(reason, unseen, self._stance(furthest), generated, expanded, counts)

    def _stance(self, node: int) -> Stance:
        return Stance(self._tree.body[node].copy(), np.array([self._foot(node, leg) for leg in range(6)]))

    def _foot(self, node: int, leg: int) -> Array:
        code, ground = int(self._tree.foot[node, leg]), self._ground
        if code == search.ROOT_FOOT:
            return np.array(self._tree.root[leg])
        i, j = divmod(code, ground.evaluation.shape[1])
        z = float(ground.elevation[i, j]) + self._profile.foot.radius
        return np.array([ground.x0 + i * ground.resolution, ground.y0 + j * ground.resolution, z])

    def _steps(self, node: int) -> tuple[PassageStep, ...]:
        """The way from the root."""
        steps = [self._step(n) for n in self._back(node)][::-1]
        if self._shift.any():
            body = self._tree.body[0].copy()
            steps.insert(0, PassageStep(search.ALL_STAND, body, 0.0, body, self._settings.margin))
        return tuple(steps)

    def _back(self, node: int) -> Iterator[int]:
        while self._tree.parent[node] >= 0:
            yield node
            node = int(self._tree.parent[node])

    def _step(self, node: int) -> PassageStep:
        tree, leg = self._tree, int(self._tree.leg[node])
        touchdown = self._foot(node, leg) if leg >= 0 else tree.body[node].copy()
        return PassageStep(leg, touchdown, float(tree.lift[node]), tree.body[node].copy(), float(tree.margin[node]))


def passable(profile: RobotProfile, settings: PassageSettings, field: Field, stance: Stance, goal_x: float) -> Crossing | NoWay:
    """Whether there is any way at all at this discretisation: all motions, all footholds, no budget but `settings.nodes`."""
    roadmap = Roadmap(profile, settings)
    roadmap.begin(field, stance, goal_x, seed=0, exhaustive=True)
    while (outcome := roadmap.grow(1_000_000)) is None:
        pass
    return outcome


def _shifts(most: float, step: float) -> Iterator[Array]:
    """Body shifts [m] of at most so much, the shortest first."""
    n = int(most / step + 1e-6)
    grid = step * np.array(np.meshgrid(*[np.arange(-n, n + 1)] * 2, indexing="ij")).reshape(2, -1).T
    length = np.linalg.norm(grid, axis=1)
    for k in np.argsort(length, kind="stable"):
        if 0.0 < length[k] <= most + 1e-9:
            yield np.array([*grid[k], 0.0])
