"""Alignment of a depth frame with keyframes and a motion prior, by Gauss-Newton."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.constraint_weights import INFORMATION_SHARE, constraint_weights
from sextant.services.perception.registration.error_twist import ALONG_FLOOR, apply_twist, error_twist
from sextant.services.perception.registration.keyframes import Keyframes
from sextant.services.perception.registration.params import AlignmentParams
from sextant.services.perception.registration.projective_matching import Match
from sextant.services.perception.registration.texture_tracking import Tracks
from sextant.shared.geometry import orthonormal

_WIDE = (30.0, 6.0, 1.0)  # factors of the spread of texture's positions in the first iterations
_KNOWN = 4.0  # times the prior's information, from which texture constrains a direction
TRUSTING = 2  # iterations from a distant start in which distant matches keep full weight


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Pose at which a frame fits the keyframes."""

    T: NDArray[np.float64]  # (4, 4) of the camera
    covariance: NDArray[np.float64]  # (6, 6) [m, rad]
    degenerate: NDArray[np.float64]  # (k, 6) unit twists that only the prior constrains
    shapeless: NDArray[np.float64]  # (k, 6) unit twists that the shape of the ground does not constrain
    match: Match


class Aligner:
    """Aligns the loaded frame of its keyframes."""

    def __init__(self, keyframes: Keyframes, blocks: int, params: AlignmentParams):
        """Initialize for frames with a number of blocks."""
        self._params = params
        self._keyframes = keyframes
        self._stride = max(1, round(blocks / params.matched_points))

    def align(
        self,
        T_prior: NDArray[np.float64],
        information: NDArray[np.float64],
        trusting: int = 0,
        T_start: NDArray[np.float64] | None = None,
        tracks: Tracks | None = None,
    ) -> Aligned:
        """Run Gauss-Newton on matches, texture and prior: (H + P) step = -(g + P error).

        Texture counts along the floor, and else only in the directions that the matches do not constrain.

        In the first `trusting` iterations all matches have full weight: for a start far from the solution, the few informative
        points are distant and would be treated as outliers.

        Args:
            T_prior: (4, 4) expected pose.
            information: (6, 6) of the prior.
            trusting: Number of iterations in which all matches have full weight.
            T_start: (4, 4) pose at which the iteration starts, by default the prior.
            tracks: Positions of texture.
        """
        params, chosen = self._params, self._keyframes.select(T_prior)
        T_start = T_prior if T_start is None else T_start
        T: NDArray[np.float64] = T_start
        settled = trusting if tracks is None else max(trusting, len(_WIDE) - 1)
        # The first step may have to cover the prior's uncertainty and a slip.
        step: NDArray[np.floating] = 1.5 * np.sqrt(np.diag(np.linalg.inv(information))) + params.slip
        for iteration in range(params.max_iterations):
            gate = min(max(params.gate_near, 2.0 * float(np.abs(step[:3]).max())), params.gate_far)
            match = self._keyframes.match(T, chosen, gate, self._stride, robust=iteration >= trusting)
            if T is T_start or gate == params.gate_near:
                believed, degenerate = constraint_weights(match)
            H, g = believed @ match.H, believed @ match.g
            if tracks is not None:
                left = np.eye(6) - believed * (match.keyframes / INFORMATION_SHARE)  # what the matches leave open
                left[ALONG_FLOOR] = np.eye(6)[ALONG_FLOOR]  # a distorted image shows a bare floor as if it had a shape
                seen, pull = tracks.equations(T, _WIDE[min(iteration, len(_WIDE) - 1)])
                seen, pull = left @ seen @ left.T, left @ pull
                H, g = H + seen, g + pull
            step = -np.linalg.solve(H + information, g + information @ error_twist(T, T_prior))
            T = apply_twist(T, step)
            if iteration >= settled and float(np.abs(step).max()) < params.converged:
                break
        covariance = np.linalg.inv(H + information)
        shapeless = degenerate
        if tracks is not None:
            degenerate = degenerate[_information_along(degenerate, seen) < _KNOWN * _information_along(degenerate, information)]
        return Aligned(orthonormal(T), (covariance + covariance.T) / 2.0, degenerate, shapeless, match)

    def align_around(
        self, T_prior: NDArray[np.float64], covariance: NDArray[np.float64], information: NDArray[np.float64]
    ) -> Aligned:
        """Return the best alignment, with several starts if the prior is uncertain along the ground."""
        found = self.align(T_prior, information)
        sigma = np.sqrt(np.diag(covariance))
        if sigma[ALONG_FLOOR].max() < self._params.unknown_sigma:
            return found
        for axis in ALONG_FLOOR:
            for sign in (-1.0, 1.0):
                start = apply_twist(T_prior, sign * sigma[axis] * np.eye(6)[axis])
                other = self.align(T_prior, information, TRUSTING, start)
                better = other.match.misfit < self._params.explained * found.match.misfit
                if better and other.match.overlap >= found.match.overlap - self._params.less_overlap:
                    found = other
        return found


def _information_along(twists: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the information (k,) along unit twists (k, 6)."""
    return np.asarray(np.einsum("ki,ij,kj->k", twists, information, twists))


def prior_information(T: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the information matrix (6, 6) of a prior.

    Raises:
        ValueError: Not a finite (4, 4) pose, or not a positive definite (6, 6) covariance.
    """
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError(f"a finite (4, 4) prior pose expected, found {T.tolist()}")
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(f"a finite (6, 6) prior covariance expected, found shape {covariance.shape}")
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise ValueError("a positive definite prior covariance expected: give every direction some variance")
    return np.asarray(np.linalg.inv(covariance))
