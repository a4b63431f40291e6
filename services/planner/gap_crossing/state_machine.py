"""The deliberate crossing of Masri 2016, step by step: stop, raise the body, look, plan a section, walk it, and again.

Pure: time, pose and maps come in, what to do next comes out. Section 4.7 (the look) and chapter 5 of the thesis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.backtracking import Trail
from sextant.services.planner.gap_crossing.plan_message import told
from sextant.services.planner.gap_crossing.roadmap import Crossing, NoWay, PassageStep, Stance
from sextant.services.planner.gap_crossing.sections import goal_behind, without
from sextant.services.planner.gap_crossing.strip_map import Field
from sextant.services.planner.gap_crossing.validated_map import is_near, objection
from sextant.services.planner.locomotion.step_planner import Stride, time_to_swing
from sextant.services.planner.terrain import GOOD
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.runtime.stopwatch import stopwatch_ns
from sextant.shared.wire.messages import ActuatorState, Mode, PassageMap, PassagePlan, PassageRequest

STRIP = (2.7, 1.0)  # [m] length and width of the map that is asked for; Masri 2016, section 4.4
BEHIND = 0.5  # [m] of it behind the body
_REQUEST_NS = 400_000_000  # [ns] between two requests of the map
_AHEAD_NS = 1_000_000_000  # [ns] by which a map may seem to be of later
_STILL_NS = 700_000_000  # [ns] at rest before a map counts: the scans of this place are in it
_PATIENCE_NS = 6_000_000_000  # [ns] that a map may take to come
_LOOKS = 3  # at one stop, at most
_WORTH = 60  # cells that a look must show
_LEAST_WORTH = 20  # likewise, once no way was found for want of seeing
_RISE = 0.01  # [m] from which a look is from higher up
_BACK, _BACK_TURN, _RETURNS = 0.015, np.radians(3.0), 2  # [m] and [rad] from where it looked off, and tries to get there
_NEARLY = 0.02  # [m] short of its goal where a section has come to it
_ASIDE, _TURNED = 0.30, np.radians(10.0)  # [m] and [rad] off the strip, from which the robot is elsewhere
_POSE_S = 2.0  # [s] for raising the body and lowering it
_PER_TICK = 4_000  # expansions for each message of the actuator, 25 a second: a core does as many meanwhile, 100 000 a second
_OFF_PLACE, _OFF_HEIGHT = 0.03, 0.025  # [m] of a standing foot from where the plan has it, from which it is planned anew
ATTEMPTS = 8  # attempts at planning a section, each with other samples
PLANNINGS = 3  # plannings at one place of the body, within
_SAME_PLACE = 0.03  # [m], before it says that there is no way
_YIELDED = 0.055  # [m] around a foot that found nothing, where ground is taken to carry none
_SUNK = 0.012  # [m] of a standing foot below the mapped ground, from which that ground has given way

Stage = Literal["survey", "look", "return", "plan", "walk"]


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """The robot as it is, or will be when the running step is over."""

    body: Array  # (4, 4) {world}
    feet: Array  # (6, 3) [m] {world} foot centres


@dataclass(frozen=True, slots=True)
class Wait:
    """Nothing to do now, and why."""

    words: str


@dataclass(frozen=True, slots=True)
class Over:
    """The robot stands behind the gap."""

    words: str


@dataclass(frozen=True, slots=True)
class Refused:
    """There is no way across, and why."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A step to be sent."""

    stride: Stride
    number: int
    stop: bool
    words: str


class Sections(Protocol):
    """Who plans sections; `Roadmap` does."""

    @property
    def edges(self) -> Array:
        """(n, 2, 3) [m] {strip} of the tree."""
        ...

    def begin(self, field: Field, stance: Stance, goal_x: float, seed: int) -> None:
        """Start anew."""
        ...

    def grow(self, expansions: int) -> Crossing | NoWay | None:
        """Go on; None while nothing is decided."""
        ...


