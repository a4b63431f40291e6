"""Approach of a gap crossing: when and where it starts.

The robot walks to the edge of the gap, turns towards the far side, and starts to cross.
"""

from collections.abc import Iterator
from dataclasses import replace
from math import radians

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.gap_detection import gap_ahead
from sextant.services.planner.gap_crossing.roadmap import Roadmap
from sextant.services.planner.gap_crossing.settings import PassageSettings
from sextant.services.planner.gap_crossing.state_machine import Errand, Outcome, Over, Refused, Standing, Wait
from sextant.services.planner.navigation.path_follower import Heading, Pilot, same_goal
from sextant.services.planner.navigation.path_planner import NoWay
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import ActuatorState, Goal, Message, PassageMap, PassagePlan, VelocityCommand

BEFORE = 0.36  # [m] from the gap to the body where it stops; the feet stay clear of the edge during the turn
_AT_VERGE = 0.05  # [m] from that place within which the robot has arrived
_ALIGNED = radians(1.5)  # heading error below which the crossing begins
_TURN_GAIN, _TURN = 1.0, 0.15  # [1/s], and [rad/s] maximum yaw rate
_REST_NS = 300_000_000  # [ns] of rest after the last turn
_LAPSES_NS = 12_000_000_000  # [ns] lifetime of a refusal; it doubles with each further one at the same place
_TURNING_NS = 30_000_000_000  # [ns] maximum duration of the turn
_INCLINED = radians(15.0)  # heading error, below which a robot at the edge crosses in the direction that it faces
_ELSEWHERE = 0.30  # [m] from the place of a refusal, beyond which the robot tries again


