"""Limits within which a registered pose is accepted."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.error_twist import error_twist
from sextant.services.perception.registration.keyframes import Match
from sextant.services.perception.registration.observability import AXES


@dataclass(frozen=True, slots=True)
class Acceptance:
    """Limits for refusing a pose, searching for a better one and restarting the map."""

    min_measured: float = 0.02  # share of the image's blocks with a depth
    min_overlap: float = 0.3  # share of points with a matching plane
    min_agreement: float = 0.5  # share of points facing a plane that lie on it
    max_rmse: float = 0.010  # [m] point-to-plane, absolute limit
    rmse_factor: float = 3.0  # times the average rmse, plus rmse_margin: relative limit
    rmse_margin: float = 0.001  # [m]
    # Departure from the prior that is allowed in addition to four sigma. A floor constrains height, roll and pitch reliably,
    # and a foot that slips off an edge tilts the robot by several degrees at once. Along the floor, a frame may have been
    # matched with the wrong block.
    jump_distance: float = 0.02  # [m] in x and y
    jump_angle: float = 0.02  # [rad] in yaw
    jump_height: float = 0.05  # [m] in z
    jump_tilt: float = 0.15  # [rad] in roll and pitch
    lever: float = 0.3  # [m] maximum camera height over the ground: a tilt about the feet also moves the camera in x and y
    max_misfit: float = 0.015  # share of points outside the known height range of their cells, above which the pose is in doubt
    doubt: int = 3  # consecutive doubtful or failed frames that start a search around the prior
    search_every: int = 8  # [frames] between searches while the doubt lasts
    patience: int = 60  # consecutive failed frames after which a new map starts at the prior
    rest_step: float = 0.001  # [m] and [rad] change of the prior between two frames, up to which the camera counts as at rest
    body_radius: float = 0.45  # [m] radius of a single body that may move in front of a camera at rest
    # For a camera without legs, which has no odometry. Where its velocity is unknown, poses around the prior are tried. A frame
    # that contradicts the map is refused. A lost frame is searched for around all keyframes.
    legless: bool = False
    max_worsening: float = 2.5  # times the recent misfit, above which a frame with little overlap is refused
    max_contradiction: float = 0.05  # share of points outside the known height range of their cells that refuses a frame


HAND_HELD = Acceptance(doubt=1, search_every=4, patience=300, legless=True, rest_step=0.003)


def check_measured_share(frame: BlockFrame, acceptance: Acceptance) -> str:
    """Return why a frame has too few measurements, or an empty string."""
    share = frame.valid / (frame.shape[0] * frame.shape[1])
    if share < acceptance.min_measured:
        return f"only {100 * share:.1f} % of the image is measured, {100 * acceptance.min_measured:.0f} % needed"
    return ""


def rejection_reason(match: Match, acceptance: Acceptance) -> str:
    """Return why a match is rejected, or an empty string."""
    if match.overlap < acceptance.min_overlap:
        return f"{100 * match.overlap:.0f} % of the frame overlaps known ground, {100 * acceptance.min_overlap:.0f} % needed"
    if match.agreement < acceptance.min_agreement:
        return f"only {100 * match.agreement:.0f} % of the overlap agrees with known ground"
    if match.rmse > acceptance.max_rmse:
        return f"surfaces are {1000 * match.rmse:.1f} mm apart, {1000 * acceptance.max_rmse:.1f} mm allowed"
    return ""


def check_jump(
    T: NDArray[np.float64], T_prior: NDArray[np.float64], covariance: NDArray[np.float64], acceptance: Acceptance
) -> str:
    """Return why a pose is implausibly far from its prior, or an empty string."""
    twist = np.abs(error_twist(T, T_prior))
    level, tilt = acceptance.jump_distance, acceptance.jump_tilt
    swept = acceptance.lever * float(min(max(twist[3], twist[4]), tilt))
    margin = np.array([level + swept, level + swept, acceptance.jump_height, tilt, tilt, acceptance.jump_angle])
    allowed = 4.0 * np.sqrt(np.diag(covariance)) + margin
    worst = int(np.argmax(twist / allowed))
    if twist[worst] <= allowed[worst]:
        return ""
    unit, factor = ("m", 1.0) if worst < 3 else ("deg", math.degrees(1.0))
    return (
        f"jump of {factor * twist[worst]:.3f} {unit} in {AXES[worst]} from the expected pose, "
        f"at most {factor * allowed[worst]:.3f} {unit} plausible"
    )
