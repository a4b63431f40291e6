"""Vertical surfaces: a wall keeps its highest measured top until it is removed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from sextant.services.mapper.elevation.vertical_surfaces import RIM, TALL
from sextant.shared.geometry import Array

CAMERA = np.array([0.0, 0.0, 0.26])
WALL_X = 0.805  # [m] x of the cells that contain the wall's face
ACROSS = np.arange(-0.095, 0.1, 0.01)  # [m]
BEFORE = np.arange(0.605, 0.80, 0.01)
BEYOND = np.arange(0.815, 1.0, 0.01)


def ground(x: NDArray[np.float64]) -> Array:
    """Return points (n, 4) x, y, z and spread [m] of flat ground at z = 0."""
    xy = np.stack(np.meshgrid(x, ACROSS, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, np.zeros((len(xy), 2))])


def face(top: float) -> Array:
    """Return points (n, 4) of the part of the wall that is in the picture.

    The highest part in the picture, `top` [m], sets the points' height and spread.
    """
    column = ground(np.array([WALL_X]))
    column[:, 2:] = top - 0.004, top
    return column


def see(grid: ElevationGrid, *parts: Array, covariance: Array | None = None, camera: Array = CAMERA) -> None:
    points = np.vstack(parts)
    grid.fuse(ValidatedScan.of(points[:, :3], np.full(len(points), 6), points[:, 3], camera, covariance))


def wall_of(grid: ElevationGrid) -> Array:
    return grid.heights(np.column_stack([np.full(len(ACROSS), WALL_X), ACROSS]))


@settings(deadline=None, max_examples=40)
@given(
    tops=st.lists(st.floats(0.02, 0.3), min_size=1, max_size=12),
    feet=st.integers(0, 20),
    assumed=st.booleans(),
)
def test_wall_keeps_its_highest_measured_top(tops: list[float], feet: int, assumed: bool) -> None:
    grid = ElevationGrid(size=256)
    if assumed:
        grid.seed_plane([[0.3, -0.5], [1.2, -0.5], [1.2, 0.5], [0.3, 0.5]], [0.0, 0.0, 0.0])
    highest = TALL + 2 * RIM
    see(grid, ground(BEFORE), face(highest))
    for top in tops:
        see(grid, ground(BEFORE), face(top))
        highest = max(highest, top)
        assert wall_of(grid).min() > highest - RIM - 0.004
    for _ in range(feet):  # of the cells with the face, only the ground in front of it is in the picture
        see(grid, ground(np.append(BEFORE, WALL_X)))
    assert wall_of(grid).min() > highest - RIM - 0.004
    assert np.abs(grid.heights(np.column_stack([BEFORE, np.zeros(len(BEFORE))]))).max() < 0.001


def test_removed_wall_is_cleared_once_ground_around_is_seen() -> None:
    grid = ElevationGrid(size=256)
    for _ in range(30):
        see(grid, ground(BEFORE), face(0.15))
    for _ in range(8):
        see(grid, ground(np.concatenate([BEFORE, [WALL_X], BEYOND])))
    assert np.abs(wall_of(grid)[1:-1]).max() < 0.001


@pytest.mark.parametrize("looks", [1, 30])
def test_new_wall_is_mapped_within_patience(looks: int) -> None:
    grid = ElevationGrid(size=256)
    for _ in range(looks):
        see(grid, ground(np.concatenate([BEFORE, [WALL_X], BEYOND])))
    for _ in range(grid.model.patience):
        see(grid, ground(BEFORE), face(0.15))
    np.testing.assert_allclose(wall_of(grid), 0.146, atol=0.002)


def test_block_rim_stays_at_known_top_height() -> None:
    grid = ElevationGrid(size=256)
    top = ground(np.append(WALL_X, BEYOND))
    top[:, 2] = 0.10
    for _ in range(10):
        see(grid, ground(BEFORE), top)
    for shown in (0.10, 0.08, 0.05):
        see(grid, ground(BEFORE), face(shown))
    np.testing.assert_allclose(wall_of(grid), 0.10, atol=0.001)


def test_low_riser_or_uncertain_pose_gives_no_vertical_surface() -> None:
    for spread, sigma in ((0.05, 0.0), (0.15, 0.10)):
        grid = ElevationGrid(size=256)
        covariance = np.diag([sigma**2] * 3 + [0.0] * 3)
        see(grid, ground(BEFORE), face(spread), covariance=covariance)
        see(grid, ground(np.append(BEFORE, WALL_X)))
        assert np.abs(wall_of(grid)).max() < 0.005


def post(x: float, top: float) -> Array:
    """Return points (4, 4) of the part of a post, 2 cm wide, that is in the picture.

    Its near side is at x.
    """
    xy = np.array([[x + a, b] for a in (0.0, 0.01) for b in (-0.005, 0.005)])
    return np.column_stack([xy, np.full(4, top - 0.004), np.full(4, top)])


@pytest.mark.parametrize("apart", [0.015, 0.03, 0.05])
def test_removed_post_is_cleared_by_scan_rows_that_skip_cells(apart: float) -> None:
    grid = ElevationGrid(size=256)
    for _ in range(8):
        see(grid, ground(BEFORE), post(WALL_X, 0.3))
    assert grid.heights([WALL_X, 0.005]) > 0.29
    for k in range(60):  # the robot walks 3 mm per scan
        rows = np.arange(0.6, 1.0, apart) + 0.003 * k % apart
        see(grid, ground(rows))
    around = np.stack(np.meshgrid(WALL_X + np.arange(-1, 3) * 0.01, ACROSS), axis=-1)
    assert np.nanmax(grid.heights(around)) < 0.005


def test_thin_wall_seen_from_both_sides_stays() -> None:
    grid = ElevationGrid(size=256)
    for _ in range(4):
        for side, x in ((BEFORE, 0.0), (BEYOND, 2.0 * WALL_X)):
            camera = np.array([x, 0.0, CAMERA[2]])
            see(grid, ground(side), face(0.15), camera=camera)
            for _ in range(6):  # from close by, only the ground in front of the wall is in view
                see(grid, ground(np.append(side, WALL_X)), camera=camera)
    assert wall_of(grid).min() > 0.12


def test_post_that_occludes_ground_stays_when_only_its_foot_is_seen() -> None:
    grid = ElevationGrid(size=256)
    see(grid, ground(BEFORE), post(WALL_X, 0.3))
    near = ground(np.concatenate([BEFORE, [WALL_X], BEYOND]))
    behind, beside = near[:, 0] - WALL_X, near[:, 1]
    for askew in (0.0, 0.5, 1.0):
        hidden = (behind > 0.005) & (np.abs(beside - askew * (behind - 0.01)) < 0.016 + 0.012 * askew)
        camera = np.array([0.0, -askew * WALL_X, CAMERA[2]])
        for _ in range(10):
            see(grid, near[~hidden], camera=camera)
        assert grid.heights(post(WALL_X, 0.3)[:, :2]).min() > 0.29


def window_edges() -> tuple[ElevationGrid, Array, Array]:
    """Return a grid that wraps inside its window, and its edge rows.

    The rows are the first and the last one of the window, as cells (n, 2) [m].
    """
    grid = ElevationGrid(size=32)
    grid.move_to([0.105, 0.0])
    y = grid.origin[1] + 0.01 * np.arange(32)
    first, last = (np.column_stack([np.full(32, grid.origin[0] + 0.01 * i), y]) for i in (0, 31))
    return grid, first, last


def test_wall_at_window_edge_ignores_high_ground_at_opposite_edge() -> None:
    grid, first, last = window_edges()
    shelf = np.vstack([first, first + np.array([0.01, 0.0]), first + np.array([0.02, 0.0])])
    high = np.column_stack([shelf, np.full((len(shelf), 1), 0.2), np.zeros((len(shelf), 1))])
    wall = np.column_stack([last, np.full((32, 1), 0.146), np.full((32, 1), 0.15)])
    foot = np.column_stack([last, np.zeros((32, 2))])
    for _ in range(10):
        see(grid, high)
    see(grid, wall)
    for _ in range(10):
        see(grid, high, foot)
    assert grid.heights(last).min() > 0.14


def test_low_ground_at_opposite_window_edge_clears_no_wall() -> None:
    grid, first, last = window_edges()
    wall = np.column_stack([last, np.full((32, 1), 0.146), np.full((32, 1), 0.15)])
    low = np.vstack([np.column_stack([p, np.zeros((32, 2))]) for p in (first, last - [0.01, 0.0], last)])
    see(grid, wall)
    for _ in range(10):
        see(grid, low)
    assert grid.heights(last).min() > 0.14
