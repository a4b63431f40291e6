"""Free rays, by which the mapper clears objects that have gone."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.runtime.compiled import compiled

_MOST = 2000  # rays of an image that a message has room for in addition to the scan
_APART = 16  # [px] between rays of an image; the next image uses pixels between them
_STRIDE = 7  # pixel offset per image, coprime to the spacing, so that every pixel is used after some time
_BLOCK = 8  # [px] between the pixels that decide whether a block of the image is empty


def compute_free_rays(
    depth_raw: NDArray[np.uint16],
    intrinsics: Intrinsics,
    sensor: DepthSensor,
    T_world_camera: Array,
    *,
    max_range: float = 1.5,
    image_number: int = 0,
    count_empty: bool = False,
) -> Array:
    """Compute the ends of rays that are free beyond the range of the reduced scan.

    A pixel with a surface beyond the scan's range proves a free ray. A pixel without a return may be too near, too dark or
    at a grazing angle, as well as too far. It counts only if the image around and above it is also empty, as beyond the end
    of the ground or in the sky. The map should require more of these rays than of the others, so they are excluded by
    default.

    Args:
        depth_raw: (h, w) raw depth, 0 = no return.
        intrinsics: Of that image.
        sensor: Range and raw unit of the camera.
        T_world_camera: (4, 4) pose of the camera.
        max_range: [m] horizontal distance from the camera at which both scans and these rays end.
        image_number: Number of the image, which selects the pixels.
        count_empty: Whether pixels without a return count.

    Returns:
        (m, 3) [m] {world}
    """
    first = (_STRIDE * image_number) % _APART
    pixels = first, (5 * first + image_number) % _APART
    lens = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    limits = sensor.min_range, sensor.max_range, max_range
    empty = _empty(depth_raw) if count_empty else np.zeros((0, 0), dtype=np.bool_)
    found: Array = _ends(depth_raw, sensor.depth_scale, pixels, lens, limits, T_world_camera, empty)
    return found[:: max(math.ceil(len(found) / _MOST), 1)]


@compiled
def _ends(
    depth: NDArray[np.uint16],
    depth_scale: float,
    pixels: tuple[int, int],
    lens: tuple[float, float, float, float],
    limits: tuple[float, float, float],
    T: Array,
    empty: NDArray[np.bool_],
) -> Array:
    """Return the ends (m, 3) [m] {world} of the free rays, row by row.

    Args:
        depth: (h, w) raw depth.
        depth_scale: Raw units per metre.
        pixels: Row and column of the first pixel that is used.
        lens: Focal lengths and centre [px].
        limits: [m] smallest and largest depth of the sensor, and the horizontal distance at which rays end.
        T: (4, 4) pose of the camera.
        empty: Blocks whose pixels without a return count, or of shape (0, 0).
    """
    fx, fy, cx, cy = lens
    nearest, farthest, reach = limits
    height, width = depth.shape
    out = np.empty(((height // _APART + 1) * (width // _APART + 1), 3))
    n = 0
    for i in range(pixels[0], height, _APART):
        y = (i - cy) / fy
        for j in range(pixels[1], width, _APART):
            z = depth[i, j] / depth_scale
            x = (j - cx) / fx
            # The ray per unit depth, and the depth at which it ends.
            u = T[0, 0] * x + (T[0, 1] * y + T[0, 2])
            v = T[1, 0] * x + (T[1, 1] * y + T[1, 2])
            end = min(reach / max(math.sqrt(u * u + v * v), 1e-9), farthest)
            beyond = z >= nearest and z <= farthest and z > end
            if beyond or (z == 0.0 and len(empty) > 0 and empty[i // _BLOCK, j // _BLOCK]):
                out[n, 0], out[n, 1] = T[0, 3] + end * u, T[1, 3] + end * v
                out[n, 2] = T[2, 3] + end * (T[2, 0] * x + (T[2, 1] * y + T[2, 2]))
                n += 1
    return out[:n]


def _empty(depth_raw: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Return the blocks that are empty together with their neighbours and all above."""
    nothing = depth_raw[::_BLOCK, ::_BLOCK] == 0
    aside = nothing.copy()
    aside[:, 1:] &= nothing[:, :-1]
    aside[:, :-1] &= nothing[:, 1:]
    aside[:-1] &= nothing[1:]
    return np.asarray(np.logical_and.accumulate(aside, axis=0))
