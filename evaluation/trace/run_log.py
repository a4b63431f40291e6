"""Messages that the scorer has received in a run: ground truth and services."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.report import Warned, camera_errors_named, without_figures
from sextant.shared.geometry import Array
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    CameraErrors,
    GroundTruth,
    HornErrors,
    Mode,
    PassageMap,
    PassagePlan,
    PlannerStatus,
    StepPlan,
    schema,
)

Kept = TypeVar("Kept", ActuatorState, BodyPose)
Counted = TypeVar("Counted", ActuatorState, StepPlan)

_MOST_STEPS = 1 << 40  # upper limit of step numbers that are added up
# Fields of kept messages that no evaluation uses.
_UNUSED_OF_STATE = frozenset(("contact", "q", "load_nm", "feet", "T_odom_body"))
_UNUSED_OF_POSE = frozenset(("T_world_odom", "covariance", "degenerate"))
_COLUMNS = ("stamp_ns", "T_world_body", "q", "torque", "feet", "contact", "carries_load", "shutdown")
_ROWS = 1024  # of a part of the columns
_MOST_WARNINGS = 100  # that are kept
_REFUSED_NS = 10_000_000_000  # [ns] minimum duration of a refusal: standing and reporting the reason


class TruthLog:
    """Ground truth of a run in columns, with a row per message; it takes a third of the memory of the messages."""

    def __init__(self) -> None:
        self._parts: list[dict[str, NDArray[Any]]] = []
        self._count = 0

    def __len__(self) -> int:
        """Number of messages."""
        return self._count

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column (n, ...) by the name of its field; without messages it is (0,)."""
        return np.concatenate([part[name] for part in self._parts])[: self._count] if self._parts else np.zeros(0)

    def append(self, truth: GroundTruth) -> None:
        """Add a message."""
        row = self._count % _ROWS
        if row == 0:
            values = {name: np.asarray(getattr(truth, name)) for name in _COLUMNS}
            self._parts.append({name: np.empty((_ROWS, *value.shape), value.dtype) for name, value in values.items()})
        for name, column in self._parts[-1].items():
            column[row] = getattr(truth, name)
        self._count += 1


