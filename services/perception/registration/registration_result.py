"""Result of the registration of one depth frame."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.projective_matching import Match


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationResult:
    """Pose of one depth frame, its uncertainty, and whether it is valid.

    Covariance and directions refer to the error twist (v, w) in world axes at the camera: (p + v, exp(w) R).
    """

    stamp_ns: int  # [ns] capture time of the frame
    T_world_camera: NDArray[np.float64]  # (4, 4), the prior where ok is False
    covariance: NDArray[np.float64]  # (6, 6) [m, rad], the prior's where ok is False
    overlap: float  # 0..1 share of the frame's points with a matching plane
    rmse: float  # [m] point-to-plane distance of the matches, NaN if there are none
    degenerate: NDArray[np.float64]  # (k, 6) unit twists that only the prior constrains
    ok: bool
    reason: str  # of the failure, empty when ok


def first_result(stamp_ns: int, T: NDArray[np.float64], covariance: NDArray[np.float64]) -> RegistrationResult:
    """Return the result for the first frame of a map, placed at its prior."""
    return RegistrationResult(stamp_ns, T.copy(), covariance.copy(), 1.0, 0.0, np.eye(6), True, "")


def refused_result(
    stamp_ns: int, T: NDArray[np.float64], covariance: NDArray[np.float64], match: Match | None, reason: str
) -> RegistrationResult:
    """Return the result for a frame that was not registered: its prior and the reason."""
    overlap, rmse = (0.0, math.nan) if match is None else (match.overlap, match.rmse)
    return RegistrationResult(stamp_ns, T.copy(), covariance.copy(), overlap, rmse, np.eye(6), False, reason)
