"""Execution of accepted step plans: targets of feet and body, cycle by cycle.

A step has three parts. First, its legs are unloaded. Then they swing along the flow, while the body moves over the standing
legs on a path that starts with the velocity of the last step. Finally, the legs are loaded again. Commanded and measured
quantities are kept separate:

    {cmd}           frame in which standing feet are fixed; it follows {odom} slowly, see `BodyTrajectory`
    body            commanded body pose {cmd}
    posture         offset by which each standing foot is commanded lower, to remove sag, see `PostureControl`
    contacts        where feet have met ground, see `GroundContacts`
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.body_trajectory import LEVEL, BodyTrajectory
from sextant.services.actuator.locomotion.foot_press import FootPress
from sextant.services.actuator.locomotion.foot_relief import FootRelief
from sextant.services.actuator.locomotion.ground_contacts import Finding, GroundContacts
from sextant.services.actuator.locomotion.ground_search import SEARCH_DEPTH_M, GroundSearch
from sextant.services.actuator.locomotion.held_feet import HeldFeet
from sextant.services.actuator.locomotion.posture_control import PostureControl
from sextant.services.actuator.locomotion.running_step import RunningStep
from sextant.services.actuator.locomotion.sixth_order_arc import SixthOrderArc
from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.shared.geometry import Array, apply, inverse, rotation_from_rpy
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import StepPlan

_ARCS: dict[str, type[Swing] | type[SixthOrderArc]] = {"flow": Swing, "sixth_order": SixthOrderArc}
_GENTLE_S = 1.0  # [s] in which hanging feet return to the ground; longer if the joint speed limits require it
_PICKED_UP_M = 0.03  # [m] clearance of feet that may lie on the ground
_DETECT_FROM, _STOP_FROM = 0.35, 0.45  # shares of a swing from which touchdown is detected, and from which it may stop the foot
_FEEL_FROM_S = 0.03  # [s] before lift-off from which the other legs must prove that they stand
_RETURN_S = 1.4  # [s] duration of a step that returns the feet to their last footholds
_RETURN_CLEARANCE_M = 0.03  # [m] minimum clearance of that step
_SET_DOWN_S = 0.33  # [s] in which feet in the air reach the ground once the robot has to stop
_SOFTLY = 12.5  # time constants of the servos' inertia that this takes at least: else heavy rotors lift the body at touchdown
_BRAKE_S = 0.2  # [s] minimum braking time of the body, if its step lasts that long
_MAX_SPEEDUP = 1.75  # largest speed-up of a step that sets its feet down; at a factor of two, joints arrive late
_UNFELT_S = 0.04  # [s] by which a step advances at most in a cycle if contact is not measured
_RETURN_CONTACT_M = 0.015  # [m] below this height a returning foot may meet ground; higher, the reversal looks like touchdown
_REVERSAL_CLEARANCE_M = 0.010  # [m] clearance of feet that reverse in mid-swing


@dataclass(frozen=True, slots=True)
class Targets:
    """Leg targets of one cycle."""

    feet: Array  # (6, 3) [m] {body}
    share: Array  # (6,) share of its load that each leg may carry, 0 to 1
    R_level_body: Array  # (3, 3) commanded attitude


class StepExecutor:
    """Converts step plans to foot targets; holds all state of the walk."""

    def __init__(
        self, settings: Settings, feet: Array, T_odom_body: Array, ground: Array | None = None, inertia_s: float = 0.0
    ):
        """Begin at rest.

        Args:
            settings: Settings of the actuator.
            feet: (6, 3) [m] {body} commanded feet, all standing.
            T_odom_body: (4, 4) body pose.
            ground: (6,) [m] {odom} measured heights of the feet. Default: the commanded heights.
            inertia_s: [s] time constant of the servos' inertia.
        """
        self.step = 0
        self.plan_ns = -1  # [ns] stamp of the plan in execution, or of the last one
        self.phase = 1.0
        self.trouble = ""  # problem of the last step; empty when it went as planned
        self._settings = settings
        self._softly_s, self._set_down_s = _SOFTLY * inertia_s, set_down_s(inertia_s)
        self._body = BodyTrajectory(T_odom_body)
        self._posture = PostureControl(settings.posture)
        self._feet = apply(T_odom_body, feet)  # (6, 3) [m] {cmd}
        self._contacts = GroundContacts(self._feet, self._feet[:, 2] if ground is None else ground)
        self._held = HeldFeet()
        self._press = FootPress()
        self._relief = FootRelief()
        self._share = np.ones(6)  # share of its load that each leg may carry
        self._running: RunningStep | None = None
        self._next: StepPlan | None = None
        self._search: GroundSearch | None = None
        self._return_plan: StepPlan | None = None  # back to the stance before the last planned step, with {cmd} as {world}

    # ------------------------------------------------------------------------------------------------------------ state

    @property
    def body_ref(self) -> Array:
        """(4, 4) {odom} commanded body pose now."""
        return self._body.T_odom_body

    @property
    def feet_odom(self) -> Array:
        """(6, 3) [m] {odom} commanded feet now."""
        return self._body.to_odom(self._feet)

    @property
    def ground(self) -> Array:
        """(6,) [m] {odom} heights at which the standing feet were set down, by the plan."""
        return self._contacts.ground

    @property
    def load_share(self) -> Array:
        """(6,) share of its load that each leg may carry now, 0 to 1."""
        return self._share.copy()

    @property
    def swing(self) -> NDArray[np.bool_]:
        """(6,) legs that the running step swings."""
        return np.zeros(6, dtype=bool) if self._running is None else self._running.plan.swing.copy()

    @property
    def gentle(self) -> bool:
        """Whether the running step is not from a plan, but brings hanging feet back."""
        return self._running is not None and self._running.gentle

    @property
    def planned(self) -> bool:
        """Whether the running step is from a plan."""
        return self._running is not None and self._running.is_planned

    @property
    def is_returning(self) -> bool:
        """Whether the executor's own step brings feet back to where they stood."""
        return self._running is not None and not self.planned and not self.gentle

    @property
    def resting(self) -> bool:
        """Whether no step is running and no foot searches for ground."""
        return self._running is None and self._search is None

    @property
    def awaiting(self) -> NDArray[np.bool_]:
        """(6,) legs whose contact must be read every cycle.

        They come down, or must prove that they stand.
        """
        running = self._running
        if self._search is not None:
            return self._search.legs.copy()
        if running is None:
            return np.zeros(6, dtype=bool)
        if running.flight is None:
            soon = running.elapsed_s >= running.unload_s - _FEEL_FROM_S - 1e-9
            return np.asarray(~running.plan.swing & ~self._contacts.proven & soon)
        coming = _DETECT_FROM <= running.swing_share(running.elapsed_s) < 1.0
        return np.asarray(running.plan.swing & ~self._contacts.stopped & coming)

    @property
    def air_s(self) -> Array:
        """(6,) [s] until feet of the running step land; infinite for the others."""
        return np.full(6, np.inf) if self._running is None else np.where(self.flying, self._running.air_s, np.inf)

    @property
    def flying(self) -> NDArray[np.bool_]:
        """(6,) legs of the running step between lift-off and touchdown."""
        lifts = self._running is not None and (self._running.flight is not None or self._running.gentle)
        return self.swing & ~self._contacts.stopped if lifts else np.zeros(6, dtype=bool)

    @property
    def searching(self) -> NDArray[np.bool_]:
        """(6,) legs that search for ground below their footholds."""
        return np.zeros(6, dtype=bool) if self._search is None else self._search.legs.copy()

    @property
    def pressing(self) -> NDArray[np.bool_]:
        """(6,) legs that press down a little, because they have not proven that they stand."""
        return self._press.legs.copy()

    @property
    def is_searching(self) -> bool:
        """Whether any leg searches for ground."""
        return self._search is not None and bool(self._search.legs.any())

    @property
    def clearance(self) -> Array:
        """(6,) [m] clearance at lift-off; infinite while it can still be raised."""
        lifted = self._running is not None and self._running.flight is not None
        return self._running.plan.clearance if lifted and self._running is not None else np.full(6, np.inf)

    @property
    def stance_at_end(self) -> tuple[Array, Array]:
        """Body (4, 4) and feet (6, 3) [m], both {odom}, at the end of the running step.

        At rest these are the commanded ones now.
        """
        if self._running is None:
            return self.body_ref, self.feet_odom
        plan = self._running.plan
        return inverse(plan.T_world_odom) @ plan.body_goal, self._feet_at_end(plan)

    def take_findings(self) -> list[Finding]:
        """Return the findings since the last call."""
        return self._contacts.take_findings()

    # --------------------------------------------------------------------------------------------------------- commands

    def seek_ground(self, legs: NDArray[np.bool_]) -> None:
        """Let legs (6,) of a resting robot that carry no load reach down for the ground.

        They must prove that they stand before others are lifted. A robot that does not stand on three legs is held up, and its
        feet stay where they are.
        """
        self._contacts.proven &= ~legs
        if 0 < np.count_nonzero(legs) <= 3:
            self._abort(legs)

    def accept(self, plan: StepPlan) -> None:
        """Take over an accepted plan: a revision of the running step, or the next step.

        Before lift-off, the plan may also replace the running step by one with another clearance and duration.
        """
        running = self._running
        if running is None or plan.step != running.plan.step:
            self._next = plan
            return
        self.plan_ns = plan.stamp_ns
        if running.flight is None and _changes_swing(plan, running.plan):
            running.plan = plan
            self._body.begin(running.elapsed_s, plan.duration)
        else:
            # The body keeps its path over the standing feet: a goal that jumped with the pose estimate would shake them.
            goal = plan.T_world_odom @ inverse(running.plan.T_world_odom) @ running.plan.body_goal
            running.plan = replace(running.plan, T_world_odom=plan.T_world_odom, touchdown=plan.touchdown, body_goal=goal)

    def lower(self, lifted: Array) -> None:
        """Lower hanging feet by heights (6,) [m], while the other legs stand."""
        touchdown = self.feet_odom
        touchdown[:, 2] -= lifted
        self._begin_gentle_step(lifted > 0.0, touchdown, clearance=0.0)

    def put_back(self, legs: NDArray[np.bool_], feet: Array) -> None:
        """Step legs from feet at (6, 3) [m] {odom} to their commanded footholds."""
        touchdown = self.feet_odom
        self._feet[legs] = self._body.to_cmd(feet)[legs]
        self._posture.reset(legs)  # their measured position is their commanded one
        self._begin_gentle_step(legs, touchdown, _PICKED_UP_M)

    def _begin_gentle_step(self, legs: NDArray[np.bool_], touchdown: Array, clearance: float) -> None:
        """Begin a gentle step of unloaded legs to touchdowns (6, 3) [m] {odom}.

        The body stays where it is.
        """
        self._share[legs] = 0.0
        plan = StepPlan(
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
        self._begin(plan).gentle = True

    def turn(self, T: Array) -> None:
        """Turn ground, feet and touchdowns in {odom} by T (4, 4) about the body.

        The commanded body pose stays, so the feet move the body to it.
        """
        T_cmd = inverse(self._body.T_odom_cmd) @ T @ self._body.T_odom_cmd
        self._contacts.turn(T, T_cmd, self.feet_odom)
        self._feet = apply(T_cmd, self._feet)
        self._next = self._next and _turned(self._next, T)
        if self._running is not None:
            self._running.plan = _turned(self._running.plan, T)
        if self._return_plan is not None:
            self._return_plan = replace(self._return_plan, touchdown=apply(T_cmd, self._return_plan.touchdown))

    def set_down(self, reaches: Callable[[Array], bool]) -> None:
        """Stand as soon as possible.

        Feet in the air continue to their touchdowns, or return to their last footholds if that is faster. No further leg is
        lifted. The body brakes at once, unless its legs would not reach their footholds from there.

        Args:
            reaches: Whether the legs reach feet (6, 3) [m] {body}.
        """
        self._next = None
        running, back = self._running, self._return_plan
        if running is None or not running.is_planned:
            return
        if running.flight is None or not running.plan.swing.any():
            self._running, self.phase = None, 1.0
            return
        since, left = running.elapsed_s - running.unload_s, running.plan.duration - running.elapsed_s
        max_speedup = _MAX_SPEEDUP * _SET_DOWN_S / self._set_down_s
        on_s = min(left, max(self._set_down_s, left / max_speedup))
        back_s = min(max(since, self._softly_s), self._set_down_s) + running.load_s
        if back is None or on_s <= back_s:
            self._come_to_rest(running, max(running.speedup, left / on_s), reaches)
            return
        returning = self._begin(self._renumbered(back, clearance=_REVERSAL_CLEARANCE_M, duration=running.unload_s + back_s))
        returning.elapsed_s = returning.unload_s  # its feet are already unloaded
        returning.returns = True
        self._come_to_rest(returning, returning.speedup, reaches)
        self.trouble = "the step is reversed"

    def _come_to_rest(self, running: RunningStep, speedup: float, reaches: Callable[[Array], bool]) -> None:
        """Finish the running step at `speedup` times its planned speed.

        The body moves only as far as necessary. It stops when the feet are down, and does not wait until they are loaded.
        """
        plan, now_s = running.plan, running.elapsed_s
        end_s = min(max(running.touchdown_s, now_s + speedup * _BRAKE_S), plan.duration)
        goal, feet = self._body.goal(plan.T_world_odom, plan.body_goal), self._body.to_cmd(self._feet_at_end(plan))
        for T_cmd_rest in self._body.rest_poses(goal, (end_s - now_s) / speedup, running.speedup):
            if reaches(apply(inverse(T_cmd_rest), feet)):
                break
        running.plan = replace(plan, stop=True, body_goal=plan.T_world_odom @ self._body.T_odom_cmd @ T_cmd_rest)
        self._body.begin(now_s, end_s, velocity_scale=running.speedup / speedup)
        running.speedup = speedup

    def _feet_at_end(self, plan: StepPlan) -> Array:
        """Return the feet (6, 3) [m] {odom} at the end of a running step."""
        landed, stopped = apply(inverse(plan.T_world_odom), plan.touchdown), self._contacts.stopped
        landed[stopped] = self._body.to_odom(self._contacts.met[stopped])
        return np.where(plan.swing[:, None], landed, self.feet_odom)

    # ------------------------------------------------------------------------------------------------------ every cycle

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
        body = self._body
        body.follow(dt, T_odom_body)
        self._posture.update(dt, body.level_error(T_odom_body), body.to_body(self._feet), self._share)
        if felt is not None:
            standing = ~self.flying & ~self.searching & ~self.pressing
            self._contacts.prove(felt, standing)
            self._relieve(dt, standing, felt)
        if self._running is None:
            self._press.stop()
            self._rest(dt, felt)
        else:
            # Feet that follow their plan unmeasured must have the time for it, also in late cycles.
            progress = dt if felt is not None else min(dt, _UNFELT_S)
            self._advance(progress * pace if self.gentle else progress, self._running, felt)
        self._contacts.settle(self._feet, dt)
        level = rotation_from_rpy(body.xyz_rpy[3:] * LEVEL)
        feet = self._press.lowered(self._posture.lowered(self._feet), dt)
        return Targets(body.to_body(feet), self._share.copy(), level)

    def _relieve(self, dt: float, standing: NDArray[np.bool_], felt: FootContact) -> None:
        """Move the commands of standing feet (6,) that something holds to where the feet are."""
        moved = self._relief.update(standing, self.feet_odom if felt.goals is None else felt.goals, felt, dt)
        if moved is not None:
            moved = self._body.to_cmd(self.feet_odom + moved) - self._feet
            self._feet += moved
            self._contacts.met += moved

    def _begin(self, plan: StepPlan) -> RunningStep:
        self._running, self._next = RunningStep(plan, self._settings.unload_s, self._settings.load_s), None
        self.step, self.plan_ns, self.phase = plan.step, plan.stamp_ns, 0.0
        self._body.begin(0.0, plan.duration)
        self._contacts.release(plan.swing)
        return self._running

    def _rest(self, dt: float, felt: FootContact | None) -> None:
        """Stand; feet without ground search for it."""
        self._body.brake(dt, self._settings.brake_s)
        self._share += np.clip(~self.searching - self._share, -dt / self._settings.load_s, dt / self._settings.load_s)
        if self._search is not None and felt is not None:
            self._search_down(dt, self._search, felt)
        elif felt is not None:
            self._contacts.survey(dt, felt)

    def _advance(self, dt: float, running: RunningStep, felt: FootContact | None) -> None:
        """Advance the running step by `dt` [s]; it is paused while other legs have to prove that they stand."""
        before, plan = running.advance(dt), running.plan
        self.phase = running.elapsed_s / plan.duration
        self._body.advance(running.elapsed_s, self._body.goal(plan.T_world_odom, plan.body_goal), plan.stop)
        if running.flight is None and running.elapsed_s > running.unload_s:
            unproven = ~plan.swing & ~self._contacts.proven
            # Gentle legs carry no load that others had to take.
            if felt is not None and np.count_nonzero(unproven) and not running.gentle:
                if self._press.legs.any():
                    self._press_down(dt, felt)
                elif running.wait.is_over(unproven, felt, running.elapsed_s - before):
                    self._contacts.accept(unproven & felt.stands, felt)
                    self._press.begin(unproven & ~felt.stands)
                running.elapsed_s = before
                self._body.pause()
                return
            self._lift_off(plan)
        self._swing_feet(before, running, felt)
        if running is self._running and running.elapsed_s >= plan.duration:
            self._land()

    def _lift_off(self, plan: StepPlan) -> None:
        """Store the stance before lift-off, to which the robot can return from a planned step."""
        self._return_plan = None
        if plan.stamp_ns >= 0:
            self._return_plan = replace(
                plan,
                stamp_ns=-1,
                T_world_odom=np.eye(4),
                touchdown=self._feet.copy(),
                clearance=np.maximum(plan.clearance, _RETURN_CLEARANCE_M),
                body_goal=self._body.T_cmd_start,
                duration=_RETURN_S,
                stop=True,
            )
        self._contacts.lift_off(plan.swing)
        self._held.reset(plan.swing)

    def _swing_feet(self, before: float, running: RunningStep, felt: FootContact | None) -> None:
        """Advance swing feet since a time `before` [s] of the step; unload and load their legs."""
        legs, contacts = running.plan.swing, self._contacts
        if running.elapsed_s <= running.unload_s:
            self._share[legs] = np.minimum(self._share[legs], 1.0 - running.elapsed_s / running.unload_s)
            return
        if felt is not None and running.flight is not None and running.is_planned:
            goals = self.feet_odom if felt.goals is None else felt.goals
            held = self._held.update(legs & ~contacts.stopped, goals, felt, running.elapsed_s - before)
            if np.count_nonzero(held):
                self._reverse_step(held, felt.feet)
                return
        targets = apply(inverse(running.plan.T_world_odom @ self._body.T_odom_cmd), running.plan.touchdown)  # {cmd}
        if running.flight is None:
            running.flight = _ARCS[self._settings.arc](self._feet[legs], targets[legs], running.plan.clearance[legs])
        since, until = running.swing_share(before), running.swing_share(running.elapsed_s)
        if felt is not None and since >= _STOP_FROM:
            self._stop_on_contact(running, targets, felt)
        stopped, free = legs & contacts.stopped, legs & ~contacts.stopped
        self._share[free] = max(0.0, (running.elapsed_s - running.touchdown_s) / running.load_s)
        if np.count_nonzero(stopped):
            self._share[stopped] = np.minimum(self._share[stopped] + (running.elapsed_s - before) / running.load_s, 1.0)
        if since < 1.0:
            feet = self._feet.copy()
            feet[legs] = running.flight.update(targets[legs], since, until - since)
            self._feet[free] = feet[free]
            contacts.ground[free] = targets[free, 2]

    def _stop_on_contact(self, running: RunningStep, targets: Array, felt: FootContact) -> None:
        """Stop swing feet that have met ground well before their targets (6, 3) [m] {cmd}."""
        self._contacts.proven &= ~felt.lifts_body  # the body may have tilted for another reason
        met = running.plan.swing & ~self._contacts.stopped & (felt.touches | felt.lifts_body)
        if not np.count_nonzero(met):
            return
        measured = self._body.to_cmd(felt.feet)
        if running.returns:
            highest = np.maximum(self._feet[:, 2], measured[:, 2])  # the foot lags
            met &= highest - targets[:, 2] < _RETURN_CONTACT_M
        self._contacts.stop_early(met, targets, measured, felt.feet)

    def _land(self) -> None:
        self._share[:] = 1.0
        self._running = None
        if self._next is not None:
            self._begin(self._next)

    # --------------------------------------------------------------------------------------------------- missing ground

    def _reverse_step(self, held: NDArray[np.bool_], feet: Array) -> None:
        """Return all swing feet, because some (6,) are blocked at (6, 3) [m] {odom}.

        To continue would drag the robot over its standing feet at full servo torque.
        """
        assert self._return_plan is not None
        self._feet[held] = self._body.to_cmd(feet)[held]
        self._begin(self._renumbered(self._return_plan, clearance=_REVERSAL_CLEARANCE_M))
        self.trouble = f"an obstacle blocks the {_names(held)} foot; the step is reversed"

    def _renumbered(self, back: StepPlan, clearance: float | None = None, duration: float | None = None) -> StepPlan:
        """Return a plan back to a stance, with the present step number and {cmd}."""
        return replace(
            back,
            step=self.step,
            T_world_odom=inverse(self._body.T_odom_cmd),
            clearance=back.clearance if clearance is None else np.full(6, clearance),
            duration=back.duration if duration is None else duration,
        )

    def _abort(self, legs: NDArray[np.bool_]) -> None:
        """Cancel lift-off because legs (6,) have no ground; they search for it.

        The others stand meanwhile.
        """
        self._running, self._next, self.phase = None, None, 1.0
        depth = self._press.hand_over(legs)
        self._feet[:, 2] -= depth
        self._search = GroundSearch(legs, self._contacts.stop_height, float(depth.max()))
        self._contacts.release(legs)  # they were not stopped by ground: no longer hold them there
        self.trouble = f"no ground under the {_names(legs)} foot at the expected height; the foot reaches down"

    def _press_down(self, dt: float, felt: FootContact) -> None:
        """Press feet down that have not proven that they stand; they search if that is in vain."""
        found, lower = self._press.update(dt, felt)
        self._feet[:, 2] -= lower
        self._contacts.lower(lower)
        self._contacts.accept(found, felt)
        if self._press.is_in_vain:
            self._abort(self._press.legs)

    def _search_down(self, dt: float, search: GroundSearch, felt: FootContact) -> None:
        """Lower feet that search for ground; they stay on contact.

        Without contact the last step is taken back.
        """
        found = search.update(felt)
        self._contacts.stay(found, self._body.to_cmd(felt.feet), felt.feet)
        self._contacts.proven |= found & ~felt.lifts_body  # the body may have tilted for another reason
        if not search.legs.any():
            self._search = None
            self.trouble = f"ground found {search.depth * 1e3:.0f} mm lower than expected"
            return
        lost = search.lost
        if not lost.any():
            self._feet[search.legs, 2] -= search.deepen(dt, felt)
            return
        self._contacts.report_missing(lost, felt.feet)
        self._search = None
        self.trouble = f"no ground under the {_names(lost)} foot down to {SEARCH_DEPTH_M * 100:.0f} cm below its foothold"
        if self._return_plan is None:
            self.trouble += "; the foot stays there"
        else:
            self._begin(self._renumbered(self._return_plan))
            self.trouble += "; the step is reversed"


def set_down_s(inertia_s: float) -> float:
    """Return the time [s] in which feet in the air reach the ground, with the time constant [s] of the servos' inertia."""
    return max(_SET_DOWN_S, _SOFTLY * inertia_s)


def _changes_swing(plan: StepPlan, running: StepPlan) -> bool:
    """Return whether a plan of the running step changes clearance or duration."""
    return plan.duration != running.duration or bool((plan.clearance != running.clearance).any())


def _turned(plan: StepPlan, T: Array) -> StepPlan:
    """Return a plan whose touchdowns are turned by T (4, 4) {odom}."""
    return replace(plan, touchdown=apply(plan.T_world_odom @ T @ inverse(plan.T_world_odom), plan.touchdown))


def _names(legs: NDArray[np.bool_]) -> str:
    return " and ".join(LEGS[leg] for leg in np.flatnonzero(legs).tolist())
