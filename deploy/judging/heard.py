"""What a run has said to its scorer: the truth, and beside it the services' words."""

from dataclasses import replace
from typing import TypeVar

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    GroundTruth,
    Mode,
    PassageMap,
    PassagePlan,
    PlannerStatus,
    StepPlan,
)

Counted = TypeVar("Counted", ActuatorState, StepPlan)

_MOST_STEPS = 1 << 40  # that are counted on: a larger number is no count
_REFUSED_NS = 10_000_000_000  # [ns] that a robot must stand and say why, where that is right


class Heard:
    """All that was said, in order; steps are counted from the run's beginning, over restarts of the actuator."""

    def __init__(self) -> None:
        self.truth: list[GroundTruth] = []
        self.poses: list[BodyPose] = []
        self.states: list[ActuatorState] = []
        self.statuses: list[PlannerStatus] = []
        self.plans: dict[int, StepPlan] = {}  # the newest revision of each step
        self.moved: dict[int, int] = {}  # footholds moved in each step, by the planner's word
        self.passage_plans: list[tuple[PassagePlan, PassageMap | None]] = []  # and the newest map of the strip by then
        self.routes: list[Array] = []  # (k, 2) [m] {world} ways to a goal, each where it was new
        self.first_step_ns: int | None = None
        self.refusal = ""  # why the robot does not go on, in the planner's words, once it has said so for long
        self._newest_step = self._steps_before = 0  # of the actuator as it counts, and of those before it
        self._blocked_since_ns: int | None = None

    @property
    def begin_ns(self) -> int:
        """Stamp [ns] of the first message of truth, from which a run's time counts."""
        return self.truth[0].stamp_ns if self.truth else 0

    def stamps(self) -> Array:
        """Times (n,) [ns] of the truth since the first of it."""
        begin = self.begin_ns
        return np.array([m.stamp_ns - begin for m in self.truth], dtype=np.float64)

    def take_in(self, truth: GroundTruth, inbox: Inbox) -> None:
        """Take in one message of truth and what the services have said since the last."""
        self.truth.append(truth)
        self.poses += inbox.drain(topics.BODY_POSE)
        for state in inbox.drain(topics.ACTUATOR_STATE):
            if state.step < self._newest_step:
                # An actuator that began anew counts from zero.
                self._steps_before = min(self._steps_before + max(self._newest_step, 0), _MOST_STEPS)
            self._newest_step = state.step
            self.states.append(self._counted_on(state))
            if self.first_step_ns is None and state.mode is Mode.WALK:
                self.first_step_ns = state.stamp_ns
        for plan in inbox.drain(topics.STEP_PLAN):
            plan = self._counted_on(plan)
            known = self.plans.get(plan.step)
            if known is None or plan.revision >= known.revision:
                self.plans[plan.step] = plan
        self.passage_plans += [(plan, inbox.latest(topics.PASSAGE)) for plan in inbox.drain(topics.PASSAGE_PLAN)]
        for status in inbox.drain(topics.PLANNER_STATUS):
            self._note(status)

    def _counted_on(self, message: Counted) -> Counted:
        step = message.step + self._steps_before
        return replace(message, step=step) if self._steps_before and abs(step) < _MOST_STEPS else message

    def _note(self, status: PlannerStatus) -> None:
        self.statuses.append(status)
        self.moved[status.step + self._steps_before] = status.moved_footholds
        if len(status.path) and not any(_goes_on(status.path, known) for known in self.routes[-1:]):
            self.routes.append(status.path)
        if status.state != "blocked":
            self._blocked_since_ns = None
            return
        if self._blocked_since_ns is None:
            self._blocked_since_ns = status.stamp_ns
        if status.stamp_ns - self._blocked_since_ns >= _REFUSED_NS:
            self.refusal = status.reason


def _goes_on(path: Array, known: Array) -> bool:
    """Whether a way (k, 2) is what is left of a known one."""
    rest = path[1:]
    return len(rest) < len(known) and np.array_equal(rest, known[len(known) - len(rest) :])
