"""Evaluate a robot's reaction to a radio outage, from its actuator states.

This module is pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.net_testbed.listener import Heard
from sextant.services.actuator.config import Settings

HOLD_S = 0.25  # [s] within which the feet must be set down during an outage
BACK_S = 2.0  # [s] within which the robot must walk again after the outage
_WORD_S = 0.02  # [s] possible delay between an event and the actuator state that reports it
OLDEST_S = Settings().plan_age_s + _WORD_S  # maximum observed age of a plan when it is accepted


@dataclass(frozen=True, slots=True)
class Cut:
    """One outage and its effects.

    Times are in [s], or None for events that did not happen or were not required.
    """

    at_ns: int
    lasted_s: float
    held_s: float | None  # after the start: it no longer walked on plans
    rested_s: float | None  # after the start: all feet were on the ground
    back_s: float | None  # after the end: it accepted a plan and walked
    oldest_s: float  # age of the oldest plan accepted since the start

    @property
    def must_hold(self) -> bool:
        """Whether the outage was long enough that the robot had to hold."""
        return self.lasted_s > HOLD_S

    @property
    def problems(self) -> tuple[str, ...]:
        """Violated requirements as text."""
        found: list[str] = []
        if self.must_hold and (self.held_s is None or self.held_s > HOLD_S):
            found.append(f"held after {_s(self.held_s)}")
        if self.back_s is None or self.back_s > BACK_S:
            found.append(f"walked again after {_s(self.back_s)}")
        if self.oldest_s > OLDEST_S:
            found.append(f"accepted a plan {self.oldest_s:.2f} s old")
        return tuple(found)


def judge(at_ns: int, mended_ns: int, heard: Sequence[Heard]) -> Cut:
    """Evaluate one outage.

    Args:
        at_ns: Start of the outage.
        mended_ns: End of the outage.
        heard: The actuator states, in order, from before the outage until the robot walks again.
    """
    before = [h for h in heard if h.at_ns <= at_ns]
    after = [h for h in heard if h.at_ns > at_ns]
    walked = bool(before) and before[-1].walks
    held = at_ns if not walked else next((h.at_ns for h in after if not h.walks), None)
    rested = at_ns if before and before[-1].mode == "hold" else next((h.at_ns for h in after if h.mode == "hold"), None)
    taken = [h for a, h in zip([*before[-1:], *after], after, strict=False) if h.plan_ns not in (a.plan_ns, -1)]
    back: int | None = mended_ns  # if it never stopped
    if held is not None:
        back = next((h.at_ns for h in taken if h.at_ns > max(mended_ns, held) and h.walks), None)
    return Cut(
        at_ns=at_ns,
        lasted_s=(mended_ns - at_ns) * 1e-9,
        held_s=_since(held, at_ns),
        rested_s=_since(rested, at_ns),
        back_s=_since(back, mended_ns),
        oldest_s=max(((h.at_ns - h.plan_ns) * 1e-9 for h in taken), default=0.0),
    )


def _since(then_ns: int | None, ns: int) -> float | None:
    return None if then_ns is None else (then_ns - ns) * 1e-9


def _s(seconds: float | None) -> str:
    return "never" if seconds is None else f"{seconds:.2f} s"
