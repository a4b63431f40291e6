"""Parameters of gap detection and of the approach of a gap."""

from dataclasses import dataclass, replace
from typing import Self

from sextant.services.planner.roadmap.params import BareGroundParams
from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class GapDetectionParams(BareGroundParams):
    """Detection of a gap on the straight line to a goal, and of bare ground in the strip across it."""

    known_share: float = ranged(0.5, 0.0, 1.0)  # [1] share of it that must be known
    wall_share: float = ranged(0.1, 0.0, 1.0)  # [1] share of the band higher than a step of the legs, from which it is a wall
    wall_base_m: float = ranged(0.10, 0.0, 1.0)  # [m] before a wall, where ground at its foot also carries none
    narrow_share: float = ranged(0.95, 0.0, 1.0)  # [1] the same as carrying_share, where there is no other gap
    min_length_m: float = ranged(0.06, 0.01, 1.0)  # [m] minimum length of a gap; narrower ones are stepped over

    def narrow(self) -> Self:
        """Return the parameters by which ground too narrow for a path is bare."""
        return replace(self, carrying_share=max(self.carrying_share, self.narrow_share))


@dataclass(frozen=True, slots=True)
class GapApproachParams(Params):
    """Approach of a gap: where the robot stops, turns, and when it tries again after a refusal."""

    start_distance_m: float = ranged(0.36, 0.1, 2.0)  # [m] from the gap to the body where it stops; feet stay clear in the turn
    start_tolerance_m: float = ranged(0.05, 0.01, 0.5)  # [m] from that place within which the robot has arrived
    aligned_deg: float = ranged(1.5, 0.1, 30.0)  # [deg] heading error below which the crossing begins
    turn_gain: float = ranged(1.0, 0.05, 10.0)  # [1/s] yaw rate per heading error
    turn_rate_rad_s: float = ranged(0.15, 0.01, 2.0)  # [rad/s] maximum yaw rate
    rest_s: float = ranged(0.3, 0.0, 10.0)  # [s] of rest after the last turn
    refusal_s: float = ranged(12.0, 0.1, 600.0)  # [s] lifetime of a refusal; it doubles with each further one at the same place
    turning_s: float = ranged(30.0, 1.0, 600.0)  # [s] maximum duration of the turn
    inclined_deg: float = ranged(15.0, 0.0, 90.0)  # [deg] error below which a robot at the edge crosses in its own direction
    retry_distance_m: float = ranged(0.30, 0.01, 5.0)  # [m] from the place of a refusal, beyond which the robot tries again
