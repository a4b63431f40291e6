"""Next best view: predicted visibility, verified by simulated pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.mapper.passage_map.next_best_view import (
    BESIDE,
    FAR,
    HIDDEN,
    NEAR,
    SEEN,
    best_view,
    candidates,
    check_visibility,
    describe_unseen_cells,
    expected_heights,
)
from sextant.services.mapper.passage_map.passage_grid import PassageGrid, cell_centres, local_centres, passage_grid
from sextant.services.mapper.passage_map.voxel_cloud import Strip, VoxelCloud
from sextant.services.perception.reduction.scan_reduction import reduce_scan
from sextant.services.simulator.physics.terrain import Terrain, build_terrain
from sextant.services.simulator.sensors.depth_camera import DepthCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Pillars, Plane
from sextant.shared.scenario.terrain import Terrain as Part

PROFILE = load_profile("phantomx_mk2")
CAMERA = PROFILE.camera
REACH = 1.5
HEIGHT = 0.09
STRIP = Strip((-0.45, 0.0), 0.0)
GAP = (
    Box((-0.2, 0.0), (1.5, 4.0), 0.0),
    Box((2.2, 0.0), (1.5, 4.0), 0.0),
    Plane(height=-0.3),
    Pillars(((0.7, 0.15), (0.95, 0.15), (1.2, 0.15), (0.7, -0.15), (0.95, -0.15), (1.2, -0.15)), 0.10, 0.0),
)


def known(strip: Strip = STRIP, block: tuple[float, float, float] | None = None) -> PassageGrid:
    """Return level ground, all known, with a block 0.3 m wide.

    `block` is the block's begin, end and height [m].
    """
    shape = local_centres(strip, 0.01).shape[:2]
    elevation = np.zeros(shape, dtype=np.float32)
    if block is not None:
        centres = local_centres(strip, 0.01)
        x = centres[..., 0] - 0.45
        elevation[(x > block[0]) & (x < block[1]) & (np.abs(centres[..., 1]) < 0.15)] = block[2]
    normals = np.broadcast_to(np.array([0, 0, 1], dtype=np.float32), (*shape, 3))
    return PassageGrid(strip, 0.01, elevation, normals, np.zeros(shape, np.float32), np.zeros(shape, bool))


def camera_at(height: float, pitch: float = 0.0, yaw: float = 0.0) -> Array:
    return np.asarray(from_xyz_rpy((0.0, 0.0, height), (0.0, pitch, yaw)) @ CAMERA.T_body_camera)


def reasons(grid: PassageGrid, T: Array) -> np.ndarray:
    everywhere = np.ones(grid.elevation.shape, dtype=bool)
    return check_visibility(grid, grid.elevation.astype(np.float64), everywhere, T, CAMERA, REACH).reshape(everywhere.shape)


@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_level_ground_in_image_and_range_is_predicted_visible(yaw: float) -> None:
    grid, T = known(), camera_at(HEIGHT, yaw=yaw)
    found = reasons(grid, T)
    centres = np.concatenate([cell_centres(STRIP, 0.01), np.zeros((*grid.elevation.shape, 1))], axis=-1)
    p = apply(inverse(T), centres)
    i = CAMERA.intrinsics
    u, v = i.fx * p[..., 0] / p[..., 2] + i.cx, i.fy * p[..., 1] / p[..., 2] + i.cy
    inside = (p[..., 2] > 0) & (u > 4) & (u < i.width - 5) & (v > 4) & (v < i.height - 5)
    outside = (p[..., 2] < 0) | (u < 0) | (u > i.width - 1) | (v < 0)
    flat = np.linalg.norm((centres - T[:3, 3])[..., :2], axis=-1)
    in_range = (p[..., 2] > CAMERA.sensor.min_range + 0.005) & (flat < REACH - 0.005)
    assert (found[inside & in_range] == SEEN).all()
    assert (found[outside] == BESIDE).all()
    assert (found[inside & (p[..., 2] < CAMERA.sensor.min_range - 0.005)] == NEAR).all()
    assert (found[inside & (flat > REACH + 0.005)] == FAR).all()
    assert not (found == HIDDEN).any()


def test_block_occludes_its_shadow() -> None:
    near, far, top = 0.7, 0.8, 0.08
    T = camera_at(HEIGHT)
    found, free = reasons(known(block=(near, far, top)), T), reasons(known(), T)
    middle = np.abs(local_centres(STRIP, 0.01)[..., 1]) < 0.05
    distance = local_centres(STRIP, 0.01)[..., 0] - 0.45 - T[0, 3]
    end = (far - T[0, 3]) * T[2, 3] / (T[2, 3] - top)
    behind = distance > far - T[0, 3] + 0.01
    assert (found[middle & behind & (distance < end - 0.02) & (free == SEEN)] == HIDDEN).all()
    assert (found[middle & (distance > end + 0.05) & (free == SEEN)] == SEEN).all()
    assert (found[middle & (distance < near - T[0, 3] - 0.01) & (free == SEEN)] == SEEN).all()


def test_higher_camera_has_less_occlusion() -> None:
    grid = known(block=(0.7, 0.8, 0.06))
    before = None
    for height in np.linspace(0.07, 0.15, 5):
        found = reasons(grid, camera_at(height))
        if before is not None:
            assert not ((found == HIDDEN) & (before == SEEN)).any()
            assert np.count_nonzero(found == HIDDEN) < np.count_nonzero(before == HIDDEN)
        before = found


@pytest.mark.parametrize("heading", [0.8, -2.0])
def test_visibility_is_invariant_to_rotation_of_scene_and_camera(heading: float) -> None:
    turn = from_xyz_rpy((3.0, -2.0, 0.0), (0.0, 0.0, heading))
    here = known(block=(0.7, 0.8, 0.06))
    origin = apply(turn, np.array([*STRIP.origin, 0.0]))
    there = replace(here, strip=Strip((float(origin[0]), float(origin[1])), heading))
    T = camera_at(HEIGHT, yaw=0.1)
    a, b = reasons(here, T), reasons(there, turn @ T)
    assert np.mean(a != b) < 1e-3  # cells on a border


def test_candidate_poses_are_within_leg_limits() -> None:
    T = from_xyz_rpy((1.0, 2.0, 0.3 + HEIGHT), (0.0, 0.0, 0.7))
    feet = apply(T, PROFILE.rest_feet(HEIGHT))
    poses = candidates(PROFILE, T, feet, 0.3)
    low, high = PROFILE.stance.body_height_range
    assert len(poses) > 10
    for pose in poses:
        assert within_limits(PROFILE, body_inverse(PROFILE, apply(inverse(pose), feet))).all()
        assert low - 1e-9 <= pose[2, 3] - 0.3 <= high + 1e-9
        np.testing.assert_allclose(pose[:2, 3], T[:2, 3])
    assert max(poses[:, 2, 3]) > 0.3 + HEIGHT + 0.03
    np.testing.assert_allclose(rpy_from_rotation(poses[0][:3, :3]), [0.0, 0.0, 0.7], atol=1e-9)
    far = feet + np.array([0.0, 0.0, -0.5])
    assert len(candidates(PROFILE, T, far, 0.3)) == 0


class ViewScene:
    """A robot in front of a scene, its map, and its view planner."""

    def __init__(self, *parts: Part, heading: float = 0.0):
        self.terrain: Terrain = build_terrain(Scenario("look", parts, Goal(1.0)), np.random.default_rng(0))
        self.renderer = Renderer(self.terrain, CAMERA.intrinsics)
        self.camera = DepthCamera(CAMERA.intrinsics, CAMERA.sensor, np.random.default_rng(1))
        self.T = from_xyz_rpy((0.0, 0.0, HEIGHT), (0.0, 0.0, heading))
        self.strip = Strip((-0.45 * math.cos(heading), -0.45 * math.sin(heading)), heading)
        self.cloud = VoxelCloud(self.strip)
        self.look(self.T)
        self.grid = self.mapped()
        self.T_camera = self.T @ CAMERA.T_body_camera
        self.view_poses = self.T_camera[None]
        self.expected = expected_heights(self.grid, self.view_poses, CAMERA, REACH, 0.0)

    def look(self, T: Array, frames: int = 8) -> None:
        T_camera = T @ CAMERA.T_body_camera
        for _ in range(frames):
            depth = self.camera.measure(self.renderer.inverse_depth(T_camera))
            scan = reduce_scan(depth, CAMERA.intrinsics, CAMERA.sensor, T_camera, max_range=REACH, max_points=14_000)
            self.cloud.insert(scan.origin + scan.points * 1e-3, scan.count)

    def mapped(self) -> PassageGrid:
        return passage_grid(self.cloud.snapshot(), self.strip, 0.01)

    def poses(self) -> Array:
        return candidates(PROFILE, self.T, apply(self.T, PROFILE.rest_feet(HEIGHT)), 0.0)

    def best(self) -> tuple[Array, np.ndarray]:
        view = best_view(self.grid, self.expected, self.grid.unseen, self.view_poses, self.poses(), CAMERA, REACH)
        assert view is not None
        return view.T_world_body, view.sees


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "heading", "kept"),
    [
        ((Plane(),), 0.0, 0.98),
        ((Plane(), Box((0.9, 0.0), (0.1, 0.3), 0.08)), 0.0, 0.93),
        ((Plane(), Box((0.75, 0.4), (0.1, 0.3), 0.10)), 0.6, 0.93),
        (GAP, 0.0, 0.6),  # nothing is known outside the picture, where the ground breaks off
    ],
    ids=["level", "block", "turned", "gap"],
)
def test_image_from_proposed_pose_shows_predicted_cells(parts: tuple[Part, ...], heading: float, kept: float) -> None:
    robot = ViewScene(*parts, heading=heading)
    T, promised = robot.best()
    assert promised.sum() > 100
    assert not (promised & ~robot.grid.unseen).any()
    shown = []
    for pose in (robot.T, T):
        robot.look(pose)
        shown.append(np.mean(~robot.mapped().unseen[promised]))
    assert shown[0] < 0.1  # the present pose shows nothing new
    assert shown[1] > kept


@pytest.mark.slow
def test_proposed_pose_shows_nearly_as_much_as_best_candidate() -> None:
    robot = ViewScene(Plane(), Box((0.9, 0.0), (0.1, 0.3), 0.08))
    gains = []
    for pose in [robot.best()[0], *robot.poses()[::7]]:
        other = ViewScene(Plane(), Box((0.9, 0.0), (0.1, 0.3), 0.08))
        other.look(pose, frames=3)
        gains.append(np.count_nonzero(robot.grid.unseen & ~other.mapped().unseen))
    assert gains[0] > 0.93 * max(gains[1:])


def test_expected_height_behind_block_is_visible_floor() -> None:
    robot = ViewScene(Plane(), Box((0.9, 0.0), (0.1, 0.3), 0.08))
    local = local_centres(robot.strip, 0.01) - [0.45, 0.0]
    shadow = (local[..., 0] > 1.0) & (local[..., 0] < 1.2) & (np.abs(local[..., 1]) < 0.1)
    assert robot.grid.unseen[shadow].all()
    assert np.abs(robot.expected[shadow]).max() < 0.005
    found = check_visibility(robot.grid, robot.expected, shadow, robot.T_camera, CAMERA, REACH)
    assert (found == HIDDEN).all()


def test_expected_height_under_camera_is_that_of_surrounding_ground() -> None:
    grid = known(Strip((0.0, 0.0), 0.0), (0.0, 0.2, 0.05))
    T = camera_at(HEIGHT)
    T[:2, 3] = cell_centres(grid.strip, 0.01)[55, 50]
    grid.elevation[53:58, 48:53] = np.nan
    around = expected_heights(grid, T[None], CAMERA, REACH, level=1.0)[53:58, 48:53]
    np.testing.assert_allclose(around, 0.05, atol=1e-6)


def test_expected_height_before_pillar_is_gap_floor() -> None:
    robot = ViewScene(*GAP)
    local = local_centres(robot.strip, 0.01) - [0.45, 0.0]
    before = (local[..., 0] > 0.78) & (local[..., 0] < 0.87) & (np.abs(local[..., 1] - 0.15) < 0.04)
    assert robot.grid.unseen[before].all()
    np.testing.assert_allclose(robot.expected[before], -0.3, atol=0.01)


def test_no_view_is_proposed_without_unseen_or_observable_cells() -> None:
    robot = ViewScene(Plane())
    nothing = np.zeros(robot.grid.elevation.shape, dtype=bool)
    assert best_view(robot.grid, robot.expected, nothing, robot.view_poses, robot.poses(), CAMERA, REACH) is None
    assert best_view(robot.grid, robot.expected, robot.grid.unseen, robot.view_poses, robot.poses()[:0], CAMERA, REACH) is None
    assert describe_unseen_cells(known(), np.empty(0, np.uint8)) == ""
    abyss = ViewScene(Box((-0.2, 0.0), (1.5, 4.0), 0.0))
    x, y = np.moveaxis(local_centres(abyss.strip, 0.01) - [0.45, 0.0], -1, 0)
    ahead = abyss.grid.unseen & (x > 0.6) & (x < 1.0) & (np.abs(y) < 0.2)
    assert best_view(abyss.grid, abyss.expected, ahead, abyss.view_poses, abyss.poses(), CAMERA, REACH) is None


def test_description_of_unseen_cells_names_reasons() -> None:
    robot = ViewScene(Plane(), Box((0.9, 0.0), (0.1, 0.3), 0.08))
    unseen = robot.grid.unseen
    why = check_visibility(robot.grid, robot.expected, unseen, robot.T_camera, CAMERA, REACH)
    words = describe_unseen_cells(robot.grid, why)
    assert words.startswith(f"{unseen.sum()} of 27000 cells not seen: ")
    for text in ("closer than the camera's minimum range", "too far", "outside the image", "hidden behind"):
        assert text in words
    nowhere = replace(robot.grid, elevation=np.full_like(robot.grid.elevation, np.nan))
    np.testing.assert_array_equal(expected_heights(nowhere, robot.view_poses, CAMERA, REACH, 0.25), 0.25)
