"""Limits of a robot, and the values that a profile has to meet."""

from dataclasses import dataclass

MIN_MINUTES = 20.0  # [min] of walking that the servos must bear, about what a battery lasts
MAX_SPEED_SHARE = 0.9  # [1] of the no-load speed: faster joints are late


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
