"""Scan reduction: one point per cell on the upper surface.

Mixed pixels between two surfaces are dropped.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.perception.reduction.scan_reduction import reduce_scan

BLOCK = np.array([[0.9, -0.2, 0.0, 1.1, 0.2, 0.05]])


def positions(scan):
    return scan.origin + scan.points / 1000.0


def reduced(world, depth, T, **settings_):
    return reduce_scan(depth, world.intrinsics, world.sensor, T, **settings_)


def test_flat_floor_gives_one_level_point_per_seen_cell(world):
    T = world.camera_pose(0.2)
    depth = world.depth_image(T)
    scan = reduced(world, depth, T, max_points=100_000)
    p = positions(scan)
    assert np.abs(p[:, 2]).max() < 0.0015
    cells = np.floor(p[:, :2] / 0.01)
    assert len(np.unique(cells, axis=0)) == len(cells)

    # All pixels' cells, computed directly, are there, except some that only one unread pixel touched.
    points = world.intrinsics.points(depth / 1000.0).reshape(-1, 3)
    points = points[points[:, 2] > 0] @ T[:3, :3].T + T[:3, 3]
    points = points[np.hypot(*(points[:, :2] - T[:2, 3]).T) < 1.9]
    expected, found = (np.floor(xy / 0.01).astype(int) @ [100_000, 1] for xy in (points[:, :2], p[:, :2]))
    missing = np.setdiff1d(expected, found)
    assert len(missing) < 0.005 * len(np.unique(expected))


def test_cell_mean_reduces_sensor_noise(world):
    T = world.camera_pose(0.2)
    scan = reduced(world, world.depth_image(T, (), np.random.default_rng(0)), T)
    z = positions(scan)[:, 2]
    assert abs(z.mean()) < 0.0005
    assert z.std() < 0.002


def test_nearest_cells_are_kept_when_points_exceed_limit(world):
    T = world.camera_pose(0.2)
    depth = world.depth_image(T)
    every = reduced(world, depth, T, max_points=100_000)
    some = reduced(world, depth, T, max_points=3000)
    assert len(some.points) == 3000
    assert some.points.nbytes + some.count.nbytes + some.spread.nbytes <= 60_000
    distances = np.sort(np.hypot(*(positions(every)[:, :2] - T[:2, 3]).T))
    assert np.hypot(*(positions(some)[:, :2] - T[:2, 3]).T).max() < distances[2999] + 0.002


def test_edge_cells_keep_upper_surface(world):
    T = world.camera_pose(0.2)
    scan = reduced(world, world.depth_image(T, BLOCK), T, max_points=100_000)
    p = positions(scan)
    inside = (p[:, 0] > 0.905) & (p[:, 0] < 1.095) & (np.abs(p[:, 1]) < 0.195)
    assert inside.sum() > 300
    assert np.abs(p[inside, 2] - 0.05).max() < 0.003
    # The front face falls into the cells at x = 0.9, with the edge above it. Their spread shows the edge.
    face = (np.abs(p[:, 0] - 0.9) < 0.006) & (np.abs(p[:, 1]) < 0.19)
    assert np.median(scan.spread[face]) > 20
    assert p[face, 2].max() > 0.04
    floor = (p[:, 0] < 0.88) | (p[:, 0] > 1.35)
    assert np.abs(p[floor, 2]).max() < 0.002


def edge_errors(world, height, seed):
    """Return how far [m] cells of a block's height extend beyond its sides.

    The result contains separate values for the front, the back and the other two sides.
    """
    rng = np.random.default_rng(seed)
    low = np.array([0.7, -0.15]) + rng.uniform(0, 0.01, 2)
    high = low + np.array([0.2, 0.3]) + rng.uniform(0, 0.01, 2)
    T = world.camera_pose(0.2)
    scan = reduced(world, world.depth_image(T, [[*low, 0.0, *high, height]], rng), T, max_points=100_000)
    p = positions(scan)
    raised = np.floor(p[p[:, 2] > height / 2, :2] / 0.01).astype(int)
    ends = []
    for along, across in ((0, 1), (1, 0)):
        between = [k for k in np.unique(raised[:, across]) if low[across] + 0.02 < 0.01 * k < high[across] - 0.03]
        lines = [raised[raised[:, across] == k, along] for k in between]
        ends.append([low[along] - 0.01 * line.min() for line in lines])
        ends.append([0.01 * (line.max() + 1) - high[along] for line in lines])
    front, back, right, left = (np.array(e) for e in ends)
    return front, back, np.concatenate([right, left])


@pytest.mark.parametrize("height", [0.02, 0.03, 0.05])
def test_block_edges_keep_their_position(world, height):
    errors = [edge_errors(world, height, seed) for seed in range(6)]
    front, back, sides = (np.concatenate(kind) for kind in zip(*errors, strict=True))
    for kind in (front, back, sides):
        assert np.median(np.abs(kind)) < 0.006
    # A high face fills the cell below its edge with pixels. Without a minimum share, nine in ten cells would be too high.
    if height == 0.05:
        assert np.percentile(front, 90) < 0.006


@pytest.mark.parametrize("x", [0.1, 0.3, 0.5, 0.7])
def test_wall_height_is_its_highest_visible_point(world, x):
    """Check a wall whose top is outside the picture.

    The pixels of its face far outnumber the highest ones.
    """
    T = world.camera_pose(x)
    depth = world.depth_image(T, [[1.507, -2.0, 0.0, 1.6, 2.0, 0.5]], np.random.default_rng(4))
    scan = reduced(world, depth, T, max_points=100_000)
    p = positions(scan)
    face = (np.floor(p[:, 0] / 0.01) == 150) & (np.abs(p[:, 1]) < 0.2)
    assert face.sum() > 30
    highest = T[2, 3] - np.tan(0.5236 - np.arctan(239.5 / 525.0)) * (1.507 - x)  # the top of the picture, at the wall
    np.testing.assert_allclose(np.median(p[face, 2]), highest, atol=0.012)
    assert (p[face, 2] > highest - 0.02).mean() > 0.9


def test_wall_below_an_overhang_does_not_lower_its_top(world):
    """Check a pillar behind a gap, whose narrower base is seen from the side, in more pixels than the top."""
    T = world.camera_pose(0.2)
    T[2, 3] += 0.4
    platform, pillar = [0.0, -1.0, 0.0, 0.5, 1.0, 0.4], [[0.7, 0.05, 0.36, 0.9, 0.25, 0.4], [0.75, 0.1, 0.0, 0.85, 0.2, 0.36]]
    scan = reduced(world, world.depth_image(T, [platform, *pillar]), T, max_points=100_000)
    p = positions(scan)
    inside = (np.abs(p[:, 0] - 0.8) < 0.085) & (np.abs(p[:, 1] - 0.15) < 0.085)
    assert np.count_nonzero(scan.spread[inside] > 30) > 40, "cells with both"
    assert np.count_nonzero(np.abs(p[inside, 2] - 0.4) > 0.003) < 4, "only the corner of the base, with walls on two sides"


def test_few_outlier_pixels_do_not_raise_cell(world):
    T = world.camera_pose(0.2)
    depth = world.depth_image(T)
    rows, columns = np.mgrid[100:220:12, 20:620:12]
    depth[rows, columns] = (depth[rows, columns] * 0.9).astype(np.uint16)
    scan = reduced(world, depth, T, max_points=100_000)
    enough = scan.count > 4
    assert (scan.spread[enough] > 15).sum() > 20
    assert np.abs(positions(scan)[enough, 2]).max() < 0.003


def test_mixed_pixels_between_surfaces_are_dropped(world):
    T = world.camera_pose(0.2)
    clean = world.depth_image(T, BLOCK)
    mixed = mixed_at_edges(clean)
    assert (mixed != clean).sum() > 200
    p_clean, p = (positions(reduced(world, d, T, max_points=100_000)) for d in (clean, mixed))
    behind = (p[:, 0] > 1.105) & (p[:, 0] < 1.4) & (np.abs(p[:, 1]) < 0.25)
    assert np.abs(p[behind, 2]).max() < 0.003
    assert len(p) > 0.99 * len(p_clean)


def mixed_at_edges(depth):
    """Return a picture with mixed pixels, as a real camera makes them.

    At each jump along a row or a column, a pixel has the mean of both sides.
    """
    mixed = depth.copy()
    for axis in (0, 1):
        before, after = depth.astype(int), np.roll(depth.astype(int), -1, axis)
        edge = (np.abs(after - before) > 40) & (before > 0) & (after > 0)
        mixed[edge] = ((before + after) // 2)[edge]
    return mixed


def rms_off_edges(p, block):
    """Return the RMS height error [m] of points at least 2 cm from a block's sides."""
    x0, y0, _, x1, y1, top = block
    outside = np.maximum.reduce([x0 - p[:, 0], p[:, 0] - x1, y0 - p[:, 1], p[:, 1] - y1])
    off = np.abs(outside) > 0.02
    truth = np.where(outside < 0, top, 0.0)
    return np.sqrt(np.mean((p[off, 2] - truth[off]) ** 2))


