"""Laws of the height map: convergence, forgetting, gating, the moving window, and a scene of low blocks."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.mapper.checked_scan import CheckedScan
from services.mapper.elevation import ElevationGrid, FusionCount
from services.mapper.fusion import FusionModel
from services.mapper.holes import fill_small_holes
from shared.camera import DepthSensor

scan_of = CheckedScan.of
CAMERA = np.array([0.0, 0.0, 0.25])


def centres(grid: ElevationGrid) -> NDArray[np.float64]:
    """(nx * ny, 2) centres of every cell of the window, in world order."""
    i, j = np.mgrid[: grid.shape[0], : grid.shape[1]]
    return np.asarray(grid.origin + grid.resolution * np.stack([i, j], axis=-1).reshape(-1, 2))


def scan(
    grid: ElevationGrid, xy: NDArray[np.float64], z: NDArray[np.float64] | float, count: int = 4, **kwargs: Any
) -> FusionCount:
    points = np.column_stack([xy, np.broadcast_to(z, len(xy))])
    return grid.fuse(scan_of(points, np.full(len(xy), count), np.zeros(len(xy)), CAMERA, **kwargs))


def test_equal_measurements_converge_and_the_variance_falls_to_the_floor_never_below() -> None:
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


def test_first_measurement_is_taken_as_it_is() -> None:
    grid = ElevationGrid(size=16)
    xy = np.array([[0.031, -0.022]])
    scan(grid, xy, -0.123)
    snapshot = grid.snapshot()
    assert grid.heights(xy)[0] == pytest.approx(-0.123, abs=1e-7)
    assert np.count_nonzero(~np.isnan(snapshot.elevation)) == 1
    assert (np.isnan(snapshot.elevation) == np.isnan(snapshot.variance)).all()


@given(st.permutations(list(range(6))))
def test_order_of_consistent_measurements_does_not_matter(order: list[int]) -> None:
    model = FusionModel(floor_sigma=1e-7, quantisation_sigma=0.0, gate=100.0)  # the floor is not reached
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


def test_more_pixels_and_a_nearer_camera_weigh_more_but_never_beat_the_floor() -> None:
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
    assert total(far, one, aside) == pytest.approx(total(far, one))  # level ground shows no shift


def random_covariance(rng: np.random.Generator) -> NDArray[np.float64]:
    """A pose covariance of millimetres and tenths of a degree, with correlations."""
    L = np.tril(rng.normal(size=(6, 6))) * np.array([2e-3, 2e-3, 1e-3, 2e-3, 2e-3, 3e-3])[:, None]
    return np.asarray(L @ L.T)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.27, 0.0), (-0.2, 0.4)])
def test_the_variance_by_the_pose_is_that_of_many_wrong_poses(slope: tuple[float, float]) -> None:
    rng = np.random.default_rng(2)
    model = FusionModel(depth_sigma=0.0, quantisation_sigma=0.0, floor_sigma=1e-9)
    S = random_covariance(rng)
    camera = np.array([0.3, -0.2, 0.5])
    places = np.array([[0.9, 0.1], [1.4, -0.6], [0.8, 0.5]])
    points = np.column_stack([places, places @ slope])
    _, predicted = model.height_variance(points, np.ones(3), np.zeros(3), camera, S, np.tile(slope, (3, 1)))
    twist = rng.multivariate_normal(np.zeros(6), S, 20_000)
    moved = points + twist[:, None, :3] + np.cross(twist[:, None, 3:], points - camera)
    error = moved[..., 2] - moved[..., :2] @ slope  # of the height noted at the place where the point comes to lie
    np.testing.assert_allclose(error.var(axis=0), predicted, rtol=0.05)


def test_an_unknown_slope_counts_with_its_spread() -> None:
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
def test_a_map_knows_how_wrong_it_is_where_sensor_and_pose_are_as_modelled(gradient: tuple[float, float]) -> None:
    """The squared error over the variance claimed is 1 in the mean, over many maps of a plane, after a second look."""
    rng = np.random.default_rng(4)
    model = FusionModel(depth_sigma=2e-3, quantisation_sigma=0.0, floor_sigma=1e-6, terrain_slope=0.0, gate=10.0)
    S = random_covariance(rng)
    camera, ratios = np.array([-0.6, 0.0, 0.4]), []
    for _ in range(300):
        grid = ElevationGrid(size=16, model=model)
        xy = centres(grid)
        truth = xy @ gradient
        # The exact map lends the slope; then its cells are made as good as new.
        grid.fuse(
            scan_of(np.column_stack([xy, truth]), np.full(len(xy), 8), np.zeros(len(xy)), camera, pose_covariance=np.eye(6))
        )
        v, w = np.split(rng.multivariate_normal(np.zeros(6), S), 2)
        points = np.column_stack([xy, truth])
        n = np.append(-np.array(gradient), 1.0)
        ray = points - camera
        # Noise along the ray, as the height at the place shows it on level ground.
        noise = 2e-3 * (ray**2).sum(axis=1) * np.abs(ray[:, 2]) / np.linalg.norm(ray, axis=1) * rng.normal(size=len(xy))
        points[:, 2] += (v + np.cross(w, ray)) @ n + noise
        grid.fuse(scan_of(points, np.ones(len(xy)), np.zeros(len(xy)), camera, pose_covariance=S))
        snapshot = grid.snapshot()
        ratio = (snapshot.elevation - truth.reshape(16, 16)) ** 2 / snapshot.variance
        ratios.append(ratio[1:-1, 1:-1].mean())  # at the window's border the slope is unknown
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_model_of_a_sensor_has_its_depth_noise() -> None:
    sensor = DepthSensor()
    model = FusionModel.of_sensor(sensor, fx=525.0)
    at_one_metre = math.hypot(model.depth_sigma, model.quantisation_sigma)
    assert at_one_metre == pytest.approx(float(sensor.sigma(np.array([1.0]), 525.0)[0]))


@pytest.mark.parametrize("sigma", [0.001, 0.002, 0.006])  # the model expects about 1 mm here: also badly understated
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
def test_what_came_or_went_is_taken_over_within_the_patience(step: float) -> None:
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
    # A rival can lose a vote to its own 3 sigma noise, so a few cells in a thousand take a scan or two longer.
    assert (np.abs(grid.heights(xy) - step) < 0.005).mean() > 0.97
    for _ in range(3):
        scan(grid, xy, step + rng.normal(0.0, 0.001, len(xy)))
    assert np.abs(grid.heights(xy) - step).max() < 0.005
    report = scan(grid, xy, step)
    assert report.updated == len(xy)
    assert report.disputed == 0


def test_a_passing_disturbance_leaves_an_established_height_alone() -> None:
    grid = ElevationGrid(size=16)
    xy = centres(grid)
    for _ in range(20):
        scan(grid, xy, 0.0)
    for k in range(30):
        scan(grid, xy, 0.0 if k % 2 else 0.08)
    np.testing.assert_allclose(grid.heights(xy), 0.0, atol=1e-6)


def test_a_single_false_first_sighting_is_replaced_by_two_that_agree() -> None:
    grid = ElevationGrid(size=16)
    xy = np.array([[0.0, 0.0]])
    scan(grid, xy, 0.15)
    scan(grid, xy, 0.0)
    report = scan(grid, xy, 0.0005)
    assert report.replaced == 1
    assert abs(grid.heights(xy)[0]) < 0.001


def test_within_one_scan_the_upper_side_of_an_edge_stands_and_equal_points_merge() -> None:
    points = np.array([[0.002, 0.002, 0.0], [0.004, 0.004, 0.03], [0.006, 0.006, 0.0]])
    for order in ([0, 1, 2], [1, 0, 2], [0, 2, 1]):
        grid = ElevationGrid(size=16)
        report = grid.fuse(scan_of(points[order], np.ones(3), np.zeros(3), CAMERA))
        assert report == FusionCount(updated=1, disputed=0, replaced=0, outside=0)
        assert grid.heights([0.005, 0.005]) == pytest.approx(0.03, abs=1e-6)
    grid = ElevationGrid(size=16)
    grid.fuse(scan_of(np.array([[0.002, 0.002, 0.001], [0.004, 0.004, 0.003]]), np.ones(2), np.zeros(2), CAMERA))
    assert grid.heights([0.005, 0.005]) == pytest.approx(0.002, abs=2e-5)


def test_points_outside_are_counted_and_change_nothing() -> None:
    grid = ElevationGrid(size=16)
    report = scan(grid, np.array([[0.0, 0.0], [0.5, 0.0], [0.0, -0.081], [900.0, 900.0]]), 0.01)
    assert report.outside == 3
    assert np.count_nonzero(~np.isnan(grid.snapshot().elevation)) == 1
    assert np.isnan(grid.heights([[0.5, 0.0], [np.nan, 0.0], [np.inf, 0.0], [1e300, 0.0]])).all()


def test_an_empty_scan_is_nothing() -> None:
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
def test_no_finite_scan_breaks_the_map(rows: list[tuple[float, float, float, int, float]], pose: float) -> None:
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
def test_bad_scans_are_refused_and_leave_the_map_as_it_was(index: int, bad: NDArray[np.float64]) -> None:
    grid = ElevationGrid(size=16)
    arguments = list(GOOD)
    arguments[index] = bad
    with pytest.raises(ValueError, match="expected"):
        grid.fuse(scan_of(*arguments))
    assert np.isnan(grid.snapshot().elevation).all()


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
def test_bad_scans_of_the_wire_are_refused(index: int, bad: NDArray[Any]) -> None:
    arguments: list[Any] = list(WIRE)
    arguments[index] = bad
    with pytest.raises(ValueError, match="expected"):
        CheckedScan.of_millimetres(*arguments)


def test_millimetres_of_the_wire_make_the_same_map_as_metres() -> None:
    rng = np.random.default_rng(4)
    metres, wire = ElevationGrid(64), ElevationGrid(64)
    origin, camera = np.array([0.02, -0.01, 0.3]), np.array([-0.2, 0.0, 0.5])
    for k in range(30):
        mm = rng.integers([-250, -250, -330], [250, 250, -300 + 60 * (k < 10)], (2000, 3)).astype(np.int16)
        count, spread = rng.integers(1, 30, 2000).astype(np.uint8), rng.integers(0, 9, 2000).astype(np.uint8)
        sights = rng.integers([200, -200, -300], [250, 200, -290], (100, 3)).astype(np.int16)
        metres.fuse(scan_of(origin + mm * 1e-3, count, spread * 1e-3, camera, sights=origin + sights * 1e-3, nearest=0.1))
        wire.fuse(CheckedScan.of_millimetres(origin, mm, count, spread, camera, None, sights, 0.1))
    for layer in ("elevation", "variance"):
        np.testing.assert_array_equal(getattr(metres.snapshot(), layer), getattr(wire.snapshot(), layer))
    assert np.isfinite(wire.snapshot().elevation).sum() > 1000


def test_bad_settings_are_refused() -> None:
    grid = ElevationGrid(size=16)
    with pytest.raises(ValueError, match="negative eigenvalue"):
        grid.fuse(scan_of(*GOOD, pose_covariance=-np.eye(6)))
    with pytest.raises(ValueError, match="pose covariance"):
        grid.fuse(scan_of(*GOOD, pose_covariance=np.full((6, 6), np.nan)))
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


# ---- the moving window


def test_cells_lie_where_the_snapshot_says() -> None:
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


@given(waypoints, st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_only_cells_that_left_the_window_are_forgotten(path: list[tuple[float, float]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = ElevationGrid(size=12, resolution=0.05)
    expected: dict[tuple[int, int], float] = {}
    for target in path:
        grid.move_to(target)
        low = np.floor(np.array(target) / 0.05).astype(int) - 6
        expected = {c: z for c, z in expected.items() if all(0 <= c[a] - low[a] < 12 for a in range(2))}
        for cell in rng.integers(low, low + 12, (20, 2)):
            if (key := (int(cell[0]), int(cell[1]))) not in expected:
                expected[key] = float(rng.normal())
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
def test_a_map_of_any_shape_and_resolution_has_its_cells_where_it_says(
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
def test_any_number_of_stops_on_the_way_is_moving_directly(target: tuple[float, float], fractions: list[float]) -> None:
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


def test_a_cell_that_comes_back_starts_anew() -> None:
    grid = ElevationGrid(size=16)
    xy = centres(grid)
    for _ in range(10):
        scan(grid, xy, 0.0)
    for _ in range(3):
        scan(grid, xy, 0.3)  # rivals in the making
    grid.move_to((5.0, 5.0))
    assert np.isnan(grid.snapshot().elevation).all()
    grid.move_to((0.0, 0.0))
    assert np.isnan(grid.snapshot().elevation).all()
    scan(grid, xy, 0.1)
    scan(grid, xy, 0.3)
    np.testing.assert_allclose(grid.heights(xy), 0.1, atol=1e-6)


def test_a_snapshot_is_detached() -> None:
    grid = ElevationGrid(size=16)
    scan(grid, centres(grid), 0.0)
    snapshot = grid.snapshot()
    grid.move_to((9.0, 9.0))
    assert (snapshot.elevation == 0.0).all()


# ---- assumed ground


def test_seeded_plane_fills_the_unseen_inside_only_and_yields_to_measurement() -> None:
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
    scan(grid, np.array([[0.015, -0.095]]), 0.04)  # replaced outright, not averaged
    assert grid.heights([0.015, -0.095]) == pytest.approx(0.04)
    assert grid.snapshot().assumed.sum() == 198
    assert grid.seed_plane(square, (0.5, 0.0, 0.0)) == 0


def test_seeding_takes_any_simple_polygon_and_clips_it_to_the_window() -> None:
    grid = ElevationGrid(size=40)
    assert grid.seed_plane([[5, 5], [6, 5], [6, 6]], (0, 0, 0)) == 0
    triangle = np.array([[-0.1, -0.1], [0.1, -0.1], [-0.1, 0.1]])
    filled = grid.seed_plane(triangle, (0, 0, 0))
    assert filled == pytest.approx(0.5 * 20 * 20, abs=20)
    assert grid.seed_plane([[-9, -9], [9, -9], [9, 9], [-9, 9]], (0, 0, 0)) == 40 * 40 - filled
    grid.move_to((1.0, 0.0))
    assert grid.snapshot().assumed.sum() == 0


# ---- holes


def test_small_holes_are_bridged_exactly_on_a_plane_and_nothing_else_is_touched() -> None:
    i, j = np.mgrid[:30, :40]
    plane = (0.0027 * i - 0.001 * j + 0.5).astype(np.float32)  # 15 degrees and more
    holed = plane.copy()
    holed[5, 5] = holed[10, 20:22] = np.nan
    holed[0, 20] = np.nan
    filled = fill_small_holes(holed)
    np.testing.assert_allclose(filled[5, 5], plane[5, 5], atol=1e-6)
    np.testing.assert_allclose(filled[10, 20:22], plane[10, 20:22], atol=1e-6)
    assert np.isnan(filled[0, 20])
    seen = ~np.isnan(holed)
    np.testing.assert_array_equal(filled[seen], holed[seen])
    assert np.isnan(holed[5, 5])


def test_holes_across_an_edge_and_the_frontier_stay_unknown() -> None:
    step = np.zeros((12, 12), dtype=np.float32)
    step[6:] = 0.04
    step[5, 5] = np.nan
    step[:, 9:] = np.nan
    filled = fill_small_holes(step)
    np.testing.assert_array_equal(np.isnan(filled), np.isnan(step))
    wide = np.zeros((12, 12), dtype=np.float32)
    wide[4:6] = np.nan
    np.testing.assert_array_equal(np.isnan(fill_small_holes(wide)), np.isnan(wide))


@pytest.mark.parametrize("second", [0.023, 0.029])
def test_a_trench_between_blocks_of_about_one_height_is_no_hole(second: float) -> None:
    blocks = np.full((12, 12), 0.029, dtype=np.float32)
    blocks[6:] = second
    blocks[6] = np.nan  # in the shadow of the nearer block
    np.testing.assert_array_equal(np.isnan(fill_small_holes(blocks)), np.isnan(blocks))


# ---- a scene of low blocks, seen by a walking camera with true poses

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
    """One 320x240 depth image with PrimeSense noise, reduced to a point per cell, the upper cluster at edges."""
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
    disparity_scale = 2 * fx * sensor.baseline  # a 640 wide image has twice the focal length
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


def test_low_blocks_come_out_crisp_with_true_poses() -> None:
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
    for x0, y0, x1, y1, top in BLOCKS:  # each block's top stands at its height, block by block
        on_top = inside & (x > x0) & (x < x1) & (y > y0) & (y < y1)
        assert np.count_nonzero(on_top) > 50
        assert np.median(snapshot.elevation[on_top]) == pytest.approx(top, abs=0.001)
    claimed = np.sqrt(snapshot.variance[inside])
    assert (np.abs(error[inside]) < 3 * claimed).mean() > 0.97


# ---- what moved away, and what stays: a camera before blocks, its scans made ray by ray

RAYS_U, RAYS_V = np.meshgrid(np.linspace(-0.45, 0.45, 181), np.linspace(-0.38, 0.38, 181), indexing="ij")


def look(
    blocks: NDArray[np.float64],
    p_camera: NDArray[np.float64],
    pitch: float = math.radians(30.0),
    rng: np.random.Generator | None = None,
    ground: float = 0.0,
) -> NDArray[np.float64]:
    """Points (n, 3), one per centimetre cell, the highest, of blocks (k, 5) x0 y0 x1 y1 top on a floor (-inf for none)."""
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


def take(grid: ElevationGrid, points: NDArray[np.float64], p_camera: NDArray[np.float64], **kwargs: Any) -> FusionCount:
    return grid.fuse(scan_of(points, np.full(len(points), 4), np.zeros(len(points)), p_camera, **kwargs))


BOX = np.array([[0.9, -0.15, 1.1, 0.15, 0.10]])
WHERE_THE_BOX_WAS = np.stack(np.meshgrid(np.arange(0.905, 1.1, 0.01), np.arange(-0.145, 0.15, 0.01), indexing="ij"), axis=-1)


@pytest.mark.parametrize("measured", [1.0, 0.3, 0.0])
def test_a_box_that_is_taken_away_is_cleared_though_its_place_is_hardly_measured(measured: float) -> None:
    """While the camera stands: of the ground where it was, as on dark or grazed floor, only a share of cells returns."""
    rng = np.random.default_rng(6)
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.4])
    for _ in range(20):
        take(grid, look(BOX, camera, rng=rng), camera)
    assert np.nanmin(grid.heights(WHERE_THE_BOX_WAS)[3:-3, 3:-3]) > 0.09
    dark = rng.random((400, 400)) >= measured
    cleared = 0
    for _ in range(60):
        points = look(np.zeros((0, 5)), camera, rng=rng)
        on_spot = (points[:, 0] > 0.88) & (points[:, 0] < 1.12) & (np.abs(points[:, 1]) < 0.17)
        i, j = np.floor(points[:, :2] / 0.01).astype(int).T
        cleared += take(grid, points[~(on_spot & dark[i % 400, j % 400])], camera).cleared
    # Where nothing returns from the spot, no line of sight to what lies behind passes well below the box's front.
    after = grid.heights(WHERE_THE_BOX_WAS)[4 if measured == 0.0 else 0 :]
    assert not (after > 0.02).any()
    known = np.isfinite(after)
    assert known.mean() <= measured + 0.05
    assert cleared > 0 or measured == 1.0
    assert np.abs(after[known]).max(initial=0.0) < 0.01


def test_a_box_over_an_abyss_is_cleared_by_sights_alone_and_nothing_nearer_than_the_camera_measures() -> None:
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.4])
    near = np.array([[0.42, -0.05, 0.52, 0.05, 0.10]])
    for k in range(20):
        above = camera + np.array([0.0, 0.0, 0.003 * k])  # so that every cell is met
        take(grid, look(np.concatenate([BOX, near]), above, ground=-9.0), above)
    assert np.nanmin(grid.heights(WHERE_THE_BOX_WAS)[3:-3, 3:-3]) > 0.09
    beyond = look(np.zeros((0, 5)), camera, ground=-0.3)[::3]  # where the pictures show nothing, somewhere below
    for _ in range(60):
        take(grid, np.empty((0, 3)), camera, sights=beyond, nearest=0.6)
    assert not (grid.heights(WHERE_THE_BOX_WAS) > 0.02).any()
    assert (grid.heights([[0.46, 0.0], [0.48, 0.02]]) > 0.09).all()


def test_lines_of_sight_clear_the_same_from_however_far_and_in_finite_time() -> None:
    """Of 90 million cells on the way from the further camera the window has 400: to follow all would not end."""
    y = np.arange(-0.245, 0.25, 0.001)
    level = np.column_stack([np.full(len(y), 1.9), y, np.full(len(y), 0.03)])
    left = []
    for away in (2.0, 9e5):
        grid = ElevationGrid(size=400)
        for k in range(20):
            above = np.array([0.0, 0.0, 0.4 + 0.003 * k])  # so that every cell is met
            take(grid, look(BOX, above), above)
        for _ in range(60):
            take(grid, np.empty((0, 3)), np.array([-away, 0.0, 0.05]), sights=level)
        left.append(grid.snapshot().elevation)
        assert np.isnan(grid.heights(WHERE_THE_BOX_WAS)[3:-3, 3:-3]).all()
        beside = np.array([0.0, 1e5, 0.0])
        assert take(grid, np.empty((0, 3)), np.array([-away, 1e5, 0.05]), sights=level + beside).cleared == 0
    np.testing.assert_array_equal(*left)


@pytest.mark.parametrize("dark", [False, True])
def test_a_thin_post_where_a_box_was_stays_though_it_is_grazed(dark: bool) -> None:
    """Whether the box went by measurement of the floor or, that being dark at first, by lines of sight."""
    rng = np.random.default_rng(6)
    grid, camera = ElevationGrid(size=400), np.array([0.0, 0.0, 0.4])
    for _ in range(20):
        take(grid, look(BOX, camera, rng=rng), camera)
    x, y = np.meshgrid(np.arange(0.605, 1.7, 0.01), np.arange(-0.295, 0.3, 0.01), indexing="ij")
    floor = np.column_stack([x.ravel(), y.ravel(), rng.normal(0.0, 1e-3, x.size)])
    on_spot = (np.abs(floor[:, 0] - 1.0) < 0.12) & (np.abs(floor[:, 1]) < 0.17)
    for k in range(200):
        take(grid, floor[~on_spot] if dark and k < 40 else floor, camera)
    assert not (grid.heights(WHERE_THE_BOX_WAS) > 0.02).any()
    post, foot = np.array([[0.995, 0.005, 0.15]]), np.array([1.0, 0.0])
    for _ in range(20):
        take(grid, post, camera)
    np.testing.assert_allclose(grid.heights(post[0, :2]), 0.15, atol=1e-3)
    for _ in range(100):
        take(grid, floor[np.abs(floor[:, :2] - foot).max(axis=1) > 0.05], camera)
    np.testing.assert_allclose(grid.heights(post[0, :2]), 0.15, atol=1e-3)


STILL = np.array(  # pillars of 5 and 2 cm, a wall of one cell, boxes seen along their faces, a stair
    [
        [0.8, 0.20, 0.85, 0.25, 0.15], [0.9, 0.08, 0.92, 0.10, 0.20], [0.7, -0.35, 1.2, -0.34, 0.12],
        [0.95, -0.2, 1.1, -0.05, 0.05], [1.3, -0.6, 2.2, 0.6, 0.06], [1.5, -0.6, 2.2, 0.6, 0.12],
    ]
)  # fmt: skip


def test_a_still_scene_loses_nothing_to_lines_of_sight_on_a_noisy_walk() -> None:
    """Grazing rays over edges, along faces and past pillars, with a pose that errs by millimetres and tenths of a degree."""
    rng = np.random.default_rng(8)
    grid = ElevationGrid(size=400)
    highest = np.full((400, 400), -np.inf)
    for k in range(50):
        camera = np.array([0.018 * k, 0.05 * math.sin(0.2 * k), 0.30 + 0.01 * math.sin(0.9 * k)])
        points = look(STILL, camera, math.radians(25.0 + 1.5 * math.sin(0.9 * k)), rng)
        w, v = rng.normal(0.0, 2e-3, 3), rng.normal(0.0, 1.5e-3, 3)
        report = take(
            grid, points + v + np.cross(w, points - camera), camera + v, pose_covariance=np.diag([2e-6] * 3 + [4e-6] * 3)
        )
        assert report.cleared == 0
        seen = np.isfinite(grid.snapshot().elevation)
        assert seen[np.isfinite(highest)].all()
        highest[seen] = 0.0
    assert grid.height_drift == 0.0


# ---- drift of the pose's height


def drifting_walk(
    rate: float, scans: int = 150, step: float = 0.004, jump_at: int = -1
) -> tuple[ElevationGrid, NDArray[np.float64]]:
    """A walk over waves with a pose that rises by a rate [m] each scan, or once by 12 mm; the grid, and its errors."""
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
def test_a_drift_in_height_is_taken_out_and_the_map_stays(rate: float) -> None:
    grid, error = drifting_walk(rate)
    assert abs(150 * rate) > 0.04
    assert grid.height_drift == pytest.approx(150 * rate, abs=0.006)
    assert np.abs(error).max() < 0.012
    assert abs(np.median(error)) < 0.006


def test_without_drift_nothing_is_compensated() -> None:
    grid, error = drifting_walk(0.0)
    assert grid.height_drift == 0.0
    assert abs(error.mean()) < 2e-4


def test_a_leap_of_the_pose_is_no_drift() -> None:
    grid, error = drifting_walk(0.0, scans=80, jump_at=50)
    assert grid.height_drift == 0.0
    assert np.median(error[error > 0.006]) == pytest.approx(0.012, abs=1e-3)  # what is in view is where the pose now has it


def test_a_box_that_comes_is_no_drift() -> None:
    grid = ElevationGrid(size=300)
    i, j = np.mgrid[0:80, 0:60]
    xy = np.column_stack([0.505 + 0.01 * i.ravel(), 0.01 * j.ravel() - 0.295])
    on_box = (np.abs(xy[:, 0] - 0.9) < 0.12) & (np.abs(xy[:, 1]) < 0.25)
    for k in range(40):
        take(grid, np.column_stack([xy, 0.01 * on_box * (k > 20)]), np.array([0.0, 0.0, 0.3]))
    assert grid.height_drift == 0.0
    np.testing.assert_allclose(grid.heights(xy), 0.01 * on_box, atol=2e-3)


# ---- scans and maps of different resolutions


@given(st.sampled_from([0.02, 0.03, 0.05]), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=20)
def test_a_coarser_map_holds_the_mean_of_its_ground_and_knows_how_far_it_strays(resolution: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = ElevationGrid((20, 30), resolution)
    low, high = grid.origin - resolution / 2, grid.origin + (np.array(grid.shape) - 0.5) * resolution
    x, y = (np.arange(low[k] + 0.005, high[k], 0.01) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    slope = rng.uniform(-0.19, 0.19, 2)  # 15 deg at most
    report = grid.fuse(
        scan_of(np.column_stack([xy, xy @ slope]), np.full(len(xy), 4), np.zeros(len(xy)), np.array([-0.5, 0.0, 0.5]))
    )
    assert report.updated == 600
    snapshot = grid.snapshot()
    error = snapshot.elevation.ravel() - centres(grid) @ slope
    assert np.abs(error).max() < 0.25 * resolution * np.abs(slope).sum() + 1e-4  # points of one cell weigh nearly alike
    strays = np.linalg.norm(slope) * resolution / math.sqrt(12.0)
    claimed = np.sqrt(np.median(snapshot.variance))
    assert 0.4 * strays < claimed < math.hypot(strays, 4e-3)


@pytest.mark.parametrize("step", [0.05, 0.10])
def test_a_coarser_map_keeps_the_upper_side_of_an_edge(step: float) -> None:
    grid = ElevationGrid(20, 0.03)
    grid.fuse(
        scan_of(np.array([[0.005, 0.0, 0.0], [0.015, 0.0, step], [0.025, 0.0, step]]), np.full(3, 8), np.zeros(3), CAMERA)
    )
    assert grid.heights([0.015, 0.005]) == pytest.approx(step, abs=1e-6)


def test_a_finer_map_than_the_scan_has_holes_and_no_guesses() -> None:
    grid = ElevationGrid((64, 64), 0.005)
    xy = np.stack(np.mgrid[-10:10, -10:10], axis=-1).reshape(-1, 2) * 0.01 + 0.0051
    scan(grid, xy, 0.03)
    assert np.isfinite(grid.snapshot().elevation).sum() == len(xy)


@pytest.mark.parametrize("seen", [0.0, 0.02, -0.03])
def test_what_a_foot_finds_outweighs_what_was_seen_there_and_nowhere_else(seen: float) -> None:
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


def test_ground_that_nobody_saw_is_known_by_the_foot_that_stands_there() -> None:
    grid = ElevationGrid(32, 0.01)
    grid.touch((0.055, 0.055, 0.03), 0.005, 0.01)
    assert float(grid.heights((0.055, 0.055))) == pytest.approx(0.03)
    assert np.isfinite(grid.snapshot().elevation).sum() == 5
    assert grid.touch((5.0, 0.0, 0.0), 0.005, 0.01) == 0


def test_a_touch_that_is_no_place_is_refused() -> None:
    with pytest.raises(ValueError, match="a finite point"):
        ElevationGrid(32, 0.01).touch((0.0, 0.0, np.nan), 0.005, 0.01)
