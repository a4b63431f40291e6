"""What moves over a course, as a scenario states it: boxes and the legs of people, each on a path."""

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
    """A box that moves along a path on the ground, upright, its length along the path."""

    path: tuple[tuple[float, float], ...]  # [m] corners of its way, in `frame`
    speed: float  # [m/s]
    size: tuple[float, float, float]  # [m] length, width, height
    kind: Literal["box"] = "box"
    # Of the path: {world}, or that of the robot, x ahead and y left, as it stands when the box sets off.
    frame: Literal["world", "robot"] = "world"
    start_s: float = 0.0  # [s] simulated, when it sets off; before, and once it has come to its end, it is not there
    period_s: float = 0.0  # [s] after which it sets off once more, again and again; 0 for once
    start_spread_s: float = 0.0  # [s] at most this much, drawn by the seed, is added to start_s

    checks = (*_CHECKS, *config.each("size", lambda v: 0 < v <= _MAX_SIZE_M, f"more than 0 and at most {_MAX_SIZE_M:g} m"))

    def __post_init__(self) -> None:
        config.verify(self)


@dataclass(frozen=True, slots=True)
class LegsMover:
    """The legs of a person who walks along a path: a pair of cylinders, one of which stands while the other swings."""

    path: tuple[tuple[float, float], ...]  # [m] corners of the way, in `frame`
    speed: float = 1.0  # [m/s]
    kind: Literal["legs"] = "legs"
    frame: Literal["world", "robot"] = "world"  # as of a box
    start_s: float = 0.0  # [s] as of a box
    period_s: float = 0.0  # [s] as of a box
    start_spread_s: float = 0.0  # [s] as of a box
    radius: float = 0.06  # [m] of a leg
    height: float = 0.85  # [m] of the hips
    stride: float = 0.6  # [m] from one footfall to the next
    hips: float = 0.2  # [m] between the legs
    lift: float = 0.08  # [m] of a swinging foot

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
