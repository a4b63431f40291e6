"""State machine of the gap crossing: stop, look, plan a section, walk it.

It repeats these stages until the robot stands behind the gap. It has no side effects: time, pose and maps are inputs, the next
action is the output. Source: Masri 2016, section 4.7 (the look) and chapter 5.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.backtracking import StepHistory
from sextant.services.planner.gap_crossing.plan_message import make_plan_message
from sextant.services.planner.gap_crossing.roadmap import NoSection, PassageStep, SectionPlan, Stance
from sextant.services.planner.gap_crossing.sections import goal_behind, without
from sextant.services.planner.gap_crossing.strip_map import StripMap
from sextant.services.planner.gap_crossing.validated_map import is_near, validation_error
from sextant.services.planner.locomotion.step_planner import PlannedStep, time_to_swing
from sextant.services.planner.robot_estimate import WorldStance, is_resting
from sextant.services.planner.terrain import GOOD
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.runtime.stopwatch import stopwatch_ns
from sextant.shared.wire.messages import ActuatorState, PassageMap, PassagePlan, PassageRequest

STRIP = (2.7, 1.0)  # [m] length and width of the requested map; Masri 2016, section 4.4
BEHIND = 0.5  # [m] of the map behind the body
_REQUEST_NS = 400_000_000  # [ns] between two map requests
_AHEAD_NS = 1_000_000_000  # [ns] by which the stamp of a map may lie in the future
_STILL_NS = 700_000_000  # [ns] of rest before a map counts, so that it contains the scans from this place
_PATIENCE_NS = 6_000_000_000  # [ns] maximum time to wait for a map
_LOOKS = 3  # maximum number of looks at one stop
_MIN_LOOK_CELLS = 60  # minimum number of cells that a look must reveal
_MIN_LOOK_CELLS_LATER = 20  # the same, after the search found no path because of unseen ground
_RISE = 0.01  # [m] from which a look counts as raised
_BACK, _BACK_TURN, _RETURNS = 0.015, np.radians(3.0), 2  # [m], [rad] tolerance and attempts of the return from a look
_NEARLY = 0.02  # [m] distance from its goal at which a section counts as complete
_ASIDE, _TURNED = 0.30, np.radians(10.0)  # [m] and [rad] off the strip, from which the robot counts as being elsewhere
_POSE_S = 2.0  # [s] duration of raising or lowering the body
_PER_TICK = 4_000  # expansions per actuator message, 25 messages a second: 100 000 a second, the capacity of a core
_OFF_PLACE, _OFF_HEIGHT = 0.03, 0.025  # [m] from a standing foot to its planned foothold, from which the robot plans again
ATTEMPTS = 8  # attempts to plan a section, each with other samples
PLANNINGS = 3  # maximum number of plannings at one place
_SAME_PLACE = 0.03  # [m] radius of one place of the body
_YIELDED = 0.055  # [m] around a foot without ground, where ground counts as no foothold
_SUNK = 0.012  # [m] from the mapped ground down to a standing foot, from which the ground has given way

Stage = Literal["survey", "look", "return", "plan", "walk"]


@dataclass(frozen=True, slots=True)
class Wait:
    """No action now, with the reason."""

    words: str


@dataclass(frozen=True, slots=True)
class Completed:
    """Final: the robot stands behind the gap."""

    words: str


@dataclass(frozen=True, slots=True)
class CannotCross:
    """Final: the gap cannot be crossed, with the reason."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class NextStep:
    """A step to send."""

    stride: PlannedStep
    number: int
    stop: bool
    words: str


