"""Settings of perception."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Settings:
    """How the pose is found and what of a frame is passed on."""

    method: Literal["projective", "kiss-icp"] = "projective"  # kiss-icp suits wide-field scanners
    blocks_across: int = 160  # to which a row of the picture is reduced for registration; clutter wants more
    legs: bool = True  # whether legs tell the motion; without them a frame that is doubted is searched for at once, and widely
    registration_range: float = 2.5  # [m] of depth beyond which surfaces say nothing of the pose: a camera bends what is far
    scan_rate_hz: float = 15.0  # of the frames that are registered and passed on as scans, at most
    scan_resolution: float = 0.01  # [m] of the cells that a scan has a point of: the map's
    scan_range: float = 1.5  # [m] horizontally from the camera
    scan_ceiling: float = 0.5  # [m] above the camera; what is higher is no ground
    scan_points: int = 14_000  # at most: 60 kB of the roughest ground
    # How far leg odometry is believed, as one sigma of the motion between two frames. Wide figures cost nothing where the
    # scene shows nothing, since there the prior stands whatever its weight; where it shows something, slips are caught.
    odometry_drift: float = 0.10  # [1] of the way travelled
    odometry_turn: float = 0.10  # [1] of the heading turned
    odometry_floor: float = 0.001  # [m] and [rad] of x, y and yaw: feet slip without notice
    odometry_level: float = 0.01  # [m] and [rad] of height, roll and pitch: legs bend, and any floor shows the truth
    # Added to these where the odometry is not reliable: few legs carry, or a camera without legs has just begun to move.
    unreliable_way: float = 0.01  # [m] of x and y
    unreliable_turn: float = 0.02  # [rad] of yaw
    unreliable_level: float = 0.01  # [m] and [rad] of height, roll and pitch
    settle_s: float = 0.4  # [s] for which the robot must stand still before {world} is laid
    tilt_s: float = 3.0  # [s] over which the tilt of the legs' frame is averaged

    def frames_per_scan(self, rate_hz: float) -> int:
        """Of how many frames of a camera of some rate one is used."""
        return max(1, round(rate_hz / self.scan_rate_hz))

    def __post_init__(self) -> None:
        within = {
            "blocks_across": (8, 1280),
            "registration_range": (0.1, 30.0),
            "scan_rate_hz": (0.1, 1000.0),
            "scan_resolution": (0.005, 1.0),
            "scan_range": (self.scan_resolution, 30.0),
            "scan_ceiling": (0.0, 30.0),
            "scan_points": (1, 16_000),  # which a message of perception/scan has room for
            "odometry_drift": (0.0, 10.0),
            "odometry_turn": (0.0, 10.0),
            "odometry_floor": (1e-6, 1.0),
            "odometry_level": (1e-6, 1.0),
            "unreliable_way": (0.0, 1.0),
            "unreliable_turn": (0.0, 1.0),
            "unreliable_level": (0.0, 1.0),
            "settle_s": (0.0, 1.5),
            "tilt_s": (1e-6, 1000.0),
        }
        for name, (low, high) in within.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} from {low:g} to {high:g} expected, found {getattr(self, name)}")
