"""Approach of a gap crossing: when and where it starts.

The robot walks to the edge of the gap, turns towards the far side, and starts to cross.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import radians

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.gap_detection import detect_gap
from sextant.services.planner.gap_crossing.outcome import CannotCross, Completed, Outcome, Wait
from sextant.services.planner.gap_crossing.refusal_memory import RefusalMemory
from sextant.services.planner.gap_crossing.state_machine import GapCrossing
from sextant.services.planner.navigation.path_follower import MotionCommand, PathFollower, same_goal
from sextant.services.planner.navigation.path_planner import NoPath
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import Roadmap
from sextant.services.planner.robot_estimate import WorldStance
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import ActuatorState, Goal, Message, PassageMap, PassagePlan, VelocityCommand


class GapCrossingController:
    """Controls gap crossings for one goal at a time."""

    def __init__(self, profile: RobotProfile, settings: Settings, may_search: Callable[[], bool] = lambda: True):
        """Initialize for a robot; `may_search` returns whether a crossing may start, see `Planner`."""
        self._may_search = may_search
        self._profile, self._settings, self._params = profile, settings, settings.gap_approach
        self._goal: Goal | None = None
        self._gap_crossing: GapCrossing | None = None
        self._approach: PathFollower | None = None
        self._crossing_line: tuple[Array, Array] | None = None  # (2,) [m] {world} start and target of the crossing
        self._still_ns = self._turning_ns = -1  # [ns] when rest and turn before the gap began, -1 before them
        self._refusals = RefusalMemory(settings.gap_approach)
        self._crossed = False
        self._yielded: list[Array] = []  # (3,) [m] {world} places where ground gave way under feet; kept for all goals
        self._reports: list[PassagePlan] = []  # not published yet

    def is_active(self, goal: Goal) -> bool:
        """Return whether the robot crosses for this goal, or approaches the gap."""
        return (
            self._goal is not None
            and same_goal(goal, self._goal)
            and goal.gap_crossing != "never"
            and (self._gap_crossing is not None or self._crossing_line is not None)
        )

    def is_crossing(self, goal: Goal) -> bool:
        """Return whether the robot crosses and needs only the map of the strip."""
        return self.is_active(goal) and self._gap_crossing is not None

    def ordered(self, goal: Goal) -> bool:
        """Return whether a goal requests a crossing that is not complete yet."""
        return goal.gap_crossing == "always" and not (self._goal is not None and same_goal(goal, self._goal) and self._crossed)

    def messages(self, now_ns: int) -> Iterator[Message]:
        """Yield the map request and the planning results that are due."""
        request = None if self._gap_crossing is None else self._gap_crossing.request(now_ns)
        if request is not None:
            yield request
        reports, self._reports = self._reports, []
        yield from reports

    def abandon(self) -> None:
        """Discard the state; the next crossing starts with six feet on the ground."""
        self._goal = self._gap_crossing = self._approach = self._crossing_line = None
        self._crossed = False
        self._refusals.forget()

    def lead(
        self, goal: Goal, state: ActuatorState, standing: WorldStance, T_world_body: Array, terrain: Terrain | None,
        map_: PassageMap | None, refused: str,
    ) -> MotionCommand | Outcome:  # fmt: skip
        """Return the next action of the crossing.

        Args:
            goal: Goal behind the gap.
            state: State of the actuator.
            standing: Robot when the running step is over.
            T_world_body: (4, 4) current body pose.
            terrain: Newest map around the robot, not needed while `is_crossing` is true.
            map_: Newest map of the strip, or None.
            refused: Why the actuator refused the last step, or "".
        """
        if self._goal is None or not same_goal(goal, self._goal):
            self.abandon()
            self._goal = goal
        xy = standing.body[:2, 3]
        refusal = self._refusals.reason_at(xy, state.stamp_ns)
        if refusal:
            return CannotCross(refusal)
        if not self.is_active(goal) and self._refusals.found_nothing_at(xy):
            return CannotCross("no gap to cross was found from here")
        if self._gap_crossing is None:
            assert terrain is not None
            led = self._approach_gap(goal, state, standing, T_world_body, terrain)
            if led is not None:
                return self._noted(led, xy, state.stamp_ns)
        assert self._gap_crossing is not None
        outcome = self._gap_crossing.advance(state, standing, map_, refused)
        report = self._gap_crossing.report
        self._reports += [] if report is None else [report]
        return self._noted(outcome, xy, state.stamp_ns)

    def _noted(self, outcome: MotionCommand | Outcome, xy: Array, now_ns: int) -> MotionCommand | Outcome:
        """Record an outcome that is final, and return it."""
        if isinstance(outcome, Completed):
            nothing = self._gap_crossing is not None and not self._gap_crossing.walked
            self._gap_crossing, self._crossing_line, self._crossed = None, None, True
            self._refusals.complete(xy if nothing else None)
        elif isinstance(outcome, CannotCross):
            straight_refusal = "" if self._gap_crossing is None else self._gap_crossing.straight_refusal
            self._gap_crossing, self._crossing_line = None, None
            self._refusals.refuse(outcome.reason, xy, now_ns, straight_refusal)
        return outcome

    def _approach_gap(
        self, goal: Goal, state: ActuatorState, standing: WorldStance, T_world_body: Array, terrain: Terrain
    ) -> MotionCommand | Outcome | None:
        """Return the next action on the way to the gap, or None once the robot crosses.

        At the gap the robot stands at its edge and faces across.
        """
        if self._crossing_line is None:
            refusal = self._select_crossing_line(goal, standing, terrain)
            if refusal:
                return CannotCross(refusal)
        assert self._crossing_line is not None
        place, target = self._crossing_line
        if self._approach is not None:
            there = replace(goal, waypoints=place[None], tolerance=self._params.start_tolerance_m, gap_crossing="never")
            led = self._approach.lead(there, terrain, T_world_body, standing.body, state.stamp_ns)
            if isinstance(led, NoPath):
                return CannotCross(f"no path to the edge of the gap: {led.reason}")
            if led.commands:
                return MotionCommand(led.commands, f"walking to the edge of a gap, {led.words}")
            self._approach = None
        unready = self._face(goal, state, standing.body, target)
        if unready is None:
            if not self._may_search():
                return Wait("waiting at the gap until the search of gap crossings is compiled")
            settings = self._settings
            passage = PassageSettings.of(settings.gap_crossing, settings.gap_detection, goal.body_height)
            roadmap = Roadmap(self._profile, passage)
            straight_refusal = self._refusals.straight_refusal_at(standing.body[:2, 3])
            self._gap_crossing = GapCrossing(
                self._profile, self._settings, roadmap, standing, target, self._yielded, straight_refusal
            )
        return unready

    def _select_crossing_line(self, goal: Goal, standing: WorldStance, terrain: Terrain) -> str:
        """Select start and target of the crossing; return why there is none, or ""."""
        xy, target = standing.body[:2, 3], goal.waypoints[-1]
        start = self._start(goal, standing, terrain)
        if isinstance(start, str):
            return start
        self._crossing_line, self._approach = (start, target.copy()), PathFollower(self._profile, self._settings)
        self._still_ns = self._turning_ns = -1
        facing = np.array([np.cos(yaw_of(standing.body)), np.sin(yaw_of(standing.body))])
        way = target - xy
        inclined = facing @ way > np.cos(radians(self._params.inclined_deg)) * np.linalg.norm(way)
        if float(np.linalg.norm(start - xy)) < self._params.start_tolerance_m and inclined:
            # The robot may stand on pillars, where a turn is difficult, so it crosses straight ahead.
            self._crossing_line, self._approach = (start, xy + float(np.linalg.norm(way)) * facing), None
        return ""

    def _face(self, goal: Goal, state: ActuatorState, body: Array, target: Array) -> MotionCommand | Outcome | None:
        """Return the next action to face a place and come to rest, or None when done.

        The place is (2,) [m] {world}; the body pose is (4, 4) {world}.
        """
        way = target - body[:2, 3]
        error = float((np.arctan2(way[1], way[0]) - yaw_of(body) + np.pi) % (2.0 * np.pi) - np.pi)
        if abs(error) > radians(self._params.aligned_deg):
            self._still_ns = -1
            self._turning_ns = state.stamp_ns if self._turning_ns < 0 else self._turning_ns
            if state.stamp_ns - self._turning_ns > round(self._params.turning_s * 1e9):
                return CannotCross(f"turning towards the gap takes too long: {np.degrees(error):.0f} deg are left")
            turn = min(max(self._params.turn_gain * error, -self._params.turn_rate_rad_s), self._params.turn_rate_rad_s)
            command = VelocityCommand(state.stamp_ns, np.zeros(2), turn, goal.body_height, goal.lift, goal.gait)
            return MotionCommand((command,), f"turning by {np.degrees(error):.0f} deg towards the gap")
        if state.phase < 1.0:
            self._still_ns = -1
            return Wait("stopping before the gap")
        self._still_ns = state.stamp_ns if self._still_ns < 0 else self._still_ns
        if state.stamp_ns - self._still_ns < round(self._params.rest_s * 1e9):
            return Wait("stopping before the gap")
        return None

    def _start(self, goal: Goal, standing: WorldStance, terrain: Terrain) -> Array | str:
        """Return the start (2,) [m] {world} of the crossing, or why there is none."""
        xy, target = standing.body[:2, 3], goal.waypoints[-1]
        ground = float(standing.feet[:, 2].mean()) - self._profile.foot.radius
        gap = detect_gap(terrain, xy, target, ground, self._settings.costmap.max_step_m, self._settings.gap_detection)
        if isinstance(gap, str):
            return xy.copy() if self.ordered(goal) else gap
        ahead = np.array([np.cos(gap.heading), np.sin(gap.heading)])
        return np.asarray(xy + max(0.0, gap.distance - self._params.start_distance_m) * ahead)
