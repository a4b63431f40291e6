"""Fusion of measurements in a cell: convergence, variance and changed ground."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid, FusionCount
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.shared.robot.camera import DepthSensor
from tests.support.grid_scans import CAMERA, centres, scan, scan_of, take


def test_equal_measurements_converge_and_variance_falls_to_its_floor() -> None:
    grid = ElevationGrid(size=16)
    xy = np.array([[0.031, -0.022]])
    model = grid.model
    _, systematic = model.height_variance(np.array([[*xy[0], 0.07]]), np.ones(1), np.zeros(1), CAMERA)
    previous = math.inf
    for _ in range(300):
        scan(grid, xy, 0.07, count=1)
        variance = float(np.nanmin(grid.snapshot().variance))
        assert variance <= previous
        assert variance >= systematic[0] * (1 - 1e-6) >= model.floor_sigma**2
        previous = variance
    assert previous == pytest.approx(systematic[0], rel=1e-5)
    assert grid.heights(xy)[0] == pytest.approx(0.07, abs=1e-6)


def test_first_measurement_is_stored_unchanged() -> None:
    grid = ElevationGrid(size=16)
    xy = np.array([[0.031, -0.022]])
    scan(grid, xy, -0.123)
    snapshot = grid.snapshot()
    assert grid.heights(xy)[0] == pytest.approx(-0.123, abs=1e-7)
    assert np.count_nonzero(~np.isnan(snapshot.elevation)) == 1
    assert (np.isnan(snapshot.elevation) == np.isnan(snapshot.variance)).all()


@given(st.permutations(list(range(6))))
def test_fusion_is_independent_of_measurement_order(order: list[int]) -> None:
    model = FusionModel(floor_sigma=1e-7, quantisation_sigma=0.0, gate=100.0)  # a floor that is never reached
    heights = np.random.default_rng(7).normal(0.02, 1e-3, 6)
    counts = [1, 2, 5, 8, 3, 1]
    xy = np.array([[0.1, 0.05]])
    results = []
    for sequence in (range(6), order):
        grid = ElevationGrid(size=64, model=model)
        for k in sequence:
            grid.fuse(scan_of(np.array([[*xy[0], heights[k]]]), np.array([counts[k]]), np.zeros(1), (-0.9, 0.0, 0.5)))
        results.append((grid.heights(xy)[0], float(np.nanmin(grid.snapshot().variance))))
    assert results[0] == pytest.approx(results[1], rel=1e-3)


def test_variance_falls_with_pixels_and_proximity_but_not_below_floor() -> None:
    model = FusionModel()
    near, far = np.array([[0.5, 0.0, 0.0]]), np.array([[1.5, 0.0, 0.0]])
    one, many, spread = np.ones(1), np.full(1, 1000.0), np.zeros(1)

    def total(points: NDArray[np.float64], count: NDArray[np.float64], pose: NDArray[np.float64] | None = None) -> float:
        level = np.zeros((1, 2))
        random, systematic = model.height_variance(points, count, spread, CAMERA, pose, level)
        return float(random[0] + systematic[0])

    assert total(near, many) < total(near, one) < total(far, one)
    assert total(near, many) > model.floor_sigma**2
    height, tilt, aside = np.diag([0, 0, 1e-4, 0, 0, 0]), np.diag([0, 0, 0, 0, 1e-4, 0]), np.diag([1e-4, 1e-4, 0, 0, 0, 1e-4])
    assert total(near, one, height) == pytest.approx(total(near, one) + 1e-4)
    assert total(far, one, tilt) == pytest.approx(total(far, one) + 1e-4 * 1.5**2)
    assert total(far, one, aside) == pytest.approx(total(far, one))  # a shift does not change level ground


def random_covariance(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a random pose covariance of millimetres and tenths of a degree.

    Its components are correlated.
    """
    L = np.tril(rng.normal(size=(6, 6))) * np.array([2e-3, 2e-3, 1e-3, 2e-3, 2e-3, 3e-3])[:, None]
    return np.asarray(L @ L.T)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.27, 0.0), (-0.2, 0.4)])
