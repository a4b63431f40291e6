"""Settings of perception."""

from dataclasses import dataclass, field
from typing import Literal

from sextant.services.perception.reduction.params import ReductionParams
from sextant.services.perception.registration.params import (
    AcceptanceParams,
    AlignmentParams,
    ExternalPoseParams,
    KeyframeParams,
    TextureParams,
)
from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True, kw_only=True)
class PerceptionParams(Params):
    """Parameters of perception; alignment, keyframes and acceptance are those of the projective registration."""

    blocks_across: int = ranged(160, 16, 1280)  # blocks per image row for registration; cluttered scenes need more
    registration_range: float = ranged(2.5, 0.6, 30.0)  # [m] maximum depth for registration: a camera distorts distant surfaces
    scan_rate_hz: float = ranged(15.0, 0.1, 1000.0)  # [Hz] maximum rate of frames that are registered and published as scans
    scan_ceiling: float = ranged(0.5, 0.0, 30.0)  # [m] above the camera; higher points are not ground
    # One sigma of leg odometry between two frames. Large values do no harm: directions that the scene does not constrain follow
    # the prior at any weight, and in the others registration detects slip.
    odometry_drift: float = ranged(0.10, 0.0, 10.0)  # [1] of the distance travelled
    odometry_turn: float = ranged(0.10, 0.0, 10.0)  # [1] of the heading turned
    odometry_floor: float = ranged(0.001, 1e-6, 1.0)  # [m] and [rad] of x, y and yaw: undetected slip
    odometry_level: float = ranged(0.01, 1e-6, 1.0)  # [m] and [rad] of height, roll and pitch: legs bend
    # Added if odometry is unreliable: too few legs carry load, or a camera without legs starts to move.
    unreliable_way: float = ranged(0.01, 0.0, 1.0)  # [m] of x and y
    unreliable_turn: float = ranged(0.02, 0.0, 1.0)  # [rad] of yaw
    unreliable_level: float = ranged(0.01, 0.0, 1.0)  # [m] and [rad] of height, roll and pitch
    settle_s: float = ranged(0.4, 0.0, 1.5)  # [s] for which the robot must stand still before {world} is defined
    tilt_s: float = ranged(3.0, 1e-6, 1000.0)  # [s] time constant for averaging the tilt of {odom}
    correct_camera: bool = True  # whether tilt and height of the camera are corrected while the robot walks
    reduction: ReductionParams = field(default_factory=ReductionParams)
    alignment: AlignmentParams = field(default_factory=AlignmentParams)
    keyframes: KeyframeParams = field(default_factory=KeyframeParams)
    texture: TextureParams = field(default_factory=TextureParams)
    acceptance: AcceptanceParams = field(default_factory=AcceptanceParams)
    external: ExternalPoseParams = field(default_factory=ExternalPoseParams)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(PerceptionParams):
    """Settings of perception: its parameters, the method, and the scans that the mapper expects."""

    # kiss-icp suits wide-field scanners; external: the pose is that of the topic external/pose, and nothing is registered
    method: Literal["projective", "kiss-icp", "external"] = "projective"
    registration: str = ""  # plug-in that estimates the camera pose, in place of the method
    legs: bool = True  # whether leg odometry is available; without it a doubtful frame starts a wide search at once
    scan_resolution: float = ranged(0.01, 0.005, 1.0)  # [m] cell edge of scans, equal to the map's
    scan_range: float = 1.5  # [m] maximum horizontal distance from the camera
    scan_points: int = ranged(14_000, 1, 16_000)  # maximum number of points: 60 kB on the roughest ground; limit of the message

    checks = (
        config.together(
            "method registration", lambda method, plugin: method != "external" or not plugin, "a plug-in or the method external"
        ),
        config.together("scan_range scan_resolution", lambda most, cell: cell <= most <= 30.0, "scan_resolution to 30 m"),
    )

    def frames_per_scan(self, rate_hz: float) -> int:
        """Return how many frames of a camera there are per registered frame."""
        return max(1, round(rate_hz / self.scan_rate_hz))