class RunLog:
    """All received messages in order.

    Steps are counted from the run's beginning, across restarts of the actuator.
    """

    def __init__(self) -> None:
        self.truth = TruthLog()
        self.begin_ns = self.newest_ns = (
            0  # [ns] stamps of the first message of truth, the zero of the run's time, and the last
        )
        self.poses: list[BodyPose] = []
        self.states: list[ActuatorState] = []
        self.statuses: list[PlannerStatus] = []
        self.plans: dict[int, StepPlan] = {}  # the newest revision of each step
        self.choices: list[PlannerStatus] = []  # the first status of each choice of a gait, or of another kind of ground
        self.hottest = float("nan")  # [deg C] highest temperature of any servo
        self.moved: dict[int, int] = {}  # moved footholds of each step, as reported by the planner
        self.passage_plans: list[tuple[PassagePlan, PassageMap | None]] = []  # with the newest map of the strip at that time
        self.routes: list[Array] = []  # (k, 2) [m] {world} new routes to a goal
        self.first_step_ns: int | None = None
        self.capture_to_plan_ns: list[int] = []  # [ns] from a depth image to the first cycle of a plan that is based on it
        self.camera_errors: CameraErrors | None = None  # the newest ones
        self.horn_errors: HornErrors | None = None  # the same
        self.warnings: dict[str, Warned] = {}  # the first of each, by its words without figures
        self.refusal = ""  # the planner's reason for not going on, once it has lasted `_REFUSED_NS`
        self._newest_step = self._steps_before = 0  # newest step of the actuator, and the steps before its restart
        self._blocked_since_ns: int | None = None
        self._map_ns: dict[int, int] = {}  # stamp of a plan -> stamp of its map
        self._executed_map_ns = -1  # the newest one of the executed plans

    def stamps(self) -> Array:
        """Return times (n,) [ns] of the truth, relative to its first message."""
        return np.asarray(self.truth["stamp_ns"] - self.begin_ns, dtype=np.float64)

    def take_in(self, truth: GroundTruth, inbox: Inbox) -> None:
        """Process one message of truth and the service messages since the last one."""
        if not self.truth:
            self.begin_ns = truth.stamp_ns
        self.truth.append(truth)
        self.newest_ns = truth.stamp_ns
        self.hottest = float(np.fmax(self.hottest, truth.temperature))
        for pose in inbox.drain(topics.BODY_POSE):
            self.poses.append(_sharing(pose, self.poses, _UNUSED_OF_POSE))
        self.horn_errors = inbox.latest(topics.HORN_ERRORS) or self.horn_errors
        states = inbox.drain(topics.ACTUATOR_STATE)
        for state in states:
            if state.step < self._newest_step:
                # A restarted actuator counts from zero.
                self._steps_before = min(self._steps_before + max(self._newest_step, 0), _MOST_STEPS)
            self._newest_step = state.step
            self.states.append(_sharing(self._counted_on(state), self.states, _UNUSED_OF_STATE))
            for words in state.warnings:
                self._warn(words, state.stamp_ns)
            if self.first_step_ns is None and state.mode is Mode.WALK:
                self.first_step_ns = state.stamp_ns
        for errors in inbox.drain(topics.CAMERA_ERRORS):
            self.camera_errors = errors
            for words in camera_errors_named(errors.finding):
                self._warn(words, errors.stamp_ns)
        for plan in inbox.drain(topics.STEP_PLAN):
            self._map_ns[plan.stamp_ns] = plan.map_ns
            plan = self._counted_on(plan)
            known = self.plans.get(plan.step)
            if known is None or plan.revision >= known.revision:
                self.plans[plan.step] = plan
        for state in states:
            map_ns = self._map_ns.get(state.plan_ns, -1)
            if map_ns > self._executed_map_ns:
                self._executed_map_ns = map_ns
                self.capture_to_plan_ns.append(state.stamp_ns - map_ns)
        self.passage_plans += [(plan, inbox.latest(topics.PASSAGE)) for plan in inbox.drain(topics.PASSAGE_PLAN)]
        for status in inbox.drain(topics.PLANNER_STATUS):
            self._note(status)

    def _counted_on(self, message: Counted) -> Counted:
        step = message.step + self._steps_before
        return replace(message, step=step) if self._steps_before and abs(step) < _MOST_STEPS else message

    def _warn(self, words: str, stamp_ns: int) -> None:
        """Keep a warning if it is new."""
        warning = without_figures(words)
        if warning not in self.warnings and len(self.warnings) < _MOST_WARNINGS:
            step = self.states[-1].step if self.states else 0
            self.warnings[warning] = Warned((stamp_ns - self.begin_ns) * 1e-9, step, words)

    def _note(self, status: PlannerStatus) -> None:
        self.statuses.append(status)
        if status.gait and _choice(status) not in map(_choice, self.choices[-1:]):
            self.choices.append(status)
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


def _choice(status: PlannerStatus) -> tuple[str, str]:
    """Return the chosen gait and the kind of ground, without the numbers that decided."""
    return status.gait, status.gait_reason.partition(":")[0]


def _sharing(message: Kept, before: Sequence[Kept], unused: frozenset[str]) -> Kept:
    """Return a message that shares equal arrays with the last one, and unused arrays in any case; this saves memory."""
    if not before:
        return message
    kept = object.__new__(type(message))  # without the checks of its constructor: it has the same values
    for name, base, _ in schema(type(message)):
        value, old = getattr(message, name), getattr(before[-1], name)
        if base is np.ndarray and (name in unused or value.tobytes() == old.tobytes()):
            value = old
        object.__setattr__(kept, name, value)
    return kept


def _goes_on(path: Array, known: Array) -> bool:
    """Return whether a path (k, 2) is the rest of a known one."""
    rest = path[1:]
    return len(rest) < len(known) and np.array_equal(rest, known[len(known) - len(rest) :])
