"""Error twists: their composition with poses, and their transport to another point."""

import numpy as np

from sextant.services.perception.registration.error_twist import apply_twist, covariance_at, error_twist, unit_twists_at
from sextant.shared.geometry import from_xyz_rpy


def test_error_twist_inverts_apply_twist():
    rng = np.random.default_rng(0)
    for _ in range(20):
        T = from_xyz_rpy(rng.normal(size=3), rng.normal(size=3))
        twist = rng.normal(scale=0.4, size=6)
        np.testing.assert_allclose(error_twist(apply_twist(T, twist), T), twist, atol=1e-12)


def test_covariance_at_another_point_is_that_of_moved_twists() -> None:
    rng = np.random.default_rng(1)
    r, root = rng.normal(size=3), 0.01 * rng.normal(size=(6, 6))
    covariance = root @ root.T
    twists = rng.multivariate_normal(np.zeros(6), covariance, 200_000)
    twists[:, :3] += np.cross(twists[:, 3:], r)
    np.testing.assert_allclose(np.cov(twists.T), covariance_at(covariance, r), atol=0.02 * np.abs(covariance).max() * 4)


def test_unit_twists_at_another_point_are_moved_and_of_unit_length() -> None:
    r = np.array([0.0, 0.0, 0.5])
    shift, tilt = np.eye(6)[0], np.eye(6)[4]
    moved = unit_twists_at(np.stack([shift, tilt]), r)
    np.testing.assert_allclose(moved[0], shift)
    np.testing.assert_allclose(moved[1], np.array([0.5, 0.0, 0.0, 0.0, 1.0, 0.0]) / np.hypot(0.5, 1.0))
    assert unit_twists_at(np.zeros((0, 6)), r).shape == (0, 6)