@pytest.mark.parametrize("top", [0.08, 0.15])
def test_mixed_pixels_do_not_increase_error_away_from_edges(world, top):
    """Check that mixed pixels do not make the map worse away from edges.

    The plain mean of every cell's pixels would be worse.
    """
    T, block = world.camera_pose(0.3), [0.8, -0.2, 0.0, 1.1, 0.2, top]
    clean = world.depth_image(T, [block], np.random.default_rng(3))
    mixed = mixed_at_edges(clean)
    filtered, undisturbed = (positions(reduced(world, d, T, max_points=100_000)) for d in (mixed, clean))
    points = world.intrinsics.points(mixed / 1000.0).reshape(-1, 3)
    points = points[points[:, 2] > 0] @ T[:3, :3].T + T[:3, 3]
    points = points[np.linalg.norm(points[:, :2] - T[:2, 3], axis=1) < 2.0]
    _, cell, n = np.unique(np.floor(points[:, :2] / 0.01), axis=0, return_inverse=True, return_counts=True)
    plain = np.stack([np.bincount(cell.ravel(), c) / n for c in points.T], axis=1)
    assert rms_off_edges(filtered, block) < 1.1 * rms_off_edges(undisturbed, block)
    assert rms_off_edges(plain, block) > 1.5 * rms_off_edges(filtered, block)


