"""Moving obstacles of a scenario: boxes and the legs of people, each on a path."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from sextant.shared.files import config

_MAX_CORNERS = 64
_MAX_SPEED_M_S = 5.0
_MAX_SIZE_M = 3.0
_MAX_TIME_S = 86_400.0
_MAX_DISTANCE_M = 50.0  # of a corner of a path, along either axis

_CHECKS = (
    *config.each("start_s period_s start_spread_s", lambda t: 0 <= t <= _MAX_TIME_S, f"0 to {_MAX_TIME_S:g} s"),
    *config.each("speed", lambda speed: 0 < speed <= _MAX_SPEED_M_S, f"more than 0 and at most {_MAX_SPEED_M_S:g} m/s"),
    config.together("path", lambda path: 2 <= len(path) <= _MAX_CORNERS, f"2 to {_MAX_CORNERS} corners"),
    config.together(
        "path", lambda path: all(abs(v) <= _MAX_DISTANCE_M for p in path for v in p), f"corners within {_MAX_DISTANCE_M:g} m"
    ),
    config.together(
        "path",
        lambda path: all(a != b for a, b in pairwise(path)),
        "corners of which no two neighbours coincide",
    ),
)


@dataclass(frozen=True, slots=True)
class BoxMover:
    """Upright box that moves on the ground, with its length along its path."""

    path: tuple[tuple[float, float], ...]  # [m] corners of the path, in `frame`
    speed: float  # [m/s] along the path
    size: tuple[float, float, float]  # [m] length, width, height
    kind: Literal["box"] = "box"
    # Frame of the path: {world}, or the robot's frame (x ahead, y left) at the time at which the box starts.
    frame: Literal["world", "robot"] = "world"
    start_s: float = 0.0  # [s] simulated start time; the box exists only while it moves
    period_s: float = 0.0  # [s] between repeated starts; 0 for a single start
    start_spread_s: float = 0.0  # [s] maximum random delay, added to start_s

    lengths = "path speed size"
    checks = (*_CHECKS, *config.each("size", lambda v: 0 < v <= _MAX_SIZE_M, f"more than 0 and at most {_MAX_SIZE_M:g} m"))

    def __post_init__(self) -> None:
        config.verify(self)


@dataclass(frozen=True, slots=True)
class LegsMover:
    """Legs of a walking person: two cylinders that stand and swing alternately."""

    path: tuple[tuple[float, float], ...]  # [m] corners of the path, in `frame`
    speed: float = 1.0  # [m/s] along the path
    kind: Literal["legs"] = "legs"
    frame: Literal["world", "robot"] = "world"  # as that of a box
    start_s: float = 0.0  # [s] as that of a box
    period_s: float = 0.0  # [s] as that of a box
    start_spread_s: float = 0.0  # [s] as that of a box
    radius: float = 0.06  # [m] of a leg
    height: float = 0.85  # [m] of the hips
    stride: float = 0.6  # [m] distance between consecutive footfalls
    hips: float = 0.2  # [m] between the legs
    lift: float = 0.08  # [m] of a swinging foot

    lengths = "path speed radius height stride hips lift"
    checks = (
        *_CHECKS,
        *config.each("radius height stride hips", lambda v: 0 < v <= _MAX_SIZE_M, f"more than 0 and at most {_MAX_SIZE_M:g} m"),
        *config.each("lift", lambda v: 0 <= v <= _MAX_SIZE_M, f"0 to {_MAX_SIZE_M:g} m"),
        config.together(
            "height radius lift", lambda h, r, lift: h > 2.0 * r + lift, "a height of more than two radii and the lift"
        ),
    )

    def __post_init__(self) -> None:
        config.verify(self)


Mover = BoxMover | LegsMover
