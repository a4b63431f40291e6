"""Depth images of a floor with boxes, as a PrimeSense-like depth camera sees it."""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import from_xyz_rpy, transform
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.runtime.compiled import compiled

INTRINSICS = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
SENSOR = DepthSensor()
R_FORWARD_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # body axes from camera axes


@compiled
def _cast(rays, R, p, boxes, out):  # type: ignore[no-untyped-def]
    """Compute the depth of the nearest surface along each ray with z = 1.

    Surfaces are the floor z = 0 and the boxes; the depth is infinite where a ray meets none.
    """
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
    """Return the raw depth (h, w) of the world at a pose.

    Disparity noise is added if a generator is given.
    """
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
    """Return T_world_camera of a camera that looks ahead and down."""
    return from_xyz_rpy([x, y, z], [roll, pitch, yaw]) @ transform(R_FORWARD_OPTICAL, np.zeros(3))
