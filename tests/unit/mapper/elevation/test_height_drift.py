"""Height drift of the pose is compensated; other height changes are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from tests.support.grid_scans import centres, take


def drifting_walk(
    rate: float, scans: int = 150, step: float = 0.004, jump_at: int = -1
) -> tuple[ElevationGrid, NDArray[np.float64]]:
    """Walk over waves with a pose that drifts in height; return grid and errors.

    The pose rises by `rate` [m] per scan, or once by 12 mm.
    """
    rng = np.random.default_rng(9)
    grid, drift = ElevationGrid(size=300), 0.0

    def ground(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(0.02 * np.sin(7.0 * xy[:, 0]) * np.cos(5.0 * xy[:, 1]))

    i, j = np.mgrid[0:80, 0:60]
    for k in range(scans):
        drift += rate + (0.012 if k == jump_at else 0.0)
        camera = np.array([step * k, 0.0, 0.3 + drift])
        first = np.floor((camera[0] + 0.5) / 0.01) * 0.01 + 0.005
        xy = np.column_stack([first + 0.01 * i.ravel(), 0.01 * j.ravel() - 0.295])
        grid.move_to(camera[:2])
        points = np.column_stack([xy, ground(xy) + drift + rng.normal(0.0, 1e-3, len(xy))])
        take(grid, points, camera, pose_covariance=np.diag([1e-7] * 3 + [1e-8] * 3))
    snapshot = grid.snapshot()
    xy = centres(grid)
    error = snapshot.elevation.ravel() - grid.height_drift - ground(xy)
    np.testing.assert_allclose(grid.heights(xy), snapshot.elevation.ravel(), atol=1e-6)
    return grid, error[np.isfinite(error)]


@pytest.mark.parametrize("rate", [1e-3, -1e-3, 3e-4])
def test_height_drift_is_compensated_and_map_stays_accurate(rate: float) -> None:
    grid, error = drifting_walk(rate)
    assert abs(150 * rate) > 0.04
    assert grid.height_drift == pytest.approx(150 * rate, abs=0.006)
    assert np.abs(error).max() < 0.012
    assert abs(np.median(error)) < 0.006


def test_no_compensation_without_drift() -> None:
    grid, error = drifting_walk(0.0)
    assert grid.height_drift == 0.0
    assert abs(error.mean()) < 2e-4


def test_pose_jump_is_not_taken_as_drift() -> None:
    grid, error = drifting_walk(0.0, scans=80, jump_at=50)
    assert grid.height_drift == 0.0
    assert np.median(error[error > 0.006]) == pytest.approx(0.012, abs=1e-3)  # ground in view is at the height of the new pose


def test_new_box_is_not_taken_as_drift() -> None:
    grid = ElevationGrid(size=300)
    i, j = np.mgrid[0:80, 0:60]
    xy = np.column_stack([0.505 + 0.01 * i.ravel(), 0.01 * j.ravel() - 0.295])
    on_box = (np.abs(xy[:, 0] - 0.9) < 0.12) & (np.abs(xy[:, 1]) < 0.25)
    for k in range(40):
        take(grid, np.column_stack([xy, 0.01 * on_box * (k > 20)]), np.array([0.0, 0.0, 0.3]))
    assert grid.height_drift == 0.0
    np.testing.assert_allclose(grid.heights(xy), 0.01 * on_box, atol=2e-3)
