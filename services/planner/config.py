"""Settings of the planner."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sextant.services.planner.navigation.params import CostmapParams, PathFollowerParams
from sextant.shared.files import config
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class PlannerParams(Params):
    """Parameters of the planner."""

    costmap: CostmapParams = field(default_factory=CostmapParams)
    path_follower: PathFollowerParams = field(default_factory=PathFollowerParams)


@dataclass(frozen=True, slots=True)
class Settings(PlannerParams):
    """Settings of stepping; the defaults let the robot walk."""

    blind: bool = False  # blind baseline: no map is read, the ground is the plane of the standing feet
    footholds: Literal["score", "evaluation"] = "score"  # map layer for footholds: Lotriet's or Masri's
    handover_s: float = 0.15  # [s] of a step in which its feet stand
    max_turn_deg: float = 10.0  # [deg] maximum turn of the body while a foot stands
    max_lean_deg: float = 12.0  # [deg] maximum lean of the body with the ground
    max_tilt_deg: float = 8.0  # [deg] maximum change of the lean in one step
    touch_step_s: float = 1.6  # [s] duration of a step by touch alone
    touch_stride: float = 0.05  # [m] maximum body travel of a step by touch
    touch_width: float = 1.2  # factor of the distance from coxa to foot by touch: folded legs rise and sense poorly
    touch_lift: float = 0.07  # [m] minimum clearance of a step by touch
    uneven: float = 0.008  # [m] relief from which ground counts as rough
    path_margin: float = 0.015  # [m] between a swinging foot and the ground under its path
    sink_margin: float = 0.003  # [m] between a descending foot, on its lowest path, and obstacles before its touchdown
    leg_margin: float = 0.010  # [m] between a leg's centre line and the ground next to its feet
    plan_from: float = 0.55  # phase of a step from which the next step is planned
    retarget_until: float = 0.45  # phase of a step until which its touchdowns may move
    retarget_from_m: float = 0.004  # [m] minimum change of a touchdown for a revision
    pose_age_s: float = 0.4  # [s] maximum age of a pose; leg odometry bridges the time between two poses
    map_age_s: float = 0.8  # [s] maximum age of the terrain map
    revise_s: float = 0.20  # [s] between revisions of a plan

    def __post_init__(self) -> None:
        config.verify(self)
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
            "uneven",
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
            "retarget_from_m",
        ):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"a {name} of at least 0 expected, found {getattr(self, name)}")