class Errand:
    """One passage, from where the robot stands before the gap until it stands behind it."""

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        roadmap: Sections,
        standing: Standing,
        target: Array,
        yielded: list[Array],
        stopwatch: Callable[[], int] = stopwatch_ns,
    ):
        """Begin where the robot stands.

        Args:
            profile: The robot.
            settings: Of the planner.
            roadmap: The planner of sections.
            standing: How the robot stands, facing the way across.
            target: (2,) [m] {world} where it is to get, straight ahead.
            yielded: (3,) [m] {world} undersides of feet that found nothing, or ground lower than it was; it adds to them.
            stopwatch: [ns] measures how long planning takes, for the report.
        """
        self._profile, self._settings, self._roadmap, self._stopwatch = profile, settings, roadmap, stopwatch
        self._target = target.copy()
        xy = standing.body[:2, 3]
        self.heading = float(np.arctan2(*(target - xy)[::-1]))
        origin = xy - BEHIND * np.array([np.cos(self.heading), np.sin(self.heading)])
        self._T_world_strip = from_xyz_rpy((*origin, 0.0), (0.0, 0.0, self.heading))
        self._stage: Stage = "survey"
        self._since_ns = -1  # when it came to rest
        self._asked_ns = -1
        self._looks = 0
        self._section = 0
        self._seed = ATTEMPTS  # of the section: so many attempts have been made
        self._map_ns = -1  # of the map that was used last
        self._field: Field | None = None
        self._base = 0  # number of the step before the section's first
        self._steps: tuple[PassageStep, ...] = ()
        self._pending: Move | None = None  # of the body alone, until the legs begin it
        self._walking_pose: Array = standing.body
        self._yielded, self._trail = yielded, Trail()
        self._newest_step = -1  # of the actuator
        self._worth, self._returns = _WORTH, 0
        self._because = ""  # why the newest section was not walked to its end, in words
        self._gave_way = ""  # which feet found nothing in this section, in words
        self._touch_ns: NDArray[np.int64] | None = None  # what was felt before does not count
        self._tried: list[Array] = []  # (2,) [m] {world} where plannings have begun
        self._begun_ns = -1
        self._stopped = ""  # why the newest planning found no way, in words
        self._walks = ""  # what the steps that it walks, or has walked last, are, in words
        self._goal = 0.0  # [m] {strip} of the section
        self._planning_ns = 0  # measured
        self._report: PassagePlan | None = None

    @property
    def report(self) -> PassagePlan | None:
        """What the newest planning came to, once."""
        report, self._report = self._report, None
        return report

    @property
    def walked(self) -> bool:
        """Whether there was anything to cross, and a way."""
        return self._walks != ""

    def request(self, now_ns: int) -> PassageRequest | None:
        """The request for the map of the strip, when it is time to repeat it."""
        if 0 <= now_ns - self._asked_ns < _REQUEST_NS:
            return None
        self._asked_ns = now_ns
        return PassageRequest(now_ns, self._T_world_strip[:2, 3].copy(), self.heading, *STRIP)

    def advance(self, state: ActuatorState, standing: Standing, map_: PassageMap | None, refused: str) -> "Outcome":
        """What to do now.

        Args:
            state: What the legs do.
            standing: How the robot stands when the running step is over.
            map_: The newest map of the strip.
            refused: Why the actuator did not take the step that was sent last, in words, or nothing.
        """
        resting = _rests(state)
        self._since_ns = (state.stamp_ns if self._since_ns < 0 else self._since_ns) if resting else -1
        self._feel(state)
        anew, self._newest_step = state.step < self._newest_step, state.step
        if anew:
            self._pending, self._because = None, " again: the actuator has begun anew"
            return self._enter("survey", Wait(f"looking at the passage{self._because}"))
        if self._pending is not None and state.step < self._pending.number:
            if not refused:
                return self._pending
            self._looks = _LOOKS  # no further look; what is known must do
        self._pending = None
        if self._stage == "walk":
            return self._walk(state, standing, refused)
        if not resting:
            return Wait("coming to rest")
        if self._stage == "plan":
            return self._plan(state, standing)
        if self._stage == "return":
            return self._return(state, standing)
        return self._look(state, standing, map_)

    # ------------------------------------------------------------------------------------------------- looking

    def _look(self, state: ActuatorState, standing: Standing, map_: PassageMap | None) -> "Outcome":
        """Wait for a map made at rest; where another view would show more, take it; then go back to walking height."""
        still_ns = state.stamp_ns - self._since_ns
        newest, latest = max(self._since_ns + _STILL_NS, self._map_ns + 1), state.stamp_ns + _AHEAD_NS
        came = map_ is not None and newest <= map_.stamp_ns <= latest
        wrong = objection(map_, self._T_world_strip, STRIP) if map_ is not None and came else ""
        if map_ is None or not came or wrong:
            if still_ns > _PATIENCE_NS:
                return Refused(f"no map of the passage comes from the mapper{wrong and f': {wrong}'}")
            return Wait(f"looking at the passage{self._because}{wrong and f'; its map is of no use: {wrong}'}")
        self._map_ns = map_.stamp_ns
        if self._stage == "survey":
            self._walking_pose = standing.body
        shows = self._looks < _LOOKS and int(map_.look_shows.sum()) >= self._worth
        if shows and is_near(map_.T_world_look, self._walking_pose):
            self._looks += 1
            rise = float(map_.T_world_look[2, 3] - self._walking_pose[2, 3])
            words = f"raising the body by {rise * 100:.0f} cm to look" if rise > _RISE else "turning the body to look"
            return self._enter("look", self._pose(state, standing, map_.T_world_look, words))
        self._field = Field.of(map_)
        if self._stage == "look":
            self._returns = 0
            return self._return(state, standing)
        return self._enter("plan", Wait("planning"))

    def _return(self, state: ActuatorState, standing: Standing) -> "Outcome":
        """Go back from a look to where the robot stood, once more if it did not get there; then plan."""
        off = inverse(self._walking_pose) @ standing.body
        back = np.linalg.norm(off[:3, 3]) < _BACK and np.abs(rpy_from_rotation(off[:3, :3])).max() < _BACK_TURN
        if back or self._returns >= _RETURNS:
            return self._enter("plan", Wait("planning"))
        self._returns += 1
        return self._enter("return", self._pose(state, standing, self._walking_pose, "back from the look"))

    def _pose(self, state: ActuatorState, standing: Standing, body: Array, words: str) -> Move:
        """A step in which the body alone moves."""
        nobody = np.zeros(6, dtype=np.bool_)
        stride = Stride(
            nobody, standing.feet, standing.feet[:, :2], np.zeros(6), body, body, standing.feet, 0, 1.0, _POSE_S, GOOD
        )
        self._pending = Move(stride, state.step + 1, True, words)
        return self._pending

    def _feel(self, state: ActuatorState) -> None:
        """Remember where a foot found nothing to stand on."""
        before, self._touch_ns = self._touch_ns, state.touch_ns.copy()
        if before is None:
            return
        new = np.flatnonzero((state.touch_ns > before) & ~state.touch_carries).tolist()
        self._yielded += [apply(state.T_world_odom, state.touch[leg]) for leg in new]
        if new:
            self._gave_way = f"no ground under the {' and '.join(LEGS[leg] for leg in new)} foot"

    def _marked(self, field: Field, feet: Array) -> Field:
        """The same ground, without what gave way under a foot, and as low as feet (6, 3) [m] {strip} stand in it by now."""
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

    def _plan(self, state: ActuatorState, standing: Standing) -> "Outcome":
        """Grow the roadmap by as much as there is time for; a section that is found is walked."""
        assert self._field is not None
        root = self._in_strip(standing)
        if self._begun_ns < 0:
            turned = abs(float(rpy_from_rotation(self._T_world_strip[:3, :3].T @ standing.body[:3, :3])[2]))
            if abs(root.body[1]) > _ASIDE or turned > _TURNED:
                return Refused(
                    f"the robot is {root.body[1]:.2f} m beside the strip and {np.degrees(turned):.0f} deg off its way"
                )
            self._field = self._marked(self._field, root.feet)
            goal = goal_behind(self._field, float(root.body[0]) + _NEARLY, self._along(self._target))
            if goal is None:
                return Over("behind the gap")
            if self._seed == ATTEMPTS:
                refusal = self._once_more_here(standing.body[:2, 3])
                if refusal:
                    return Refused(refusal)
                self._section, self._seed = self._section + 1, 0
            self._seed += 1
            self._goal = goal
            self._begun_ns, self._planning_ns = state.stamp_ns, 0
            self._roadmap.begin(self._field, root, goal, seed=ATTEMPTS * self._section + self._seed)
        began_ns = self._stopwatch()
        found = self._roadmap.grow(_PER_TICK)
        self._planning_ns += self._stopwatch() - began_ns
        if found is None:
            return Wait(f"planning section {self._section} of the passage")
        self._begun_ns = -1
        if isinstance(found, NoWay) and found.closer is not None and self._seed == ATTEMPTS:
            found = found.closer  # once other samples have found nothing either: it may be a dead end
        self._report = self._tell(state.stamp_ns, found)
        self._stopped = found.reason if isinstance(found, NoWay) else ""
        if isinstance(found, NoWay):
            if self._seed < ATTEMPTS:
                return Wait(f"planning section {self._section} of the passage once more: {found.reason}")
            if found.unseen and self._worth > _LEAST_WORTH and self._looks < _LOOKS:
                self._worth, self._because = _LEAST_WORTH, f" again: {found.reason}"  # a look that shows little may do
                return self._enter("survey", Wait(f"looking at the passage{self._because}"))
            back = self._trail.back([apply(self._field.T_strip_world, place) for place in self._yielded], _YIELDED)
            if back:
                self._walks = f"backing off in section {self._section}"
                return self._set_out(back, state, f"backing off by {len(back)} steps to find another way: {found.reason}")
            return self._look_anew(found, standing.body[:2, 3])
        self._trail.begin(root, found.steps)
        self._walks = f"section {self._section}"
        return self._set_out(found.steps, state, f"walking section {self._section} of the passage: {len(found.steps)} steps")

    def _look_anew(self, found: NoWay, xy: Array) -> "Outcome":
        """Where there was no way plan once more on a map that more scans have made better, so often and no more."""
        if self._plannings_at(xy) < PLANNINGS:
            self._because = f" again: {found.reason}"
            return self._enter("survey", Wait(f"looking at the passage{self._because}"))
        return Refused(found.reason + (", and no look is left that would show more" if found.unseen else ""))

    def _set_out(self, steps: tuple[PassageStep, ...], state: ActuatorState, words: str) -> "Outcome":
        """Walk steps from here, saying so in words."""
        self._steps, self._base, self._looks, self._seed, self._worth = steps, state.step, 0, ATTEMPTS, _WORTH
        return self._enter("walk", Wait(words))

    def _once_more_here(self, xy: Array) -> str:
        """Note that a section begins at a place (2,) [m] {world}; why it is no use to try again there, in words, or nothing."""
        if self._plannings_at(xy) >= PLANNINGS:
            words = f"after {PLANNINGS} plannings at one place the robot does not get on"
            return f"{words}: {self._stopped}" if self._stopped else words
        self._tried.append(xy.copy())
        return ""

    def _plannings_at(self, xy: Array) -> int:
        """How often a section was planned at a place (2,) [m] {world}."""
        return sum(float(np.linalg.norm(xy - place)) < _SAME_PLACE for place in self._tried)

    def _in_strip(self, standing: Standing) -> Stance:
        T = inverse(self._T_world_strip)
        return Stance(apply(T, standing.body[:3, 3]), apply(T, standing.feet))

    def _along(self, xy: Array) -> float:
        return float(apply(inverse(self._T_world_strip), np.array([*xy, 0.0]))[0])

    def _enter(self, stage: Stage, first: "Outcome") -> "Outcome":
        """Go on to another stage, which has to come to rest anew."""
        self._stage, self._since_ns = stage, -1
        return first

    # ------------------------------------------------------------------------------------------------- walking

    def _walk(self, state: ActuatorState, standing: Standing, refused: str) -> "Outcome":
        """Send the section's next step; where the legs are not as planned, or it is over, stop and look again."""
        assert self._field is not None
        resting = _rests(state)
        done = state.step - self._base  # steps of the section that have begun, or are over
        why = self._astray(standing, min(done, len(self._steps)))
        if why and resting and done > 0 and not self._astray(standing, done - 1):
            if state.stamp_ns - self._since_ns < _STILL_NS:
                return Wait("a foot had no hold; standing")
            # The step was not taken: some foot had to find its ground first. It is due again.
            self._base, done, why = self._base + 1, done - 1, ""
        why = self._gave_way or refused or why
        if done >= len(self._steps) or why:
            if not resting:
                return Wait(f"the last step of {self._walks}")
            self._gave_way = ""
            self._yielded += self._sunk(standing, min(done, len(self._steps)))
            self._trail.ended(done)
            self._because = f" again: {why}" if why else ""
            return self._enter("survey", Wait(f"looking at the passage{self._because}"))
        if not resting and not self._settings.plan_from <= state.phase < 1.0:  # at 1 without rest a foot looks for its ground
            return Wait(self._words(done))
        return Move(
            self._stride(standing, self._steps[done]), state.step + 1, done == len(self._steps) - 1, self._words(done + 1)
        )

    def _stride(self, standing: Standing, step: PassageStep) -> Stride:
        """A step of the section as it crosses the wire."""
        assert self._field is not None
        T = self._field.T_world_strip
        swing = np.arange(6) == step.leg
        touchdown = standing.feet.copy()
        clearance = np.full(6, self._settings.path_margin)
        if step.leg >= 0:
            touchdown[step.leg], clearance[step.leg] = apply(T, np.asarray(step.touchdown)), step.clearance
        body = T @ from_xyz_rpy(step.body, np.zeros(3))
        legs = np.flatnonzero(swing)
        swinging = time_to_swing(self._profile, self._settings, standing.feet[legs], touchdown[legs], clearance[legs])
        duration = max([self._profile.stance.step_s, *swinging.tolist()])
        return Stride(swing, touchdown, touchdown[:, :2], clearance, body, body, standing.feet, 0, 1.0, duration, GOOD)

    def _astray(self, standing: Standing, done: int) -> str:
        """Which foot will not stand where the plan has it after so many steps, in words, or nothing."""
        assert self._field is not None
        feet = apply(self._field.T_strip_world, standing.feet)
        newest = {step.leg: step for step in self._steps[:done] if step.leg >= 0}
        for step in newest.values():
            off = feet[step.leg] - step.touchdown
            level, height = float(np.hypot(off[0], off[1])), abs(float(off[2]))
            if level > _OFF_PLACE or height > _OFF_HEIGHT:
                return f"the {LEGS[step.leg]} foot is {max(level, height) * 100:.0f} cm from where it was to stand"
        return ""

    def _sunk(self, standing: Standing, done: int) -> list[Array]:
        """Undersides (3,) [m] {world} of feet that stand lower than the ground was: it has given way."""
        assert self._field is not None
        feet = apply(self._field.T_strip_world, standing.feet)
        newest = {step.leg: step for step in self._steps[:done] if step.leg >= 0}
        low = [leg for leg, step in newest.items() if feet[leg, 2] < step.touchdown[2] - _OFF_HEIGHT]
        return [standing.feet[leg] - [0.0, 0.0, self._profile.foot.radius] for leg in low]

    def _words(self, step: int) -> str:
        return f"passage, {self._walks}: step {step} of {len(self._steps)}"

    def _tell(self, stamp_ns: int, found: Crossing | NoWay) -> PassagePlan:
        """What planning came to, for everybody."""
        assert self._field is not None
        T, edges = self._field.T_world_strip, self._roadmap.edges
        return told(stamp_ns, self._section, found, T, self._goal, edges, self._planning_ns * 1e-9)


def _rests(state: ActuatorState) -> bool:
    """Whether no step is walked, and no foot looks for its ground."""
    return state.phase >= 1.0 and state.mode is Mode.HOLD


Outcome = Move | Wait | Over | Refused
