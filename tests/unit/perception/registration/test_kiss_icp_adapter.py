"""KISS-ICP adapter with the common registration interface."""

import sys

import numpy as np
import pytest

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.camera_correction import CameraCorrection
from sextant.services.perception.registration.error_twist import error_twist
from sextant.services.perception.registration.frame_registration import FrameRegistration
from sextant.services.perception.registration.kiss_icp_adapter import KissRegistration
from sextant.shared.geometry import inverse
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.profiles import load_profile

WIDE_CAMERA = Intrinsics(320, 240, 160.0, 160.0, 159.5, 119.5)  # 90 deg wide
WIDE_SENSOR = DepthSensor(min_range=0.2, max_range=3.0, baseline=0.25)
SPREAD = np.diag([0.01] * 3 + [0.01] * 3) ** 2


@pytest.fixture
def pillars():
    rng = np.random.default_rng(1)
    corners = rng.uniform([0.3, -1.0], [2.5, 1.0], (14, 2))
    return np.column_stack([corners, np.zeros(14), corners + 0.15, rng.uniform(0.05, 0.3, 14)])


def walk(world, boxes, frames=21):
    """Return true poses and results of a walk of 1 cm per frame.

    The odometry measures 20 % too much.
    """
    rng = np.random.default_rng(2)
    registration = KissRegistration(WIDE_CAMERA, WIDE_SENSOR)
    truth = world.walk(frames, 0.01)
    results = []
    for i, T in enumerate(truth):
        prior = T
        if i:
            motion = inverse(truth[i - 1]) @ T
            motion[:3, 3] *= 1.2
            prior = results[-1].T_world_camera @ motion
        depth = world.depth_image(T, boxes, rng, WIDE_CAMERA, WIDE_SENSOR)
        results.append(registration.update(depth, i, prior, SPREAD))
    return truth, results


@pytest.mark.slow
def test_walk_among_pillars_is_tracked(world, pillars):
    truth, results = walk(world, pillars)
    assert all(r.ok for r in results)
    error = error_twist(results[-1].T_world_camera, truth[-1])
    assert np.linalg.norm(error[:3]) < 0.015  # odometry only ends 0.04 m off
    assert np.degrees(np.abs(error[3:])).max() < 1.0


@pytest.mark.slow
def test_registration_is_deterministic(world, pillars):
    first, second = (b"".join(r.T_world_camera.tobytes() for r in walk(world, pillars, 4)[1]) for _ in range(2))
    assert first == second


@pytest.mark.slow
def test_flat_floor_keeps_prior_in_unobservable_directions(world):
    registration = KissRegistration(WIDE_CAMERA, WIDE_SENSOR)
    rng = np.random.default_rng(3)
    T = world.camera_pose(0.0)
    registration.update(world.depth_image(T, (), rng, WIDE_CAMERA, WIDE_SENSOR), 0, T, SPREAD)
    T_next, prior = world.camera_pose(0.02), world.camera_pose(0.03, 0.01, yaw=0.01, z=0.26)
    result = registration.update(world.depth_image(T_next, (), rng, WIDE_CAMERA, WIDE_SENSOR), 1, prior, SPREAD)
    assert result.ok
    assert np.abs(error_twist(result.T_world_camera, prior)[[0, 1, 5]]).max() < 0.002
    assert abs(result.T_world_camera[2, 3] - 0.25) < 0.003


def test_lost_map_restarts_after_15_failed_frames(world, pillars):
    registration = KissRegistration(WIDE_CAMERA, WIDE_SENSOR)
    T, far = world.camera_pose(0.0), world.camera_pose(3.0, 0.5)
    registration.update(world.depth_image(T, pillars, None, WIDE_CAMERA, WIDE_SENSOR), 0, T, SPREAD)
    depth = world.depth_image(far, (), None, WIDE_CAMERA, WIDE_SENSOR)
    results = [registration.update(depth, i, far, SPREAD) for i in range(1, 17)]
    assert [r.ok for r in results] == [False] * 15 + [True]
    assert "restarts" in results[14].reason


def test_empty_image_and_invalid_arguments_are_reported(world):
    registration = KissRegistration(world.intrinsics, world.sensor)
    dark = registration.update(np.zeros((480, 640), np.uint16), 0, np.eye(4), SPREAD)
    assert not dark.ok
    assert "measured" in dark.reason
    with pytest.raises(ValueError, match="positive voxel size"):
        KissRegistration(world.intrinsics, world.sensor, voxel_size=0.0)
    with pytest.raises(ValueError, match="uint16"):
        registration.update(np.zeros((480, 640)), 0, np.eye(4), SPREAD)


def test_missing_library_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    monkeypatch.delitem(sys.modules, "sextant.services.perception.registration.kiss_icp_adapter")
    profile = load_profile("phantomx_mk2")
    with pytest.raises(ValueError, match=r"needs the library kiss-icp: .*; pip install kiss-icp"):
        FrameRegistration(profile, Settings(method="kiss-icp"), CameraCorrection(profile.camera))
