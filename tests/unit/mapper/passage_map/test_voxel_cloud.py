"""Voxel cloud: centroids weighted by pixels, limited to the strip.

Repeated scans add nothing, and removed objects disappear.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.mapper.passage_map.voxel_cloud import Strip, VoxelCloud
from sextant.shared.geometry import Array

STRIP = Strip((0.0, 0.0), 0.0, 1.0, 0.6)


def ones(points: Array) -> Array:
    return np.ones(len(points))


def ground(z: float = 0.0, x: tuple[float, float] = (0.0, 1.0), y: tuple[float, float] = (-0.3, 0.3)) -> Array:
    i, j = np.meshgrid(np.arange(x[0] + 0.005, x[1], 0.01), np.arange(y[0] + 0.005, y[1], 0.01), indexing="ij")
    return np.column_stack([i.ravel(), j.ravel(), np.full(i.size, z)])


@given(
    points=st.lists(st.tuples(*[st.floats(-0.2, 0.2)] * 3, st.integers(1, 255)), min_size=1, max_size=60),
    cuts=st.lists(st.integers(0, 60), max_size=3),
)
@settings(max_examples=50, deadline=None)
def test_voxel_is_weighted_centroid_of_its_points(points: list[tuple[float, float, float, int]], cuts: list[int]) -> None:
    rows = np.array(points, dtype=np.float64)
    cloud = VoxelCloud(Strip((-0.3, 0.0), 0.0, 0.6, 0.6), 0.05, see_through=10.0)
    for part in np.split(rows, sorted(c for c in cuts if c < len(rows))):  # the number of scans does not matter
        cloud.insert(part[:, :3], part[:, 3])
    snapshot = cloud.snapshot()
    keys = np.floor(rows[:, :3] / 0.05)
    voxels, of = np.unique(keys, axis=0, return_inverse=True)
    assert len(snapshot.points) == len(voxels) == len(cloud)
    for k in range(len(voxels)):
        inside = rows[of.ravel() == k]
        mean = np.average(inside[:, :3], axis=0, weights=inside[:, 3])
        here = np.argmin(np.linalg.norm(snapshot.points - mean, axis=1))
        np.testing.assert_allclose(snapshot.points[here], mean, atol=1e-12)
        assert snapshot.weight[here] == inside[:, 3].sum()


def test_repeated_scan_adds_no_voxels() -> None:
    cloud, points = VoxelCloud(STRIP), ground()
    assert cloud.insert(points, ones(points)).added == len(points)
    before = cloud.snapshot().points
    again = cloud.insert(points, ones(points))
    assert (again.added, again.merged) == (0, len(points))
    np.testing.assert_allclose(cloud.snapshot().points, before, atol=1e-12)


def test_column_voxels_are_sorted_by_height() -> None:
    cloud = VoxelCloud(STRIP, see_through=10.0)
    points = np.concatenate([ground(z) for z in (0.102, -0.301, 0.055)])
    cloud.insert(points, ones(points))
    snapshot = cloud.snapshot()
    assert (np.diff(snapshot.column) >= 0).all()
    heights = snapshot.points[:, 2].reshape(-1, 3)
    np.testing.assert_allclose(heights, np.broadcast_to([-0.301, 0.055, 0.102], heights.shape))
    i, j = np.divmod(snapshot.column, snapshot.shape[1])
    centres = snapshot.origin + 0.01 * np.column_stack([i, j])
    assert np.abs(snapshot.points[:, :2] - centres).max() <= 0.005 + 1e-9


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.5])
def test_only_points_in_strip_are_kept(heading: float) -> None:
    strip = Strip((2.0, -1.0), heading, 1.0, 0.5)
    rng = np.random.default_rng(0)
    p = np.column_stack([strip.world(rng.uniform([-0.5, -0.8], [1.5, 0.8], (3000, 2))), np.zeros(3000)])
    cloud = VoxelCloud(strip, margin=0.05)
    made = cloud.insert(p, ones(p))
    inside = strip.contains(p[:, :2], 0.05)
    assert made.outside == np.count_nonzero(~inside)
    assert made.merged + made.added == np.count_nonzero(inside)
    np.testing.assert_allclose(strip.local(strip.world(p[:, :2])), p[:, :2], atol=1e-12)


def test_only_voxels_outside_moved_strip_are_dropped() -> None:
    cloud, points = VoxelCloud(STRIP), ground()
    cloud.insert(points, ones(points))
    before = cloud.snapshot()
    on = Strip((0.5, 0.0), 0.3, 1.0, 0.6)
    cloud.move_to(on)
    after = cloud.snapshot()
    kept = before.points[on.contains(before.points[:, :2], cloud.margin)]
    np.testing.assert_allclose(after.points, kept[np.lexsort((kept[:, 1], kept[:, 0]))], atol=1e-12)
    cloud.move_to(Strip((9.0, 0.0), 0.0))
    assert len(cloud) == 0


def test_voxel_count_is_bounded_and_refused_points_are_counted() -> None:
    cloud, points = VoxelCloud(STRIP, max_voxels=100), ground()
    made = cloud.insert(points, ones(points))
    assert (made.added, made.refused) == (100, len(points) - 100)
    assert cloud.insert(points[:100], np.ones(100)).merged == 100


def test_removed_block_is_cleared_after_patience_and_memory_is_reused() -> None:
    cloud, floor = VoxelCloud(STRIP, patience=3, max_voxels=7000), ground(-0.3)
    block = ground(0.05, (0.4, 0.5), (-0.05, 0.05))
    cloud.insert(floor, ones(floor))
    cloud.insert(block, ones(block))
    assert len(cloud) == len(floor) + len(block)
    removed = [cloud.insert(floor, ones(floor)).removed for _ in range(4)]
    assert removed == [0, 0, len(block), 0]
    assert len(cloud) == len(floor)
    for z in np.linspace(0.1, 0.9, 5):
        up = block + np.array([0.0, 0.0, z])
        assert cloud.insert(up, ones(up)).refused == 0
        for _ in range(3):
            cloud.insert(floor, ones(floor))
    assert len(cloud) == len(floor)


def test_intermittently_seen_edge_stays() -> None:
    cloud = VoxelCloud(STRIP, patience=3)
    top, floor = np.array([[0.505, 0.005, 0.05]]), np.array([[0.505, 0.005, -0.3]])
    for k in range(30):
        cloud.insert(top if k % 3 == 0 else floor, np.ones(1))
    assert len(cloud) == 2


@pytest.mark.parametrize(("width", "stays"), [(0.01, True), (0.03, True), (0.09, False)])
def test_top_that_overhangs_a_wall_stays(width: float, stays: bool) -> None:
    cloud, top = VoxelCloud(STRIP, patience=3), ground(0.05, (0.4, 0.6), (-0.1, 0.1))
    cloud.insert(top, ones(top))
    wall = ground(-0.1, (0.4, 0.6), (0.0, width))
    for _ in range(10):
        cloud.insert(wall, ones(wall))
    assert len(cloud) == len(wall) + len(top) - (0 if stays else len(wall))


def test_scan_counts_once_per_voxel_it_sees_through() -> None:
    cloud = VoxelCloud(STRIP, patience=3)
    top, floor = np.array([[0.505, 0.005, 0.05]]), np.tile([[0.505, 0.005, -0.3]], (10, 1))
    cloud.insert(top, np.ones(1))
    assert [cloud.insert(floor, np.ones(10)).removed for _ in range(3)] == [0, 0, 1]


def test_invalid_scan_strip_or_settings_are_refused() -> None:
    cloud, points = VoxelCloud(STRIP), ground()
    for bad, count in (
        (points[:, :2], ones(points)),
        (points, np.ones(3)),
        (points * np.nan, ones(points)),
        (points + 2e6, ones(points)),
        (points, 0 * ones(points)),
        (points, np.inf * ones(points)),
    ):
        with pytest.raises(ValueError, match="expected"):
            cloud.insert(bad, count)
    assert len(cloud) == 0
    for origin, heading, length, width in (
        ((np.nan, 0.0), 0.0, 1.0, 1.0),
        ((0.0, 0.0), np.inf, 1.0, 1.0),
        ((0.0, 0.0), 0.0, 0.0, 1.0),
        ((0.0, 0.0), 0.0, 1.0, 200.0),
    ):
        with pytest.raises(ValueError, match="expected"):
            Strip(origin, heading, length, width)
    with pytest.raises(ValueError, match="expected"):
        VoxelCloud(STRIP, 0.0)
    with pytest.raises(ValueError, match="expected"):
        VoxelCloud(STRIP, patience=0)
