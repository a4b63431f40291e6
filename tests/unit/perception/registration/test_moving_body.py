"""Detection of a moving body: evidence within one body's size, or everywhere."""

import numpy as np

from sextant.services.perception.registration.moving_body import is_one_body, is_within_body

RADIUS = 0.45
FLOOR = np.random.default_rng(0).uniform(-1.5, 1.5, (4000, 2))


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 0.05, len(FLOOR))


def test_evidence_within_one_body_is_detected_as_one_body() -> None:
    body = np.linalg.norm(FLOOR - [0.5, 0.3], axis=1) < 0.25
    assert body.sum() > 50
    assert is_one_body(FLOOR, noise(1) + 3.0 * body, RADIUS)


def test_evidence_in_several_places_is_not_one_body() -> None:
    things = (np.linalg.norm(FLOOR - [0.9, 0.6], axis=1) < 0.2) | (np.linalg.norm(FLOOR - [-0.6, -0.8], axis=1) < 0.2)
    assert not is_one_body(FLOOR, noise(2) + 3.0 * things, RADIUS)


def test_noise_is_not_detected_as_body() -> None:
    assert not is_one_body(FLOOR, noise(3), RADIUS)
    assert not is_one_body(np.zeros((0, 2)), np.zeros(0), RADIUS)


def test_few_outlier_points_do_not_widen_body() -> None:
    rng = np.random.default_rng(4)
    body = rng.uniform(-0.2, 0.2, (95, 2))
    assert is_within_body(np.vstack([body, rng.uniform(1.0, 2.0, (5, 2))]), RADIUS)
    assert not is_within_body(np.vstack([body, rng.uniform(1.0, 2.0, (30, 2))]), RADIUS)
    assert not is_within_body(np.zeros((0, 2)), RADIUS)
