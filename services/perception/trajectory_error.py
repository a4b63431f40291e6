"""Error of an estimated trajectory against the true one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import align_rigid, inverse, log_so3

_SAME_SHAPE = 0.1  # of a trajectory's extent, up to which two trajectories have the same shape


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryError:
    """Absolute trajectory error after the best rigid alignment."""

    T_truth_estimate: NDArray[np.float64]  # (4, 4) the alignment, or identity
    distances: NDArray[np.float64]  # (n,) [m] between aligned and true positions
    angles: NDArray[np.float64]  # (n,) [rad] between aligned and true orientations

    @property
    def rms(self) -> float:
        """Root mean square of the distances [m]."""
        return float(np.sqrt(np.mean(self.distances**2)))

    @property
    def final(self) -> float:
        """Distance at the last pose [m]."""
        return float(self.distances[-1])

    @property
    def worst(self) -> float:
        """Largest distance [m]."""
        return float(self.distances.max())


def trajectory_error(T_estimate: NDArray[np.float64], T_truth: NDArray[np.float64], *, align: bool = True) -> TrajectoryError:
    """Compare poses taken at the same times.

    Args:
        T_estimate: (n, 4, 4) estimated poses.
        T_truth: (n, 4, 4) true poses.
        align: First move the whole estimate rigidly onto the truth, by position.

    Raises:
        ValueError: The shapes differ, or there are fewer than three poses to align.
    """
    if T_estimate.shape != T_truth.shape or T_estimate.ndim != 3 or T_estimate.shape[1:] != (4, 4):
        raise ValueError(f"two (n, 4, 4) trajectories expected, found {T_estimate.shape} and {T_truth.shape}")
    if len(T_truth) == 0:
        raise ValueError("at least one pose expected, found none")
    T = align_rigid(T_estimate[:, :3, 3], T_truth[:, :3, 3]) if align else np.eye(4)
    difference = inverse(T_truth) @ T @ T_estimate
    return TrajectoryError(
        T, np.linalg.norm(difference[:, :3, 3], axis=-1), np.linalg.norm(log_so3(difference[:, :3, :3]), axis=-1)
    )


def relative_size(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> float | None:
    """Return the size of an estimated trajectory (n, 3) [m] relative to the true one.

    Both have the same times. The result is None if nothing moves, or if the shapes differ by more than a tenth of the true
    size.
    """
    T = align_rigid(estimate, truth)
    p, q = (estimate - estimate.mean(axis=0)) @ T[:3, :3].T, truth - truth.mean(axis=0)
    squares, extent = float((p * p).sum()), float(np.sqrt((q * q).sum()))
    scale = float((p * q).sum()) / squares if squares > 0.0 else 0.0
    if scale <= 0.0 or float(np.linalg.norm(q - scale * p)) > _SAME_SHAPE * extent:
        return None
    return 1.0 / scale
