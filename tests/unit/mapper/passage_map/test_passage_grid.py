"""Passage grid: heights, normals and roughness of the cloud in a turned frame.

Unknown cells stay unknown.
"""

import numpy as np
import pytest

from sextant.services.mapper.elevation.start_ground import feet_plane
from sextant.services.mapper.passage_map.passage_grid import (
    PassageGrid,
    cell_centres,
    close_thin_holes,
    local_centres,
    passage_grid,
    with_assumed,
)
from sextant.services.mapper.passage_map.voxel_cloud import Strip, VoxelCloud
from sextant.shared.geometry import Array

HEADINGS = [0.0, 0.5, -2.2]
SLOPE = np.array([0.2, -0.1])  # [m/m] along x and y


def strip(heading: float, length: float = 0.8, width: float = 0.5) -> Strip:
    return Strip((0.3, -0.2), heading, length, width)


def ground(where: Strip, height: object = 0.0) -> Array:
    """Return a random point in each {world} cell on and around a strip, as in scans."""
    rng = np.random.default_rng(0)
    low, high = where.corners(0.06).min(axis=0), where.corners(0.06).max(axis=0)
    i, j = np.meshgrid(
        np.arange(*np.floor([low[0], high[0]] / np.array(0.01))), np.arange(*np.floor([low[1], high[1]] / np.array(0.01)))
    )
    xy = (np.column_stack([i.ravel(), j.ravel()]) + rng.uniform(0.1, 0.9, (i.size, 2))) * 0.01
    z = height(xy) if callable(height) else np.full(len(xy), height)
    return np.column_stack([xy, z])


def cloud_of(where: Strip, *clouds: Array) -> VoxelCloud:
    cloud = VoxelCloud(where, see_through=10.0)
    for points in clouds:
        cloud.insert(points, np.ones(len(points)))
    return cloud


@pytest.mark.parametrize("heading", HEADINGS)
def test_slope_is_mapped_exactly_at_any_strip_heading(heading: float) -> None:
    where = strip(heading)
    grid = passage_grid(cloud_of(where, ground(where, lambda xy: 0.1 + xy @ SLOPE)).snapshot(), where, 0.01)
    assert grid.elevation.shape == (80, 50)
    np.testing.assert_allclose(grid.elevation, 0.1 + cell_centres(where, 0.01) @ SLOPE, atol=1e-6)
    normal = np.array([*-SLOPE, 1.0]) / np.linalg.norm([*SLOPE, 1.0])
    np.testing.assert_allclose(grid.normals, np.broadcast_to(normal, grid.normals.shape), atol=1e-5)
    assert grid.roughness.max() < 1e-6
    assert not grid.assumed.any()
    assert not grid.unseen.any()


@pytest.mark.parametrize("heading", HEADINGS)
def test_cell_has_height_and_normal_of_topmost_surface(heading: float) -> None:
    where = strip(heading)
    floor = ground(where, lambda xy: -0.3 + xy @ SLOPE)
    near = np.abs(where.local(floor[:, :2]) - [0.4, 0.0]).max(axis=1) < 0.1
    pillar = np.column_stack([floor[near, :2], np.full(np.count_nonzero(near), 0.02)])
    grid = passage_grid(cloud_of(where, floor, pillar).snapshot(), where, 0.01)
    on = np.abs(local_centres(where, 0.01) - [0.4, 0.0]).max(axis=-1)
    np.testing.assert_allclose(grid.elevation[on < 0.085], 0.02, atol=1e-6)
    np.testing.assert_allclose(
        grid.normals[on < 0.085], np.broadcast_to([0.0, 0.0, 1.0], (np.count_nonzero(on < 0.085), 3)), atol=1e-5
    )
    beside = cell_centres(where, 0.01)[on > 0.115]
    np.testing.assert_allclose(grid.elevation[on > 0.115], -0.3 + beside @ SLOPE, atol=1e-6)


def test_surface_of_few_pixels_above_ground_is_ignored() -> None:
    where = strip(0.0)
    floor = ground(where)
    few = np.abs(where.local(floor[:, :2]) - [0.4, 0.0]).max(axis=1) < 0.1
    over = floor[few] + np.array([0.0, 0.0, 0.08])
    for pixels, height in ((3.0, 0.0), (10.0, 0.08)):
        cloud = cloud_of(where)
        cloud.insert(floor, np.full(len(floor), 10.0))
        cloud.insert(over, np.full(len(over), pixels))
        grid = passage_grid(cloud.snapshot(), where, 0.01)
        on = np.abs(local_centres(where, 0.01) - [0.4, 0.0]).max(axis=-1) < 0.085
        np.testing.assert_allclose(grid.elevation[on], height, atol=1e-6)


