"""Fault injection into the planner's messages.

The planner becomes silent, repeats itself, or its plans are fuzzed.
"""

import copy
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from sextant.shared.geometry import rotation_from_rpy
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Retriggered, Service
from sextant.shared.wire.messages import Message, PlannerStatus, StepPlan

PLANS_PER_STEP = 134  # fuzzed plans per step; with 25 steps a second: 3350 per second, a million in 300 s
_REPEATED = 8  # number of plans that are repeated


class PlannerFaultInjector:
    """Manipulates the planner's messages, across restarts of the planner."""

    def __init__(self, rng: np.random.Generator):
        """Start without manipulation."""
        self.how = ""  # "mute", "repeating", "fuzzed", or empty for none
        self.fuzzed = 0  # number of fuzzed plans so far
        self.stamps: set[int] = set()  # [ns] stamps of fuzzed plans that differ from the original's
        self._rng = rng
        self._plans: deque[StepPlan] = deque(maxlen=_REPEATED)
        self._status: PlannerStatus | None = None
        self._said = 0

    def around(self, planner: Service) -> Service:
        """Wrap a planner so that its messages are manipulated."""
        return _Meddled(planner, self)

    def speak(self, now_ns: int, step: Callable[[], Iterator[Message]]) -> Iterator[Message]:
        """Yield the messages of one step.

        Args:
            now_ns: [ns] time.
            step: The planner's own step; not called while muted or repeating.
        """
        if self.how in ("mute", "repeating"):
            if self._status is not None:
                yield replace(self._status, stamp_ns=now_ns)
            if self.how == "repeating" and self._plans:
                self._said += 1
                yield self._plans[self._said % len(self._plans)]
            return
        for message in step():
            if isinstance(message, StepPlan):
                self._plans.append(message)
            elif isinstance(message, PlannerStatus):
                self._status = message
            yield message
        if self.how == "fuzzed" and self._plans:
            for _ in range(PLANS_PER_STEP):
                self.fuzzed += 1
                plan = self._plans[self._rng.integers(len(self._plans))]
                wrong = fuzzed(plan, now_ns, self._rng)
                if wrong.stamp_ns != plan.stamp_ns:
                    self.stamps.add(wrong.stamp_ns)
                yield wrong


class _Meddled:
    """Planner with manipulated messages."""

    def __init__(self, planner: Service, meddler: PlannerFaultInjector):
        self._planner, self._meddler = planner, meddler
        self.name, self.stages = planner.name, planner.stages
        assert isinstance(planner, Retriggered)
        self.retrigger = planner.retrigger

    @property
    def trigger(self) -> AnyTopic | Every:
        return self._planner.trigger

    @property
    def subscribes(self) -> tuple[AnyTopic, ...]:
        return self._planner.subscribes

    @property
    def publishes(self) -> tuple[AnyTopic, ...]:
        return self._planner.publishes

    def step(self, message: Any, inbox: Inbox) -> Iterator[Message]:
        """Yield the manipulated messages of a step; `message` is the actuator's state."""
        yield from self._meddler.speak(message.stamp_ns, lambda: iter(self._planner.step(message, inbox)))

    def status(self) -> str:
        return self._planner.status()


def fuzzed(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    """Return a plan with one to three errors.

    Values are NaN, infinite, out of range, old, early or of another step; a plan may also stay as it is.
    """
    # Non-finite values come last, because other errors compute with the values.
    for kind in sorted(rng.choice(len(_WRONGS), size=rng.integers(1, 4)).tolist(), reverse=True):
        plan = _WRONGS[kind](plan, now_ns, rng)
    return plan


def _unchecked(plan: StepPlan, **values: Any) -> StepPlan:
    """Return a plan without validation of its values."""
    made = copy.copy(plan)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


_ARRAYS = ("touchdown", "clearance", "T_world_odom", "body_goal")


def _not_finite(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    name = _ARRAYS[rng.integers(len(_ARRAYS))]
    array = getattr(plan, name).copy()
    array.flat[rng.integers(array.size)] = (np.nan, np.inf, -np.inf)[rng.integers(3)]
    return _unchecked(plan, **{name: array})


def _out_of_range(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    name = _ARRAYS[rng.integers(len(_ARRAYS))]
    array = getattr(plan, name).copy()
    array.flat[rng.integers(array.size)] += rng.normal() * 10.0 ** rng.uniform(-3.0, 6.0)
    return _unchecked(plan, **{name: array})


def _moved(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    """Move touchdowns and body by distances that may still be reachable."""
    sigma = 10.0 ** rng.uniform(-3.0, -0.5)
    goal = plan.body_goal.copy()
    goal[:3, 3] += rng.normal(size=3) * sigma
    goal[:3, :3] = goal[:3, :3] @ rotation_from_rpy(rng.normal(size=3) * sigma)
    return _unchecked(plan, touchdown=plan.touchdown + rng.normal(size=(6, 3)) * sigma, body_goal=goal)


def _hurried(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    return _unchecked(plan, duration=float((0.0, -1.0, 1e-9, 1e9, np.nan, np.inf, rng.uniform(0.2, 5.0))[rng.integers(7)]))


def _at_another_time(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    return _unchecked(plan, stamp_ns=now_ns + round(rng.normal() * 10.0 ** rng.uniform(6.0, 12.0)))


def _present(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    """Set a stamp so new that the guard validates the rest of the plan."""
    return _unchecked(plan, stamp_ns=now_ns + int(rng.integers(0, 1_000_000)))


def _of_another_step(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    return _unchecked(plan, step=plan.step + int(rng.integers(-3, 4)), revision=int(rng.integers(0, 1 << 40)))


def _of_another_epoch(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    return _unchecked(plan, epoch=plan.epoch + int(rng.integers(-2, 3)))


def _other_legs(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    return _unchecked(plan, swing=rng.random(6) < 0.5)


def _repeated(plan: StepPlan, now_ns: int, rng: np.random.Generator) -> StepPlan:
    return plan


_WRONGS: tuple[Callable[[StepPlan, int, np.random.Generator], StepPlan], ...] = (
    *(_not_finite, _out_of_range, _moved, _moved, _hurried, _at_another_time),
    *(_present, _present, _present, _of_another_step, _of_another_epoch, _other_legs, _repeated),
)
