"""Limits within which a registered pose is accepted."""

import math
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.error_twist import error_twist
from sextant.services.perception.registration.observability import AXES
from sextant.services.perception.registration.params import AcceptanceParams
from sextant.services.perception.registration.projective_matching import Match


@dataclass(frozen=True, slots=True)
class Acceptance(AcceptanceParams):
    """Limits for refusing a pose, and whether there is a motion prior."""

    # For a camera without legs, which has no odometry. Where its velocity is unknown, poses around the prior are tried. A frame
    # that contradicts the map is refused. A lost frame is searched for around all keyframes.
    legless: bool = False

    @classmethod
    def of(cls, params: AcceptanceParams, legs: bool) -> Self:
        """Return the limits of a camera on legs, or of a hand-held one.

        A hand-held camera is in doubt at once, searches more often, is lost later, and moves more at rest.
        """
        common = {field.name: getattr(params, field.name) for field in fields(AcceptanceParams)}
        if not legs:
            common |= {"doubt": 1, "search_every": 4, "patience": 300, "rest_step": 0.003}
        return cls(**common, legless=not legs)


HAND_HELD = Acceptance.of(AcceptanceParams(), legs=False)


def check_measured_share(frame: BlockFrame, acceptance: Acceptance) -> str:
    """Return why a frame has too few measurements, or an empty string."""
    share = frame.valid / (frame.shape[0] * frame.shape[1])
    if share < acceptance.min_measured:
        return f"only {100 * share:.1f} % of the image is measured, {100 * acceptance.min_measured:.0f} % needed"
    return ""


def rejection_reason(match: Match, acceptance: Acceptance, max_rmse: float | None = None) -> str:
    """Return why a match is rejected, or an empty string.

    `max_rmse` [m] replaces that of the limits.
    """
    max_rmse = acceptance.max_rmse if max_rmse is None else max_rmse
    if match.overlap < acceptance.min_overlap:
        return f"{100 * match.overlap:.0f} % of the frame overlaps known ground, {100 * acceptance.min_overlap:.0f} % needed"
    if match.agreement < acceptance.min_agreement:
        return f"only {100 * match.agreement:.0f} % of the overlap agrees with known ground"
    if match.rmse > max_rmse:
        return f"surfaces are {1000 * match.rmse:.1f} mm apart, {1000 * max_rmse:.1f} mm allowed"
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
