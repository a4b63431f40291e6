"""Outcomes of a gap crossing: the next action, or how it ended. `GapCrossing` decides which."""

from dataclasses import dataclass

from sextant.services.planner.locomotion.step_planner import PlannedStep


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


Outcome = NextStep | Wait | Completed | CannotCross
