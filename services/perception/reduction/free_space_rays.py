"""Lines of sight that meet nothing within the map: by them things that stood there and are gone are cleared."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics

_MOST = 2000  # lines of a picture, which a message has room for beside the scan
_APART = 16  # [px] between lines of sight in a picture; the next picture's lie between them
_STRIDE = 7  # prime to it: by how much they move on, so that after a while every pixel has had its turn
_BLOCK = 8  # [px] between the pixels by which a part of the picture is called empty


def free_sights(
    depth_raw: NDArray[np.uint16],
    intrinsics: Intrinsics,
    sensor: DepthSensor,
    T_world_camera: Array,
    *,
    max_range: float = 1.5,
    turn: int = 0,
    believe_empty: bool = False,
) -> Array:
    """Points up to which the camera sees nothing, though the reduced scan, which ends nearer, does not tell so.

    A pixel whose surface lies beyond the scan's range tells it for certain. One without a return may be too near, too dark
    or grazed as well as too far: it counts only if all of the picture around it and above it is empty, too, as where the
    ground ends or the sky begins; a reader should want more of these than of the others, so they are left out by default.

    Args:
        depth_raw: (h, w) raw depth, 0 = no return.
        intrinsics: Of that image.
        sensor: Range and raw unit of the camera.
        T_world_camera: (4, 4) pose of the camera.
        max_range: [m] horizontal distance from the camera at which scans end, and these do.
        turn: Number of the picture; each looks through other pixels.
        believe_empty: Whether pixels without a return count.

    Returns:
        (m, 3) [m] {world}
    """
    first = (_STRIDE * turn) % _APART
    rows = np.arange(first, depth_raw.shape[0], _APART)
    columns = np.arange((5 * first + turn) % _APART, depth_raw.shape[1], _APART)
    z = depth_raw[first::_APART, columns[0] :: _APART] / sensor.depth_scale
    x, y = (columns - intrinsics.cx) / intrinsics.fx, (rows - intrinsics.cy) / intrinsics.fy
    ray = [R[0] * x + (R[1] * y + R[2])[:, None] for R in T_world_camera[:3, :3]]  # by its depth, {world}
    flat = np.maximum(np.sqrt(ray[0] ** 2 + ray[1] ** 2), 1e-9)
    end = np.minimum(max_range / flat, sensor.max_range)  # depth
    free = (z >= sensor.min_range) & (z <= sensor.max_range) & (z > end)
    if believe_empty:
        free |= (z == 0) & _empty(depth_raw)[np.ix_(rows // _BLOCK, columns // _BLOCK)]
    found = np.column_stack([p + end[free] * along[free] for p, along in zip(T_world_camera[:3, 3], ray, strict=True)])
    return found[:: max(math.ceil(len(found) / _MOST), 1)]


def _empty(depth_raw: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Blocks of the picture that are empty with their neighbours, and with all that is above them."""
    nothing = depth_raw[::_BLOCK, ::_BLOCK] == 0
    aside = nothing.copy()
    aside[:, 1:] &= nothing[:, :-1]
    aside[:, :-1] &= nothing[:, 1:]
    aside[:-1] &= nothing[1:]
    return np.asarray(np.logical_and.accumulate(aside, axis=0))
