"""Constraint weights: directions that hold only noise get no weight."""

import numpy as np

from sextant.services.perception.registration.constraint_weights import constraint_weights
from sextant.services.perception.registration.projective_matching import Match


def test_constraint_weight_grows_with_information_to_noise_ratio():
    rng = np.random.default_rng(3)
    ratios = np.array([0.5, 1.0, 2.0, 3.5, 5.0, 1e4])
    for _ in range(20):
        L = np.tril(rng.normal(size=(6, 6))) + 3.0 * np.eye(6)
        U, _ = np.linalg.qr(rng.normal(size=(6, 6)))
        H = L @ (U * ratios) @ U.T @ L.T
        B, unknown = constraint_weights(Match(H, np.zeros(6), L @ L.T, 2, 1.0, 1.0, 0.0))
        share = np.clip((ratios - 2.0) / 3.0, 0.0, 1.0)
        np.testing.assert_allclose(B @ H, 0.05 * L @ (U * share * ratios) @ U.T @ L.T, rtol=1e-5, atol=1e-5 * np.abs(H).max())
        assert unknown.shape == (3, 6)
        np.testing.assert_allclose(np.linalg.norm(unknown, axis=1), 1.0)
        np.testing.assert_allclose(B @ H @ unknown.T, 0.0, atol=1e-5 * np.abs(H).max())


def test_match_without_information_leaves_all_directions_to_the_prior() -> None:
    B, unknown = constraint_weights(Match(np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), 1, 0.0, 0.0, 0.0))
    assert not B.any()
    np.testing.assert_array_equal(unknown, np.eye(6))
