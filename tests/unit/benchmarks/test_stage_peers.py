"""The peers of the map stages give the same results, so that times are comparable."""

import numpy as np
import pytest

from benchmarks.peers import score_peers
from benchmarks.peers.map_peer import NumpyGrid
from benchmarks.peers.reduction_peers import NumpyReduction, Open3dCloud
from benchmarks.peers.scenes import MAPPED
from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, ride
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from sextant.services.mapper.footholds.hole_filling import fill_small_holes
from sextant.services.mapper.footholds.layers import FootholdLayers, Margin
from sextant.services.mapper.footholds.params import FootholdMapParams, ScoreParams
from sextant.services.perception.reduction.scan_reduction import reduce_scan

WEIGHTS = ScoreParams(unknown_clearance=0.02)
MODEL = FusionModel()


@pytest.mark.parametrize("scene", ["steps", "boxes"])
def test_numpy_reduction_gives_same_cells(scene: str) -> None:
    way = ride(MAPPED[scene](np.random.default_rng(1000)), np.random.default_rng(1), Errors(), frames=3, length=0.1)
    camera, T = way.profile.camera, way.T_world_camera[0]
    depth = CarriedCamera(way, np.random.default_rng(2)).frame(0)
    found = reduce_scan(depth, camera.intrinsics, camera.sensor, T, max_range=1.5)
    ours = found.origin + 1e-3 * found.points
    theirs = NumpyReduction(camera.intrinsics, camera.sensor, 0.01, 1.5).reduce(depth, T)
    cells, others = ({tuple(c) for c in np.floor(p[:, :2] / 0.01 + 1e-6).astype(int).tolist()} for p in (ours, theirs))
    assert len(cells ^ others) < 0.002 * len(cells)
    heights = dict(zip(map(tuple, np.floor(theirs[:, :2] / 0.01 + 1e-6).astype(int).tolist()), theirs[:, 2], strict=True))
    off = [
        abs(heights[c] - z)
        for *xy, z in ours
        for c in [tuple(np.floor(np.array(xy) / 0.01 + 1e-6).astype(int))]
        if c in heights
    ]
    assert np.mean(np.array(off) < 0.002) > 0.95


def test_open3d_reduction_finds_same_ground() -> None:
    pytest.importorskip("open3d", reason="Open3D, of the bench extra, and what it needs of the system", exc_type=ImportError)
    way = ride(MAPPED["flat"](np.random.default_rng(0)), np.random.default_rng(1), Errors(), frames=3, length=0.1)
    camera, T = way.profile.camera, way.T_world_camera[0]
    depth = CarriedCamera(way, np.random.default_rng(2)).frame(0)
    points = Open3dCloud(camera.intrinsics, camera.sensor, 0.01, 1.5).reduce(depth, T)
    assert len(points) > 10_000
    assert abs(np.median(points[:, 2])) < 0.002


def test_numpy_fusion_gives_same_map() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = ElevationGrid(64, 0.01, MODEL), NumpyGrid(64, 0.01, MODEL)
    for k in range(40):
        p = rng.uniform([-0.4, -0.4, 0.0], [0.6, 0.4, 0.0], (600, 3))  # some cells twice or more, some outside
        p[:, 2] = 0.1 * (p[:, 0] > 0.1 + 0.1 * (k > 20)) + 0.003 * rng.standard_normal(600)  # a step that moves away
        p[rng.random(600) < 0.05, 2] += 0.05
        count, spread = rng.integers(1, 20, 600), rng.uniform(0.0, 0.004, 600)
        camera = np.array([0.005 * k - 0.3, 0.1 - 0.004 * k, 0.5])
        for grid in (ours, theirs):
            grid.move_to(camera[:2])
        ours.fuse(ValidatedScan.of(p, count, spread, camera, 1e-6 * np.eye(6)))
        theirs.fuse(p, count, spread, camera, 1e-6 * np.eye(6))
    elevation = ours.snapshot().elevation
    known = np.isfinite(elevation)
    assert known.mean() > 0.5
    np.testing.assert_array_equal(known, np.isfinite(theirs.elevation))
    assert np.mean(np.abs(elevation - theirs.elevation)[known] < 1e-5) > 0.99


def test_numpy_clearing_and_drift_tracking_match() -> None:
    rng = np.random.default_rng(3)
    ours, theirs = ElevationGrid(64, 0.01, MODEL), NumpyGrid(64, 0.01, MODEL)
    x, y = np.mgrid[-0.295:0.3:0.01, -0.295:0.3:0.01]
    boxed = (np.abs(x - 0.1) < 0.05) & (np.abs(y) < 0.05)
    heights = []
    for k in range(120):
        # A box is taken away; the ground under it is never measured. Later, the pose sinks by 8 mm.
        seen = ~boxed if k >= 10 else np.full(x.shape, True)
        rise = -0.008 * (k > 60)
        p = np.column_stack(
            [x[seen], y[seen], np.where(boxed, 0.2, 0.0)[seen] + rise + 0.0005 * rng.standard_normal(seen.sum())]
        )
        scan = p, np.full(len(p), 8), np.zeros(len(p)), np.array([-0.4, 0.0, 0.5]), 1e-9 * np.eye(6)
        ours.fuse(ValidatedScan.of(*scan))
        theirs.fuse(*scan)
        elevation = ours.snapshot().elevation
        np.testing.assert_array_equal(np.isfinite(elevation), np.isfinite(theirs.elevation))
        heights.append(float(np.nanmedian(elevation)))
    assert np.isnan(elevation[38:46, 28:36]).mean() > 0.8  # most of the box is gone
    assert heights[-1] < -0.006  # and the map follows the newest poses
    np.testing.assert_allclose(elevation, theirs.elevation, atol=1e-5)


@pytest.mark.parametrize("name", score_peers.SCORE)
def test_other_libraries_give_same_foothold_layers(name: str) -> None:
    pytest.importorskip({"SciPy": "scipy", "scikit-image": "skimage"}.get(name, "cv2"), reason="of the bench extra")
    rng = np.random.default_rng(1)
    x, y = np.mgrid[0:80, 0:60] * 0.01
    elevation = (0.2 * x + 0.05 * (y > 0.3) + 0.001 * rng.standard_normal(x.shape)).astype(np.float32)
    elevation[20:30, 15:40] = np.nan
    elevation[rng.random(x.shape) < 0.005] = np.nan
    made = FootholdLayers(elevation.shape, 0.01, Margin(sigmas=0.0), WEIGHTS, FootholdMapParams()).update(
        fill_small_holes(elevation), np.zeros_like(elevation), np.zeros(2, dtype=np.int64)
    )
    score, evaluation = score_peers.SCORE[name](0.01, WEIGHTS, FootholdMapParams()).layers(fill_small_holes(elevation))
    assert np.isfinite(made.score).mean() > 0.5
    np.testing.assert_array_equal(np.isfinite(made.score), np.isfinite(score))
    np.testing.assert_allclose(score, made.score, atol=1e-3, rtol=1e-3)
    assert np.mean(evaluation == made.evaluation) > 0.999