class SectionPlanner(Protocol):
    """A planner of sections, implemented by `Roadmap`."""

    @property
    def edges(self) -> Array:
        """Return the tree, (n, 2, 3) [m] {strip}."""
        ...

    def begin(self, field: StripMap, stance: Stance, goal_x: float, seed: int) -> None:
        """Start a new search."""
        ...

    def grow(self, expansions: int) -> SectionPlan | NoSection | None:
        """Continue the search; return None while it is undecided."""
        ...


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
            stopwatch: [ns] clock for the planning time in the report.
        """
        self._profile, self._settings, self._roadmap, self._stopwatch = profile, settings, roadmap, stopwatch
        self._target = target.copy()
        xy = standing.body[:2, 3]
        self.heading = float(np.arctan2(*(target - xy)[::-1]))
        origin = xy - BEHIND * np.array([np.cos(self.heading), np.sin(self.heading)])
        self._T_world_strip = from_xyz_rpy((*origin, 0.0), (0.0, 0.0, self.heading))
        self._stage: Stage = "survey"
        self._since_ns = -1  # when the robot came to rest
        self._asked_ns = -1
        self._looks = 0
        self._section = 0
        self._seed = ATTEMPTS  # number of attempts for the section
        self._map_ns = -1  # of the map that was used last
        self._field: StripMap | None = None
        self._base = 0  # number of the step before the first step of the section
        self._steps: tuple[PassageStep, ...] = ()
        self._pending: NextStep | None = None  # a step of the body alone, until the actuator begins it
        self._walking_pose: Array = standing.body
        self._yielded, self._trail = yielded, StepHistory()
        self._newest_step = -1  # newest step number of the actuator
        self._worth, self._returns = _MIN_LOOK_CELLS, 0
        self._because = ""  # why the last section was not completed
        self._gave_way = ""  # which feet found no ground in this section
        self._touch_ns: NDArray[np.int64] | None = None  # earlier touches do not count
        self._tried: list[Array] = []  # (2,) [m] {world} body places of previous plannings
        self._begun_ns = -1
        self._stopped = ""  # why the last planning found no path
        self._walks = ""  # name of the steps that are executed or were executed last
        self._goal = 0.0  # [m] {strip} goal of the section
        self._planning_ns = 0  # measured planning time
        self._report: PassagePlan | None = None

    @property
    def report(self) -> PassagePlan | None:
        """Return the result of the last planning, once."""
        report, self._report = self._report, None
        return report

    @property
    def walked(self) -> bool:
        """Return whether there was a gap and a path across it."""
        return self._walks != ""

    def request(self, now_ns: int) -> PassageRequest | None:
        """Return a request for the map of the strip when it is due, else None."""
        if 0 <= now_ns - self._asked_ns < _REQUEST_NS:
            return None
        self._asked_ns = now_ns
        return PassageRequest(now_ns, self._T_world_strip[:2, 3].copy(), self.heading, *STRIP)

    def advance(self, state: ActuatorState, standing: WorldStance, map_: PassageMap | None, refused: str) -> "Outcome":
        """Return the next action.

        Args:
            state: State of the actuator.
            standing: Robot when the running step is over.
            map_: Newest map of the strip.
            refused: Why the actuator refused the last step, or "".
        """
        resting = is_resting(state)
        self._since_ns = (state.stamp_ns if self._since_ns < 0 else self._since_ns) if resting else -1
        self._record_missing_ground(state)
        anew, self._newest_step = state.step < self._newest_step, state.step
        if anew:
            self._pending, self._begun_ns, self._because = None, -1, " again: the actuator has restarted"
            return self._enter("survey", Wait(f"surveying the gap{self._because}"))
        if self._pending is not None and state.step < self._pending.number:
            if not refused:
                return self._pending
            self._looks = _LOOKS  # no further look: the known ground must suffice
        self._pending = None
        if self._stage == "walk":
            return self._walk(state, standing, refused)
        if not resting:
            return Wait("stopping")
        if self._stage == "plan":
            return self._plan(state, standing)
        if self._stage == "return":
            return self._return(state, standing)
        return self._look(state, standing, map_)

    # ------------------------------------------------------------------------------------------------- looking

    def _look(self, state: ActuatorState, standing: WorldStance, map_: PassageMap | None) -> "Outcome":
        """Wait for a map taken at rest, then plan.

        If another view would reveal more, look from there first and return to the walking height.
        """
        still_ns = state.stamp_ns - self._since_ns
        newest, latest = max(self._since_ns + _STILL_NS, self._map_ns + 1), state.stamp_ns + _AHEAD_NS
        came = map_ is not None and newest <= map_.stamp_ns <= latest
        wrong = validation_error(map_, self._T_world_strip, STRIP) if map_ is not None and came else ""
        if map_ is None or not came or wrong:
            if still_ns > _PATIENCE_NS:
                return CannotCross(f"no valid map of the gap received from the mapper{wrong and f': {wrong}'}")
            return Wait(f"surveying the gap{self._because}{wrong and f'; the received map is invalid: {wrong}'}")
        self._map_ns = map_.stamp_ns
        if self._stage == "survey":
            self._walking_pose = standing.body
        shows = self._looks < _LOOKS and int(map_.look_shows.sum()) >= self._worth
        if shows and is_near(map_.T_world_look, self._walking_pose):
            self._looks += 1
            rise = float(map_.T_world_look[2, 3] - self._walking_pose[2, 3])
            words = (
                f"raising the body by {rise * 100:.0f} cm for a better view"
                if rise > _RISE
                else "turning the body for a better view"
            )
            return self._enter("look", self._pose(state, standing, map_.T_world_look, words))
        self._field = StripMap.of(map_)
        if self._stage == "look":
            self._returns = 0
            return self._return(state, standing)
        return self._enter("plan", Wait("planning"))

    def _return(self, state: ActuatorState, standing: WorldStance) -> "Outcome":
        """Return from a look to the stance before it, then plan.

        The return is repeated once if the robot missed the pose.
        """
        off = inverse(self._walking_pose) @ standing.body
        back = np.linalg.norm(off[:3, 3]) < _BACK and np.abs(rpy_from_rotation(off[:3, :3])).max() < _BACK_TURN
        if back or self._returns >= _RETURNS:
            return self._enter("plan", Wait("planning"))
        self._returns += 1
        return self._enter(
            "return", self._pose(state, standing, self._walking_pose, "moving the body back to the walking pose")
        )

    def _pose(self, state: ActuatorState, standing: WorldStance, body: Array, words: str) -> NextStep:
        """Return a step in which only the body moves."""
        nobody = np.zeros(6, dtype=np.bool_)
        stride = PlannedStep(
            nobody, standing.feet, standing.feet[:, :2], np.zeros(6), body, body, standing.feet, 0, 1.0, _POSE_S, GOOD
        )
        self._pending = NextStep(stride, state.step + 1, True, words)
        return self._pending

    def _record_missing_ground(self, state: ActuatorState) -> None:
        """Record places where a foot found no ground."""
        before, self._touch_ns = self._touch_ns, state.touch_ns.copy()
        if before is None:
            return
        new = np.flatnonzero((state.touch_ns > before) & ~state.touch_carries).tolist()
        self._yielded += [apply(state.T_world_odom, state.touch[leg]) for leg in new]
        if new:
            self._gave_way = f"no ground under the {' and '.join(LEGS[leg] for leg in new)} foot"

    def _marked(self, field: StripMap, feet: Array) -> StripMap:
        """Return the field updated by touch.

        Ground that gave way under a foot carries none. Ground is no higher than the feet (6, 3) [m] {strip} that stand on it.
        """
        gone = [apply(field.T_strip_world, place) for place in self._yielded]
        soles = feet - [0.0, 0.0, self._profile.foot.radius]
        on_gone = [any(np.hypot(*(sole - place)[:2]) < _YIELDED for place in gone) for sole in soles]
        sunk = [
            sole for sole, known in zip(soles, on_gone, strict=True) if not known and field.lowest_at(sole) - sole[2] > _SUNK
        ]
        self._yielded += [apply(field.T_world_strip, sole) for sole in sunk]
        for place in [*gone, *soles[on_gone], *sunk]:
            field = without(field, place, _YIELDED)
        return field

    # ------------------------------------------------------------------------------------------------- planning

    def _plan(self, state: ActuatorState, standing: WorldStance) -> "Outcome":
        """Grow the roadmap within the time budget; walk a section once it is found."""
        assert self._field is not None
        root = self._in_strip(standing)
        if self._begun_ns < 0:
            turned = abs(float(rpy_from_rotation(self._T_world_strip[:3, :3].T @ standing.body[:3, :3])[2]))
            if abs(root.body[1]) > _ASIDE or turned > _TURNED:
                return CannotCross(
                    f"the robot is {root.body[1]:.2f} m and {np.degrees(turned):.0f} deg off the centre line of the strip"
                )
            self._field = self._marked(self._field, root.feet)
            goal = goal_behind(self._field, float(root.body[0]) + _NEARLY, self._along(self._target))
            if goal is None:
                return Completed("no gap ahead of the robot")
            if self._seed == ATTEMPTS:
                refusal = self._count_planning(standing.body[:2, 3])
                if refusal:
                    return CannotCross(refusal)
                self._section, self._seed = self._section + 1, 0
            self._seed += 1
            self._goal = goal
            self._begun_ns, self._planning_ns = state.stamp_ns, 0
            self._roadmap.begin(self._field, root, goal, seed=ATTEMPTS * self._section + self._seed)
        began_ns = self._stopwatch()
        found = self._roadmap.grow(_PER_TICK)
        self._planning_ns += self._stopwatch() - began_ns
        if found is None:
            return Wait(f"planning section {self._section} of the gap crossing")
        self._begun_ns = -1
        if isinstance(found, NoSection) and found.closer is not None and self._seed == ATTEMPTS:
            found = found.closer  # after all attempts have failed: it may be a dead end
        self._report = self._tell(state.stamp_ns, found)
        self._stopped = found.reason if isinstance(found, NoSection) else ""
        if isinstance(found, NoSection):
            if self._seed < ATTEMPTS:
                return Wait(f"planning section {self._section} of the gap crossing again: {found.reason}")
            if found.unseen and self._worth > _MIN_LOOK_CELLS_LATER and self._looks < _LOOKS:
                self._worth, self._because = (
                    _MIN_LOOK_CELLS_LATER,
                    f" again: {found.reason}",
                )  # a look that reveals little may be enough
                return self._enter("survey", Wait(f"surveying the gap{self._because}"))
            back = self._trail.back([apply(self._field.T_strip_world, place) for place in self._yielded], _YIELDED)
            if back:
                self._walks = f"backtracking in section {self._section}"
                return self._set_out(back, state, f"backtracking {len(back)} steps to find another path: {found.reason}")
            return self._replan_or_fail(found, standing.body[:2, 3])
        self._trail.begin(root, found.steps)
        self._walks = f"section {self._section}"
        return self._set_out(
            found.steps, state, f"walking section {self._section} of the gap crossing: {len(found.steps)} steps"
        )

    def _replan_or_fail(self, found: NoSection, xy: Array) -> "Outcome":
        """Plan again on a map with more scans, up to `PLANNINGS` times at one place.

        Use this where no path was found.
        """
        if self._plannings_at(xy) < PLANNINGS:
            self._because = f" again: {found.reason}"
            return self._enter("survey", Wait(f"surveying the gap{self._because}"))
        return CannotCross(found.reason + ("; no better view is available" if found.unseen else ""))

    def _set_out(self, steps: tuple[PassageStep, ...], state: ActuatorState, words: str) -> "Outcome":
        """Start to walk steps; `words` is the reason for the status."""
        self._steps, self._base, self._looks, self._seed, self._worth = steps, state.step, 0, ATTEMPTS, _MIN_LOOK_CELLS
        return self._enter("walk", Wait(words))

    def _count_planning(self, xy: Array) -> str:
        """Record that a section starts at a place (2,) [m] {world}.

        Return why another attempt there is useless, or "".
        """
        if self._plannings_at(xy) >= PLANNINGS:
            words = f"the robot made no progress after {PLANNINGS} plans at one place"
            return f"{words}: {self._stopped}" if self._stopped else words
        self._tried.append(xy.copy())
        return ""

    def _plannings_at(self, xy: Array) -> int:
        """Return how often a section was planned at a place (2,) [m] {world}."""
        return sum(float(np.linalg.norm(xy - place)) < _SAME_PLACE for place in self._tried)

    def _in_strip(self, standing: WorldStance) -> Stance:
        T = inverse(self._T_world_strip)
        return Stance(apply(T, standing.body[:3, 3]), apply(T, standing.feet))

    def _along(self, xy: Array) -> float:
        return float(apply(inverse(self._T_world_strip), np.array([*xy, 0.0]))[0])

    def _enter(self, stage: Stage, first: "Outcome") -> "Outcome":
        """Enter another stage; the robot must come to rest again first."""
        self._stage, self._since_ns = stage, -1
        return first

    # ------------------------------------------------------------------------------------------------- walking

    def _walk(self, state: ActuatorState, standing: WorldStance, refused: str) -> "Outcome":
        """Return the next step of the section.

        If it is complete, or the feet are not where planned, stop and look again.
        """
        assert self._field is not None
        resting = is_resting(state)
        done = state.step - self._base  # number of steps of the section that have begun or are over
        why = self._astray(standing, min(done, len(self._steps)))
        if why and resting and done > 0 and not self._astray(standing, done - 1):
            if state.stamp_ns - self._since_ns < _STILL_NS:
                return Wait("a foot had to search for the ground; waiting with all legs at rest")
            # The step was not taken, because some foot had to find its ground first. It is due again.
            self._base, done, why = self._base + 1, done - 1, ""
        why = self._gave_way or refused or why
        if done >= len(self._steps) or why:
            if not resting:
                return Wait(f"finishing the last step of {self._walks}")
            self._gave_way = ""
            self._yielded += self._sunk(standing, min(done, len(self._steps)))
            self._trail.ended(done)
            self._because = f" again: {why}" if why else ""
            return self._enter("survey", Wait(f"surveying the gap{self._because}"))
        if not resting and not self._settings.revision.plan_from_phase <= state.phase < 1.0:  # at 1, a foot searches for ground
            return Wait(self._words(done))
        return NextStep(
            self._stride(standing, self._steps[done]), state.step + 1, done == len(self._steps) - 1, self._words(done + 1)
        )

    def _stride(self, standing: WorldStance, step: PassageStep) -> PlannedStep:
        """Return a step of the section as a step in {world}."""
        assert self._field is not None
        T = self._field.T_world_strip
        swing = np.arange(6) == step.leg
        touchdown = standing.feet.copy()
        clearance = np.full(6, self._settings.step.path_margin_m)
        if step.leg >= 0:
            touchdown[step.leg], clearance[step.leg] = apply(T, np.asarray(step.touchdown)), step.clearance
        body = T @ from_xyz_rpy(step.body, np.zeros(3))
        legs = np.flatnonzero(swing)
        swinging = time_to_swing(self._profile, self._settings.step, standing.feet[legs], touchdown[legs], clearance[legs])
        duration = max([self._profile.stance.step_s, *swinging.tolist()])
        return PlannedStep(swing, touchdown, touchdown[:, :2], clearance, body, body, standing.feet, 0, 1.0, duration, GOOD)

    def _astray(self, standing: WorldStance, done: int) -> str:
        """Return which foot stands away from its planned foothold, or "".

        `done` is the number of completed steps of the section.
        """
        assert self._field is not None
        feet = apply(self._field.T_strip_world, standing.feet)
        newest = {step.leg: step for step in self._steps[:done] if step.leg >= 0}
        for step in newest.values():
            off = feet[step.leg] - step.touchdown
            level, height = float(np.hypot(off[0], off[1])), abs(float(off[2]))
            if level > _OFF_PLACE or height > _OFF_HEIGHT:
                return f"the {LEGS[step.leg]} foot is {max(level, height) * 100:.0f} cm from its planned foothold"
        return ""

    def _sunk(self, standing: WorldStance, done: int) -> list[Array]:
        """Return undersides (3,) [m] {world} of feet where the ground gave way."""
        assert self._field is not None
        feet = apply(self._field.T_strip_world, standing.feet)
        newest = {step.leg: step for step in self._steps[:done] if step.leg >= 0}
        low = [leg for leg, step in newest.items() if feet[leg, 2] < step.touchdown[2] - _OFF_HEIGHT]
        return [standing.feet[leg] - [0.0, 0.0, self._profile.foot.radius] for leg in low]

    def _words(self, step: int) -> str:
        return f"gap crossing, {self._walks}: step {step} of {len(self._steps)}"

    def _tell(self, stamp_ns: int, found: SectionPlan | NoSection) -> PassagePlan:
        """Return the message with the planning result."""
        assert self._field is not None
        T, edges = self._field.T_world_strip, self._roadmap.edges
        return make_plan_message(stamp_ns, self._section, found, T, self._goal, edges, self._planning_ns * 1e-9)


Outcome = NextStep | Wait | Completed | CannotCross
