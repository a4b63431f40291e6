"""Moving least squares: planes and distant edges stay, and noise falls.

The result does not depend on orientation.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.mapper.passage_map.moving_least_squares import smooth
from sextant.shared.geometry import Array, exp_so3

RADIUS = 0.025


def grid(n: int = 40, step: float = 0.01) -> Array:
    i, j = np.meshgrid(np.arange(n) * step, np.arange(n) * step, indexing="ij")
    return np.column_stack([i.ravel(), j.ravel(), np.zeros(n * n)])


def ones(points: Array) -> Array:
    return np.ones(len(points))


@given(
    tilt=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    shift=st.tuples(*[st.floats(-100.0, 100.0)] * 3),
    seed=st.integers(0, 1000),
)
@settings(max_examples=30, deadline=None)
def test_plane_of_any_orientation_is_unchanged(
    tilt: tuple[float, float, float], shift: tuple[float, float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 0.3, (800, 3)) * [1, 1, 0] @ exp_so3(tilt).T + shift
    surface = smooth(points, rng.uniform(0.1, 10.0, 800), RADIUS)
    np.testing.assert_allclose(surface.points, points, atol=1e-9)
    found = np.isfinite(surface.roughness)
    assert found.mean() > 0.9
    normal = exp_so3(tilt)[:, 2]
    assert np.abs(np.abs(surface.normals[found] @ normal) - 1).max() < 1e-6
    assert np.nanmax(surface.roughness) < 1e-6


def test_normals_have_unit_length_and_point_up() -> None:
    rng = np.random.default_rng(1)
    surface = smooth(rng.uniform(0, 0.15, (2000, 3)), np.ones(2000), RADIUS)
    normals = surface.normals[np.isfinite(surface.roughness)]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (normals[:, 2] >= 0).all()


@pytest.mark.parametrize("radius", [0.02, 0.03, 0.05])
def test_noise_reduction_matches_weighted_mean_of_neighbourhood(radius: float) -> None:
    rng, sigma = np.random.default_rng(2), 5e-4
    points = grid(80)
    points[:, 2] = rng.normal(0, sigma, len(points))
    surface = smooth(points, ones(points), radius, passes=1)
    offsets = np.arange(-10, 11) * 0.01
    d2 = (offsets[:, None] ** 2 + offsets**2).ravel()
    w = np.where(d2 <= radius**2, np.exp(-4 * d2 / radius**2), 0.0)
    expected = sigma * np.sqrt((w**2).sum()) / w.sum()  # of a weighted mean, since the plane's tilt does not move its middle
    inner = (np.abs(points[:, :2] - 0.395) < 0.3).all(axis=1)
    assert np.std(surface.points[inner, 2]) == pytest.approx(expected, rel=0.15)
    assert np.mean(surface.roughness[inner]) < sigma


@pytest.mark.parametrize("gap", [0.03, 0.10, 0.30])
def test_edge_higher_than_radius_is_unchanged(gap: float) -> None:
    points = grid()
    upper = points[:, 0] > 0.2
    points[upper, 2] += gap
    surface = smooth(points, ones(points), RADIUS)
    np.testing.assert_allclose(surface.points, points, atol=1e-9)
    np.testing.assert_allclose(surface.normals[:, 2], 1.0, atol=1e-9)


@pytest.mark.parametrize("step", [0.015, 0.02])
def test_robust_passes_preserve_low_step(step: float) -> None:
    points = grid()
    upper = points[:, 0] > 0.195
    points[upper, 2] += step
    errors = [np.abs(smooth(points, ones(points), RADIUS, passes=n).points[:, 2] - points[:, 2]).max() for n in (1, 3)]
    assert errors[1] < 0.5 * errors[0]


def test_smoothing_is_equivariant_to_rigid_motion() -> None:
    rng = np.random.default_rng(3)
    points = grid(30)
    points[:, 2] = 0.02 * np.sin(points[:, 0] * 30) + rng.normal(0, 1e-3, len(points))
    weight = rng.uniform(0.5, 2.0, len(points))
    R, shift = exp_so3([0.3, -0.2, 1.1]), np.array([3.0, -2.0, 1.0])
    here, there = smooth(points, weight, RADIUS), smooth(points @ R.T + shift, weight, RADIUS)
    np.testing.assert_allclose(there.points, here.points @ R.T + shift, atol=1e-9)
    turned = here.normals @ R.T
    turned *= np.sign(turned[:, 2:])
    np.testing.assert_allclose(there.normals, turned, atol=1e-7)
    np.testing.assert_allclose(there.roughness, here.roughness, atol=1e-9)


def test_smoothing_ignores_point_order_and_weight_scale() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 0.2, (500, 3)) * [1, 1, 0.05]
    weight, order = rng.uniform(1, 9, 500), rng.permutation(500)
    here, there = smooth(points, weight), smooth(points[order], 7.0 * weight[order])
    np.testing.assert_allclose(there.points, here.points[order], atol=1e-12)
    np.testing.assert_allclose(there.roughness, here.roughness[order], atol=1e-12)


def test_degenerate_points_get_no_normal_and_stay() -> None:
    line = np.column_stack([np.linspace(0, 0.1, 50), np.linspace(0, 0.2, 50), np.linspace(0, 0.05, 50)])
    alone = np.array([[1.0, 1.0, 1.0], [1.001, 1.0, 1.0]])
    heap = np.full((20, 3), 2.0)
    points = np.concatenate([line, alone, heap])
    surface = smooth(points, ones(points))
    np.testing.assert_array_equal(surface.points, points)
    assert np.isnan(surface.normals).all()
    assert np.isnan(surface.roughness).all()
    assert len(smooth(np.empty((0, 3)), np.empty(0)).points) == 0


def test_invalid_cloud_is_refused() -> None:
    points = grid(5)
    for bad, weight, radius in (
        (points[:, :2], ones(points), RADIUS),
        (points, np.ones(3), RADIUS),
        (points * np.nan, ones(points), RADIUS),
        (points, 0 * ones(points), RADIUS),
        (points, ones(points), 0.0),
        (points, ones(points), np.inf),
    ):
        with pytest.raises(ValueError, match="expected"):
            smooth(bad, weight, radius)
