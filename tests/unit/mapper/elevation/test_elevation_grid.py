"""Elevation grid as a whole.

The tests cover seeding, low blocks, other resolutions, foot contacts, and invalid settings.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.shared.robot.camera import DepthSensor
from tests.support.grid_scans import CAMERA, centres, scan, scan_of


def test_invalid_settings_are_refused() -> None:
    grid = ElevationGrid(size=16)
    with pytest.raises(ValueError, match="coordinates"):
        grid.move_to((0.0, math.nan))
    with pytest.raises(ValueError, match="8 cells"):
        ElevationGrid(size=4)
    with pytest.raises(ValueError, match="8 cells"):
        ElevationGrid(size=(100, 7))
    with pytest.raises(ValueError, match="resolution"):
        ElevationGrid(resolution=0.0)
    with pytest.raises(ValueError, match="floor_sigma"):
        FusionModel(floor_sigma=0.0)
    with pytest.raises(ValueError, match="patience"):
        FusionModel(patience=0)
    with pytest.raises(ValueError, match="polygon"):
        grid.seed_plane([[0, 0], [1, 1]], (0, 0, 0))
    with pytest.raises(ValueError, match="plane"):
        grid.seed_plane([[0, 0], [1, 1], [0, 1]], (0, 0))


@pytest.mark.slow
def test_seeded_plane_fills_unseen_cells_and_is_replaced_by_measurement() -> None:
    grid = ElevationGrid(size=64)
    grid.move_to((0.2, 0.0))
    scan(grid, np.array([[0.055, 0.005]]), 0.02)
    square = [[0.0, -0.1], [0.1, -0.1], [0.1, 0.1], [0.0, 0.1]]
    assert grid.seed_plane(square, (0.01, 0.1, 0.2)) == 10 * 20 - 1
    snapshot = grid.snapshot()
    assert grid.heights([0.055, 0.005]) == pytest.approx(0.02)
    assert grid.heights([0.015, -0.095]) == pytest.approx(0.01 + 0.1 * 0.015 - 0.2 * 0.095, abs=1e-6)
    assert np.isnan(grid.heights([[-0.005, 0.0], [0.105, 0.0]])).all()
    assert snapshot.assumed.sum() == 199
    assert np.sqrt(snapshot.variance[snapshot.assumed == 1]) == pytest.approx(0.02)
    scan(grid, np.array([[0.015, -0.095]]), 0.04)  # replaced entirely, not averaged
    assert grid.heights([0.015, -0.095]) == pytest.approx(0.04)
    assert grid.snapshot().assumed.sum() == 198
    assert grid.seed_plane(square, (0.5, 0.0, 0.0)) == 0


def test_seed_polygon_is_clipped_to_map_window() -> None:
    grid = ElevationGrid(size=40)
    assert grid.seed_plane([[5, 5], [6, 5], [6, 6]], (0, 0, 0)) == 0
    triangle = np.array([[-0.1, -0.1], [0.1, -0.1], [-0.1, 0.1]])
    filled = grid.seed_plane(triangle, (0, 0, 0))
    assert filled == pytest.approx(0.5 * 20 * 20, abs=20)
    assert grid.seed_plane([[-9, -9], [9, -9], [9, 9], [-9, 9]], (0, 0, 0)) == 40 * 40 - filled
    grid.move_to((1.0, 0.0))
    assert grid.snapshot().assumed.sum() == 0


BLOCKS = np.array(  # x0, y0, x1, y1, height [m]
    [[0.6, -0.35, 0.75, -0.2, 0.01], [0.7, 0.0, 0.85, 0.2, 0.02], [0.95, -0.2, 1.1, -0.02, 0.03], [1.2, 0.0, 1.4, 0.15, 0.04]]
)  # fmt: skip


def true_height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    z = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for x0, y0, x1, y1, top in BLOCKS:
        z[(x >= x0) & (x < x1) & (y >= y0) & (y < y1)] = top
    return z


def block_scan(
    p_camera: NDArray[np.float64], pitch: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return points, counts and spreads of a 320x240 image with PrimeSense noise.

    The image is reduced to a point per cell, the upper cluster at edges.
    """
    sensor, fx = DepthSensor(), 262.5
    u, v = (np.mgrid[:320, :240].reshape(2, -1) - np.array([[159.5], [119.5]])) / fx
    forward = np.array([math.cos(pitch), 0.0, -math.sin(pitch)])
    down = np.array([-math.sin(pitch), 0.0, -math.cos(pitch)])
    ray = forward + u[:, None] * np.array([0.0, -1.0, 0.0]) + v[:, None] * down
    depth = np.where(ray[:, 2] < 0, -p_camera[2] / np.minimum(ray[:, 2], -1e-9), np.inf)
    for x0, y0, x1, y1, top in BLOCKS:
        with np.errstate(divide="ignore"):
            t0 = (np.array([x0, y0, -1.0]) - p_camera) / ray
            t1 = (np.array([x1, y1, top]) - p_camera) / ray
        enter, leave = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
        depth = np.where((enter <= leave) & (enter > 0), np.minimum(depth, enter), depth)
    disparity_scale = 2 * fx * sensor.baseline  # a 640 pixel wide image has twice the focal length
    seen = (depth > sensor.min_range) & (depth < 2.0)
    depth, ray = depth[seen], ray[seen]
    disparity = disparity_scale / depth + rng.normal(0.0, sensor.disparity_sigma, len(depth))
    depth = disparity_scale / (np.round(disparity / sensor.disparity_step) * sensor.disparity_step)
    points = p_camera + depth[:, None] * ray
    points = points[(np.abs(points[:, 1]) < 1.0) & (np.abs(points[:, 0]) < 2.5)]
    index = np.floor(points[:, :2] / 0.01).astype(int) + 500
    cell, group = np.unique(index[:, 0] * 1000 + index[:, 1], return_inverse=True)
    high, low = np.full(len(cell), -np.inf), np.full(len(cell), np.inf)
    np.maximum.at(high, group, points[:, 2])
    np.minimum.at(low, group, points[:, 2])
    keep = (high - low < 0.008)[group] | (points[:, 2] > 0.5 * (high + low)[group])
    points, group = points[keep], group[keep]
    count = np.bincount(group, minlength=len(cell)).astype(float)
    mean = np.stack([np.bincount(group, points[:, a], minlength=len(cell)) / count for a in range(3)], axis=1)
    square = np.bincount(group, points[:, 2] ** 2, minlength=len(cell)) / count
    return mean, count, np.sqrt(np.maximum(square - mean[:, 2] ** 2, 0.0))


