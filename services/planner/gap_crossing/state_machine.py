"""State machine of the gap crossing: stop, look, plan a section, walk it.

It repeats these stages until the robot stands behind the gap, or decides that the gap cannot be crossed (`CannotCross`). It has
no side effects: time, pose and maps are inputs, the next action is the output. Source: Masri 2016, section 4.7 (the look) and
chapter 5.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.outcome import CannotCross, Completed, NextStep, Outcome, Wait
from sextant.services.planner.gap_crossing.section_search import SectionPlanner, SectionSearch
from sextant.services.planner.gap_crossing.section_walk import SectionWalk, body_step
from sextant.services.planner.gap_crossing.strip_survey import STILL_NS, StripSurvey
from sextant.services.planner.gap_crossing.validated_map import is_near
from sextant.services.planner.gap_crossing.view_budget import ViewBudget
from sextant.services.planner.gap_crossing.yielded_ground import YIELDED_RADIUS_M, YieldedGround
from sextant.services.planner.roadmap.backtracking import StepHistory
from sextant.services.planner.roadmap.roadmap import NoSection, PassageStep, Stance
from sextant.services.planner.roadmap.sections import goal_behind
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.services.planner.robot_estimate import WorldStance, is_resting
from sextant.shared.geometry import Array, apply, inverse, rpy_from_rotation
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.stopwatch import stopwatch_ns
from sextant.shared.wire.messages import ActuatorState, PassageMap, PassagePlan, PassageRequest

_PATIENCE_NS = 6_000_000_000  # [ns] maximum time to wait for a map
_RISE = 0.01  # [m] from which a look counts as raised
_BACK, _BACK_TURN, _RETURNS = 0.015, np.radians(3.0), 2  # [m], [rad] tolerance and attempts of the return from a look
_NEARLY = 0.02  # [m] distance from its goal at which a section counts as complete
# [m] and [rad] beyond what a section may plan, from which the robot counts as being elsewhere.
_ASIDE, _TURNED = 0.18, np.radians(10.0)

Stage = Literal["survey", "look", "return", "plan", "walk"]


class GapCrossing:
    """One gap crossing, from the stance before the gap to a stance behind it."""

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        roadmap: SectionPlanner,
        standing: WorldStance,
        target: Array,
        yielded: list[Array],
        straight_refusal: str = "",
        stopwatch: Callable[[], int] = stopwatch_ns,
    ):
        """Start from the robot's current stance.

        Args:
            profile: The robot.
            settings: Settings of the planner.
            roadmap: Planner of sections.
            standing: Robot before the gap, facing across.
            target: (2,) [m] {world} goal, straight ahead.
            yielded: (3,) [m] {world} undersides of feet that found no ground, or lower ground; this class appends to the list.
            straight_refusal: Why an earlier crossing from here found no section straight on: the body then turns at once.
            stopwatch: [ns] clock for the planning time in the report.
        """
        self._profile, self._settings = profile, settings
        self._target = target.copy()
        self._survey = StripSurvey(standing.body[:2, 3], target)
        self._views = ViewBudget()
        self._ground = YieldedGround(yielded, profile.foot.radius)
        self._search = SectionSearch(roadmap, stopwatch)
        if straight_refusal:
            self._allow_turns(straight_refusal)
        self._trail = StepHistory()
        self._stage: Stage = "survey"
        self._since_ns = -1  # when the robot came to rest
        self._newest_step = -1  # newest step number of the actuator
        self._pending: NextStep | None = None  # a step of the body alone, until the actuator begins it
        self._walking_pose: Array = standing.body
        self._returns = 0  # attempts to return from a look
        self._field: StripMap | None = None
        self._walk: SectionWalk | None = None  # the steps that are executed or were executed last
        self._because = ""  # why the last section was not completed
        self._bare_ground = settings.gap_detection  # which ground is a gap

    @property
    def report(self) -> PassagePlan | None:
        """Return the result of the last planning, once."""
        return self._search.take_report()

    @property
    def straight_refusal(self) -> str:
        """Return why no section leads straight on, or "" while the body does not turn."""
        return self._search.straight_refusal

    @property
    def walked(self) -> bool:
        """Return whether there was a gap and a path across it."""
        return self._walk is not None

    def request(self, now_ns: int) -> PassageRequest | None:
        """Return a request for the map of the strip when it is due, else None."""
        return self._survey.request(now_ns)

    def advance(self, state: ActuatorState, standing: WorldStance, map_: PassageMap | None, refused: str) -> Outcome:
        """Return the next action.

        Args:
            state: State of the actuator.
            standing: Robot when the running step is over.
            map_: Newest map of the strip.
            refused: Why the actuator refused the last step, or "".
        """
        resting = is_resting(state)
        self._since_ns = (state.stamp_ns if self._since_ns < 0 else self._since_ns) if resting else -1
        self._ground.record(state)
        restarted, self._newest_step = state.step < self._newest_step, state.step
        if restarted:
            self._pending = None
            self._search.interrupt()
            return self._survey_again("the actuator has restarted")
        if self._pending is not None and state.step < self._pending.number:
            if not refused:
                return self._pending
            self._views.exhaust()
        self._pending = None
        if self._stage == "walk":
            return self._walk_section(state, standing, refused)
        if not resting:
            return Wait("stopping")
        if self._stage == "plan":
            return self._plan(state, standing)
        if self._stage == "return":
            return self._return(state, standing)
        return self._look(state, standing, map_)

    def _enter(self, stage: Stage, first: Outcome) -> Outcome:
        """Enter another stage; the robot must come to rest again first."""
        self._stage, self._since_ns = stage, -1
        return first

    def _survey_again(self, why: str) -> Outcome:
        """Wait for another map; `why` is "" if the section was completed."""
        self._because = f" again: {why}" if why else ""
        return self._enter("survey", Wait(f"surveying the gap{self._because}"))

    # ------------------------------------------------------------------------------------------------- looking

    def _look(self, state: ActuatorState, standing: WorldStance, map_: PassageMap | None) -> Outcome:
        """Wait for a map taken at rest, then plan.

        If another view would reveal more, look from there first and return to the walking height.
        """
        usable = self._survey.use(map_, self._since_ns, state.stamp_ns)
        if isinstance(usable, str):
            if state.stamp_ns - self._since_ns > _PATIENCE_NS:
                return CannotCross(f"no valid map of the gap received from the mapper{usable and f': {usable}'}")
            return Wait(f"surveying the gap{self._because}{usable and f'; the received map is invalid: {usable}'}")
        if self._stage == "survey":
            self._walking_pose = standing.body
        if self._views.allows(usable) and is_near(usable.T_world_next_view, self._walking_pose):
            self._views.spend()
            rise = float(usable.T_world_next_view[2, 3] - self._walking_pose[2, 3])
            move = f"raising the body by {rise * 100:.0f} cm" if rise > _RISE else "turning the body"
            return self._enter("look", self._move_body(state, standing, usable.T_world_next_view, f"{move} for a better view"))
        self._field = StripMap.of(usable)
        if self._stage == "look":
            self._returns = 0
            return self._return(state, standing)
        return self._enter("plan", Wait("planning"))

    def _return(self, state: ActuatorState, standing: WorldStance) -> Outcome:
        """Return from a look to the stance before it, then plan.

        The return is repeated once if the robot missed the pose.
        """
        off = inverse(self._walking_pose) @ standing.body
        back = np.linalg.norm(off[:3, 3]) < _BACK and np.abs(rpy_from_rotation(off[:3, :3])).max() < _BACK_TURN
        if back or self._returns >= _RETURNS:
            return self._enter("plan", Wait("planning"))
        self._returns += 1
        words = "moving the body back to the walking pose"
        return self._enter("return", self._move_body(state, standing, self._walking_pose, words))

    def _move_body(self, state: ActuatorState, standing: WorldStance, body: Array, words: str) -> NextStep:
        """Return a step in which only the body moves."""
        self._pending = NextStep(body_step(standing, body), state.step + 1, True, words)
        return self._pending

    # ------------------------------------------------------------------------------------------------- planning

    def _plan(self, state: ActuatorState, standing: WorldStance) -> Outcome:
        """Grow the roadmap within the time budget; walk a section once it is found."""
        root = self._in_strip(standing)
        if not self._search.is_running:
            end = self._begin_search(root, standing)
            if end is not None:
                return end
        section = self._search.section
        found = self._search.grow(state.stamp_ns, self._required_field.T_world_strip)
        if found is None:
            return Wait(f"planning section {section} of the gap crossing")
        if isinstance(found, NoSection):
            return self._without_section(found, state, standing)
        self._trail.begin(root, found.steps)
        words = f"walking section {section} of the gap crossing: {len(found.steps)} steps"
        return self._set_out(f"section {section}", found.steps, state, words)

    def _begin_search(self, root: Stance, standing: WorldStance) -> Completed | CannotCross | None:
        """Start the search for a section; return the end of the crossing if there is none to search."""
        params = self._settings.gap_crossing
        drift, turn = params.drift_m, 0.0
        if self._search.turns:
            drift, turn = params.turning_drift_m, np.radians(params.most_turn_deg)
        if abs(root.body[1]) > drift + _ASIDE or abs(root.yaw) > turn + _TURNED:
            off = f"{root.body[1]:.2f} m and {np.degrees(root.yaw):.0f} deg"
            return CannotCross(f"the robot is {off} off the centre line of the strip")
        field = self._field = self._ground.excluded_from(self._required_field, root.feet)
        target_x = float(apply(inverse(self._survey.T_world_strip), np.array([*self._target, 0.0]))[0])
        x = float(root.body[0]) + _NEARLY
        goal_x = goal_behind(field, x, target_x, self._bare_ground)
        if goal_x is None and not self.walked:
            self._bare_ground = self._bare_ground.narrow()
            goal_x = goal_behind(field, x, target_x, self._bare_ground)
        if goal_x is None:
            return Completed("no gap ahead of the robot")
        refusal = self._search.begin(field, root, goal_x, standing.body[:2, 3])
        return self._refused(refusal) if refusal else None

    def _without_section(self, found: NoSection, state: ActuatorState, standing: WorldStance) -> Outcome:
        """Return the next action after a search without a path.

        In this order: other samples, a view that reveals little, turns of the body on a wider map, other stances further back,
        a map with more scans.
        """
        section = self._search.section
        if self._search.has_attempts:
            return Wait(f"planning section {section} of the gap crossing again: {found.reason}")
        if found.unseen and self._views.accept_less():
            return self._survey_again(found.reason)
        if not self._search.turns:
            self._allow_turns(found.reason)
            return self._survey_again(f"no section leads straight on: {found.reason}")
        back = self._trail.back(self._ground.in_strip(self._required_field), YIELDED_RADIUS_M)
        if back:
            words = f"backtracking {len(back)} steps to find another path: {found.reason}"
            return self._set_out(f"backtracking in section {section}", back, state, words)
        if self._search.may_plan_at(standing.body[:2, 3]):
            return self._survey_again(found.reason)
        return self._refused(found.reason + ("; no better view is available" if found.unseen else ""))

    def _allow_turns(self, straight_refusal: str) -> None:
        """Let the body turn from now on, on a wider map."""
        self._search.allow_turns(straight_refusal)
        self._survey.widen()

    def _refused(self, reason: str) -> CannotCross:
        """Return the end of a crossing without a further section, with the reason for each heading that was tried."""
        if not self._search.turns:
            return CannotCross(reason)
        most = f"{self._settings.gap_crossing.most_turn_deg:.0f} deg"
        return CannotCross(f"straight on: {self._search.straight_refusal}; with turns up to {most}: {reason}")

    def _set_out(self, name: str, steps: tuple[PassageStep, ...], state: ActuatorState, words: str) -> Outcome:
        """Start to walk steps; `words` is the reason for the status."""
        self._walk = SectionWalk(name, steps, self._required_field, state.step)
        self._views.renew()
        self._search.finish()
        return self._enter("walk", Wait(words))

    def _in_strip(self, standing: WorldStance) -> Stance:
        T = inverse(self._survey.T_world_strip)
        yaw = float(rpy_from_rotation(T[:3, :3] @ standing.body[:3, :3])[2])
        return Stance(apply(T, standing.body[:3, 3]), apply(T, standing.feet), yaw)

    @property
    def _required_field(self) -> StripMap:
        """Return the strip, which is known from the first planning on."""
        assert self._field is not None
        return self._field

    # ------------------------------------------------------------------------------------------------- walking

    def _walk_section(self, state: ActuatorState, standing: WorldStance, refused: str) -> Outcome:
        """Return the next step of the section.

        If it is complete, or the feet are not where planned, stop and look again.
        """
        assert self._walk is not None
        walk, resting = self._walk, is_resting(state)
        done = walk.done(state.step)
        why = walk.stray_foot(standing, min(done, len(walk)))
        if why and resting and done > 0 and not walk.stray_foot(standing, done - 1):
            if state.stamp_ns - self._since_ns < STILL_NS:
                return Wait("a foot had to search for the ground; waiting with all legs at rest")
            walk.repeat_last()  # the step was not taken, because some foot had to find its ground first
            done, why = done - 1, ""
        why = self._ground.reason or refused or why
        if done >= len(walk) or why:
            if not resting:
                return Wait(f"finishing the last step of {walk.name}")
            self._ground.reason = ""
            self._ground.add(walk.sunk_soles(standing, min(done, len(walk)), self._profile.foot.radius))
            self._trail.ended(done)
            return self._survey_again(why)
        if not resting and not self._settings.revision.plan_from_phase <= state.phase < 1.0:  # at 1, a foot searches for ground
            return Wait(walk.describe(done))
        planned = walk.planned_step(done, standing, self._profile, self._settings)
        return NextStep(planned, state.step + 1, done == len(walk) - 1, walk.describe(done + 1))
