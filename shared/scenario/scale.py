"""Courses of another size: every length and speed of a scenario times a factor.

A schema names its lengths and speeds in `lengths`. Durations stay: a robot of that size walks as many leg lengths in a second.
"""

import dataclasses
import re
from typing import Any

from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profile_proposal import REFERENCE_LEG_M

LOWEST, HIGHEST = 0.1, 10.0  # scales that a course can have


def leg_scale(profile: RobotProfile) -> float:
    """Return the length of a robot's femur and tibia, relative to a PhantomX, to two decimals."""
    return round((profile.links.femur + profile.links.tibia) / REFERENCE_LEG_M, 2)


def suffix_of(scale: float) -> str:
    """Return the suffix of a scenario's name that states its scale, such as `+x0.85`; empty for 1."""
    return "" if scale == 1.0 else f"+x{scale:g}"


def scale_of(suffix: str) -> float | None:
    """Return the scale of a suffix without its plus sign, such as `x0.85`; None if it is no scale.

    Raises:
        ConfigError: The scale is too small or too large.
    """
    found = re.fullmatch(r"x(\d{1,9}(?:\.\d{1,9})?)", suffix)
    if found is None:
        return None
    scale = float(found[1])
    if not LOWEST <= scale <= HIGHEST:
        raise ConfigError("scenario", [f"a scale from x{LOWEST:g} to x{HIGHEST:g} expected, found {suffix!r}"])
    return scale


def unscaled_name(scenario: str) -> str:
    """Return the name of a scenario without its scale."""
    return re.sub(r"\+x[\d.]+(?=\+|$)", "", scenario)


def scaled_table(value: object, scale: float) -> Any:
    """Return the plain table of a dataclass, as `config.as_table` does, with its lengths and speeds times a scale."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        lengths = getattr(value, "lengths", "").split()
        pairs = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return {
            name: scaled_table(item, scale) if name not in lengths else _times(item, scale)
            for name, item in pairs
            if item is not None
        }
    if isinstance(value, list | tuple):
        return [scaled_table(item, scale) for item in value]
    if isinstance(value, dict):
        return {key: scaled_table(item, scale) for key, item in value.items()}
    return value


def _times(length: Any, scale: float) -> Any:
    """Return a length, or a list of them, times a scale."""
    return [_times(one, scale) for one in length] if isinstance(length, list | tuple) else length * scale
