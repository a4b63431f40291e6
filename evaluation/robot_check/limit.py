"""One property of a robot, and the value that limits it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Limit:
    """One property of the robot and the value that limits it."""

    name: str
    value: float
    needed: float | None  # the least or largest acceptable value; None: any
    unit: str
    is_met: bool
    sentence: str  # what limits it, and what to change


def in_cm(length: float) -> str:
    """Return a length [m] as text."""
    return f"{100 * length:.1f} cm"