class PassageMode:
    """Controls gap crossings for one goal at a time."""

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Initialize for a robot."""
        self._profile, self._settings = profile, settings
        self._goal: Goal | None = None
        self._errand: Errand | None = None
        self._approach: Pilot | None = None
        self._verge: tuple[Array, Array] | None = None  # (2,) [m] {world} start and target of the crossing
        self._still_ns = self._turning_ns = -1
        self._refused = ""
        self._refused_at: Array | None = None  # (2,) [m] {world}
        self._refused_ns, self._lapses_ns = 0, _LAPSES_NS
        self._crossed = False
        self._nothing_at: Array | None = None  # (2,) [m] {world} place of a look that found nothing to cross
        self._yielded: list[Array] = []  # (3,) [m] {world} places where ground gave way under feet; kept for all goals
        self._reports: list[PassagePlan] = []  # not published yet

    def under_way(self, goal: Goal) -> bool:
        """Return whether the robot crosses for this goal, or approaches the gap."""
        return self._goal is not None and same_goal(goal, self._goal) and (self._errand is not None or self._verge is not None)

    def crosses(self, goal: Goal) -> bool:
        """Return whether the robot crosses and needs only the map of the strip."""
        return self.under_way(goal) and self._errand is not None

    def ordered(self, goal: Goal) -> bool:
        """Return whether a goal requests a crossing that is not complete yet."""
        return goal.passage and not (self._goal is not None and same_goal(goal, self._goal) and self._crossed)

    def messages(self, now_ns: int) -> Iterator[Message]:
        """Yield the map request and the planning results that are due."""
        request = None if self._errand is None else self._errand.request(now_ns)
        if request is not None:
            yield request
        reports, self._reports = self._reports, []
        yield from reports

    def abandon(self) -> None:
        """Discard the state; the next crossing starts with six feet on the ground."""
        self._goal = self._errand = self._approach = self._verge = None
        self._refused, self._refused_at, self._crossed, self._nothing_at = "", None, False, None

    def lead(
        self, goal: Goal, state: ActuatorState, standing: Standing, T_world_body: Array, terrain: Terrain | None,
        map_: PassageMap | None, refused: str,
    ) -> Heading | Outcome:  # fmt: skip
        """Return the next action of the crossing.

        Args:
            goal: Goal behind the gap.
            state: State of the actuator.
            standing: Robot when the running step is over.
            T_world_body: (4, 4) current body pose.
            terrain: Newest map around the robot, not needed while `crosses` is true.
            map_: Newest map of the strip, or None.
            refused: Why the actuator refused the last step, or "".
        """
        if self._goal is None or not same_goal(goal, self._goal):
            self.abandon()
            self._goal = goal
        xy = standing.body[:2, 3]
        lately = state.stamp_ns - self._refused_ns < self._lapses_ns
        if self._refused and lately and self._is_where_refused(xy):
            return Refused(self._refused)
        self._refused = ""
        nothing_at = None if self.under_way(goal) else self._nothing_at
        if nothing_at is not None and float(np.linalg.norm(xy - nothing_at)) < _ELSEWHERE:
            return Refused("no gap to cross was found from here")
        if self._errand is None:
            assert terrain is not None
            led = self._to_verge(goal, state, standing, T_world_body, terrain)
            if led is not None:
                return self._noted(led, xy, state.stamp_ns)
        assert self._errand is not None
        outcome = self._errand.advance(state, standing, map_, refused)
        report = self._errand.report
        self._reports += [] if report is None else [report]
        return self._noted(outcome, xy, state.stamp_ns)

    def _noted(self, outcome: Heading | Outcome, xy: Array, now_ns: int) -> Heading | Outcome:
        """Record an outcome that is final, and return it."""
        if isinstance(outcome, Over):
            nothing = self._errand is not None and not self._errand.walked
            self._errand, self._verge, self._crossed, self._nothing_at = None, None, True, xy.copy() if nothing else None
        elif isinstance(outcome, Refused):
            self._errand, self._verge = None, None
            self._lapses_ns = 2 * self._lapses_ns if self._is_where_refused(xy) else _LAPSES_NS
            self._refused, self._refused_at, self._refused_ns = outcome.reason, xy.copy(), now_ns
        return outcome

    def _is_where_refused(self, xy: Array) -> bool:
        """Return whether a place (2,) [m] {world} is near the last refusal."""
        return self._refused_at is not None and float(np.linalg.norm(xy - self._refused_at)) < _ELSEWHERE

    def _to_verge(
        self, goal: Goal, state: ActuatorState, standing: Standing, T_world_body: Array, terrain: Terrain
    ) -> Heading | Outcome | None:
        """Return the next action on the way to the gap, or None once the robot crosses.

        At the gap the robot stands at its edge and faces across.
        """
        if self._verge is None:
            refusal = self._choose_verge(goal, standing, terrain)
            if refusal:
                return Refused(refusal)
        assert self._verge is not None
        place, target = self._verge
        if self._approach is not None:
            there = replace(goal, waypoints=place[None], tolerance=_AT_VERGE, passage=False)
            led = self._approach.lead(there, terrain, T_world_body, standing.body, state.stamp_ns)
            if isinstance(led, NoWay):
                return Refused(f"no path to the edge of the gap: {led.reason}")
            if led.commands:
                return Heading(led.commands, f"walking to the edge of a gap, {led.words}")
            self._approach = None
        unready = self._face(goal, state, standing.body, target)
        if unready is None:
            roadmap = Roadmap(self._profile, PassageSettings(body_height=goal.body_height))
            self._errand = Errand(self._profile, self._settings, roadmap, standing, target, self._yielded)
        return unready

    def _choose_verge(self, goal: Goal, standing: Standing, terrain: Terrain) -> str:
        """Select start and target of the crossing; return why there is none, or ""."""
        xy, target = standing.body[:2, 3], goal.waypoints[-1]
        start = self._start(goal, standing, terrain)
        if isinstance(start, str):
            return start
        self._verge, self._approach, self._turning_ns = (start, target.copy()), Pilot(self._profile), -1
        facing = np.array([np.cos(yaw_of(standing.body)), np.sin(yaw_of(standing.body))])
        way = target - xy
        if float(np.linalg.norm(start - xy)) < _AT_VERGE and facing @ way > np.cos(_INCLINED) * np.linalg.norm(way):
            # The robot may stand on pillars, where a turn is difficult, so it crosses straight ahead.
            self._verge, self._approach = (start, xy + float(np.linalg.norm(way)) * facing), None
        return ""

    def _face(self, goal: Goal, state: ActuatorState, body: Array, target: Array) -> Heading | Outcome | None:
        """Return the next action to face a place and come to rest, or None when done.

        The place is (2,) [m] {world}; the body pose is (4, 4) {world}.
        """
        way = target - body[:2, 3]
        error = float((np.arctan2(way[1], way[0]) - yaw_of(body) + np.pi) % (2.0 * np.pi) - np.pi)
        if abs(error) > _ALIGNED:
            self._still_ns = -1
            self._turning_ns = state.stamp_ns if self._turning_ns < 0 else self._turning_ns
            if state.stamp_ns - self._turning_ns > _TURNING_NS:
                return Refused(f"turning towards the gap takes too long: {np.degrees(error):.0f} deg are left")
            turn = min(max(_TURN_GAIN * error, -_TURN), _TURN)
            command = VelocityCommand(state.stamp_ns, np.zeros(2), turn, goal.body_height, goal.lift, goal.gait)
            return Heading((command,), f"turning by {np.degrees(error):.0f} deg towards the gap")
        if state.phase < 1.0:
            self._still_ns = -1
            return Wait("stopping before the gap")
        self._still_ns = state.stamp_ns if self._still_ns < 0 else self._still_ns
        if state.stamp_ns - self._still_ns < _REST_NS:
            return Wait("stopping before the gap")
        return None

    def _start(self, goal: Goal, standing: Standing, terrain: Terrain) -> Array | str:
        """Return the start (2,) [m] {world} of the crossing, or why there is none."""
        xy, target = standing.body[:2, 3], goal.waypoints[-1]
        ground = float(standing.feet[:, 2].mean()) - self._profile.foot.radius
        gap = gap_ahead(terrain, xy, target, ground)
        if isinstance(gap, str):
            return xy.copy() if self.ordered(goal) else gap
        ahead = np.array([np.cos(gap.heading), np.sin(gap.heading)])
        return np.asarray(xy + max(0.0, gap.distance - BEFORE) * ahead)
