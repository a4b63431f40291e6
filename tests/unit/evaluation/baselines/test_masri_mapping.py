"""Masri's terrain modelling as published: known motions are found, and his maps follow his rules."""

import math

import numpy as np
import pytest

from sextant.evaluation.baselines import masri_mapping as his
from sextant.evaluation.baselines.masri_mapping import HeightMap, Nearest, Registration, WorldModel, error_between, registered
from sextant.plugins import Frame, NoPose, Pose
from sextant.services.perception.registration.plugin_registration import PluginRegistration
from sextant.shared.geometry import Array, apply, exp_so3, inverse, transform
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")


def corner(rng: np.random.Generator, n: int = 3000) -> Array:
    """Return points (n, 3) on three faces that meet, so that each motion is observable."""
    points = rng.uniform(0.0, 0.6, (n, 3))
    points[np.arange(n), rng.integers(0, 3, n)] = 0.0
    return points + np.array([0.2, -0.3, 0.5])


def test_nearest_neighbours_are_the_nearest() -> None:
    rng = np.random.default_rng(0)
    points, query = rng.normal(size=(300, 3)), rng.normal(size=(50, 3))
    index, distance = Nearest(points).of(query)
    off = np.linalg.norm(query[:, None] - points, axis=2)
    np.testing.assert_array_equal(index[:, 0], off.argmin(axis=1))
    np.testing.assert_allclose(distance[:, 0], off.min(axis=1), atol=1e-5)


def test_centroids_keep_one_point_per_voxel() -> None:
    points = np.array([[0.01, 0.01, 0.01], [0.03, 0.03, 0.03], [0.06, 0.0, 0.0], [-0.01, 0.0, 0.0]])
    found = his.centroids(points, 0.05)
    assert sorted(found.tolist()) == [[-0.01, 0.0, 0.0], [0.02, 0.02, 0.02], [0.06, 0.0, 0.0]]


@pytest.mark.parametrize("normals", [True, False])
def test_registration_finds_a_known_motion(normals: bool) -> None:
    rng = np.random.default_rng(1)
    model = corner(rng)
    truth = transform(exp_so3(np.array([0.02, -0.01, 0.03])), np.array([0.02, -0.015, 0.01]))
    scan = apply(inverse(truth), model[rng.permutation(len(model))[:1500]])
    T, errors = registered(scan, model, np.eye(4), normals)
    off, angle = error_between(T, truth)
    assert off < (0.001 if normals else 0.004)
    assert angle < 0.01
    assert len(errors) <= his.ITERATIONS
    assert errors[-1] < errors[0]


def test_scan_without_correspondences_is_left_out() -> None:
    model, scan = WorldModel(), corner(np.random.default_rng(2))
    assert model.add(scan, np.eye(4)) is not None
    count = len(model.points)
    assert model.add(scan, transform(np.eye(3), np.array([5.0, 0.0, 0.0]))) is None
    assert len(model.points) == count


def test_height_map_keeps_the_highest_point_of_a_cell() -> None:
    model = WorldModel()
    model.points = np.array([[0.005, 0.005, 0.0], [0.006, 0.004, 0.1], [0.015, 0.005, -0.2]])
    ground = model.height_map(np.zeros(2), (3, 1), smoothed=False)
    np.testing.assert_allclose(ground.elevation[:, 0], [0.1, -0.2, np.nan], atol=1e-6)


def test_foothold_map_follows_his_rules() -> None:
    z = np.zeros((30, 30), dtype=np.float32)
    z[20:] = 0.05  # a step
    z[:, 25:] = -0.2  # deeper than 25 cm below the body
    normals = np.tile([0.0, 0.0, 1.0], (30, 30, 1))
    normals[5, 5] = [math.sin(1.0), 0.0, math.cos(1.0)]  # steeper than pi / 4
    z[10, 10] = np.nan
    B = his.accessible(HeightMap(np.zeros(2), z, normals), body_z=0.1)
    assert B[5, 5] == B[10, 10] == 0
    assert (B[19:21, :24] == 0).all()
    assert (B[:, 25:] == 0).all()
    assert B[2, 2] == B[28, 5] == 1
    F = his.evaluation(B)
    assert F.min() >= -his.BOUND
    assert (F[B == 1] < 0).all()  # closing removes no accessible cell
    assert F[10, 10] < 0  # a vacant cell is bridged


def test_plug_in_returns_a_pose_or_a_reason() -> None:
    plugin, camera = Registration(PROFILE), PROFILE.camera.intrinsics
    depth = np.full((camera.height, camera.width), 0.7, dtype=np.float32)
    depth[: camera.height // 2, : camera.width // 2] = 0.6
    T = np.eye(4)
    first = plugin.register(Frame(0, depth, T, np.eye(6)))
    assert isinstance(first, Pose)
    np.testing.assert_allclose(first.T_world_camera, T)
    second = plugin.register(Frame(1, depth, T, np.eye(6)))
    assert isinstance(second, Pose)
    assert error_between(second.T_world_camera, T)[0] < 0.005
    assert isinstance(plugin.register(Frame(2, np.zeros_like(depth), T, np.eye(6))), NoPose)


def test_perception_registers_by_the_plug_in() -> None:
    camera = PROFILE.camera
    name = "sextant.evaluation.baselines.masri_mapping:Registration"
    raw = np.full((camera.intrinsics.height, camera.intrinsics.width), round(0.7 * camera.sensor.depth_scale), dtype=np.uint16)
    found = PluginRegistration(PROFILE, name).update(raw, 0, np.eye(4), np.eye(6))
    assert found.ok
    np.testing.assert_allclose(found.T_world_camera, np.eye(4), atol=1e-9)
