"""Trajectory errors: zero for a rigid motion, and the offset without alignment."""

import numpy as np
import pytest

from sextant.services.perception.trajectory_error import trajectory_error
from sextant.shared.geometry import from_xyz_rpy


def poses(n=20, seed=0):
    rng = np.random.default_rng(seed)
    return from_xyz_rpy(rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))


def test_aligned_error_of_rigidly_moved_trajectory_is_zero():
    truth = poses()
    T = from_xyz_rpy([1.0, -2.0, 3.0], [0.3, -1.0, 2.0])
    error = trajectory_error(T @ truth, truth)
    assert error.rms < 1e-12
    assert error.angles.max() < 1e-7
    np.testing.assert_allclose(error.T_truth_estimate @ T, np.eye(4), atol=1e-12)


def test_unaligned_error_is_position_offset():
    truth = poses()
    moved = truth.copy()
    moved[:, 0, 3] += 0.3
    moved[-1, 1, 3] += 0.4
    error = trajectory_error(moved, truth, align=False)
    assert error.final == pytest.approx(0.5)
    assert error.worst == pytest.approx(0.5)
    assert error.rms == pytest.approx(np.sqrt((19 * 0.09 + 0.25) / 20))


def test_alignment_never_increases_error():
    truth, estimate = poses(seed=1), poses(seed=2)
    assert trajectory_error(estimate, truth).rms <= trajectory_error(estimate, truth, align=False).rms


def test_invalid_trajectories_are_refused():
    with pytest.raises(ValueError, match="trajectories expected"):
        trajectory_error(poses(5), poses(6))
    with pytest.raises(ValueError, match="n >= 3"):
        trajectory_error(poses(2), poses(2))
    with pytest.raises(ValueError, match="found none"):
        trajectory_error(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), align=False)
