"""A small world for perception: a floor with boxes, seen by a PrimeSense-like depth camera on a walking body."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from shared.camera import DepthSensor, Intrinsics
from shared.compiled import compiled
from shared.geometry import from_xyz_rpy, transform

INTRINSICS = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
SENSOR = DepthSensor()
R_FORWARD_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # body axes from camera axes


@compiled
def _cast(rays, R, p, boxes, out):  # type: ignore[no-untyped-def]
    """Depth of the nearest surface along each ray with z = 1: the floor z = 0 or a box; infinite where none."""
    for n in range(len(rays)):
        dx = R[0, 0] * rays[n, 0] + R[0, 1] * rays[n, 1] + R[0, 2]
        dy = R[1, 0] * rays[n, 0] + R[1, 1] * rays[n, 1] + R[1, 2]
        dz = R[2, 0] * rays[n, 0] + R[2, 1] * rays[n, 1] + R[2, 2]
        nearest = -p[2] / dz if dz < 0.0 else np.inf
        ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
        for k in range(len(boxes)):
            ax, bx = (boxes[k, 0] - p[0]) * ix, (boxes[k, 3] - p[0]) * ix
            ay, by = (boxes[k, 1] - p[1]) * iy, (boxes[k, 4] - p[1]) * iy
            az, bz = (boxes[k, 2] - p[2]) * iz, (boxes[k, 5] - p[2]) * iz
            enter = max(min(ax, bx), min(ay, by), min(az, bz))
            leave = min(max(ax, bx), max(ay, by), max(az, bz))
            if 0.0 < enter < leave and enter < nearest:
                nearest = enter
        out[n] = nearest


def depth_image(T_world_camera, boxes=(), rng=None, intrinsics=INTRINSICS, sensor=SENSOR) -> NDArray[np.uint16]:
    """Raw depth (h, w) of the world at a pose, with disparity noise when a generator is given."""
    rays = intrinsics.points(np.ones((intrinsics.height, intrinsics.width))).reshape(-1, 3)
    z = np.empty(len(rays))
    _cast(rays, T_world_camera[:3, :3].copy(), T_world_camera[:3, 3].copy(), np.reshape(boxes, (-1, 6)) * 1.0, z)
    if rng is not None:
        scale = intrinsics.fx * sensor.baseline
        disparity = scale / z + sensor.disparity_sigma * rng.standard_normal(len(z))
        z = scale / np.maximum(np.round(disparity / sensor.disparity_step) * sensor.disparity_step, 1e-3)
    z[(z < sensor.min_range) | (z > sensor.max_range)] = 0.0
    return np.round(z * sensor.depth_scale).astype(np.uint16).reshape(intrinsics.height, intrinsics.width)


def camera_pose(x: float, y: float = 0.0, yaw: float = 0.0, z: float = 0.25, pitch=0.5236, roll=0.0):
    """A camera looking ahead and down: T_world_camera of its height and attitude."""
    return from_xyz_rpy([x, y, z], [roll, pitch, yaw]) @ transform(R_FORWARD_OPTICAL, np.zeros(3))


def walk(steps: int, step: float):
    """Camera poses (n, 4, 4) of a walk along x with the bob, roll, pitch and yaw of a gait."""
    s = step * np.arange(steps)
    phase = 2 * np.pi * s / 0.1  # one gait cycle every 10 cm
    return np.stack(
        [
            camera_pose(
                s[i],
                0.005 * np.sin(phase[i] / 2),
                yaw=np.radians(1.0) * np.sin(phase[i] / 3),
                z=0.25 + 0.004 * np.sin(phase[i]),
                pitch=np.radians(30 + 0.7 * np.sin(phase[i] + 1)),
                roll=np.radians(1.0) * np.sin(phase[i] / 2 + 2),
            )
            for i in range(steps)
        ]
    )


def steps_world():
    """Two stairs of 3 cm across the way, and blocks between."""
    rng = np.random.default_rng(5)
    boxes = [[1.2, -2, 0, 6, 2, 0.03], [1.6, -2, 0, 6, 2, 0.06]]
    for x in np.arange(0.5, 4.5, 0.3):
        base = 0.03 * (x > 1.2) + 0.03 * (x > 1.6)
        for _ in range(2):
            cx, cy = x + rng.uniform(-0.1, 0.1), rng.uniform(-0.5, 0.5)
            boxes.append([cx, cy, 0, cx + 0.15, cy + 0.2, base + rng.uniform(0.01, 0.04)])
    return np.array(boxes)


def boxes_world():
    """A floor with a low box every half metre or so."""
    rng = np.random.default_rng(6)
    centres = np.column_stack([np.arange(0.6, 5.0, 0.45), rng.uniform(-0.4, 0.4, 10)])
    heights = rng.uniform(0.02, 0.06, 10)
    return np.array([[x, y, 0.0, x + 0.12, y + 0.12, h] for (x, y), h in zip(centres, heights, strict=True)])


def pillars_world():
    """Posts of all heights, close together: every direction is constrained."""
    rng = np.random.default_rng(7)
    corners = rng.uniform([0.5, -0.8], [3.0, 0.8], (40, 2))
    return np.column_stack([corners, np.zeros(40), corners + 0.08, rng.uniform(0.03, 0.2, 40)])


@dataclass(frozen=True)
class World:
    """What tests need of this file, given through a fixture."""

    intrinsics: Intrinsics
    sensor: DepthSensor
    depth_image: Callable[..., NDArray[np.uint16]]
    camera_pose: Callable[..., NDArray[np.float64]]
    walk: Callable[[int, float], NDArray[np.float64]]
    scenes: dict[str, NDArray[np.float64]]


@pytest.fixture(scope="session")
def world() -> World:
    return World(
        INTRINSICS,
        SENSOR,
        depth_image,
        camera_pose,
        walk,
        {"flat": np.zeros((0, 6)), "boxes": boxes_world(), "steps": steps_world(), "pillars": pillars_world()},
    )