@pytest.mark.slow
def test_low_blocks_are_mapped_accurately_with_true_poses() -> None:
    rng = np.random.default_rng(11)
    grid = ElevationGrid(size=256)
    for k in range(60):
        p_camera = np.array([0.012 * k, 0.03 * math.sin(k), 0.25 + 0.005 * math.sin(2.0 * k)])
        grid.move_to(p_camera[:2])
        grid.fuse(scan_of(*block_scan(p_camera, math.radians(30 + math.sin(k)), rng), p_camera))
    snapshot = grid.snapshot()
    xy = centres(grid).reshape(256, 256, 2)
    x, y = xy[..., 0], xy[..., 1]
    truth = true_height(x, y)
    edge = np.zeros(truth.shape, dtype=bool)
    for dx in (-0.02, 0.0, 0.02):
        for dy in (-0.02, 0.0, 0.02):
            edge |= np.abs(true_height(x + dx, y + dy) - truth) > 0.001
    course = (x > 0.55) & (x < 1.5) & (np.abs(y) < 0.4)
    error = snapshot.elevation - truth
    seen = course & ~np.isnan(snapshot.elevation)
    assert seen[course].mean() > 0.9
    inside = seen & ~edge
    assert np.sqrt((error[inside] ** 2).mean()) < 0.003
    assert abs(error[inside].mean()) < 0.0005
    for x0, y0, x1, y1, top in BLOCKS:  # the top of each block is at its height
        on_top = inside & (x > x0) & (x < x1) & (y > y0) & (y < y1)
        assert np.count_nonzero(on_top) > 50
        assert np.median(snapshot.elevation[on_top]) == pytest.approx(top, abs=0.001)
    claimed = np.sqrt(snapshot.variance[inside])
    assert (np.abs(error[inside]) < 3 * claimed).mean() > 0.97


