"""Ray clearing: rays remove what they pass through, and standing objects remain.

A camera in front of blocks makes the scans ray by ray.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.params import RayClearingParams
from tests.support.grid_scans import take

RAYS_U, RAYS_V = np.meshgrid(np.linspace(-0.45, 0.45, 181), np.linspace(-0.38, 0.38, 181), indexing="ij")


def clear_along_rays(
    blocks: NDArray[np.float64],
    p_camera: NDArray[np.float64],
    pitch: float = math.radians(30.0),
    rng: np.random.Generator | None = None,
    ground: float = 0.0,
) -> NDArray[np.float64]:
    """Return the highest point (n, 3) of each centimetre cell in view.

    The scene consists of blocks (k, 5) x0 y0 x1 y1 top on a floor (-inf for none).
    """
    forward = np.array([math.cos(pitch), 0.0, -math.sin(pitch)])
    down = np.array([-math.sin(pitch), 0.0, -math.cos(pitch)])
    ray = forward + RAYS_U[..., None] * np.array([0.0, -1.0, 0.0]) + RAYS_V[..., None] * down
    ray = ray.reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(ray[:, 2] < 0, (ground - p_camera[2]) / ray[:, 2], np.inf)
        for x0, y0, x1, y1, top in blocks:
            t0, t1 = (np.array([x0, y0, -2.0]) - p_camera) / ray, (np.array([x1, y1, top]) - p_camera) / ray
            enter, leave = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
            depth = np.where((enter <= leave) & (enter > 0), np.minimum(depth, enter), depth)
    seen = (depth > 0.4) & (depth < 2.0)
    depth, ray = depth[seen], ray[seen]
    if rng is not None:
        depth = depth + 1.3e-3 * depth**2 * rng.normal(size=len(depth))
    points = p_camera + depth[:, None] * ray
    order = np.argsort(-points[:, 2])
    _, first = np.unique(np.floor(points[order, :2] / 0.01).astype(int) @ [100_000, 1], return_index=True)
    return np.asarray(points[order][first])


BOX = np.array([[0.9, -0.15, 1.1, 0.15, 0.10]])

BOX_FOOTPRINT_XY = np.stack(np.meshgrid(np.arange(0.905, 1.1, 0.01), np.arange(-0.145, 0.15, 0.01), indexing="ij"), axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("measured", [1.0, 0.3, 0.0])
def test_removed_box_is_cleared_despite_sparse_measurements(measured: float) -> None:
    """Check a box that is removed while the camera stands still.

    Only a share of the cells at its place returns a measurement, as on a dark floor or at a grazing angle.
    """
    rng = np.random.default_rng(6)
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.4])
    for _ in range(20):
        take(grid, clear_along_rays(BOX, camera, rng=rng), camera)
    assert np.nanmin(grid.heights(BOX_FOOTPRINT_XY)[3:-3, 3:-3]) > 0.09
    dark = rng.random((400, 400)) >= measured
    cleared = 0
    for _ in range(60):
        points = clear_along_rays(np.zeros((0, 5)), camera, rng=rng)
        on_spot = (points[:, 0] > 0.88) & (points[:, 0] < 1.12) & (np.abs(points[:, 1]) < 0.17)
        i, j = np.floor(points[:, :2] / 0.01).astype(int).T
        cleared += take(grid, points[~(on_spot & dark[i % 400, j % 400])], camera).cleared
    # Without returns from the place, no ray to the ground behind it passes well below the box's front.
    after = grid.heights(BOX_FOOTPRINT_XY)[4 if measured == 0.0 else 0 :]
    assert not (after > 0.02).any()
    known = np.isfinite(after)
    assert known.mean() <= measured + 0.05
    assert cleared > 0 or measured == 1.0
    assert np.abs(after[known]).max(initial=0.0) < 0.01


def test_free_space_rays_clear_box_over_abyss_but_not_below_min_range() -> None:
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.4])
    near = np.array([[0.42, -0.05, 0.52, 0.05, 0.10]])
    for k in range(20):
        above = camera + np.array([0.0, 0.0, 0.003 * k])  # so that every cell is hit
        take(grid, clear_along_rays(np.concatenate([BOX, near]), above, ground=-9.0), above)
    assert np.nanmin(grid.heights(BOX_FOOTPRINT_XY)[3:-3, 3:-3]) > 0.09
    beyond = clear_along_rays(np.zeros((0, 5)), camera, ground=-0.3)[::3]  # ends of rays below, where pictures show nothing
    for _ in range(60):
        take(grid, np.empty((0, 3)), camera, sights=beyond, nearest=0.6)
    assert not (grid.heights(BOX_FOOTPRINT_XY) > 0.02).any()
    assert (grid.heights([[0.46, 0.0], [0.48, 0.02]]) > 0.09).all()


def test_cell_counts_once_per_scan_by_measured_and_free_space_rays() -> None:
    """Check a removed box without returns from its place, seen through by one kind of rays or by both."""
    camera = np.array([0.0, 0.0, 0.4])
    behind = clear_along_rays(np.zeros((0, 5)), camera)
    behind = behind[(behind[:, 0] > 1.12) & (np.abs(behind[:, 1]) < 0.17)]
    cleared: list[list[int]] = []
    for sights in (np.empty((0, 3)), behind):
        grid = ElevationGrid(size=400, clearing=RayClearingParams(every=1))
        for _ in range(3):
            take(grid, clear_along_rays(BOX, camera), camera)
        cleared.append([take(grid, behind, camera, sights=sights).cleared for _ in range(16)])
    assert sum(cleared[0]) > 50
    assert cleared[1] == cleared[0]


def test_clearing_result_is_independent_of_camera_distance() -> None:
    """Check that clearing ends, with the same result, at any distance of the camera.

    Of 90 million cells on the way from the further camera, the window has 400.
    """
    y = np.arange(-0.245, 0.25, 0.001)
    level = np.column_stack([np.full(len(y), 1.9), y, np.full(len(y), 0.03)])
    left = []
    for away in (2.0, 9e5):
        grid = ElevationGrid(size=400)
        for k in range(20):
            above = np.array([0.0, 0.0, 0.4 + 0.003 * k])  # so that every cell is hit
            take(grid, clear_along_rays(BOX, above), above)
        for _ in range(60):
            take(grid, np.empty((0, 3)), np.array([-away, 0.0, 0.05]), sights=level)
        left.append(grid.snapshot().elevation)
        assert np.isnan(grid.heights(BOX_FOOTPRINT_XY)[3:-3, 3:-3]).all()
        beside = np.array([0.0, 1e5, 0.0])
        assert take(grid, np.empty((0, 3)), np.array([-away, 1e5, 0.05]), sights=level + beside).cleared == 0
    np.testing.assert_array_equal(*left)


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True])
def test_thin_post_on_cleared_place_survives_grazing_rays(dark: bool) -> None:
    """Check a post where a box was cleared by floor measurements or, if dark, by rays."""
    rng = np.random.default_rng(6)
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.4])
    for _ in range(20):
        take(grid, clear_along_rays(BOX, camera, rng=rng), camera)
    x, y = np.meshgrid(np.arange(0.605, 1.7, 0.01), np.arange(-0.295, 0.3, 0.01), indexing="ij")
    floor = np.column_stack([x.ravel(), y.ravel(), rng.normal(0.0, 1e-3, x.size)])
    on_spot = (np.abs(floor[:, 0] - 1.0) < 0.12) & (np.abs(floor[:, 1]) < 0.17)
    for k in range(200):
        take(grid, floor[~on_spot] if dark and k < 40 else floor, camera)
    assert not (grid.heights(BOX_FOOTPRINT_XY) > 0.02).any()
    post, foot = np.array([[0.995, 0.005, 0.15]]), np.array([1.0, 0.0])
    for _ in range(20):
        take(grid, post, camera)
    np.testing.assert_allclose(grid.heights(post[0, :2]), 0.15, atol=1e-3)
    for _ in range(100):
        take(grid, floor[np.abs(floor[:, :2] - foot).max(axis=1) > 0.05], camera)
    np.testing.assert_allclose(grid.heights(post[0, :2]), 0.15, atol=1e-3)


STATIC_SCENE = np.array(  # pillars of 5 cm and 2 cm, a wall of one cell, boxes seen along their faces, and a stair
    [
        [0.8, 0.20, 0.85, 0.25, 0.15], [0.9, 0.08, 0.92, 0.10, 0.20], [0.7, -0.35, 1.2, -0.34, 0.12],
        [0.95, -0.2, 1.1, -0.05, 0.05], [1.3, -0.6, 2.2, 0.6, 0.06], [1.5, -0.6, 2.2, 0.6, 0.12],
    ]
)  # fmt: skip


@pytest.mark.slow
def test_static_scene_loses_few_cells_to_ray_clearing_on_noisy_walk() -> None:
    """Check grazing rays over edges, along faces and past pillars, with a noisy pose.

    The pose errs by millimetres and tenths of a degree. Only single cells are lost: an object fills them in part, and more
    scans have looked past it than have measured it.
    """
    rng = np.random.default_rng(8)
    grid = ElevationGrid(size=400)
    cleared = 0
    for k in range(50):
        camera = np.array([0.018 * k, 0.05 * math.sin(0.2 * k), 0.30 + 0.01 * math.sin(0.9 * k)])
        points = clear_along_rays(STATIC_SCENE, camera, math.radians(25.0 + 1.5 * math.sin(0.9 * k)), rng)
        w, v = rng.normal(0.0, 2e-3, 3), rng.normal(0.0, 1.5e-3, 3)
        report = take(
            grid, points + v + np.cross(w, points - camera), camera + v, pose_covariance=np.diag([2e-6] * 3 + [4e-6] * 3)
        )
        assert report.cleared <= 2
        cleared += report.cleared
    assert cleared <= 10
    assert grid.height_drift == 0.0


def legs_at(y: float) -> NDArray[np.float64]:
    """Return two legs of a person as blocks 12 cm thick, as high as the camera."""
    return np.array([[0.94, y + a - 0.06, 1.06, y + a + 0.06, 0.9] for a in (-0.1, 0.1)])


@pytest.mark.slow
@pytest.mark.parametrize("above", [5e-324, 1e-300, 1e-12])
def test_ray_clearing_terminates_for_nearly_level_rays(above: float) -> None:
    """Check rays that would leave the window's heights only after 1e320 cells.

    An integer cannot hold that number.
    """
    grid = ElevationGrid(size=400)
    for k in range(20):
        p_camera = np.array([0.0, 0.0, 0.4 + 0.003 * k])
        take(grid, clear_along_rays(BOX, p_camera), p_camera)
    y = np.arange(-0.245, 0.25, 0.001)
    level = np.column_stack([np.full(len(y), 1.9), y, np.zeros(len(y))])
    for _ in range(60):
        take(grid, np.empty((0, 3)), np.array([0.0, 0.0, above]), sights=level)
    assert np.isnan(grid.heights(BOX_FOOTPRINT_XY)[3:-3, 3:-3]).all()


@pytest.mark.slow
def test_crossing_person_leaves_no_obstacle_on_partly_hidden_ground() -> None:
    """Check a person who crosses in front of the camera within 2 s.

    Two low blocks hide the ground behind them.
    """
    rng = np.random.default_rng(9)
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.25])
    low = np.array([[0.85, -0.3, 0.95, -0.1, 0.04], [0.85, 0.1, 0.95, 0.3, 0.04]])
    for _ in range(20):
        take(grid, clear_along_rays(low, camera, rng=rng), camera)
    before = grid.snapshot().elevation
    for k in range(30):
        take(grid, clear_along_rays(np.concatenate([low, legs_at(0.9 - 0.06 * k)]), camera, rng=rng), camera)
    assert np.nanmax(grid.snapshot().elevation) > 0.08
    for _ in range(30):
        take(grid, clear_along_rays(low, camera, rng=rng), camera)
    after = grid.snapshot().elevation
    assert np.nanmax(after) < 0.065, "lines of sight pass over the blocks 2 cm and more below that"
    known = np.isfinite(before) & np.isfinite(after)
    assert np.abs(after - before)[known].max() < 0.02


@pytest.mark.slow
def test_person_who_stands_and_leaves_is_cleared_behind_blocks() -> None:
    """Check legs that stand still for some scans where only they are seen, and never the ground.

    They rise behind a block, as high as the camera, and leave. Their cells have been measured more often than a single
    crossing does, and have lower neighbours.
    """
    rng = np.random.default_rng(11)
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.25])
    low = np.array([[0.85, -0.3, 0.95, 0.3, 0.04]])
    for _ in range(20):
        take(grid, clear_along_rays(low, camera, rng=rng), camera)
    person = np.array([[0.96, -0.06, 1.08, 0.06, 0.9]])
    for _ in range(14):
        take(grid, clear_along_rays(np.concatenate([low, person]), camera, rng=rng), camera)
    assert np.nanmax(grid.snapshot().elevation) > 0.08
    for _ in range(75):
        take(grid, clear_along_rays(low, camera, rng=rng), camera)
    assert np.nanmax(grid.snapshot().elevation) < 0.065, "lines of sight pass over the block 2 cm and more below that"


@pytest.mark.parametrize("scans_inside", [1, 8, 16, 255])
def test_cleared_cells_can_settle_within_counted_scans(scans_inside: int) -> None:
    """Check that the count of measuring scans, a byte, reaches the limit at which a cleared cell is normal again."""
    assert 16 <= RayClearingParams(scans_inside=scans_inside).settled_scans <= np.iinfo(np.uint8).max