def test_pose_variance_matches_monte_carlo(slope: tuple[float, float]) -> None:
    rng = np.random.default_rng(2)
    model = FusionModel(depth_sigma=0.0, quantisation_sigma=0.0, floor_sigma=1e-9)
    S = random_covariance(rng)
    camera = np.array([0.3, -0.2, 0.5])
    places = np.array([[0.9, 0.1], [1.4, -0.6], [0.8, 0.5]])
    points = np.column_stack([places, places @ slope])
    _, predicted = model.height_variance(points, np.ones(3), np.zeros(3), camera, S, np.tile(slope, (3, 1)))
    twist = rng.multivariate_normal(np.zeros(6), S, 20_000)
    moved = points + twist[:, None, :3] + np.cross(twist[:, None, 3:], points - camera)
    error = moved[..., 2] - moved[..., :2] @ slope  # error of the height stored where the moved point lies
    np.testing.assert_allclose(error.var(axis=0), predicted, rtol=0.05)


def test_unknown_slope_adds_mean_variance_over_headings() -> None:
    rng = np.random.default_rng(3)
    model = FusionModel(depth_sigma=0.0, quantisation_sigma=0.0, floor_sigma=1e-9, terrain_slope=0.3)
    S = random_covariance(rng)
    points, camera = np.array([[0.9, 0.1, 0.0]]), np.array([0.3, -0.2, 0.5])
    _, unknown = model.height_variance(points, np.ones(1), np.zeros(1), camera, S)
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    slopes = 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    known = [model.height_variance(points, np.ones(1), np.zeros(1), camera, S, s[None])[1][0] for s in slopes]
    assert unknown[0] == pytest.approx(np.mean(known), rel=1e-6)


@pytest.mark.parametrize("gradient", [(0.0, 0.0), (0.2, -0.1)])
def test_claimed_variance_matches_squared_error(gradient: tuple[float, float]) -> None:
    """Check that squared error over claimed variance is 1 on average.

    The average is over many maps of a plane after a second scan.
    """
    rng = np.random.default_rng(4)
    model = FusionModel(depth_sigma=2e-3, quantisation_sigma=0.0, floor_sigma=1e-6, terrain_slope=0.0, gate=10.0)
    S = random_covariance(rng)
    camera, ratios = np.array([-0.6, 0.0, 0.4]), []
    for _ in range(300):
        grid = ElevationGrid(size=16, model=model)
        xy = centres(grid)
        truth = xy @ gradient
        # The exact map provides the slope; then its cells are made as good as new.
        grid.fuse(
            scan_of(np.column_stack([xy, truth]), np.full(len(xy), 8), np.zeros(len(xy)), camera, pose_covariance=np.eye(6))
        )
        v, w = np.split(rng.multivariate_normal(np.zeros(6), S), 2)
        points = np.column_stack([xy, truth])
        n = np.append(-np.array(gradient), 1.0)
        ray = points - camera
        # Noise along the ray, projected to the height that level ground shows at the place.
        noise = 2e-3 * (ray**2).sum(axis=1) * np.abs(ray[:, 2]) / np.linalg.norm(ray, axis=1) * rng.normal(size=len(xy))
        points[:, 2] += (v + np.cross(w, ray)) @ n + noise
        grid.fuse(scan_of(points, np.ones(len(xy)), np.zeros(len(xy)), camera, pose_covariance=S))
        snapshot = grid.snapshot()
        ratio = (snapshot.elevation - truth.reshape(16, 16)) ** 2 / snapshot.variance
        ratios.append(ratio[1:-1, 1:-1].mean())  # at the window's border the slope is unknown
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_model_of_sensor_matches_its_depth_noise() -> None:
    sensor = DepthSensor()
    model = FusionModel.of_sensor(sensor, fx=525.0)
    at_one_metre = math.hypot(model.depth_sigma, model.quantisation_sigma)
    assert at_one_metre == pytest.approx(float(sensor.sigma(np.array([1.0]), 525.0)[0]))


@pytest.mark.parametrize("sigma", [0.001, 0.002, 0.006])  # the model expects about 1 mm here, so 6 mm is far above it
def test_noisy_plane_stays_unbiased(sigma: float) -> None:
    rng = np.random.default_rng(3)
    grid = ElevationGrid(size=64)
    xy = centres(grid)
    truth = 0.1 * xy[:, 0] - 0.05 * xy[:, 1] + 0.3
    for _ in range(100):
        scan(grid, xy, truth + rng.normal(0.0, sigma, len(xy)))
    error = grid.heights(xy) - truth
    assert abs(error.mean()) < 0.5e-3
    assert abs(np.median(error)) < 0.5e-3
    assert np.sqrt((error**2).mean()) < 1.2 * sigma


