"""Settings of the planner."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar, Literal

from sextant.services.planner.gap_crossing.params import GapApproachParams, GapDetectionParams
from sextant.services.planner.locomotion.params import BlindWalkingParams, GaitChoiceParams, RevisionParams, StepParams
from sextant.services.planner.navigation.params import CostmapParams, PathFollowerParams, StallParams
from sextant.services.planner.params import FootholdParams
from sextant.services.planner.roadmap.params import GapCrossingParams
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannerParams(Params):
    """Parameters of the planner."""

    foothold: FootholdParams = field(default_factory=FootholdParams)
    step: StepParams = field(default_factory=StepParams)
    gait_choice: GaitChoiceParams = field(default_factory=GaitChoiceParams)
    revision: RevisionParams = field(default_factory=RevisionParams)
    blind_walking: BlindWalkingParams = field(default_factory=BlindWalkingParams)
    costmap: CostmapParams = field(default_factory=CostmapParams)
    path_follower: PathFollowerParams = field(default_factory=PathFollowerParams)
    stall: StallParams = field(default_factory=StallParams)
    gap_detection: GapDetectionParams = field(default_factory=GapDetectionParams)
    gap_approach: GapApproachParams = field(default_factory=GapApproachParams)
    gap_crossing: GapCrossingParams = field(default_factory=GapCrossingParams)

    renamed: ClassVar[Mapping[str, str]] = MappingProxyType(  # settings of version 0.1
        {
            "handover_s": "step.handover_s",
            "max_turn_deg": "step.max_turn_deg",
            "max_lean_deg": "step.max_lean_deg",
            "max_tilt_deg": "step.max_tilt_deg",
            "uneven": "step.rough_m",
            "path_margin": "step.path_margin_m",
            "sink_margin": "step.sink_margin_m",
            "leg_margin": "step.leg_margin_m",
            "touch_step_s": "blind_walking.step_s",
            "touch_stride": "blind_walking.stride_m",
            "touch_width": "blind_walking.width_ratio",
            "touch_lift": "blind_walking.lift_m",
            "plan_from": "revision.plan_from_phase",
            "retarget_until": "revision.retarget_until_phase",
            "retarget_from_m": "revision.retarget_from_m",
            "pose_age_s": "revision.pose_age_s",
            "map_age_s": "revision.map_age_s",
            "revise_s": "revision.interval_s",
        }
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(PlannerParams):
    """Settings of the planner: its parameters, and what a run chooses."""

    blind: bool = False  # blind baseline: no map is read, the ground is the plane of the standing feet
    footholds: Literal["score", "evaluation"] = "score"  # map layer for footholds: Lotriet's or Masri's
    step_planner: str = ""  # plug-in that plans steps by sight; empty for Sextant's own
