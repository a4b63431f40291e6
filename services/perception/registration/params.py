"""Parameters of the registration by projective ICP, and of poses in its place."""

from dataclasses import dataclass

from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class AlignmentParams(Params):
    """Gauss-Newton alignment of a frame with keyframes and the motion prior."""

    gate_near: float = ranged(0.02, 0.001, 0.5)  # [m] limit of the point-to-plane distance of a match after small steps
    gate_far: float = ranged(0.06, 0.001, 0.5)  # [m] the same limit after large steps
    slip: float = ranged(0.01, 0.0, 0.5)  # [m] and [rad] added to the prior's spread for the first expected step
    max_iterations: int = ranged(10, 1, 200)  # maximum number of Gauss-Newton steps
    matched_points: int = ranged(3200, 100, 1_000_000)  # points of a full image that are matched with one keyframe
    converged: float = ranged(1e-4, 1e-8, 0.1)  # [m] and [rad] step that ends the iteration
    unknown_sigma: float = ranged(0.03, 0.0, 1.0)  # [m] and [rad] along the ground; a larger prior sigma tries nearby starts
    less_overlap: float = ranged(0.1, 0.0, 1.0)  # [1] smaller overlap that a better pose may have
    explained: float = ranged(0.85, 0.0, 1.0)  # [1] ratio of misfits below which another pose is better

    checks = (config.together("gate_near gate_far", lambda near, far: near <= far, "at most gate_far"),)


@dataclass(frozen=True, slots=True)
class KeyframeParams(Params):
    """Storage of keyframes."""

    active: int = ranged(4, 1, 32)  # number of keyframes that a frame is matched with
    stored: int = ranged(32, 1, 512)  # number of keyframes kept
    distance: float = ranged(0.12, 0.001, 5.0)  # [m] from the nearest keyframe at which a new one is stored
    angle: float = ranged(0.12, 0.001, 3.0)  # [rad] the same for the rotation

    checks = (config.together("active stored", lambda active, stored: active <= stored, "at most the stored keyframes"),)


@dataclass(frozen=True, slots=True)
class AcceptanceParams(Params):
    """Limits for refusing a pose, searching for a better one and restarting the map.

    A camera without legs has fixed values of `doubt`, `search_every`, `patience` and `rest_step` instead.
    """

    min_measured: float = ranged(0.02, 0.0, 1.0)  # [1] share of the image's blocks with a depth
    min_overlap: float = ranged(0.3, 0.0, 1.0)  # [1] share of points with a matching plane
    min_agreement: float = ranged(0.5, 0.0, 1.0)  # [1] share of points facing a plane that lie on it
    max_rmse: float = ranged(0.010, 1e-4, 1.0)  # [m] point-to-plane, absolute limit
    rmse_factor: float = ranged(3.0, 0.0, 100.0)  # [1] times the average rmse, plus rmse_margin: relative limit
    rmse_margin: float = ranged(0.001, 0.0, 1.0)  # [m] added to the relative limit
    # Departure from the prior that is allowed in addition to four sigma. A floor constrains height, roll and pitch reliably,
    # and a foot that slips off an edge tilts the robot by several degrees at once. Along the floor, a frame may have been
    # matched with the wrong block.
    jump_distance: float = ranged(0.02, 0.0, 5.0)  # [m] in x and y
    jump_angle: float = ranged(0.02, 0.0, 3.0)  # [rad] in yaw
    jump_height: float = ranged(0.05, 0.0, 5.0)  # [m] in z
    jump_tilt: float = ranged(0.15, 0.0, 3.0)  # [rad] in roll and pitch
    lever: float = ranged(0.3, 0.0, 5.0)  # [m] maximum camera height: a tilt about the feet also moves the camera in x and y
    max_misfit: float = ranged(0.015, 0.0, 1.0)  # [1] share of points off the known heights, from which a pose is doubted
    doubt: int = ranged(3, 1, 10_000)  # consecutive doubtful or failed frames that start a search around the prior
    search_every: int = ranged(8, 1, 10_000)  # [frames] between searches while the doubt lasts
    patience: int = ranged(60, 1, 100_000)  # consecutive failed frames after which a new map starts at the prior
    rest_step: float = ranged(0.001, 0.0, 0.1)  # [m] and [rad] change of the prior in a frame, up to which the camera rests
    body_radius: float = ranged(0.45, 0.0, 5.0)  # [m] radius of one body that may move in front of a camera at rest
    max_worsening: float = ranged(2.5, 1.0, 100.0)  # [1] times the recent misfit, from which little overlap refuses a frame
    max_contradiction: float = ranged(
        0.05, 0.0, 1.0
    )  # [1] share of points off the known heights that refuses a frame, without legs


