"""Settings of perception."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Settings:
    """Parameters of the registration and of the scans."""

    method: Literal["projective", "kiss-icp"] = "projective"  # kiss-icp suits wide-field scanners
    blocks_across: int = 160  # blocks per image row for registration; cluttered scenes need more
    legs: bool = True  # whether leg odometry is available; without it a doubtful frame starts a wide search at once
    registration_range: float = 2.5  # [m] maximum depth of surfaces for registration, because a camera distorts distant ones
    scan_rate_hz: float = 15.0  # maximum rate of frames that are registered and published as scans
    scan_resolution: float = 0.01  # [m] cell edge of scans, equal to the map's
    scan_range: float = 1.5  # [m] maximum horizontal distance from the camera
    scan_ceiling: float = 0.5  # [m] above the camera; higher points are not ground
    scan_points: int = 14_000  # maximum number of points: 60 kB on the roughest ground
    # One sigma of leg odometry between two frames. Large values do no harm: directions that the scene does not constrain follow
    # the prior at any weight, and in the others registration detects slip.
    odometry_drift: float = 0.10  # [1] of the distance travelled
    odometry_turn: float = 0.10  # [1] of the heading turned
    odometry_floor: float = 0.001  # [m] and [rad] of x, y and yaw: undetected slip
    odometry_level: float = 0.01  # [m] and [rad] of height, roll and pitch: legs bend, and any floor constrains these
    # Added if odometry is unreliable: too few legs carry load, or a camera without legs starts to move.
    unreliable_way: float = 0.01  # [m] of x and y
    unreliable_turn: float = 0.02  # [rad] of yaw
    unreliable_level: float = 0.01  # [m] and [rad] of height, roll and pitch
    settle_s: float = 0.4  # [s] for which the robot must stand still before {world} is defined
    tilt_s: float = 3.0  # [s] time constant for averaging the tilt of {odom}

    def frames_per_scan(self, rate_hz: float) -> int:
        """Return how many frames of a camera there are per registered frame."""
        return max(1, round(rate_hz / self.scan_rate_hz))

    def __post_init__(self) -> None:
        within = {
            "blocks_across": (8, 1280),
            "registration_range": (0.1, 30.0),
            "scan_rate_hz": (0.1, 1000.0),
            "scan_resolution": (0.005, 1.0),
            "scan_range": (self.scan_resolution, 30.0),
            "scan_ceiling": (0.0, 30.0),
            "scan_points": (1, 16_000),  # limit of a perception/scan message
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
