"""Moving window of the map: cells keep their places until they leave the window."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from tests.support.grid_scans import centres, scan


def test_snapshot_cells_match_their_coordinates() -> None:
    grid = ElevationGrid(size=32)
    grid.move_to((-3.217, 12.34))
    xy = centres(grid)
    z = np.random.default_rng(1).normal(size=len(xy))
    scan(grid, xy, z)
    snapshot = grid.snapshot()
    np.testing.assert_allclose(snapshot.elevation.ravel(), z, rtol=1e-6)
    np.testing.assert_allclose(grid.heights(xy), z, rtol=1e-6)
    np.testing.assert_allclose(snapshot.origin, grid.origin)
    assert np.abs(snapshot.origin + (np.array(grid.shape) / 2) * grid.resolution - (-3.217, 12.34)).max() <= grid.resolution


coordinate = st.floats(-0.6, 0.6).map(lambda x: round(x, 3))

waypoints = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=8)


@pytest.mark.slow
@given(waypoints, st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_only_cells_outside_moved_window_are_cleared(path: list[tuple[float, float]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = ElevationGrid(size=12, resolution=0.05)
    expected: dict[tuple[int, int], float] = {}
    for target in path:
        grid.move_to(target)
        low = np.floor(np.array(target) / 0.05).astype(int) - 6
        expected = {c: z for c, z in expected.items() if all(0 <= c[a] - low[a] < 12 for a in range(2))}
        for cell in rng.integers(low, low + 12, (20, 2)):
            if (key := (int(cell[0]), int(cell[1]))) not in expected:
                expected[key] = 1e-3 * float(rng.normal())  # so level that no ray passes below a cell
                scan(grid, (cell[None] + 0.5) * 0.05, expected[key])
        elevation = grid.snapshot().elevation
        wanted = np.full((12, 12), np.nan)
        for (i, j), z in expected.items():
            wanted[i - low[0], j - low[1]] = z
        np.testing.assert_allclose(elevation, wanted, rtol=1e-6)


@given(
    st.tuples(st.integers(8, 40), st.integers(8, 40)),
    st.sampled_from([0.005, 0.01, 0.02, 0.05, 0.3]),
    st.lists(st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0)), min_size=1, max_size=4),
)
@settings(deadline=None)
def test_cells_match_coordinates_at_any_shape_and_resolution(
    shape: tuple[int, int], resolution: float, path: list[tuple[float, float]]
) -> None:
    grid = ElevationGrid(shape, resolution)
    for target in path:
        grid.move_to(target)
    xy = centres(grid)
    z = np.random.default_rng(len(xy)).normal(size=len(xy))
    assert scan(grid, xy, z).outside == 0
    np.testing.assert_allclose(grid.snapshot().elevation, z.reshape(shape), rtol=1e-5)
    np.testing.assert_allclose(grid.heights(xy), z, rtol=1e-5)
    inside = np.array(path[-1]) - grid.origin
    assert (np.abs(inside / resolution - np.array(shape) // 2) <= 0.5 + 1e-6).all()
    np.testing.assert_allclose(grid.origin, (grid.low + 0.5) * resolution)


@given(st.tuples(coordinate, coordinate), st.lists(st.floats(0.0, 1.0), max_size=6))
@settings(deadline=None)
def test_move_in_several_steps_equals_direct_move(target: tuple[float, float], fractions: list[float]) -> None:
    snapshots = []
    for stops in ([], sorted(fractions)):
        grid = ElevationGrid(size=16, resolution=0.05)
        scan(grid, centres(grid), np.linspace(0.0, 2.55, 256))
        for fraction in stops:
            grid.move_to(np.array(target) * fraction)
        grid.move_to(target)
        snapshots.append(grid.snapshot())
    np.testing.assert_array_equal(snapshots[0].elevation, snapshots[1].elevation)
    np.testing.assert_array_equal(snapshots[0].variance, snapshots[1].variance)
    np.testing.assert_array_equal(snapshots[0].origin, snapshots[1].origin)


def test_cell_that_reenters_window_is_empty() -> None:
    grid = ElevationGrid(size=16)
    xy = centres(grid)
    for _ in range(10):
        scan(grid, xy, 0.0)
    for _ in range(3):
        scan(grid, xy, 0.3)  # rivals below the number of votes they need
    grid.move_to((5.0, 5.0))
    assert np.isnan(grid.snapshot().elevation).all()
    grid.move_to((0.0, 0.0))
    assert np.isnan(grid.snapshot().elevation).all()
    scan(grid, xy, 0.1)
    scan(grid, xy, 0.3)
    np.testing.assert_allclose(grid.heights(xy), 0.1, atol=1e-6)


def test_snapshot_is_independent_of_grid() -> None:
    grid = ElevationGrid(size=16)
    scan(grid, centres(grid), 0.0)
    snapshot = grid.snapshot()
    grid.move_to((9.0, 9.0))
    assert (snapshot.elevation == 0.0).all()