def test_cells_with_single_grazing_pixel_are_kept(world):
    T = world.camera_pose(0.0)
    scan = reduced(world, world.depth_image(T), T, max_range=2.5, max_points=100_000)
    far = np.hypot(*(positions(scan)[:, :2] - T[:2, 3]).T) > 2.0
    assert far.sum() > 500
    assert scan.count[far].min() == 1


def test_max_range_and_ceiling_are_applied(world):
    T = world.camera_pose(0.2)
    wall = np.array([[1.5, -2.0, 0.0, 1.6, 2.0, 2.0]])
    depth = world.depth_image(world.camera_pose(0.2, pitch=0.2), wall)
    T = world.camera_pose(0.2, pitch=0.2)
    low = positions(reduced(world, depth, T, ceiling=0.1, max_points=100_000))
    assert low[:, 2].max() <= 0.351
    near = positions(reduced(world, depth, T, max_range=1.0, max_points=100_000))
    assert np.hypot(*(near[:, :2] - T[:2, 3]).T).max() < 1.002


def test_reduction_is_invariant_to_shift_by_whole_cells(world):
    depth = world.depth_image(world.camera_pose(0.2), BLOCK, np.random.default_rng(1))
    a = reduced(world, depth, world.camera_pose(0.2))
    b = reduced(world, depth, world.camera_pose(100.2, -50.0))
    np.testing.assert_allclose(b.origin - a.origin, [100.0, -50.0, 0.0], atol=1e-9)
    assert np.abs(a.points.astype(int) - b.points.astype(int)).max() <= 1


def test_reduction_is_deterministic(world):
    T = world.camera_pose(0.2)
    depth = world.depth_image(T, BLOCK, np.random.default_rng(1))
    a, b = (reduced(world, depth, T) for _ in range(2))
    assert a.points.tobytes() + a.count.tobytes() == b.points.tobytes() + b.count.tobytes()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), low=st.integers(0, 65535), share=st.floats(0, 1))
def test_any_image_is_reduced(world, seed, low, share):
    rng = np.random.default_rng(seed)
    depth = rng.integers(low, 65536, (480, 640)).astype(np.uint16)
    depth[rng.random(depth.shape) < share] = 0
    scan = reduced(world, depth, world.camera_pose(0.0))
    assert len(scan.points) == len(scan.count) == len(scan.spread) <= 20_000
    assert (scan.count > 0).all()


def test_an_empty_image_gives_no_points(world):
    scan = reduced(world, np.zeros((480, 640), np.uint16), world.camera_pose(0.0))
    assert scan.points.shape == (0, 3)


def test_invalid_arguments_are_refused(world):
    depth, T = np.zeros((480, 640), np.uint16), world.camera_pose(0.0)
    with pytest.raises(ValueError, match="uint16 depth image"):
        reduced(world, depth.T, T)
    with pytest.raises(ValueError, match="finite"):
        reduced(world, depth, np.full((4, 4), np.inf))
    with pytest.raises(ValueError, match="max_range"):
        reduced(world, depth, T, max_range=1000.0)
