"""Weights of directions by how far a match constrains them.

Noisy normals make a flat floor seem to constrain x, y and yaw.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.projective_matching import Match
from sextant.shared.runtime.compiled import compiled

INFORMATION_SHARE = 0.1  # matches share calibration and keyframe errors, so ten count as one
_SNR_OPEN, _SNR_KNOWN = 2.0, 5.0  # information over that of plane noise: weight 0 below the first, 1 above the second
_SWEEPS = 12  # maximum sweeps of Jacobi's method; six are enough for a (6, 6) matrix


def constraint_weights(match: Match) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute how far a match constrains each direction.

    N is the information that noise alone would give. The generalised eigenvalues of H against N are 1 in directions that hold
    only noise. The weight of a direction rises from 0 to 1 between `_SNR_OPEN` and `_SNR_KNOWN`. (After Zhang, Kaess and
    Singh 2016, On degeneracy of optimization-based state estimation problems.)

    Returns:
        The (6, 6) matrix B of the weighted normal equations, B H and B g, and the unit twists (k, 6) of the directions with
        weight 0.
    """
    return _weights(match.H, match.N, INFORMATION_SHARE / match.keyframes)


@compiled
def _product(A: NDArray[np.float64], B: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply two small matrices without a library call."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@compiled
def _cholesky(N: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return L with N = L L^T for a (6, 6) matrix that is not zero, and the inverse of L."""
    scale = 0.0
    for i in range(6):
        scale += N[i, i] / 6.0
    L, inverse_L = np.zeros((6, 6)), np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            rest = N[i, j] + (1e-9 * scale if i == j else 0.0)
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(rest, 1e-12 * scale)) if i == j else rest / L[j, j]
    for j in range(6):
        for i in range(j, 6):
            rest = 1.0 if i == j else 0.0
            for k in range(j, i):
                rest -= L[i, k] * inverse_L[k, j]
            inverse_L[i, j] = rest / L[i, i]
    return L, inverse_L


@compiled
def _rotate(A: NDArray[np.float64], U: NDArray[np.float64], p: int, q: int) -> None:
    """Apply the Jacobi rotation that zeroes A[p, q] to A, and to the eigenvectors U."""
    theta = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
    t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    for k in range(6):
        A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
    for k in range(6):
        A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
    for k in range(6):
        U[k, p], U[k, q] = c * U[k, p] - s * U[k, q], s * U[k, p] + c * U[k, q]


@compiled
def _diagonalize(A: NDArray[np.float64]) -> NDArray[np.float64]:
    """Diagonalize a symmetric (6, 6) matrix in place; return its eigenvectors as columns.

    Cyclic Jacobi rotations are applied until the off-diagonal elements vanish.
    """
    U = np.eye(6)
    for _ in range(_SWEEPS):
        aside, whole = 0.0, 0.0
        for i in range(6):
            whole += A[i, i] * A[i, i]
            for j in range(i):
                aside += A[i, j] * A[i, j]
        if aside <= 1e-24 * whole:
            break
        for p in range(5):
            for q in range(p + 1, 6):
                if A[p, q] != 0.0:
                    _rotate(A, U, p, q)
    return U


@compiled
def _weights(H: NDArray[np.float64], N: NDArray[np.float64], scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return B of `constraint_weights` times a factor, and the unit twists with weight 0; without matches N is zero."""
    if not N.any():
        return np.zeros((6, 6)), np.eye(6)
    L, inverse_L = _cholesky(N)
    ratios = _product(_product(inverse_L, H), inverse_L.T)
    U = _diagonalize(ratios)
    share = np.empty(6)
    for k in range(6):
        share[k] = min(max((ratios[k, k] - _SNR_OPEN) / (_SNR_KNOWN - _SNR_OPEN), 0.0), 1.0)
    B = _product(_product(L, U * share), _product(U.T, inverse_L))
    directions = _product(U.T, inverse_L)
    for k in range(6):
        length = np.sqrt(np.sum(directions[k] ** 2))
        for j in range(6):
            directions[k, j] /= length
    return scale * B, directions[share == 0.0]
