"""Sent step plans, and what the actuator made of them.

The actuator's state names the plan that it executes and the plan that it refused, by their stamps.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.locomotion.replan_attempts import RefusedSteps, StepVariant
from sextant.services.planner.locomotion.step_planner import PlannedStep
from sextant.services.planner.robot_estimate import RobotEstimate, WorldStance, is_resting
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode, StepPlan

UNKNOWN_STEP = "unknown step in progress; waiting for it to finish"  # reason if no tracked plan explains the running step
_KEPT = 40  # number of remembered plans besides the newest
_RENEW_NS = 35_000_000  # [ns] after which the running step is sent again: without a plan the actuator goes on for 180 ms
_MEASURED_NS = 300_000_000  # [ns] of rest after which a foot that stopped on ground counts as measured
_REVISION_NS = 100_000_000  # [ns] from a revision until the actuator's state names it; after that it counts as lost
_SETTLED_NS = 150_000_000  # [ns] before a step, from which its plan stays, if it has fast feet
_UNANSWERED_NS = 300_000_000  # [ns] without an answer from resting legs, after which a plan counts as late


@dataclass(frozen=True, slots=True, eq=False)
class NumberedStep:
    """A step with what its plan message needs."""

    planned: PlannedStep
    number: int  # of the step
    variant: StepVariant  # way of taking the step
    T_world_odom: Array  # (4, 4) estimate under which the step was planned
    stop: bool = False  # whether the legs rest after the step
    map_ns: int = -1  # [ns] stamp of the newest terrain map that the step agrees with; -1 without one
    leg_heights: Array = field(default_factory=lambda: np.zeros(6))  # (6,) [m] of that map, see TerrainMap


@dataclass(frozen=True, slots=True, eq=False)
class SentPlan:
    """A sent plan with its step."""

    plan: StepPlan
    step: NumberedStep

    def planned_in(self, T_world_odom: Array) -> PlannedStep:
        """Return the step in another estimate of {world}; the legs follow it in {odom}."""
        return self.step.planned.moved_by(T_world_odom @ inverse(self.plan.T_world_odom))


class PlanTracker:
    """Tracks the sent plans: which one is executed, which one was refused."""

    def __init__(self, foot_radius_m: float):
        """Start without plans."""
        self.running: SentPlan | None = None  # the plan that is executed, or was last; None if unknown
        self.refusals = RefusedSteps()  # of the next step
        self.reversed_legs: NDArray[np.bool_] = np.zeros(6, dtype=np.bool_)  # legs that returned to their previous footholds
        self._sole_to_centre = np.array([0.0, 0.0, foot_radius_m])  # [m]
        self._sent: list[SentPlan] = []  # plans that the actuator may still execute, the newest last
        self._step, self._begun_ns = -1, 0  # the running step, or the last one, and when it was first received
        self._moved_ns = 0  # [ns] when the legs last moved
        self._renew_ns = 0
        self.executed_map_ns = -1  # [ns] stamp of the newest map of an executed plan
        self._revision: SentPlan | None = None  # newest one of the running step, which the actuator may still execute

    def update(self, state: ActuatorState) -> bool:
        """Note which plan is executed and which was refused.

        Return whether a new step has begun.
        """
        if state.step != self._step:
            self._step, self._begun_ns = state.step, state.stamp_ns
        if not is_resting(state):
            self._moved_ns = state.stamp_ns
        begun = self._update_running(state)
        refused = next((sent for sent in self._sent if sent.plan.stamp_ns == state.refused_plan_ns), None)
        if refused is not None:
            self._sent.remove(refused)
            if refused.plan.step == state.step:
                self._revision, self._renew_ns = None, 0  # continue with the accepted plan at once
            waiting = state.phase < 1.0 and any(sent.plan.step == refused.plan.step for sent in self._sent)
            if refused.plan.step == state.step + 1 and not waiting:
                self.refusals.add(refused.step.variant, state.plan_refusal)
        return begun

    def _update_running(self, state: ActuatorState) -> bool:
        """Note which plan is executed; return whether a new step has begun."""
        before = self.running
        if before is not None and before.plan.stamp_ns == state.plan_ns:
            return False
        running = self.running = next((sent for sent in self._sent if sent.plan.stamp_ns == state.plan_ns), None)
        if running is None:  # the actuator executes another plan, has reversed the step, or has restarted
            if before is not None and state.plan_ns < 0 and state.step == before.plan.step:
                self.reversed_legs = before.plan.swing.copy()
            return False
        self.executed_map_ns = max(self.executed_map_ns, running.plan.map_ns)
        if before is not None and before.plan.step == running.plan.step:
            return False
        self.refusals.forget()
        if not (self.reversed_legs & running.plan.swing).any():
            self.reversed_legs = np.zeros(6, dtype=np.bool_)
        return True

    def feet_are_measured(self, now_ns: int) -> bool:
        """Return whether the legs rest long enough that their feet count as measured."""
        return now_ns - self._moved_ns >= _MEASURED_NS

    def is_settled(self, state: ActuatorState) -> bool:
        """Return whether the next step begins so soon that its plan must not change.

        Another plan would arrive when its feet are already in the air, and send them on to other places, which can be too far
        for fast feet.
        """
        running = self.running
        if running is None or state.phase >= 1.0 or running.plan.step != state.step or self.refusals.count:
            return False
        left_ns = (1.0 - state.phase) * running.plan.duration * 1e9
        return left_ns < _SETTLED_NS and any(sent.plan.step == state.step + 1 for sent in self._sent)

    def is_unanswered(self, state: ActuatorState) -> bool:
        """Return whether resting legs leave a plan of the next step unanswered.

        They neither execute it nor refuse it for its content: plans arrive too late.
        """
        plan = next((sent.plan for sent in self._sent if sent.plan.step == state.step + 1), None)
        if plan is None or state.phase < 1.0 or self.refusals.count:
            return False
        return state.stamp_ns - plan.stamp_ns > _UNANSWERED_NS

    def stance_after(self, robot: RobotEstimate) -> WorldStance | None:
        """Return the robot at the end of the running step, or None if unknown."""
        state, T_world_odom = robot.state, robot.T_world_odom
        feet = robot.feet_in_world()
        if state.phase >= 1.0:
            return WorldStance(T_world_odom @ state.body_ref, feet)
        if self.running is None:
            return None
        plan = self.running.plan
        moved = T_world_odom @ inverse(plan.T_world_odom)  # from the plan's estimate of {world} to the newest
        feet[plan.swing] = apply(moved, plan.touchdown)[plan.swing]
        met = plan.swing & state.touchdown_contact & (state.touchdown_ns > self._begun_ns)  # met ground early
        feet[met] = apply(T_world_odom, state.touchdown_point)[met] + self._sole_to_centre
        return WorldStance(moved @ plan.body_goal, feet)

    def send(self, state: ActuatorState, step: NumberedStep) -> StepPlan:
        """Return the plan of a step, as its next revision, and track it."""
        plan = self._send(state, step)
        self._revision = self._sent[-1] if step.number == state.step else None
        return plan

    def _send(self, state: ActuatorState, step: NumberedStep) -> StepPlan:
        revision = 1 + max((sent.plan.revision for sent in self._sent if sent.plan.step == step.number), default=0)
        planned, touchdown = step.planned, step.planned.touchdown.copy()
        touchdown[planned.swing, 2] += step.leg_heights[planned.swing]  # the actuator measures heights by its legs
        newest_ns = self._sent[-1].plan.stamp_ns if self._sent else -1
        plan = StepPlan(
            stamp_ns=max(state.stamp_ns, newest_ns + 1),  # it identifies the plan
            epoch=state.epoch,
            step=step.number,
            revision=revision,
            T_world_odom=np.array(step.T_world_odom),
            swing=planned.swing,
            touchdown=touchdown,
            clearance=planned.clearance,
            body_goal=planned.body_goal,
            duration=planned.duration,
            stop=step.stop,
            map_ns=step.map_ns,
        )
        self._sent = [*self._sent[-_KEPT:], SentPlan(plan, step)]
        self._renew_ns = state.stamp_ns + _RENEW_NS
        return plan

    def renew(self, state: ActuatorState, pose: BodyPose | None) -> StepPlan | None:
        """Return the running step unchanged if no plan was sent for a while, else None.

        The robot walks only while it receives plans.
        """
        running = self.running
        if running is None or state.mode is not Mode.WALK or state.phase >= 1.0 or state.stamp_ns < self._renew_ns:
            return None
        revision = self._revision
        if revision is not None and _is_on_its_way(revision.plan, running.plan, state.stamp_ns):
            running = revision  # the running plan would undo it
        T_world_odom = running.plan.T_world_odom if pose is None else pose.T_world_odom
        planned = running.planned_in(T_world_odom)
        return self._send(state, replace(running.step, planned=planned, T_world_odom=T_world_odom))


def _is_on_its_way(revision: StepPlan, running: StepPlan, now_ns: int) -> bool:
    """Return whether the actuator may still execute a revision of the running plan."""
    newer = revision.step == running.step and revision.revision > running.revision
    return newer and now_ns - revision.stamp_ns < _REVISION_NS
