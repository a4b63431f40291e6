"""Settings of the planner."""

from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True, slots=True)
class Settings:
    """How the robot steps; defaults walk."""

    blind: bool = False  # the baseline: no map is read, the ground is taken for the plane of the standing feet
    footholds: Literal["score", "evaluation"] = "score"  # the map's layer to walk on: Lotriet's or Masri's
    handover_s: float = 0.15  # [s] of a step in which its feet stand
    max_turn_deg: float = 10.0  # [deg] of the body while a foot stands
    max_lean_deg: float = 12.0  # [deg] of the body with the ground, and
    max_tilt_deg: float = 8.0  # [deg] by which that changes in one step
    touch_step_s: float = 1.6  # [s] duration of a step by touch alone,
    touch_stride: float = 0.05  # [m] of the body in it, at most,
    touch_width: float = 1.2  # of the distance of its feet from the coxa: folded legs neither rise straight up nor feel much,
    touch_lift: float = 0.07  # [m] and clearance of its feet, at least
    uneven: float = 0.008  # [m] of relief from which it is
    path_margin: float = 0.015  # [m] of a swinging foot over what lies under its way
    sink_margin: float = 0.003  # [m] likewise over what stands before its touchdown, by the lowest way that it may come down
    leg_margin: float = 0.010  # [m] of a leg's middle line over the ground beside its feet
    plan_from: float = 0.55  # phase of a step from which the next one is planned
    retarget_until: float = 0.45  # phase until which touchdowns of the running step may move
    retarget_from_m: float = 0.004  # [m] smaller moves are not worth it
    pose_age_s: float = 0.4  # [s] since an older pose came the planner waits; between two the legs' odometry carries it on
    map_age_s: float = 0.8  # [s] likewise for the map
    revise_s: float = 0.20  # [s] between revisions of a plan

    def __post_init__(self) -> None:
        if not self.retarget_until < self.plan_from:
            raise ValueError(f"retarget_until below plan_from expected, found {self.retarget_until} and {self.plan_from}")
        if not 0.8 <= self.touch_step_s <= 4.0:
            raise ValueError(f"touch_step_s of 0.8 to 4 s expected, found {self.touch_step_s}")
        positive = (
            "pose_age_s",
            "map_age_s",
            "revise_s",
            "touch_stride",
            "touch_width",
            "touch_lift",
        )
        for name in positive:
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"a positive {name} expected, found {getattr(self, name)}")
        for name in (
            "max_turn_deg",
            "max_lean_deg",
            "max_tilt_deg",
            "handover_s",
            "path_margin",
            "sink_margin",
            "leg_margin",
        ):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"a {name} of at least 0 expected, found {getattr(self, name)}")
