"""Decision of the planner: a step to send, or the reason why there is none."""

from dataclasses import dataclass
from typing import Literal

from sextant.services.planner.locomotion.plan_tracking import NumberedStep

State = Literal["waiting", "resting", "stepping", "blocked", "arrived"]


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What the planner does now, with its status."""

    state: State
    reason: str
    blocked_leg: int = -1  # the leg that has no step, -1 for none
    step: NumberedStep | None = None  # the step to send
    retry_s: float = 0.0  # [s] until the next attempt if there is no step; 0: at the next state of the actuator
    invalid_command: bool = False  # blocked because this robot can never execute the command