@dataclass(frozen=True, slots=True)
class ExternalPoseParams(Params):
    """Checks of a pose from another localization (`method = "external"`)."""

    max_age_s: float = ranged(0.5, 0.05, 2.0)  # [s] maximum age of a pose; leg odometry carries it to the time of a frame
    smooth_s: float = ranged(0.15, 0.001, 10.0)  # [s] time constant of the mean of poses, which reduces their noise
    jump: float = ranged(0.10, 0.01, 1.0)  # [m] maximum deviation from the place to which the legs carried the earlier poses
    jump_angle: float = ranged(0.10, 0.01, 1.0)  # [rad] the same for the rotation
    drift_share: float = ranged(0.3, 0.0, 1.0)  # [1] of the way and of the turn of the legs, by which poses may correct them
    drift_rate: float = ranged(0.01, 0.0, 0.2)  # [m/s] and [rad/s] by which poses may correct them as well
    max_tilt: float = ranged(0.25, 0.02, 1.0)  # [rad] tilt of the body against its legs
    sigma: float = ranged(0.01, 0.001, 0.2)  # [m] standard deviation of a position of unknown uncertainty
    sigma_angle: float = ranged(0.01, 0.001, 0.2)  # [rad] the same for the rotation
    max_sigma: float = ranged(0.2, 0.01, 10.0)  # [m] and [rad] maximum uncertainty of a pose


@dataclass(frozen=True, slots=True)
class TextureParams(Params):
    """Texture of the ground in the grey images of a camera with colour."""

    use: bool = True  # whether texture fixes what the shape of the ground does not, such as x, y and yaw on a floor
    keyframes: int = ranged(2, 1, 32)  # number of keyframes whose texture is tracked
    min_texture: float = ranged(1.5, 0.1, 100.0)  # [1/255 per px] gradient of the brightness of a point, in each direction
    search_px: float = ranged(12.0, 1.0, 50.0)  # [px] maximum distance from where the legs expect a point
    min_correlation: float = ranged(0.75, 0.0, 1.0)  # [1] of a patch with the frame
    min_tracks: int = ranged(25, 6, 1000)  # points that agree with a pose
    min_agreement: float = ranged(0.6, 0.0, 1.0)  # [1] share of the points found that agree with it
    min_found: float = ranged(0.3, 0.0, 1.0)  # [1] share of the expected points that agree with it
    slip: float = ranged(0.006, 0.0, 0.5)  # [m] by which legs and texture may differ since a keyframe ...
    slip_share: float = ranged(0.25, 0.0, 1.0)  # [1] ... plus this share of the path walked since
    turn: float = ranged(0.01, 0.0, 1.0)  # [rad] the same for yaw, plus `slip_share` of the turning ...
    turn_rate: float = ranged(0.3, 0.0, 5.0)  # [rad/m] ... and this per path
    trusted_margin: float = ranged(3.0, 1.0, 100.0)  # [1] times `slip` and `turn`, once texture is trusted
    probation: float = ranged(0.15, 0.0, 10.0)  # [m] way over which texture must agree with the legs before it is trusted
    patience: int = ranged(3, 0, 1000)  # consecutive frames with too few points after which the trust is lost
