"""What a robot does when the radio is cut and comes back, from what its actuator said. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

from sextant.deploy.bed.ear import Heard
from sextant.services.actuator.config import Settings

HOLD_S = 0.25  # within which feet are set down where nothing comes any more
BACK_S = 2.0  # within which it walks again once the radio is back
_WORD_S = 0.02  # that a word of the actuator's may come after what it tells of
OLDEST_S = Settings().plan_age_s + _WORD_S  # that a plan may be seen to be when it is taken


@dataclass(frozen=True, slots=True)
class Cut:
    """One cut, and what came of it; times [s], None where something did not happen or need not have."""

    at_ns: int
    lasted_s: float
    held_s: float | None  # after the cut: it no longer did as planned
    rested_s: float | None  # after the cut: all feet were on the ground
    back_s: float | None  # after the radio was back: it took a plan and walked
    oldest_s: float  # age of the oldest plan that it took from the cut on

    @property
    def must_hold(self) -> bool:
        """Whether it lasted so long that it had to hold."""
        return self.lasted_s > HOLD_S

    @property
    def problems(self) -> tuple[str, ...]:
        """What was not as it must be, in words."""
        found: list[str] = []
        if self.must_hold and (self.held_s is None or self.held_s > HOLD_S):
            found.append(f"held after {_s(self.held_s)}")
        if self.back_s is None or self.back_s > BACK_S:
            found.append(f"walked again after {_s(self.back_s)}")
        if self.oldest_s > OLDEST_S:
            found.append(f"took a plan of {self.oldest_s:.2f} s")
        return tuple(found)


def judge(at_ns: int, mended_ns: int, heard: Sequence[Heard]) -> Cut:
    """What came of one cut.

    Args:
        at_ns: When nothing came through any more.
        mended_ns: When it did again.
        heard: What the actuator said, from before the cut until it walked again, in order.
    """
    before = [h for h in heard if h.at_ns <= at_ns]
    after = [h for h in heard if h.at_ns > at_ns]
    walked = bool(before) and before[-1].walks
    held = at_ns if not walked else next((h.at_ns for h in after if not h.walks), None)
    rested = at_ns if before and before[-1].mode == "hold" else next((h.at_ns for h in after if h.mode == "hold"), None)
    taken = [h for a, h in zip([*before[-1:], *after], after, strict=False) if h.plan_ns not in (a.plan_ns, -1)]
    back: int | None = mended_ns  # where it never stopped
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
