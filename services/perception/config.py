"""Settings of perception."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Settings:
    """How the pose is found and what of a frame is passed on."""

    method: Literal["projective", "kiss-icp"] = "projective"  # kiss-icp suits wide-field scanners
    scan_rate_hz: float = 15.0  # of the scans that are passed on, at most
    scan_range: float = 1.5  # [m] horizontally from the camera
    scan_points: int = 6000  # at most: 60 kB
    # How far leg odometry is believed, as one sigma of the motion between two frames.
    odometry_drift: float = 0.04  # [1] of the way travelled
    odometry_turn: float = 0.05  # [1] of the heading turned
    odometry_floor: float = 0.0002  # [m] and [rad] of x, y and yaw at a standstill
    odometry_level: float = 0.003  # [m] and [rad] of height, roll and pitch, in which the legs bend

    def __post_init__(self) -> None:
        if self.scan_rate_hz <= 0:
            raise ValueError(f"a positive scan_rate_hz expected, found {self.scan_rate_hz}")