@pytest.mark.slow
@given(st.sampled_from([0.02, 0.03, 0.05]), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=20)
def test_coarse_map_holds_mean_height_with_matching_variance(resolution: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = ElevationGrid((20, 30), resolution)
    low, high = grid.origin - resolution / 2, grid.origin + (np.array(grid.shape) - 0.5) * resolution
    x, y = (np.arange(low[k] + 0.005, high[k], 0.01) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    slope = rng.uniform(-0.19, 0.19, 2)  # at most 15 deg
    report = grid.fuse(
        scan_of(np.column_stack([xy, xy @ slope]), np.full(len(xy), 4), np.zeros(len(xy)), np.array([-0.5, 0.0, 0.5]))
    )
    assert report.updated == 600
    snapshot = grid.snapshot()
    error = snapshot.elevation.ravel() - centres(grid) @ slope
    assert np.abs(error).max() < 0.25 * resolution * np.abs(slope).sum() + 1e-4  # points of a cell have similar weights
    strays = np.linalg.norm(slope) * resolution / math.sqrt(12.0)
    claimed = np.sqrt(np.median(snapshot.variance))
    assert 0.4 * strays < claimed < math.hypot(strays, 4e-3)


@pytest.mark.parametrize("step", [0.05, 0.10])
def test_coarse_map_keeps_upper_side_of_edge(step: float) -> None:
    grid = ElevationGrid(20, 0.03)
    grid.fuse(
        scan_of(np.array([[0.005, 0.0, 0.0], [0.015, 0.0, step], [0.025, 0.0, step]]), np.full(3, 8), np.zeros(3), CAMERA)
    )
    assert grid.heights([0.015, 0.005]) == pytest.approx(step, abs=1e-6)


def test_map_finer_than_scan_leaves_gaps_unknown() -> None:
    grid = ElevationGrid((64, 64), 0.005)
    xy = np.stack(np.mgrid[-10:10, -10:10], axis=-1).reshape(-1, 2) * 0.01 + 0.0051
    scan(grid, xy, 0.03)
    assert np.isfinite(grid.snapshot().elevation).sum() == len(xy)


@pytest.mark.parametrize("seen", [0.0, 0.02, -0.03])
def test_foot_contact_overrides_seen_height_only_at_the_foot(seen: float) -> None:
    grid = ElevationGrid(32, 0.01)
    xy = centres(grid).reshape(-1, 2)
    for _ in range(10):
        scan(grid, xy, np.full(len(xy), seen))
    before = grid.snapshot().elevation
    assert grid.touch((0.055, 0.055, 0.0), 0.005, 0.01) == 5
    after = grid.snapshot().elevation
    found = abs(float(grid.heights((0.055, 0.055))))
    assert found <= abs(seen)
    assert found < 0.011, "by more than can be noise, and the map gives way"
    far = np.hypot(*(centres(grid) - 0.055).T).T.reshape(before.shape) > 0.012
    np.testing.assert_array_equal(after[far], before[far])


def test_foot_contact_sets_height_of_unseen_ground() -> None:
    grid = ElevationGrid(32, 0.01)
    grid.touch((0.055, 0.055, 0.03), 0.005, 0.01)
    assert float(grid.heights((0.055, 0.055))) == pytest.approx(0.03)
    assert np.isfinite(grid.snapshot().elevation).sum() == 5
    assert grid.touch((5.0, 0.0, 0.0), 0.005, 0.01) == 0


def test_non_finite_foot_contact_is_refused() -> None:
    with pytest.raises(ValueError, match="a finite point"):
        ElevationGrid(32, 0.01).touch((0.0, 0.0, np.nan), 0.005, 0.01)


GROUND = np.stack(np.meshgrid(np.arange(0.405, 0.8, 0.01), np.arange(-0.195, 0.2, 0.01)), axis=-1).reshape(-1, 2)


def known_ground() -> ElevationGrid:
    grid = ElevationGrid(size=200)
    for _ in range(4):
        scan(grid, GROUND, 0.0)
    return grid


def fused(grid: ElevationGrid, z: NDArray[np.float64] | float, ground: float | None) -> float:
    points = np.column_stack([GROUND, np.broadcast_to(z, len(GROUND))])
    once = scan_of(points, np.full(len(GROUND), 4), np.zeros(len(GROUND)), CAMERA)
    return grid.fuse(once, ground).contradiction


def test_scan_that_contradicts_ground_under_the_feet_is_not_fused() -> None:
    tilted = -0.2 * GROUND[:, 0]  # as with intrinsics of another camera
    grid = known_ground()
    for _ in range(8):
        assert fused(grid, tilted, ground=0.0) == pytest.approx(-0.12, abs=0.01)
    np.testing.assert_allclose(grid.heights(GROUND), 0.0, atol=1e-3)
    for _ in range(8):
        assert fused(grid, tilted, ground=None) == 0.0, "without the feet, the newest scans are right"
    np.testing.assert_allclose(grid.heights(GROUND), tilted, atol=0.01)


def test_scan_with_a_new_object_is_fused() -> None:
    grid, half = known_ground(), np.where(GROUND[:, 1] > 0.0, 0.2, 0.0)
    for _ in range(8):
        assert fused(grid, half, ground=0.0) == 0.0
    np.testing.assert_allclose(grid.heights(GROUND), half, atol=0.01)


def test_rays_reflected_by_a_wet_floor_clear_no_ground() -> None:
    far = CAMERA + 4.0 * (np.column_stack([GROUND, np.zeros(len(GROUND))]) - CAMERA)
    cleared = []
    for ground in (0.0, None):
        grid = known_ground()
        for _ in range(40):
            grid.fuse(scan_of(far, np.full(len(far), 4), np.zeros(len(far)), CAMERA), ground)
        cleared.append(int(np.isnan(grid.heights(GROUND)).sum()))
    assert cleared[0] == 0
    assert cleared[1] > 0
