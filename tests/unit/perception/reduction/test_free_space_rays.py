"""Free-space rays: the space along them is free, and doubtful pixels give none."""

import numpy as np
import pytest

from sextant.services.perception.reduction.free_space_rays import compute_free_rays
from sextant.shared.robot.camera import DepthSensor, Intrinsics

WALL = np.array([[1.2, -0.3, 0.0, 1.3, 0.3, 0.1]])


def sights(world, depth, T, **settings):
    return compute_free_rays(depth, world.intrinsics, world.sensor, T, **settings)


@pytest.mark.slow
def test_rays_end_at_scan_range_above_ground(world):
    T = world.camera_pose(0.2)
    points = sights(world, world.depth_image(T, WALL), T, max_range=0.9)
    assert len(points) > 50
    np.testing.assert_allclose(np.linalg.norm(points[:, :2] - T[:2, 3], axis=1), 0.9, atol=1e-6)
    assert (points[:, 2] > 0).all()
    assert len(sights(world, world.depth_image(T, WALL), T, max_range=10.0)) == 0


def test_consecutive_images_use_different_pixels(world):
    T = world.camera_pose(0.2)
    depth = world.depth_image(T)
    turns = [sights(world, depth, T, max_range=0.9, image_number=k) for k in range(16)]
    every = np.round(np.concatenate(turns), 6)
    assert len(np.unique(every, axis=0)) == len(every)


@pytest.mark.parametrize("above", [True, False])
def test_pixels_without_return_give_rays_only_below_empty_columns(world, above):
    T = world.camera_pose(0.2)
    depth = world.depth_image(T)
    h, w = depth.shape
    depth[: h // 2, w // 4 : w // 2] = 0
    if not above:
        depth[:16, w // 4 : w // 2] = 1000  # the pixels above do return a depth
    range_ = 1.4
    before = sights(world, depth, T, max_range=range_)
    after = sights(world, depth, T, max_range=range_, count_empty=True)
    assert (len(after) > len(before) + 20) == above
    near = np.zeros_like(depth)
    near[: h // 2] = world.depth_image(T)[: h // 2]  # the ground at the feet is too near, which is not a drop
    assert len(sights(world, near, T, max_range=range_, count_empty=True)) == len(sights(world, near, T, max_range=range_))


def test_ray_count_fits_message_at_any_image_size() -> None:
    pixels = Intrinsics(1440, 1440, 800.0, 800.0, 720.0, 720.0)
    seen = compute_free_rays(np.full((1440, 1440), 2000, dtype=np.uint16), pixels, DepthSensor(), np.eye(4), max_range=0.9)
    assert 900 < len(seen) <= 2000