@pytest.mark.parametrize("step", [0.02, -0.02, 0.2, -0.2])
def test_changed_ground_is_replaced_within_patience(step: float) -> None:
    rng = np.random.default_rng(5)
    grid = ElevationGrid(size=32)
    xy = centres(grid)
    for _ in range(40):
        scan(grid, xy, rng.normal(0.0, 0.001, len(xy)))
    before = grid.heights(xy)
    for k in range(grid.model.patience):
        assert np.abs(grid.heights(xy)).max() < 0.005, f"dragged after {k} scans"
        np.testing.assert_array_equal(grid.heights(xy), before)
        scan(grid, xy, step + rng.normal(0.0, 0.001, len(xy)))
    # A rival can lose a vote to its own 3 sigma noise, so a few cells in a thousand take one or two more scans.
    assert (np.abs(grid.heights(xy) - step) < 0.005).mean() > 0.97
    for _ in range(3):
        scan(grid, xy, step + rng.normal(0.0, 0.001, len(xy)))
    assert np.abs(grid.heights(xy) - step).max() < 0.005
    report = scan(grid, xy, step)
    assert report.updated == len(xy)
    assert report.disputed == 0


@pytest.mark.parametrize(("lower", "width", "stays"), [(0.14, 1, True), (0.14, 3, True), (0.14, 6, False), (0.03, 1, False)])
def test_only_a_narrow_deep_place_in_a_clear_surface_is_a_wall_below_an_overhang(lower: float, width: int, stays: bool) -> None:
    """Check a surface in which a camera above it sees lower ground, in a square of some cells."""
    grid, p_camera = ElevationGrid(size=32), np.array([0.0, 0.0, 0.8])
    xy = centres(grid)
    surface = np.column_stack([xy, np.zeros(len(xy))])
    for _ in range(10):
        take(grid, surface, p_camera)
    square = np.abs(xy - 0.005 * width).max(axis=1) < 0.005 * width
    assert np.count_nonzero(square) == width**2
    for _ in range(20):
        take(grid, surface[square] - np.array([0.0, 0.0, lower]), p_camera)
    assert grid.heights(xy[square]) == pytest.approx(0.0 if stays else -lower, abs=1e-3)


def test_intermittent_outliers_do_not_change_established_height() -> None:
    grid = ElevationGrid(size=16)
    xy = centres(grid)
    for _ in range(20):
        scan(grid, xy, 0.0)
    for k in range(30):
        scan(grid, xy, 0.0 if k % 2 else 0.08)
    np.testing.assert_allclose(grid.heights(xy), 0.0, atol=1e-6)


def test_false_first_measurement_is_replaced_by_two_that_agree() -> None:
    grid = ElevationGrid(size=16)
    xy = np.array([[0.0, 0.0]])
    scan(grid, xy, 0.15)
    scan(grid, xy, 0.0)
    report = scan(grid, xy, 0.0005)
    assert report.replaced == 1
    assert abs(grid.heights(xy)[0]) < 0.001


def test_one_scan_keeps_upper_side_of_edge_and_merges_close_points() -> None:
    points = np.array([[0.002, 0.002, 0.0], [0.004, 0.004, 0.03], [0.006, 0.006, 0.0]])
    for order in ([0, 1, 2], [1, 0, 2], [0, 2, 1]):
        grid = ElevationGrid(size=16)
        report = grid.fuse(scan_of(points[order], np.ones(3), np.zeros(3), CAMERA))
        assert report == FusionCount(updated=1, disputed=0, replaced=0, outside=0)
        assert grid.heights([0.005, 0.005]) == pytest.approx(0.03, abs=1e-6)
    grid = ElevationGrid(size=16)
    grid.fuse(scan_of(np.array([[0.002, 0.002, 0.001], [0.004, 0.004, 0.003]]), np.ones(2), np.zeros(2), CAMERA))
    assert grid.heights([0.005, 0.005]) == pytest.approx(0.002, abs=2e-5)
