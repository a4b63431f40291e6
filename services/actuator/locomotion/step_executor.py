"""Execution of accepted step plans: targets of feet and body, cycle by cycle.

A step has three parts. First, its legs are unloaded. Then they swing along the flow, while the body moves over the standing
legs on a path that starts with the velocity of the last step. Finally, the legs are loaded again. Commanded and measured
quantities are kept separate:

    {cmd}           frame in which standing feet are fixed; it follows {odom} slowly in x, y and yaw, because feet roll and
                    slip, so that the commanded and the measured pose stay together
    ref             commanded body pose {cmd}
    pressed         offset by which each standing foot is commanded lower: slow integral of (ref - measured) in height, roll
                    and pitch over the foot, to remove sag; zero for a foot without load
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.body_trajectory import coordinates, hermite, pose, wrapped
from sextant.services.actuator.locomotion.sixth_order_arc import SixthOrderArc
from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.shared.geometry import (
    Array,
    apply,
    inverse,
    rotation_from_rpy,
    rotation_z,
    transform,
    yaw_of,
)
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import StepPlan

_ARCS: dict[str, type[Swing] | type[SixthOrderArc]] = {"flow": Swing, "sixth_order": SixthOrderArc}
_GENTLE_S = 1.0  # [s] in which hanging feet return to the ground; longer if the joint speed limits require it
_PICKED_UP = 0.03  # [m] clearance of feet that may lie on the ground
_FOLLOW = 2.0  # [1/s] at which {cmd} follows {odom}
_UP = np.array([0.0, 0.0, 1.0])
_LEVEL = np.array([1.0, 1.0, 0.0])  # mask of x, y, z, or of roll, pitch, yaw
_PRESSED_LIMIT = 0.025  # [m]
_RELEASE_S = 0.1  # [s] time constant in which the pressed offset of an unloaded foot decays
_LISTEN_FROM, _STOP_FROM = 0.35, 0.45  # shares of a swing from which touchdown is detected, and from which it may stop the foot
_EARLY = 0.006  # [m] height over its target from which a touch stops a foot; below that the leg's compliance takes it up
_SETTLE_S = 0.05  # [s] time constant in which the command of a stopped foot moves to its measured position
_REACH, _REACH_SPEED = 0.04, 0.04  # [m] by which a foot searches for ground below its target, and [m/s] its speed
_PUSHED_DOWN = 0.005  # [m] of that search after which the load of all joints of the leg shows that the foot stood all the time
_FEEL_FROM_S = 0.03  # [s] before lift-off from which the other legs must prove that they stand
_SURVEY_S = 0.05  # [s] time constant in which the height of new footholds is measured at rest
_SURVEYED = 0.010  # [m] largest correction of the height at which touchdown was detected
_WAIT_S, _LONGER_S = 0.07, 0.12  # [s] waiting time for unproven legs, and for those that stand by their last reading alone
_IN_VAIN_S = 0.2  # [s] longest additional wait while their servos do not answer
_BACK_S = 1.4  # [s] in which a step is taken back
_SOON_S = 0.33  # [s] in which feet in the air reach the ground once the robot has to stop
_BRAKE_S = 0.2  # [s] minimum braking time of the body, if its step lasts that long
_FASTER = 1.75  # largest speed-up of a step for that; at a factor of two, joints arrive late, one by one
_NEARLY_BACK = 0.015  # [m] below this height a returning foot may meet ground; higher, the reversal itself looks like touchdown
_SPAN = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])  # squared weights in the length of a body path: 1 rad counts as 0.14 m
_PLACES = 11  # number of candidate rest poses of a stopping body, from the earliest possible one to its goal
_LOW = 0.010  # [m] clearance of feet that return to their last footholds
_HELD, _HELD_S = 0.05, 0.4  # [m] lag of a foot in the air, and [s] duration, from which it counts as held


@dataclass(frozen=True, slots=True)
class Finding:
    """Contact, or missing ground, that a foot has found."""

    leg: int
    p_odom: Array  # (3,) [m] foot centre: where it met ground, or the deepest point of its search
    carries: bool  # False: there is no ground


@dataclass(slots=True)
class _Search:
    """State of feet that search for ground below their footholds."""

    legs: NDArray[np.bool_]  # (6,) still searching
    reach: Array  # (6,) [m] search depth of each
    depth: float = 0.0  # [m] below where they stood


@dataclass(slots=True)
class _Patience:
    """Waiting time of a step, before lift-off, for legs without proven contact."""

    waited_s: float = 0.0
    in_vain_s: float = 0.0  # additional time in which they gave no readings

    def is_over(self, legs: NDArray[np.bool_], felt: FootContact, dt: float) -> bool:
        """Add `dt` [s] and return whether the waiting time of unproven legs (6,) is over."""
        if (legs & ~felt.heard).any() and self.in_vain_s < _IN_VAIN_S - 1e-9:
            self.in_vain_s += dt
        else:
            self.waited_s += dt
        lost = legs & ~felt.leans if self.waited_s <= _LONGER_S else legs
        return self.waited_s > _WAIT_S and bool(lost.any())


@dataclass(frozen=True, slots=True)
class Targets:
    """Leg targets of one cycle."""

    feet: Array  # (6, 3) [m] {body}
    share: Array  # (6,) share of its load that each leg may carry, 0 to 1
    R_level_body: Array  # (3, 3) commanded attitude


class StepExecutor:
    """Converts step plans to foot targets; holds all state of the walk."""

    def __init__(self, settings: Settings, feet: Array, T_odom_body: Array, ground: Array | None = None):
        """Begin at rest.

        Args:
            settings: Settings of the actuator.
            feet: (6, 3) [m] {body} commanded feet, all standing.
            T_odom_body: (4, 4) body pose.
            ground: (6,) [m] {odom} measured heights of the feet. Default: the commanded heights.
        """
        self.step = 0
        self.plan_ns = -1  # [ns] stamp of the plan in execution, or of the last one
        self.phase = 1.0
        self.swing: NDArray[np.bool_] = np.zeros(6, dtype=bool)
        self._settings = settings
        self._T_odom_cmd = np.eye(4)
        self._ref = coordinates(T_odom_body)  # {cmd}
        self._velocity = np.zeros(6)
        self._pressed = np.zeros(6)  # [m] by which each foot is commanded lower
        self._feet = apply(T_odom_body, feet)  # (6, 3) [m] {cmd}
        self._ground = self._feet[:, 2].copy() if ground is None else ground.copy()
        self._share = np.ones(6)
        self._plan: StepPlan | None = None
        self._next: StepPlan | None = None
        self._elapsed = 0.0
        self._start_ref, self._start_velocity = self._ref, self._velocity
        self._start_elapsed = 0.0  # [s] of the plan at which the body path began
        self._end_elapsed = 0.0  # [s] of the plan at which that path ends
        self._flight: Swing | SixthOrderArc | None = None
        self._stopped: NDArray[np.bool_] = np.zeros(6, dtype=bool)  # swing legs that met ground before their targets
        self._met = self._feet.copy()  # (6, 3) [m] {cmd} where they met it
        self._proven: NDArray[np.bool_] = np.ones(6, dtype=bool)  # legs that have carried load since touchdown
        self._behind_s = np.zeros(6)  # [s] for which feet in the air have lagged
        self._short = np.zeros(6)  # [m] over their targets at which legs were stopped, by ground or by a false touchdown
        self._landed: NDArray[np.bool_] = np.zeros(6, dtype=bool)  # legs of the last swing
        self._surveyed = np.zeros(6)  # [m] height corrections of new footholds
        self._search: _Search | None = None
        self._way_back: StepPlan | None = None  # return to the stance before the last step, with {cmd} as {world}
        self._patience = _Patience()
        self._hurry = 1.0  # speed relative to the plan
        self.gentle = False  # whether the running step is not from a plan, but brings hanging feet back
        self._returning = False  # whether feet return to the footholds that they have just left
        self._taking_back = False  # whether the last swing was not from a plan: it cannot be taken back
        self._findings: list[Finding] = []
        self.trouble = ""  # problem of the last step; empty when it went as planned

    @property
    def body_ref(self) -> Array:
        """(4, 4) {odom} commanded body pose now."""
        return np.asarray(self._T_odom_cmd @ pose(self._ref))

    @property
    def feet_odom(self) -> Array:
        """(6, 3) [m] {odom} commanded feet now."""
        return apply(self._T_odom_cmd, self._feet)

    @property
    def ground(self) -> Array:
        """(6,) [m] {odom} heights at which the standing feet were set down, by the plan."""
        return self._ground

    @property
    def load_share(self) -> Array:
        """(6,) share of its load that each leg may carry now, 0 to 1."""
        return self._share.copy()

    @property
    def awaiting(self) -> NDArray[np.bool_]:
        """(6,) legs whose contact must be read every cycle.

        They come down, or must prove that they stand.
        """
        plan = self._plan
        if self._search is not None:
            return self._search.legs.copy()
        if plan is None:
            return np.zeros(6, dtype=bool)
        if self._flight is None:
            soon = self._elapsed >= self._settings.unload_s - _FEEL_FROM_S - 1e-9
            return np.asarray(~plan.swing & ~self._proven & soon)
        coming = _LISTEN_FROM <= self._progress(plan, self._elapsed) < 1.0
        return np.asarray(self.swing & ~self._stopped & coming)

    @property
    def air_s(self) -> Array:
        """(6,) [s] until feet of the running step land; infinite for the others."""
        if self._plan is None:
            return np.full(6, np.inf)
        end, begin = self._plan.duration - self._settings.load_s, self._settings.unload_s
        return np.where(self.flying, max(end - max(self._elapsed, begin), 0.0) / self._hurry, np.inf)

    @property
    def flying(self) -> NDArray[np.bool_]:
        """(6,) legs of the running step between lift-off and touchdown."""
        lifts = self._flight is not None or self.gentle
        return self.swing & ~self._stopped if lifts else np.zeros(6, dtype=bool)

    @property
    def searching(self) -> NDArray[np.bool_]:
        """(6,) legs that search for ground below their footholds."""
        return np.zeros(6, dtype=bool) if self._search is None else self._search.legs.copy()

    @property
    def clearance(self) -> Array:
        """(6,) [m] clearance at lift-off; infinite while it can still be raised."""
        lifted = self._plan is not None and self._flight is not None
        return self._plan.clearance if lifted and self._plan is not None else np.full(6, np.inf)

    @property
    def is_returning(self) -> bool:
        """Whether the walker's own step brings feet back to where they stood."""
        return self._plan is not None and not self.planned and not self.gentle

    def doubt(self, legs: NDArray[np.bool_]) -> None:
        """Require legs (6,) to prove that they stand before others are lifted."""
        self._proven &= ~legs

    def take_findings(self) -> list[Finding]:
        """Return the findings since the last call."""
        found, self._findings = self._findings, []
        return found

    @property
    def resting(self) -> bool:
        """Whether no step is running and no foot searches for ground."""
        return self._plan is None and self._search is None

    @property
    def stance_at_end(self) -> tuple[Array, Array]:
        """Body (4, 4) and feet (6, 3) [m], both {odom}, at the end of the running step.

        At rest these are the commanded ones now.
        """
        if self._plan is None:
            return self.body_ref, self.feet_odom
        return inverse(self._plan.T_world_odom) @ self._plan.body_goal, self._feet_at_end(self._plan)

    def accept(self, plan: StepPlan) -> None:
        """Take over an accepted plan: a revision of the running step, or the next step.

        Before lift-off, the plan may also replace the running step by one with another clearance and duration.
        """
        running = self._plan
        if running is not None and plan.step == running.step and self._flight is None and _another(plan, running):
            self._plan, self.plan_ns = plan, plan.stamp_ns
            self._start_ref, self._start_velocity, self._start_elapsed = self._ref.copy(), self._velocity, self._elapsed
            self._end_elapsed = plan.duration
        elif running is not None and plan.step == running.step:
            # The body keeps its path over the standing feet: a goal that jumped with the pose estimate would shake them.
            self.plan_ns = plan.stamp_ns
            goal = plan.T_world_odom @ inverse(running.T_world_odom) @ running.body_goal
            self._plan = replace(running, T_world_odom=plan.T_world_odom, touchdown=plan.touchdown, body_goal=goal)
        else:
            self._next = plan

    def update(self, dt: float, T_odom_body: Array, felt: FootContact | None = None, pace: float = 1.0) -> Targets:
        """Advance by one cycle.

        Args:
            dt: [s] since the last cycle.
            T_odom_body: (4, 4) body pose by the measured joints.
            felt: Measured contacts; without them every foot follows its plan.
            pace: Speed factor of a gentle step.

        Returns:
            Targets of the legs.
        """
        if self.resting and self._next is not None:
            self._begin(self._next)
            self.trouble = ""
        self._follow(dt, T_odom_body)
        self._correct(dt, T_odom_body)
        if felt is not None:
            self._prove(felt)
        if self._plan is None:
            self._brake(dt)
            self._share += np.clip(~self.searching - self._share, -dt / self._settings.load_s, dt / self._settings.load_s)
            if self._search is not None and felt is not None:
                self._search_down(dt, self._search, felt)
            elif felt is not None:
                self._survey(dt, felt)
        else:
            self._advance(dt * pace if self.gentle else dt, self._plan, felt)
        self._feet[self._stopped] += (1.0 - math.exp(-dt / _SETTLE_S)) * (self._met - self._feet)[self._stopped]
        return self._targets()

    def lower(self, lifted: Array) -> None:
        """Lower hanging feet by heights (6,) [m], while the other legs stand."""
        touchdown = self.feet_odom
        touchdown[:, 2] -= lifted
        self._bring(lifted > 0.0, touchdown, clearance=0.0)

    def put_back(self, legs: NDArray[np.bool_], feet: Array) -> None:
        """Step legs from feet at (6, 3) [m] {odom} to their commanded footholds."""
        touchdown = self.feet_odom
        self._feet[legs] = apply(inverse(self._T_odom_cmd), feet)[legs]
        self._pressed[legs] = 0.0  # their measured position is their commanded one
        self._bring(legs, touchdown, _PICKED_UP)

    def _bring(self, legs: NDArray[np.bool_], touchdown: Array, clearance: float) -> None:
        """Begin a gentle step of unloaded legs to touchdowns (6, 3) [m] {odom}.

        The body stays where it is.
        """
        self._share[legs] = 0.0
        self._begin(
            StepPlan(
                stamp_ns=-1,
                epoch=0,
                step=self.step,
                revision=0,
                T_world_odom=np.eye(4),
                swing=legs.copy(),
                touchdown=touchdown,
                clearance=np.full(6, clearance),
                body_goal=self.body_ref,
                duration=_GENTLE_S,
                stop=True,
            )
        )
        self.gentle = True

    def turn(self, T: Array) -> None:
        """Turn ground, feet and touchdowns in {odom} by T (4, 4) about the body.

        The commanded body pose stays, so the feet move the body to it.
        """
        T_cmd = inverse(self._T_odom_cmd) @ T @ self._T_odom_cmd
        self._ground = apply(T, np.column_stack([self.feet_odom[:, :2], self._ground]))[:, 2]
        self._feet, self._met = apply(T_cmd, self._feet), apply(T_cmd, self._met)
        self._plan, self._next = (plan and _turned(plan, T) for plan in (self._plan, self._next))
        if self._way_back is not None:
            self._way_back = replace(self._way_back, touchdown=apply(T_cmd, self._way_back.touchdown))

    @property
    def planned(self) -> bool:
        """Whether the running step is from a plan."""
        return self._plan is not None and self._plan.stamp_ns >= 0

    def set_down(self, reaches: Callable[[Array], bool]) -> None:
        """Stand as soon as possible: feet in the air go on or back, the sooner of the two.

        Both are footholds that were checked before. No further leg is lifted. The body brakes at once, unless its legs would
        not reach their footholds from there.

        Args:
            reaches: Whether the legs reach feet (6, 3) [m] {body}.
        """
        self._next = None
        plan = self._plan
        if plan is None or not self.planned:
            return
        if self._flight is None or not plan.swing.any():
            self._plan, self._flight = None, None
            self.swing, self.phase = np.zeros(6, dtype=bool), 1.0
            return
        since, left = self._elapsed - self._settings.unload_s, plan.duration - self._elapsed
        back = self._way_back
        on_s, back_s = min(left, max(_SOON_S, left / _FASTER)), min(since, _SOON_S) + self._settings.load_s
        if back is None or on_s <= back_s:
            self._come_to_rest(plan, max(self._hurry, left / on_s), reaches)
            return
        duration = self._settings.unload_s + back_s
        again = replace(back, step=self.step, clearance=np.full(6, _LOW), duration=duration)
        again = replace(again, T_world_odom=inverse(self._T_odom_cmd))
        self._begin(again)
        self._elapsed = self._settings.unload_s  # they are already unloaded
        self._come_to_rest(again, self._hurry, reaches)
        self._returning = True
        self.trouble = "the step is reversed"

    def _come_to_rest(self, plan: StepPlan, hurry: float, reaches: Callable[[Array], bool]) -> None:
        """Finish the running step at `hurry` times its planned speed.

        The body moves only as far as necessary.

        The body stops when the feet are down, and does not wait until they are loaded.
        """
        down = plan.duration - self._settings.load_s
        self._end_elapsed = min(max(down, self._elapsed + hurry * _BRAKE_S), plan.duration)
        left_s = (self._end_elapsed - self._elapsed) / hurry
        goal, velocity = self._goal(plan), self._hurry * self._velocity
        soon = self._ref + left_s / 3.0 * velocity  # brakes with a deceleration that decreases linearly to zero
        if (goal - self._ref) @ (_SPAN * velocity) > 0.0 > (goal - soon) @ (_SPAN * velocity):
            soon = goal
        feet = apply(inverse(self._T_odom_cmd), self._feet_at_end(plan))
        for share in np.linspace(0.0, 1.0, _PLACES):
            T_cmd_rest = pose(soon + share * (goal - soon))
            if reaches(apply(inverse(T_cmd_rest), feet)):
                break
        self._plan = replace(plan, stop=True, body_goal=plan.T_world_odom @ self._T_odom_cmd @ T_cmd_rest)
        self._start_ref, self._start_velocity = self._ref.copy(), self._velocity * (self._hurry / hurry)
        self._start_elapsed, self._hurry = self._elapsed, hurry

    def _feet_at_end(self, plan: StepPlan) -> Array:
        """Return the feet (6, 3) [m] {odom} at the end of a running step."""
        landed = apply(inverse(plan.T_world_odom), plan.touchdown)
        landed[self._stopped] = apply(self._T_odom_cmd, self._met[self._stopped])
        return np.where(plan.swing[:, None], landed, self.feet_odom)

    def _goal(self, plan: StepPlan) -> Array:
        """Return the body goal {cmd} of a step (6,), with angles unwrapped."""
        goal = coordinates(inverse(plan.T_world_odom @ self._T_odom_cmd) @ plan.body_goal)
        goal[3:] = self._start_ref[3:] + wrapped(goal[3:] - self._start_ref[3:])
        return goal

    def _begin(self, plan: StepPlan) -> None:
        self._plan, self._next = plan, None
        self.plan_ns = plan.stamp_ns
        self.step, self.phase, self.swing, self._elapsed = plan.step, 0.0, plan.swing.copy(), 0.0
        self._start_ref, self._start_velocity, self._start_elapsed = self._ref.copy(), self._velocity.copy(), 0.0
        self._end_elapsed = plan.duration
        self._flight, self._patience = None, _Patience()
        self._hurry, self._returning, self.gentle = 1.0, False, False
        self._stopped &= ~plan.swing

    def _advance(self, dt: float, plan: StepPlan, felt: FootContact | None) -> None:
        before = self._elapsed
        self._elapsed = min(before + self._hurry * dt, plan.duration)
        self.phase = self._elapsed / plan.duration
        T_cmd_world = inverse(plan.T_world_odom @ self._T_odom_cmd)
        goal = self._goal(plan)
        whole = self._end_elapsed - self._start_elapsed
        end_velocity = np.zeros(6) if plan.stop else (goal - self._start_ref) / whole
        way = (self._start_ref, self._start_velocity, goal, end_velocity)
        self._ref, self._velocity = hermite(*way, whole, min(self._elapsed - self._start_elapsed, whole))
        if self._flight is None and self._elapsed > self._settings.unload_s:
            unproven = ~plan.swing & ~self._proven
            if felt is not None and unproven.any() and not self.gentle:  # gentle legs carry no load that others had to take
                if self._patience.is_over(unproven, felt, self._elapsed - before):
                    self._abort(unproven)
                self._elapsed, self._velocity = before, np.zeros(6)  # the step is paused
                return
            self._lift_off(plan)
        self._swing_feet(before, plan, apply(T_cmd_world, plan.touchdown), felt)
        if self._elapsed >= plan.duration:
            self._land()

    def _swing_feet(self, before: float, plan: StepPlan, targets: Array, felt: FootContact | None) -> None:
        """Advance swing feet to targets (6, 3) [m] {cmd}; unload and load their legs."""
        begin, end = self._settings.unload_s, plan.duration - self._settings.load_s
        legs = plan.swing
        if self._elapsed <= begin:
            self._share[legs] = np.minimum(self._share[legs], 1.0 - self._elapsed / begin)
            return
        if felt is not None and self._flight is not None and self.planned:
            held = self._held(legs, felt, self._elapsed - before)
            if held.any():
                self._return_step(held, felt.feet)
                return
        if self._flight is None:
            self._flight = _ARCS[self._settings.arc](self._feet[legs], targets[legs], plan.clearance[legs])
        since, until = self._progress(plan, before), self._progress(plan, self._elapsed)
        if felt is not None and since >= _STOP_FROM:
            met = legs & ~self._stopped & (felt.touches | felt.heaves)
            if self._returning:
                highest = np.maximum(self._feet[:, 2], apply(inverse(self._T_odom_cmd), felt.feet)[:, 2])  # the foot lags
                met &= highest - targets[:, 2] < _NEARLY_BACK
            self._stop(met, targets, felt.feet)
            self._proven &= ~felt.heaves  # the body may have tilted for another reason
        load_s = self._settings.load_s
        self._share[legs & ~self._stopped] = max(0.0, (self._elapsed - end) / load_s)
        stopped = legs & self._stopped
        self._share[stopped] = np.minimum(self._share[stopped] + (self._elapsed - before) / load_s, 1.0)
        if since < 1.0:
            feet = self._feet.copy()
            feet[legs] = self._flight.update(targets[legs], since, until - since)
            free = legs & ~self._stopped
            self._feet[free] = feet[free]
            self._ground[free] = targets[free, 2]

    def _held(self, legs: NDArray[np.bool_], felt: FootContact, dt: float) -> NDArray[np.bool_]:
        """Return swing legs (6,) whose feet have lagged far behind the servo goals.

        A folded leg at a joint limit lags behind the plan, but not behind its goals.
        """
        goals = self.feet_odom if felt.goals is None else felt.goals
        behind = np.linalg.norm(goals - felt.feet, axis=1) > _HELD
        self._behind_s = np.where(legs & ~self._stopped & felt.known & behind, self._behind_s + dt, 0.0)
        return self._behind_s > _HELD_S - 1e-9

    def _return_step(self, held: NDArray[np.bool_], feet: Array) -> None:
        """Return all feet of the step, because some (6,) are held at (6, 3) [m] {odom}.

        To continue would drag the robot over its standing feet at full servo torque.
        """
        back = self._way_back
        assert back is not None
        self._feet[held] = apply(inverse(self._T_odom_cmd), feet)[held]
        self._begin(replace(back, step=self.step, T_world_odom=inverse(self._T_odom_cmd), clearance=np.full(6, _LOW)))
        self.trouble = f"an obstacle blocks the {_names(held)} foot; the step is reversed"

    def _lift_off(self, plan: StepPlan) -> None:
        """Store the stance before lift-off, to which the robot can return."""
        self._way_back = replace(
            plan,
            stamp_ns=-1,
            T_world_odom=np.eye(4),
            touchdown=self._feet.copy(),
            clearance=np.maximum(plan.clearance, 0.03),
            body_goal=pose(self._start_ref),
            duration=_BACK_S,
            stop=True,
        )
        self._proven[plan.swing] = False
        self._short[plan.swing] = self._behind_s[plan.swing] = 0.0
        self._landed = plan.swing.copy()
        self._taking_back = plan.stamp_ns < 0

    def _prove(self, felt: FootContact) -> None:
        """Note feet that carry load while others are unloaded.

        A foot that is only assumed to stand yields no finding.
        """
        proven = felt.bears & ~self._proven & ~self.flying & ~self.searching
        self._proven |= proven
        self._findings += [Finding(leg, felt.feet[leg].copy(), True) for leg in np.flatnonzero(proven & felt.known).tolist()]

    def _survey(self, dt: float, felt: FootContact) -> None:
        """Measure at rest the height of feet that have just met ground.

        Their first measurement was in motion.

        The feet that stood before determine the body pose. All six are in the fit, so each update sees about half of the error.
        A foot whose height continues to change stands on soft ground or is not at its target, so the correction is limited.
        """
        fresh = self._stopped & self._landed & ~self.searching & felt.known
        gap = min(dt / _SURVEY_S, 1.0) * (felt.feet[:, 2] - self._ground)
        gap = np.where(fresh, np.clip(self._surveyed + gap, -_SURVEYED, _SURVEYED) - self._surveyed, 0.0)
        self._surveyed += gap
        self._ground += gap
        self._met[:, 2] += gap

    def _abort(self, legs: NDArray[np.bool_]) -> None:
        """Cancel lift-off because legs (6,) have no ground; they search for it.

        The others stand meanwhile.
        """
        self._plan = self._next = None
        self.swing, self.phase = np.zeros(6, dtype=bool), 1.0
        self._search = _Search(legs.copy(), _REACH + self._short)
        self._stopped &= ~legs  # they were not stopped by ground: no longer hold them there
        self.trouble = f"no ground under the {_names(legs)} foot at the expected height; the foot reaches down"

    def _search_down(self, dt: float, search: _Search, felt: FootContact) -> None:
        """Lower feet that search for ground; they stay on contact.

        Without contact the last step is taken back.
        """
        # A foot below its femur's axis hardly turns the femur, so touchdown detection may miss that it stands.
        pushes = felt.pushes & (search.depth > _PUSHED_DOWN)
        found = search.legs & (felt.touches | pushes | felt.heaves)
        self._stay(found, apply(inverse(self._T_odom_cmd), felt.feet), felt.feet)
        self._proven |= found & ~felt.heaves  # the body may have tilted for another reason
        search.legs &= ~found
        if not search.legs.any():
            self._search = None
            self.trouble = f"ground found {search.depth * 100:.0f} cm lower than expected"
            return
        lost = search.legs & (search.depth > search.reach - 1e-9)
        if not lost.any():
            search.depth += _REACH_SPEED * dt
            self._feet[search.legs, 2] -= _REACH_SPEED * dt
            return
        self._findings += [Finding(leg, felt.feet[leg].copy(), False) for leg in np.flatnonzero(lost).tolist()]
        self._search, where = None, f"no ground under the {_names(lost)} foot down to {_REACH * 100:.0f} cm below its foothold"
        back, self._proven[lost] = self._way_back, True  # already reported
        if back is None or self._taking_back:
            self.trouble = f"{where}; the foot stays there"
            return
        self._begin(replace(back, step=self.step, T_world_odom=inverse(self._T_odom_cmd)))
        self.trouble = f"{where}; the step is reversed"

    def _progress(self, plan: StepPlan, elapsed: float) -> float:
        """Return the finished share of the swing, 0 to 1, at a time [s] in the step."""
        begin, end = self._settings.unload_s, plan.duration - self._settings.load_s
        return min(max((elapsed - begin) / (end - begin), 0.0), 1.0)

    def _stop(self, legs: NDArray[np.bool_], targets: Array, feet: Array) -> None:
        """Stop feet where they have met ground, unless they are close to their targets.

        Args:
            legs: (6,) that have met something.
            targets: (6, 3) [m] {cmd} their targets.
            feet: (6, 3) [m] {odom} their measured positions.
        """
        met = apply(inverse(self._T_odom_cmd), feet)
        over = met[:, 2] - targets[:, 2]
        early = legs & (over > _EARLY)
        self._stay(early, met, feet)
        self._short[early] = over[early]

    def _stay(self, legs: NDArray[np.bool_], met: Array, feet: Array) -> None:
        """Keep feet at measured positions (6, 3) [m], in {cmd} and in {odom}."""
        self._met[legs] = met[legs]
        self._ground[legs] = feet[legs, 2]
        self._surveyed[legs] = 0.0
        self._stopped |= legs
        self._findings += [Finding(leg, feet[leg].copy(), True) for leg in np.flatnonzero(legs).tolist()]

    def _land(self) -> None:
        self._share[:] = 1.0
        self.swing, self.gentle = np.zeros(6, dtype=bool), False
        self._plan, self._flight = None, None
        if self._next is not None:
            self._begin(self._next)

    def _brake(self, dt: float) -> None:
        self._velocity = self._velocity * np.exp(-dt / self._settings.brake_s)
        self._ref = self._ref + self._velocity * dt

    def _follow(self, dt: float, T_odom_body: Array) -> None:
        """Move {cmd} in {odom} so that commanded and measured x, y and yaw converge."""
        ref = self.body_ref
        place = ref[:3, 3]
        way = (T_odom_body[:3, 3] - place) * _LEVEL
        turn = math.remainder(yaw_of(T_odom_body) - yaw_of(ref), math.tau)
        R = rotation_z(_FOLLOW * dt * turn)
        # First turn about the body, then translate.
        step = transform(R, place - R @ place + _FOLLOW * dt * way)
        self._T_odom_cmd = step @ self._T_odom_cmd

    def _correct(self, dt: float, T_odom_body: Array) -> None:
        """Lower or raise standing feet to hold the body's height, roll and pitch.

        The offset of the other feet decays.

        A foot that touched down with the offset of the others would miss its foothold by it, and be overloaded or hang.
        """
        error = self._ref - coordinates(inverse(self._T_odom_cmd) @ T_odom_body)
        error[3:] = wrapped(error[3:])
        feet = apply(inverse(pose(self._ref)), self._feet)
        low = error[2] + error[3] * feet[:, 1] - error[4] * feet[:, 0]
        self._pressed += dt * (self._share * self._settings.level_gain * low - (1.0 - self._share) / _RELEASE_S * self._pressed)
        self._pressed = np.minimum(np.maximum(self._pressed, -_PRESSED_LIMIT), _PRESSED_LIMIT)

    def _targets(self) -> Targets:
        level = rotation_from_rpy(self._ref[3:] * _LEVEL)
        feet = apply(inverse(pose(self._ref)), self._feet - self._pressed[:, None] * _UP)
        return Targets(feet, self._share.copy(), level)


def _another(plan: StepPlan, running: StepPlan) -> bool:
    """Return whether a plan of the running step changes clearance or duration."""
    return plan.duration != running.duration or bool((plan.clearance != running.clearance).any())


def _turned(plan: StepPlan, T: Array) -> StepPlan:
    """Return a plan whose touchdowns are turned by T (4, 4) {odom}."""
    return replace(plan, touchdown=apply(plan.T_world_odom @ T @ inverse(plan.T_world_odom), plan.touchdown))


def _names(legs: NDArray[np.bool_]) -> str:
    return " and ".join(LEGS[leg] for leg in np.flatnonzero(legs).tolist())
