"""Parameters of steps, their revision, and walking by touch."""

from dataclasses import dataclass

from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class StepParams(Params):
    """Choice of a step: body motion, margins of the feet's paths, and the time that a swing takes."""

    handover_s: float = ranged(0.15, 0.0, 2.0)  # [s] of a step in which its feet stand
    max_turn_deg: float = ranged(10.0, 0.0, 45.0)  # [deg] maximum turn of the body while a foot stands
    max_lean_deg: float = ranged(12.0, 0.0, 45.0)  # [deg] maximum lean of the body with the ground
    max_tilt_deg: float = ranged(8.0, 0.0, 45.0)  # [deg] maximum change of the lean in one step
    rough_m: float = ranged(0.008, 0.001, 0.1)  # [m] relief from which ground counts as rough
    path_margin_m: float = ranged(0.015, 0.0, 0.1)  # [m] between a swinging foot and the ground under its path
    sink_margin_m: float = ranged(0.003, 0.0, 0.1)  # [m] between a descending foot, on its lowest path, and obstacles
    leg_margin_m: float = ranged(0.010, 0.0, 0.1)  # [m] between a leg's centre line and the ground next to its feet
    descent_m: float = ranged(0.03, 0.0, 0.1)  # [m] above a foothold, from where the foot descends vertically
    reach_margin_m: float = ranged(0.005, 0.0, 0.05)  # [m] by which a standing foot may be lower than estimated
    wide_search_ratio: float = ranged(1.5, 1.0, 3.0)  # [1] factor of the foothold search radius if the usual one finds no step
    room_enough: float = ranged(1.75, 1.0, 2.0)  # [1] suitability of the poorest foothold, from which a step is not shortened
    height_cost: float = ranged(2.0, 0.0, 10.0)  # [1] time for height relative to ground distance; the body covers half of that
    rough_height_cost: float = ranged(2.5, 0.0, 10.0)  # [1] the same where a foot goes higher than commanded
    gathered_m: float = ranged(0.02, 0.0, 0.5)  # [m] minimum approach of all feet to their rest in a step on the spot
    max_joint_speed: float = ranged(0.75, 0.1, 1.0)  # [1] of the no-load speed: over a fifth of a swing, with `auto_speed`
    shift_s: float = ranged(1.0, 0.2, 10.0)  # [s] duration of a shift of the body that makes room for a leg


@dataclass(frozen=True, slots=True)
class GaitChoiceParams(Params):
    """Choice of gait and speed by the ground, the pose, recent failures and the servos' load, where the request is `auto`."""

    ahead_m: float = ranged(0.60, 0.1, 2.0)  # [m] length of the ground that counts, from the robot's centre on
    half_width_m: float = ranged(0.26, 0.05, 1.0)  # [m] half width of that ground
    even_step_m: float = ranged(0.006, 0.0, 0.1)  # [m] largest height difference within 2 cm on even ground
    even_carrying: float = ranged(0.95, 0.0, 1.0)  # [1] least share of even ground that carries a foot
    even_slope_deg: float = ranged(4.0, 0.0, 45.0)  # [deg] steepest even ground
    firm_carrying: float = ranged(0.15, 0.0, 1.0)  # [1] share of the ground that carries a foot, below which it is doubtful
    firm_slope_deg: float = ranged(12.0, 0.0, 45.0)  # [deg] from where ground is doubtful
    even_unseen: float = ranged(0.10, 0.0, 1.0)  # [1] largest unseen share of even ground
    firm_unseen: float = ranged(0.35, 0.0, 1.0)  # [1] unseen share, above which the ground is doubtful
    memory_s: float = ranged(10.0, 0.0, 600.0)  # [s] for which a failure counts
    event_s: float = ranged(1.0, 0.0, 60.0)  # [s] in which equal failures count once
    doubtful_failures: int = ranged(1, 1, 100)  # failures from which ground is doubtful
    difficult_failures: int = ranged(3, 1, 100)  # failures from which ground is difficult
    calm_s: float = ranged(2.0, 0.0, 60.0)  # [s] after which ground that has become better counts as better
    even_lift_m: float = ranged(0.015, 0.005, 0.1)  # [m] largest clearance of a swing over even ground
    max_duty: float = ranged(0.32, 0.05, 1.0)  # [1] largest predicted root mean square torque, of the stall torque
    max_measured_duty: float = ranged(0.33, 0.05, 1.0)  # [1] the same of the measured torque, above which the robot slows
    heat_horizon_s: float = ranged(600.0, 10.0, 1e5)  # [s] in which no servo may come near its temperature limit
    heat_reserve_k: float = ranged(1.0, 0.0, 30.0)  # [K] below the temperature from which the actuator walks slower


@dataclass(frozen=True, slots=True)
class RevisionParams(Params):
    """When steps are planned and revised, and how old their inputs may be."""

    plan_from_phase: float = ranged(0.55, 0.0, 0.95)  # [1] phase of a step from which the next step is planned
    retarget_until_phase: float = ranged(0.45, 0.0, 0.95)  # [1] phase of a step until which its touchdowns may move
    retarget_from_m: float = ranged(0.004, 0.0, 0.1)  # [m] minimum change of a touchdown for a revision
    interval_s: float = ranged(0.20, 0.01, 5.0)  # [s] between plans of the next step by the same map
    pose_age_s: float = ranged(0.4, 0.01, 5.0)  # [s] maximum age of a pose; leg odometry bridges the time between two poses
    map_age_s: float = ranged(0.8, 0.01, 10.0)  # [s] maximum age of the terrain map

    checks = (
        config.together(
            "retarget_until_phase plan_from_phase", lambda until, begin: until < begin, "less than plan_from_phase"
        ),
    )


@dataclass(frozen=True, slots=True)
class BlindWalkingParams(Params):
    """Walking by touch alone: the ground is assumed to be the plane of the feet."""

    step_s: float = ranged(1.6, 0.8, 2.0)  # [s] duration of a step
    stride_m: float = ranged(0.05, 0.005, 0.2)  # [m] maximum body travel of a step
    width_ratio: float = ranged(1.2, 0.5, 2.0)  # [1] factor of the distance from coxa to foot: folded legs sense poorly
    lift_m: float = ranged(0.07, 0.01, 0.2)  # [m] minimum clearance of a step
    slope_share: float = ranged(0.3, 0.0, 1.0)  # [1] share by which the body follows the newest feet's slope in each step
    seen_length_m: float = ranged(0.35, 0.02, 2.0)  # [m] length of the ground ahead that must be seen, from an unseen start
    seen_half_width_m: float = ranged(0.15, 0.0, 1.0)  # [m] half width of that ground
    seen_share: float = ranged(0.4, 0.0, 1.0)  # [1] share of it that must be seen
    level_m: float = ranged(0.10, 0.0, 1.0)  # [m] maximum difference between its median height and the plane of the feet
