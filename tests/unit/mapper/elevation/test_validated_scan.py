"""Validation of scans: empty or outside scans do nothing, bad ones are refused."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid, FusionCount
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from tests.support.grid_scans import CAMERA, scan, scan_of


def test_points_outside_window_are_counted_and_ignored() -> None:
    grid = ElevationGrid(size=16)
    report = scan(grid, np.array([[0.0, 0.0], [0.5, 0.0], [0.0, -0.081], [900.0, 900.0]]), 0.01)
    assert report.outside == 3
    assert np.count_nonzero(~np.isnan(grid.snapshot().elevation)) == 1
    assert np.isnan(grid.heights([[0.5, 0.0], [np.nan, 0.0], [np.inf, 0.0], [1e300, 0.0]])).all()


def test_empty_scan_changes_nothing() -> None:
    grid = ElevationGrid(size=16)
    assert grid.fuse(scan_of(np.empty((0, 3)), np.empty(0), np.empty(0), CAMERA)) == FusionCount(0, 0, 0, 0)


@given(
    st.lists(
        st.tuples(
            st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-1e5, 1e5), st.integers(1, 10**6), st.floats(0.0, 10.0)
        ),
        max_size=30,
    ),
    st.floats(0.0, 1.0),
)
@settings(deadline=None)
def test_any_finite_scan_keeps_map_consistent(rows: list[tuple[float, float, float, int, float]], pose: float) -> None:
    grid = ElevationGrid(size=16)
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    for _ in range(8):
        report = grid.fuse(scan_of(table[:, :3], table[:, 3], table[:, 4], CAMERA, pose_covariance=pose * np.eye(6)))
        cells = len(np.unique(np.floor(table[:, :2] / 0.01)[(grid.heights(table[:, :2]) > -np.inf)], axis=0))
        assert report.updated + report.disputed == cells
    snapshot = grid.snapshot()
    seen = ~np.isnan(snapshot.elevation)
    assert np.count_nonzero(seen) == cells
    assert (snapshot.variance[seen] >= grid.model.floor_sigma**2 * (1 - 1e-6)).all()
    assert np.isfinite(snapshot.variance[seen]).all()
    if seen.any():
        assert snapshot.elevation[seen].max() <= table[:, 2].max() + 1e-2
        assert snapshot.elevation[seen].min() >= table[:, 2].min() - 1e-2


GOOD = (np.zeros((2, 3)), np.ones(2), np.zeros(2), np.zeros(3))


@pytest.mark.parametrize(
    ("index", "bad"),
    [
        (0, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.nan]])),
        (0, np.array([[0.0, np.inf, 0.0], [0.0, 0.0, 0.0]])),
        (0, np.array([[-1e300, 0.0, 0.0], [0.0, 0.0, 0.0]])),
        (0, np.zeros((2, 2))),
        (1, np.ones(3)),
        (1, np.array([1.0, 0.0])),
        (1, np.array([1.0, np.nan])),
        (2, np.array([0.0, -1e-3])),
        (2, np.array([np.inf, 0.0])),
        (3, np.array([0.0, np.nan, 0.0])),
        (3, np.zeros(2)),
    ],
)
def test_invalid_scan_is_refused_and_map_stays_unchanged(index: int, bad: NDArray[np.float64]) -> None:
    grid = ElevationGrid(size=16)
    arguments = list(GOOD)
    arguments[index] = bad
    with pytest.raises(ValueError, match="expected"):
        grid.fuse(scan_of(*arguments))
    assert np.isnan(grid.snapshot().elevation).all()


def test_invalid_pose_covariance_is_refused() -> None:
    grid = ElevationGrid(size=16)
    with pytest.raises(ValueError, match="negative eigenvalue"):
        grid.fuse(scan_of(*GOOD, pose_covariance=-np.eye(6)))
    with pytest.raises(ValueError, match="pose covariance"):
        grid.fuse(scan_of(*GOOD, pose_covariance=np.full((6, 6), np.nan)))


WIRE = (np.zeros(3), np.zeros((2, 3), np.int16), np.ones(2, np.uint8), np.zeros(2, np.uint8), np.zeros(3))


@pytest.mark.parametrize(
    ("index", "bad"),
    [
        (0, np.array([0.0, np.nan, 0.0])),
        (0, np.zeros(2)),
        (1, np.zeros((2, 3))),
        (1, np.zeros((2, 2), np.int16)),
        (2, np.array([1, 0], np.uint8)),
        (2, np.ones(3, np.uint8)),
        (2, np.ones(2)),
        (3, np.zeros(1, np.uint8)),
        (4, np.array([0.0, 1e300, 0.0])),
    ],
)
def test_invalid_millimetre_scan_is_refused(index: int, bad: NDArray[Any]) -> None:
    arguments: list[Any] = list(WIRE)
    arguments[index] = bad
    with pytest.raises(ValueError, match="expected"):
        ValidatedScan.of_millimetres(*arguments)


@pytest.mark.slow
def test_millimetre_scan_gives_same_map_as_metre_scan() -> None:
    rng = np.random.default_rng(4)
    metres, wire = ElevationGrid(64), ElevationGrid(64)
    origin, camera = np.array([0.02, -0.01, 0.3]), np.array([-0.2, 0.0, 0.5])
    for k in range(30):
        mm = rng.integers([-250, -250, -330], [250, 250, -300 + 60 * (k < 10)], (2000, 3)).astype(np.int16)
        count, spread = rng.integers(1, 30, 2000).astype(np.uint8), rng.integers(0, 9, 2000).astype(np.uint8)
        sights = rng.integers([200, -200, -300], [250, 200, -290], (100, 3)).astype(np.int16)
        metres.fuse(scan_of(origin + mm * 1e-3, count, spread * 1e-3, camera, sights=origin + sights * 1e-3, nearest=0.1))
        wire.fuse(ValidatedScan.of_millimetres(origin, mm, count, spread, camera, None, sights, 0.1))
    for layer in ("elevation", "variance"):
        np.testing.assert_array_equal(getattr(metres.snapshot(), layer), getattr(wire.snapshot(), layer))
    assert np.isfinite(wire.snapshot().elevation).sum() > 1000
