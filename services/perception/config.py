"""Settings of perception."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Settings:
    """How the pose is found and what of a frame is passed on."""

    method: Literal["projective", "kiss-icp"] = "projective"  # kiss-icp suits wide-field scanners
    blocks_across: int = 160  # to which a row of the picture is reduced for registration; clutter wants more
    scan_rate_hz: float = 15.0  # of the frames that are registered and passed on as scans, at most
    scan_resolution: float = 0.01  # [m] of the cells that a scan has a point of: the map's
    scan_range: float = 1.5  # [m] horizontally from the camera
    scan_points: int = 14_000  # at most: 60 kB of the roughest ground
    # How far leg odometry is believed, as one sigma of the motion between two frames. Wide figures cost nothing where the
    # scene shows nothing, since there the prior stands whatever its weight; where it shows something, slips are caught.
    odometry_drift: float = 0.10  # [1] of the way travelled
    odometry_turn: float = 0.10  # [1] of the heading turned
    odometry_floor: float = 0.001  # [m] and [rad] of x, y and yaw: feet slip without notice
    odometry_level: float = (
        0.01  # [m] and [rad] of height, roll and pitch, in which the legs bend and any floor shows the truth
    )
    settle_s: float = 0.4  # [s] for which the robot must stand still before {world} is laid
    tilt_s: float = 3.0  # [s] over which the tilt of the legs' frame is averaged

    def __post_init__(self) -> None:
        if self.scan_rate_hz <= 0:
            raise ValueError(f"a positive scan_rate_hz expected, found {self.scan_rate_hz}")
        if not 0.005 <= self.scan_resolution <= 1.0:
            raise ValueError(f"a scan_resolution of 0.005 to 1 m expected, found {self.scan_resolution}")
