"""Error twists: small differences of poses, and where their covariance is valid.

An error twist (v, w) in world axes at a point of the body maps a pose (R, p) to (exp(w) R, p + v).
"""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, exp_so3, log_so3

ALONG_FLOOR = [0, 1, 5]  # x, y and yaw


def apply_twist(T: NDArray[np.float64], twist: NDArray[np.floating]) -> NDArray[np.float64]:
    """Move a pose by an error twist (6,) in world axes at its origin."""
    out = T.copy()
    out[:3, :3] = exp_so3(twist[3:]) @ T[:3, :3]
    out[:3, 3] += twist[:3]
    return out


def error_twist(T: NDArray[np.float64], T_from: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the error twist (6,) for which apply_twist(T_from, twist) is T."""
    return np.concatenate([T[:3, 3] - T_from[:3, 3], log_so3(T[:3, :3] @ T_from[:3, :3].T)])


def covariance_at(covariance: Array, r: Array) -> Array:
    """Return the covariance (6, 6) [m, rad] at a point r (3,) [m] {world} away."""
    J = _carried(r)
    return np.asarray(J @ covariance @ J.T, dtype=np.float64)


def unit_twists_at(twists: Array, r: Array) -> Array:
    """Return the unit twists (k, 6) at a point r (3,) [m] {world} away."""
    moved = twists @ _carried(r).T
    return np.asarray(moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12), dtype=np.float64)


def _carried(r: Array) -> Array:
    """Return J (6, 6) that moves an error twist by r (3,) [m] {world}: v + w x r."""
    J = np.eye(6)
    J[:3, 3:] = [[0.0, r[2], -r[1]], [-r[2], 0.0, r[0]], [r[1], -r[0], 0.0]]
    return J
