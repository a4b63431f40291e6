"""Validation of a reduced scan before fusion: shapes, finite values and ranges."""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.shared.runtime.compiled import compiled

MAX_COORDINATE_M = 1e6  # [m] larger coordinates are refused, so that cell indices stay exact


@dataclass(frozen=True, slots=True, eq=False)
class ValidatedScan:
    """Validated scan, created by `of` or `of_millimetres`; see `ElevationGrid.fuse`.

    Lengths stay in metres or in the millimetres of the message. They are converted to 8-byte numbers only where they are
    used, which saves time.
    """

    points: NDArray[Any]  # (n, 3) [unit] {world} from the origin
    count: NDArray[Any]  # (n,)
    spread: NDArray[Any]  # (n,) [unit]
    p_world_camera: NDArray[np.float64]  # (3,) [m]
    pose_covariance: NDArray[np.float64]  # (6, 6)
    sights: NDArray[Any]  # (m, 3) [unit] {world} from the origin
    nearest: float  # [m]
    origin: NDArray[np.float64]  # (3,) [m] {world}
    unit: float  # [m]

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
        """Validate a scan in metres.

        Args:
            points: (n, 3) [m] {world} one point per visible cell, on the upper surface if a cell has two.
            count: (n,) pixels merged into each point, at least 1.
            spread: (n,) [m] height range of these pixels, at least 0.
            p_world_camera: (3,) [m] {world} optical centre.
            pose_covariance: (6, 6) [m^2, m rad, rad^2] of the camera's position, then rotation, in world axes.
            sights: (m, 3) [m] {world} ends of additional free rays.
            nearest: [m] from the camera up to which rays prove nothing, because it measures nothing there.

        Raises:
            ValueError: A shape is wrong, or a value is not finite or out of its range.
        """
        p, n, s, c = _checked_scan(points, count, spread, p_world_camera)
        covariance = _checked_covariance(pose_covariance)
        ends = np.empty((0, 3)) if sights is None else np.ascontiguousarray(sights, dtype=np.float64)
        if ends.ndim != 2 or ends.shape[1] != 3 or not (np.abs(ends) < MAX_COORDINATE_M).all():
            raise ValueError(f"sights (m, 3), finite and within {MAX_COORDINATE_M:g} m, expected, found shape {ends.shape}")
        return cls(p, n, s, c, covariance, ends, _checked_nearest(nearest), np.zeros(3), 1.0)

    @classmethod
    def of_millimetres(
        cls,
        origin: NDArray[np.float64],
        points_mm: NDArray[np.int16],
        count: NDArray[np.uint8],
        spread_mm: NDArray[np.uint8],
        p_world_camera: NDArray[np.float64],
        pose_covariance: NDArray[np.float64] | None = None,
        sights_mm: NDArray[np.int16] | None = None,
        nearest: float = 0.0,
    ) -> Self:
        """Validate a scan message.

        Points (n, 3) and sights (m, 3) are relative to the origin (3,) [m] {world}.

        Raises:
            ValueError: A shape or type is wrong, or a value is not finite or out of its range.
        """
        ends = np.empty((0, 3), dtype=np.int16) if sights_mm is None else sights_mm
        for name, array, dtype, columns in (
            ("points", points_mm, np.int16, (3,)),
            ("sights", ends, np.int16, (3,)),
            ("count", count, np.uint8, ()),
            ("spread", spread_mm, np.uint8, ()),
        ):
            if array.dtype != dtype or array.shape != (len(array), *columns):
                raise ValueError(f"{name} of {np.dtype(dtype)} (n, {columns}) expected, found {array.dtype} {array.shape}")
        if not len(points_mm) == len(count) == len(spread_mm):
            raise ValueError(f"count and spread of {len(points_mm)} points expected, found {len(count)} and {len(spread_mm)}")
        if len(count) and not count.min():
            raise ValueError("counts of at least 1 expected: drop empty cells before fusing")
        begin, camera = _checked_place("origin", origin), _checked_place("camera position", p_world_camera)
        covariance = _checked_covariance(pose_covariance)
        p, e = np.ascontiguousarray(points_mm), np.ascontiguousarray(ends)
        n, s = np.ascontiguousarray(count), np.ascontiguousarray(spread_mm)
        return cls(p, n, s, camera, covariance, e, _checked_nearest(nearest), begin, 1e-3)


def _checked_place(name: str, p: ArrayLike) -> NDArray[np.float64]:
    """Return three coordinates [m], or raise a ValueError."""
    place = np.asarray(p, dtype=np.float64)
    if place.shape != (3,) or not all(abs(v) < MAX_COORDINATE_M for v in place.tolist()):
        raise ValueError(f"{name} of 3 coordinates within {MAX_COORDINATE_M:g} m expected, found {p!r}")
    return place


def _checked_nearest(nearest: float) -> float:
    """Return a distance [m], or raise a ValueError."""
    if not 0 <= nearest < math.inf:
        raise ValueError(f"a nearest distance of at least 0 m expected, found {nearest}")
    return nearest


def _checked_scan(
    points: NDArray[np.floating],
    count: NDArray[np.integer | np.floating],
    spread: NDArray[np.floating],
    p_world_camera: ArrayLike,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the scan as contiguous float64 arrays, or raise a ValueError."""
    p = np.ascontiguousarray(points, dtype=np.float64)
    n = np.ascontiguousarray(count, dtype=np.float64)
    s = np.ascontiguousarray(spread, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3:
        raise ValueError(f"points (n, 3) expected, found shape {p.shape}")
    if n.shape != (len(p),) or s.shape != (len(p),):
        raise ValueError(f"count and spread of shape {(len(p),)} expected, found {n.shape} and {s.shape}")
    c = _checked_place("camera position", p_world_camera)
    near, filled, spread_out = _all_in_range(p, n, s, MAX_COORDINATE_M)
    if not near:
        raise ValueError(f"points finite and within {MAX_COORDINATE_M:g} m expected: drop invalid pixels before fusing")
    if not filled:
        raise ValueError("counts of at least 1 expected: drop empty cells before fusing")
    if not spread_out:
        raise ValueError("finite spreads of at least 0 m expected")
    return p, n, s, c


def _checked_covariance(covariance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return a (6, 6) covariance, zero for None, or raise a ValueError."""
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
    """Return whether points, counts and spreads are finite and in range.

    Points (n, 3) must be nearer than `far`, counts (n,) at least 1, spreads (n,) at least 0.
    """
    near, filled, spread_out = True, True, True
    for k in range(len(count)):
        near &= (abs(points[k, 0]) < far) & (abs(points[k, 1]) < far) & (abs(points[k, 2]) < far)
        filled &= (count[k] >= 1.0) & (count[k] < np.inf)
        spread_out &= (spread[k] >= 0.0) & (spread[k] < far)
    return near, filled, spread_out


@compiled
def _is_covariance(S: NDArray[np.float64], share: float) -> bool:
    """Return whether a matrix is symmetric and has no negative eigenvalue.

    A share of its largest element is tolerated.
    """
    size = 0.0
    for i in range(6):
        for j in range(6):
            size = max(size, abs(S[i, j]))
    # With this tolerance added to the diagonal it has a Cholesky factor.
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