def test_top_with_few_pixels_over_a_wall_is_the_height_of_the_surface_around_it() -> None:
    where = strip(0.0)
    top = ground(where)
    wall = top[np.abs(where.local(top[:, :2])[:, 1]) < 0.01] - np.array([0.0, 0.0, 0.14])
    cloud = cloud_of(where, top)
    cloud.insert(wall, np.full(len(wall), 10.0))
    np.testing.assert_allclose(passage_grid(cloud.snapshot(), where, 0.01).elevation, 0.0, atol=1e-6)


@pytest.mark.parametrize("heading", [0.0, np.pi / 4, -np.pi / 2])
def test_crack_between_blocks_is_unknown_despite_stray_pixels(heading: float) -> None:
    where = Strip((0.3, -0.2), heading, 0.8, 0.5)
    top = ground(where)
    along = where.local(top[:, :2])[:, 0]
    in_crack, beyond = np.abs(along - 0.4) < 0.01, along > 0.6
    cloud = VoxelCloud(where, see_through=10.0)
    cloud.insert(top[~in_crack & ~beyond], np.full(np.count_nonzero(~in_crack & ~beyond), 100.0))
    cloud.insert(top[in_crack | beyond], np.full(np.count_nonzero(in_crack | beyond), 20.0))
    grid = passage_grid(cloud.snapshot(), where, 0.01)
    x = local_centres(where, 0.01)[..., 0]
    inside = np.abs(x - 0.4) < 0.006
    assert grid.unseen[inside].mean() > 0.85
    assert not grid.unseen[np.abs(x - 0.4) > 0.03].any(), "neither an edge nor thinner ground is a crack"


def top_with(cells: object, height: float) -> PassageGrid:
    """Return the map of a top at height 0 that rises by 5 % along x, with cells at another height [m]."""
    where = strip(0.0)
    slope = 0.05 * local_centres(where, 0.01)[..., 0]
    normal = np.array([-0.05, 0.0, 1.0], np.float32) / np.float32(np.hypot(1.0, 0.05))
    normals = np.broadcast_to(normal, (*slope.shape, 3)).copy()
    elevation, roughness = slope.astype(np.float32), np.full(slope.shape, 0.001, np.float32)
    elevation[cells] = height  # type: ignore[index]
    if np.isnan(height):
        normals[cells], roughness[cells] = np.nan, np.nan  # type: ignore[index]
    return PassageGrid(where, 0.01, elevation, normals, roughness, np.zeros(slope.shape, np.bool_))


LINE = (np.array([20, 21, 22, 23, 24, 25]), np.array([10, 10, 11, 12, 12, 12]))


@pytest.mark.parametrize("height", [np.nan, -0.1])
def test_hole_a_cell_wide_in_a_top_is_closed(height: float) -> None:
    closed, firm = close_thin_holes(top_with(LINE, height)), top_with(np.s_[:0], 0.0)
    np.testing.assert_allclose(closed.elevation, firm.elevation, atol=4e-4)
    np.testing.assert_allclose(closed.normals, firm.normals, atol=1e-6)
    np.testing.assert_allclose(closed.roughness, firm.roughness, atol=1e-6)
    for layer in (closed.elevation, closed.normals, closed.roughness):
        assert (layer.dtype, layer.flags.c_contiguous) == (np.float32, True), "compiled functions expect such arrays"


@pytest.mark.parametrize("height", [np.nan, -0.1])
@pytest.mark.parametrize(
    "cells",
    [
        pytest.param(np.s_[20:22, 10:12], id="two cells wide"),
        pytest.param(np.s_[20:30, 10:14], id="wide"),
        pytest.param(np.s_[40, :], id="crack from edge to edge"),
        pytest.param(np.s_[75:, 20], id="leads out of the strip"),
    ],
)
def test_hole_that_a_foot_may_enter_stays(cells: object, height: float) -> None:
    grid = top_with(cells, height)
    assert close_thin_holes(grid) is grid


