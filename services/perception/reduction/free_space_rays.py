"""Free rays, by which the mapper clears objects that have gone."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics

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
    rows = np.arange(first, depth_raw.shape[0], _APART)
    columns = np.arange((5 * first + image_number) % _APART, depth_raw.shape[1], _APART)
    z = depth_raw[first::_APART, columns[0] :: _APART] / sensor.depth_scale
    x, y = (columns - intrinsics.cx) / intrinsics.fx, (rows - intrinsics.cy) / intrinsics.fy
    ray = [R[0] * x + (R[1] * y + R[2])[:, None] for R in T_world_camera[:3, :3]]  # per unit depth, {world}
    flat = np.maximum(np.sqrt(ray[0] ** 2 + ray[1] ** 2), 1e-9)
    end = np.minimum(max_range / flat, sensor.max_range)  # depth
    free = (z >= sensor.min_range) & (z <= sensor.max_range) & (z > end)
    if count_empty:
        free |= (z == 0) & _empty(depth_raw)[np.ix_(rows // _BLOCK, columns // _BLOCK)]
    found = np.column_stack([p + end[free] * along[free] for p, along in zip(T_world_camera[:3, 3], ray, strict=True)])
    return found[:: max(math.ceil(len(found) / _MOST), 1)]


def _empty(depth_raw: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Return the blocks that are empty together with their neighbours and all above."""
    nothing = depth_raw[::_BLOCK, ::_BLOCK] == 0
    aside = nothing.copy()
    aside[:, 1:] &= nothing[:, :-1]
    aside[:, :-1] &= nothing[:, 1:]
    aside[:-1] &= nothing[1:]
    return np.asarray(np.logical_and.accumulate(aside, axis=0))
