"""Alignment of a depth frame with keyframes and a motion prior, by Gauss-Newton."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.constraint_weights import INFORMATION_SHARE, constraint_weights
from sextant.services.perception.registration.error_twist import ALONG_FLOOR, apply_twist
from sextant.services.perception.registration.keyframes import Keyframes
from sextant.services.perception.registration.params import AlignmentParams
from sextant.services.perception.registration.projective_matching import Match
from sextant.services.perception.registration.texture_tracking import Tracks
from sextant.shared.geometry import orthonormal
from sextant.shared.runtime.compiled import compiled

Array = NDArray[Any]  # argument of compiled functions, any numeric type

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
        normal = np.empty((6, 6))
        seen, pull = np.zeros((6, 6)), np.zeros(6)
        # The first step may have to cover the prior's uncertainty and a slip.
        way = 1.5 * math.sqrt(float(np.diag(np.linalg.inv(information))[:3].max())) + params.slip
        step = math.inf  # largest element [m, rad]
        for iteration in range(params.max_iterations):
            gate = min(max(params.gate_near, 2.0 * way), params.gate_far)
            match = self._keyframes.match(T, chosen, gate, self._stride, robust=iteration >= trusting)
            if T is T_start or gate == params.gate_near:
                believed, degenerate = constraint_weights(match)
            if tracks is not None:
                left = np.eye(6) - believed * (match.keyframes / INFORMATION_SHARE)  # what the matches leave open
                left[ALONG_FLOOR] = np.eye(6)[ALONG_FLOOR]  # a distorted image shows a bare floor as if it had a shape
                seen, pull = tracks.equations(T, _WIDE[min(iteration, len(_WIDE) - 1)])
                seen, pull = left @ seen @ left.T, left @ pull
            before = step
            T, way, step = _advance(T, T_prior, believed, match.H, match.g, seen, pull, information, normal)
            # Steps with the same weights shrink by a similar factor each time. If so, this is the sum of those to come.
            rest = step * step / (before - step) if iteration > settled and before > step else math.inf
            if iteration >= settled and min(step, rest) < params.converged:
                break
        covariance = np.linalg.inv(normal)
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


@compiled
def _advance(
    T: Array,
    T_prior: Array,
    B: Array,
    H: Array,
    g: Array,
    seen: Array,
    pull: Array,
    information: Array,
    normal: Array,
) -> tuple[Array, float, float]:
    """Return the pose (4, 4) after one step, and the step's largest shift [m] and largest element [m, rad].

    Args:
        T: Pose.
        T_prior: Expected pose.
        B: (6, 6) weights of the equations H, g of the matches, of `constraint_weights`.
        H: (6, 6) information of the matches.
        g: (6,) their gradient.
        seen: (6, 6) information of texture.
        pull: (6,) its gradient.
        information: (6, 6) of the prior.
        normal: (6, 6) sum of all information, written.
    """
    # 1. Error twist from the prior: log of R R_prior^T.
    error, R = np.empty(6), np.empty((3, 3))
    for i in range(3):
        error[i] = T[i, 3] - T_prior[i, 3]
        for j in range(3):
            R[i, j] = T[i, 0] * T_prior[j, 0] + T[i, 1] * T_prior[j, 1] + T[i, 2] * T_prior[j, 2]
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine = math.sqrt(x * x + y * y + z * z)
    scale = math.atan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)) / sine if sine > 1e-8 else 1.0
    error[3], error[4], error[5] = scale * x, scale * y, scale * z
    # 2. Solve the normal equations by elimination; they are not symmetric where B is from an earlier pose.
    left, new = np.empty((6, 6)), np.empty(6)
    for i in range(6):
        total = pull[i]
        for k in range(6):
            total += B[i, k] * g[k] + information[i, k] * error[k]
        new[i] = -total
        for j in range(6):
            normal[i, j] = seen[i, j] + information[i, j]
            for k in range(6):
                normal[i, j] += B[i, k] * H[k, j]
            left[i, j] = normal[i, j]
    for i in range(6):
        pivot = i
        for k in range(i + 1, 6):
            pivot = k if abs(left[k, i]) > abs(left[pivot, i]) else pivot
        new[i], new[pivot] = new[pivot], new[i]
        for j in range(6):
            left[i, j], left[pivot, j] = left[pivot, j], left[i, j]
        for k in range(i + 1, 6):
            factor = left[k, i] / left[i, i]
            new[k] -= factor * new[i]
            for j in range(i, 6):
                left[k, j] -= factor * left[i, j]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            new[i] -= left[i, k] * new[k]
        new[i] /= left[i, i]
    # 3. Move the pose by exp of the step.
    out = T.copy()
    x, y, z = new[3], new[4], new[5]
    angle = math.sqrt(x * x + y * y + z * z)
    a = math.sin(angle) / angle if angle > 0.0 else 1.0
    b = 2.0 * (math.sin(angle / 2.0) / angle) ** 2 if angle > 0.0 else 0.5
    for j in range(3):
        u, v, w = T[0, j], T[1, j], T[2, j]
        along = x * u + y * v + z * w
        out[0, j] = u + a * (y * w - z * v) + b * (x * along - angle * angle * u)
        out[1, j] = v + a * (z * u - x * w) + b * (y * along - angle * angle * v)
        out[2, j] = w + a * (x * v - y * u) + b * (z * along - angle * angle * w)
        out[j, 3] = T[j, 3] + new[j]
    way = largest = 0.0
    for i in range(6):
        largest = max(largest, abs(new[i]))
        way = max(way, abs(new[i])) if i < 3 else way
    return out, way, largest
