"""Passage mapping of pillars in a gap, from simulated pictures.

The map contains the footholds, and each look shows more of it.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid, ElevationSnapshot
from sextant.services.mapper.passage_map.passage_grid import PassageGrid, cell_centres
from sextant.services.mapper.passage_map.passage_mapping import PassageMapping, ViewProposal
from sextant.services.mapper.passage_map.voxel_cloud import Strip
from sextant.services.perception.reduction.scan_reduction import reduce_scan
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.sensors.depth_camera import DepthCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Pillars, Plane

PROFILE = load_profile("phantomx_mk2")
CAMERA = PROFILE.camera
HEIGHT, REACH = 0.09, 1.5
PILLARS = ((0.7, 0.15), (0.95, 0.12), (1.2, 0.15), (0.7, -0.15), (0.95, -0.12), (1.2, -0.15))
GAP = (
    Box((-0.2, 0.0), (1.5, 4.0), 0.0),
    Box((2.2, 0.0), (1.5, 4.0), 0.0),
    Plane(height=-0.3),
    Pillars(PILLARS, 0.10, 0.0),
)


class Robot:
    """A robot that stands in front of the gap and looks."""

    def __init__(self) -> None:
        self.terrain = build_terrain(Scenario("gap", GAP, Goal(2.0)), np.random.default_rng(0))
        self.renderer = Renderer(self.terrain, CAMERA.intrinsics)
        self.camera = DepthCamera(CAMERA.intrinsics, CAMERA.sensor, np.random.default_rng(1))
        self.T = from_xyz_rpy((0.0, 0.0, HEIGHT), (0.0, 0.0, 0.0))
        self.feet = apply(self.T, PROFILE.rest_feet(HEIGHT))
        elevation = ElevationGrid()
        elevation.seed_plane([(-0.45, -0.5), (0.54, -0.5), (0.54, 0.5), (-0.45, 0.5)], [0.0, 0.0, 0.0])
        self.known: ElevationSnapshot = elevation.snapshot()
        self.mapping = PassageMapping(PROFILE, Strip((-0.45, 0.0), 0.0), self.known, REACH)

    def look(self, T: Array, frames: int = 6) -> PassageGrid:
        self.T = T
        T_camera = T @ CAMERA.T_body_camera
        for _ in range(frames):
            depth = self.camera.measure(self.renderer.inverse_depth(T_camera))
            scan = reduce_scan(depth, CAMERA.intrinsics, CAMERA.sensor, T_camera, max_range=REACH, max_points=14_000)
            self.mapping.add(scan.origin + scan.points * 1e-3, scan.count)
        return self.mapping.grid(self.known)

    def view_proposal(self, grid: PassageGrid) -> ViewProposal:
        return self.mapping.view_proposal(grid, self.T, apply(inverse(self.T), self.feet))


def test_footholds_in_gap_lie_only_on_pillars() -> None:
    robot = Robot()
    grid = robot.look(robot.T)
    evaluation = robot.mapping.evaluation(grid, HEIGHT, 0.0)
    centres = cell_centres(grid.strip, grid.resolution)
    accessible = evaluation < 0
    true = robot.terrain.height_at(centres[accessible])
    assert np.abs(true).max() < 1e-6  # no cell in the gap
    over_gap = centres[..., 0] > 0.56
    assert not (accessible & over_gap & ~np.any(near_pillars(centres, 0.05), axis=0) & (centres[..., 0] < 1.44)).any()
    for x, y in PILLARS:
        on = np.abs(centres - [x, y]).max(axis=-1) < 0.05
        assert evaluation[on].min() <= -2
        best = centres[on & (evaluation == evaluation[on].min())].mean(axis=0)
        assert math.hypot(*(best - [x, y])) < 0.015
        middle = np.abs(centres - [x, y]).max(axis=-1) < 0.03
        np.testing.assert_allclose(grid.elevation[middle], 0.0, atol=0.004)
        assert grid.normals[middle][:, 2].min() > 0.98
    assert grid.assumed[(centres[..., 0] > -0.4) & (centres[..., 0] < 0.5)].all()


def near_pillars(centres: Array, half: float) -> np.ndarray:
    return np.stack([np.abs(centres - p).max(axis=-1) < half for p in PILLARS])


def test_proposed_views_reduce_unseen_cells_until_no_view_is_left() -> None:
    robot = Robot()
    grid = robot.look(robot.T)
    unseen = [np.count_nonzero(grid.unseen)]
    assert "hidden behind" in robot.view_proposal(grid).reason
    for _ in range(6):
        view = robot.view_proposal(grid).view
        if view is None:
            break
        assert np.count_nonzero(view.sees) >= 20
        grid = robot.look(view.T_world_body)
        unseen.append(np.count_nonzero(grid.unseen))
    assert robot.view_proposal(grid).view is None
    assert (np.diff(unseen) < 0).all()
    assert unseen[0] - unseen[-1] > 900


def test_strip_of_fractional_cells_is_refused_and_mapping_is_unchanged() -> None:
    robot = Robot()
    before = robot.look(robot.T)
    with pytest.raises(ValueError, match="whole cells"):
        robot.mapping.move_to(Strip((0.0, 0.0), 0.0, 1.005, 1.0), robot.known)
    np.testing.assert_array_equal(robot.mapping.grid(robot.known).elevation, before.elevation)


def test_height_drift_is_corrected_between_scans() -> None:
    x, y = np.mgrid[0.505:0.6:0.01, -0.045:0.05:0.01]
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    count = np.full(len(points), 8, dtype=np.uint8)
    known = ElevationGrid(64).snapshot()
    mapping = PassageMapping(PROFILE, Strip((0.0, 0.0), 0.0), known, REACH)
    mapping.add(points[::2], count[::2])
    mapping.add(points[1::2] + np.array([0.0, 0.0, 0.012]), count[1::2], height_drift=0.012)
    told = mapping.grid(replace(known, height_drift=0.012))
    np.testing.assert_allclose(told.elevation[np.isfinite(told.elevation)], 0.012, atol=1e-6)
    assert np.isfinite(told.elevation).sum() >= len(points)


def test_map_layer_is_resampled_to_rotated_strip() -> None:
    known = ElevationGrid(64).snapshot()
    strip = Strip((-0.1, 0.05), math.pi / 2, 0.4, 0.2)
    mapping = PassageMapping(PROFILE, strip, known, REACH)
    row, column = np.indices(known.elevation.shape)
    centres = cell_centres(strip, known.resolution)
    found = mapping.resample(row * 100 + column, known.origin, -1)
    wanted = np.rint((centres - known.origin) / known.resolution).astype(int)
    beyond = np.any((wanted < 0) | (wanted >= 64), axis=-1)
    assert 0 < beyond.sum() < beyond.size
    np.testing.assert_array_equal(found, np.where(beyond, -1, wanted[..., 0] * 100 + wanted[..., 1]))
