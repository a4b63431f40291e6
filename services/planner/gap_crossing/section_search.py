"""Search for the sections of a crossing: attempts with other footholds and samples, and their limit at one place."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from sextant.services.planner.gap_crossing.plan_message import make_plan_message
from sextant.services.planner.roadmap.roadmap import NoSection, SectionPlan, Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import PassagePlan

PLANNINGS = 3  # maximum number of plannings at one place
_PER_TICK = 4_000  # expansions per actuator message, 25 messages a second: 100 000 a second, the capacity of a core
_SAME_PLACE = 0.03  # [m] radius of one place of the body


class SectionPlanner(Protocol):
    """A planner of sections, implemented by `Roadmap`."""

    @property
    def edges(self) -> Array:
        """Return the tree, (n, 2, 3) [m] {strip}."""
        ...

    def attempts(self, field: StripMap) -> tuple[int | None, ...]:
        """Return the `inward` of the searches to try in turn on a strip."""
        ...

    def begin(self, field: StripMap, stance: Stance, goal_x: float, seed: int, turning: bool, inward: int | None) -> None:
        """Start a new search."""
        ...

    def grow(self, expansions: int) -> SectionPlan | NoSection | None:
        """Continue the search; return None while it is undecided."""
        ...


class SectionSearch:
    """Searches for one section after the other."""

    def __init__(self, roadmap: SectionPlanner, stopwatch: Callable[[], int]):
        """Start without a section.

        Args:
            roadmap: Planner of sections.
            stopwatch: [ns] clock for the planning time in the report.
        """
        self._roadmap, self._stopwatch = roadmap, stopwatch
        self.section = 0  # number of the section
        self.is_running = False
        self.straight_refusal = ""  # why no section leads straight on; then the body turns in all further sections
        self._left: list[int | None] = []  # attempts that remain for the section
        self._begun = 0  # number of searches, the seed of the newest
        self._tried: list[Array] = []  # (2,) [m] {world} body places of previous plannings
        self._stopped = ""  # why the last planning found no path
        self._goal_x = 0.0  # [m] {strip} goal of the section
        self._planning_ns = 0  # measured planning time
        self._report: PassagePlan | None = None

    @property
    def has_attempts(self) -> bool:
        """Return whether other samples remain to be tried for this section."""
        return bool(self._left)

    def begin(self, field: StripMap, root: Stance, goal_x: float, xy: Array) -> str:
        """Start the next attempt, of a new section if none is left; return why it is useless, or "".

        Args:
            field: The strip.
            root: Stance at the start.
            goal_x: [m] {strip} goal of the body.
            xy: (2,) [m] {world} place of the body.
        """
        if not self.has_attempts:
            if not self.may_plan_at(xy):
                words = f"the robot made no progress after {PLANNINGS} plans at one place"
                return f"{words}: {self._stopped}" if self._stopped else words
            self._tried.append(xy.copy())
            self.section, self._left = self.section + 1, [*self._roadmap.attempts(field)]
        self._goal_x, self._planning_ns, self.is_running, self._begun = goal_x, 0, True, self._begun + 1
        self._roadmap.begin(field, root, goal_x, self._begun, self.turns, self._left.pop(0))
        return ""

    @property
    def turns(self) -> bool:
        """Return whether the body may turn."""
        return bool(self.straight_refusal)

    def allow_turns(self, straight_refusal: str) -> None:
        """Allow turns of the body from now on, because no section leads straight on; count plannings again."""
        self.straight_refusal = straight_refusal
        self._tried.clear()

    def grow(self, now_ns: int, T_world_strip: Array) -> SectionPlan | NoSection | None:
        """Continue within the time budget; return the result, or None while it is undecided.

        A section that only leads closer counts after all attempts have failed, because it may be a dead end.
        """
        began_ns = self._stopwatch()
        found = self._roadmap.grow(_PER_TICK)
        self._planning_ns += self._stopwatch() - began_ns
        if found is None:
            return None
        self.is_running = False
        if isinstance(found, NoSection) and found.closer is not None and not self.has_attempts:
            found = found.closer
        self._report = make_plan_message(
            now_ns, self.section, found, T_world_strip, self._goal_x, self._roadmap.edges, self._planning_ns * 1e-9
        )
        self._stopped = found.reason if isinstance(found, NoSection) else ""
        return found

    def interrupt(self) -> None:
        """Stop the running attempt without a result."""
        self.is_running = False

    def finish(self) -> None:
        """End the section; the next attempt is one of another section."""
        self._left.clear()

    def may_plan_at(self, xy: Array) -> bool:
        """Return whether another section may be planned at a place (2,) [m] {world}."""
        return sum(float(np.linalg.norm(xy - place)) < _SAME_PLACE for place in self._tried) < PLANNINGS

    def take_report(self) -> PassagePlan | None:
        """Return the result of the last planning, once."""
        report, self._report = self._report, None
        return report
