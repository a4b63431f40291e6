"""A reduced scan as it may be fused: of the right shapes, finite, within range."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.compiled import compiled

FAR = 1e6  # [m] coordinates beyond this are refused: a cell index must stay exact


@dataclass(frozen=True, slots=True, eq=False)
class CheckedScan:
    """A reduced scan that can be fused, as `of` makes it; see `ElevationGrid.fuse`."""

    points: NDArray[np.float64]  # (n, 3) [m] {world}
    count: NDArray[np.float64]  # (n,)
    spread: NDArray[np.float64]  # (n,) [m]
    p_world_camera: NDArray[np.float64]  # (3,) [m]
    pose_covariance: NDArray[np.float64]  # (6, 6)
    sights: NDArray[np.float64]  # (m, 3) [m] {world}
    nearest: float  # [m]

    @classmethod
    def of(
        cls,
        points: NDArray[np.floating],
        count: NDArray[np.integer | np.floating],
        spread: NDArray[np.floating],
        p_world_camera: ArrayLike,
        pose_covariance: NDArray[np.float64] | None = None,
        sights: NDArray[np.floating] | None = None,
        nearest: float = 0.0,
    ) -> Self:
        """Check a scan; the arguments are those of `ElevationGrid.fuse`.

        Raises:
            ValueError: A shape is wrong, or a value is not finite or out of its range.
        """
        p, n, s, c = _checked_scan(points, count, spread, p_world_camera)
        covariance = _checked_covariance(pose_covariance)
        ends = np.empty((0, 3)) if sights is None else np.ascontiguousarray(sights, dtype=np.float64)
        if ends.ndim != 2 or ends.shape[1] != 3 or not (np.abs(ends) < FAR).all():
            raise ValueError(f"sights (m, 3), finite and within {FAR:g} m, expected, found shape {ends.shape}")
        if not 0 <= nearest < math.inf:
            raise ValueError(f"a nearest distance of at least 0 m expected, found {nearest}")
        return cls(p, n, s, c, covariance, ends, nearest)


def _checked_scan(
    points: NDArray[np.floating],
    count: NDArray[np.integer | np.floating],
    spread: NDArray[np.floating],
    p_world_camera: ArrayLike,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The scan as contiguous float64 arrays; ValueError where a shape or the camera is wrong."""
    p = np.ascontiguousarray(points, dtype=np.float64)
    n = np.ascontiguousarray(count, dtype=np.float64)
    s = np.ascontiguousarray(spread, dtype=np.float64)
    c = np.asarray(p_world_camera, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3:
        raise ValueError(f"points (n, 3) expected, found shape {p.shape}")
    if n.shape != (len(p),) or s.shape != (len(p),):
        raise ValueError(f"count and spread of shape {(len(p),)} expected, found {n.shape} and {s.shape}")
    if c.shape != (3,) or not (np.abs(c) < FAR).all():
        raise ValueError(f"camera position of 3 coordinates within {FAR:g} m expected, found {p_world_camera!r}")
    near, filled, spread_out = _all_in_range(p, n, s, FAR)
    if not near:
        raise ValueError(f"points finite and within {FAR:g} m expected: drop invalid pixels before fusing")
    if not filled:
        raise ValueError("counts of at least 1 expected: drop empty cells before fusing")
    if not spread_out:
        raise ValueError("finite spreads of at least 0 m expected")
    return p, n, s, c


def _checked_covariance(covariance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """A (6, 6) covariance, zero for none; ValueError where it is none."""
    if covariance is None:
        return np.zeros((6, 6))
    out = np.ascontiguousarray(covariance, dtype=np.float64)
    if out.shape != (6, 6) or not np.isfinite(out).all():
        raise ValueError(f"a finite pose covariance (6, 6) expected, found {covariance!r}")
    if not _is_covariance(out, 1e-6):
        raise ValueError("a pose covariance that is symmetric and has no negative eigenvalue expected")
    return out


@compiled
def _all_in_range(
    points: NDArray[np.float64], count: NDArray[np.float64], spread: NDArray[np.float64], far: float
) -> tuple[bool, bool, bool]:
    """Whether all points (n, 3) are finite and near, all counts (n,) finite and from 1, all spreads (n,) finite and from 0."""
    near, filled, spread_out = True, True, True
    for k in range(len(count)):
        near &= (abs(points[k, 0]) < far) & (abs(points[k, 1]) < far) & (abs(points[k, 2]) < far)
        filled &= (count[k] >= 1.0) & (count[k] < np.inf)
        spread_out &= (spread[k] >= 0.0) & (spread[k] < far)
    return near, filled, spread_out


@compiled
def _is_covariance(S: NDArray[np.float64], share: float) -> bool:
    """Whether a matrix is symmetric and has no negative eigenvalue, but for a share of its largest element."""
    size = 0.0
    for i in range(6):
        for j in range(6):
            size = max(size, abs(S[i, j]))
    # With so much more in each direction it has a Cholesky factor.
    L = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            if abs(S[i, j] - S[j, i]) > share * size:
                return False
            rest = S[i, j] + (share * size if i == j else 0.0)
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i == j:
                if not rest >= 0.0:
                    return False
                L[i, i] = math.sqrt(rest)
            else:
                L[i, j] = rest / L[j, j] if L[j, j] > 0.0 else 0.0
    return True