def test_crack_between_tops_of_different_heights_stays() -> None:
    grid = top_with(np.s_[30:40, 20:30], 0.05)
    grid.elevation[29, 20:30] = np.nan
    assert close_thin_holes(grid) is grid
    shallow = top_with(LINE, -0.02)
    assert close_thin_holes(shallow) is shallow, "a step down is no hole"


def test_unseen_cells_are_unknown() -> None:
    where = strip(0.7)
    points = ground(where)
    local = where.local(points[:, :2])
    seen = np.hypot(local[:, 0] - 0.4, local[:, 1]) > 0.1
    grid = passage_grid(cloud_of(where, points[seen]).snapshot(), where, 0.01)
    hole = np.hypot(*np.moveaxis(local_centres(where, 0.01) - [0.4, 0.0], -1, 0))
    assert grid.unseen[hole < 0.085].all()
    assert not grid.unseen[hole > 0.115].any()
    assert np.isnan(grid.normals[grid.unseen]).all()
    nothing = passage_grid(cloud_of(where).snapshot(), where, 0.01)
    assert nothing.unseen.all()
    assert not nothing.assumed.any()


def test_isolated_point_has_height_but_no_normal() -> None:
    where = strip(0.0)
    grid = passage_grid(cloud_of(where, np.array([[0.505, -0.195, 0.1]])).snapshot(), where, 0.01)
    assert np.count_nonzero(~grid.unseen) == 1
    np.testing.assert_allclose(grid.elevation[~grid.unseen], 0.1)
    assert np.isnan(grid.normals).all()
    assert np.isnan(grid.roughness).all()


def test_noise_is_reduced_and_reported_as_roughness() -> None:
    where, rng, sigma = strip(0.0), np.random.default_rng(1), 0.002
    clouds = [ground(where) for _ in range(4)]
    for points in clouds:
        points[:, 2] = rng.normal(0.005, sigma, len(points))
    grid = passage_grid(cloud_of(where, *clouds).snapshot(), where, 0.01)
    assert np.std(grid.elevation) < sigma / 2
    assert abs(np.mean(grid.elevation) - 0.005) < sigma / 4
    assert 0.2 * sigma < np.median(grid.roughness) < sigma


@pytest.mark.parametrize("heading", HEADINGS)
def test_foot_plane_fills_only_unknown_cells(heading: float) -> None:
    where = strip(heading)
    points = ground(where, 0.05)
    ahead = where.local(points[:, :2])[:, 0] > 0.5
    grid = passage_grid(cloud_of(where, points[ahead]).snapshot(), where, 0.01)
    feet = np.column_stack([where.world([[0.1, 0.2], [0.1, -0.2], [0.3, 0.2], [0.3, -0.2]]), np.zeros(4)])
    feet[:, 2] = 0.02 + feet[:, :2] @ SLOPE
    a, *slope = feet_plane(feet)
    centres = cell_centres(where, 0.01)
    plane = np.where(local_centres(where, 0.01)[..., 0] < 0.6, a + centres @ slope, np.nan)
    filled = with_assumed(grid, plane)
    near, known = local_centres(where, 0.01)[..., 0] < 0.485, ~grid.unseen
    assert filled.assumed[near].all()
    np.testing.assert_array_equal(filled.assumed, grid.unseen & np.isfinite(plane))
    np.testing.assert_allclose(filled.elevation[near], 0.02 + centres[near] @ SLOPE, atol=1e-6)
    np.testing.assert_array_equal(filled.elevation[known], grid.elevation[known])
    normal = np.array([*-SLOPE, 1.0]) / np.linalg.norm([*SLOPE, 1.0])
    np.testing.assert_allclose(filled.normals[near], np.broadcast_to(normal, (np.count_nonzero(near), 3)), atol=1e-5)
    assert with_assumed(grid, np.full(grid.elevation.shape, np.nan)) is grid


def test_invalid_strip_and_plane_are_refused() -> None:
    with pytest.raises(ValueError, match="whole cells"):
        cell_centres(Strip((0.0, 0.0), 0.0, 1.005, 1.0), 0.01)
    with pytest.raises(ValueError, match="whole cells"):
        cell_centres(Strip((0.0, 0.0), 0.0, 0.001, 1.0), 0.01)
    where = strip(0.0)
    grid = passage_grid(cloud_of(where).snapshot(), where, 0.01)
    with pytest.raises(ValueError, match="expected"):
        with_assumed(grid, np.zeros((3, 3)))
