"""Removal of the robot's own legs from depth images. Pure.

A leg before the camera would be mapped as ground, and would pull the registration towards "the robot stands still".
"""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.links import LINK_RADII_M

TOO_NEAR = 1  # raw depth of a removed pixel: below the range of a camera, and unlike 0 it never counts as empty space
_MARGIN_M = 0.02  # [m] around a link: for its cables and brackets, and for its motion since the joints were measured
_FOOT_M = 0.03  # [m] of the shank above the foot's centre that stays, because the ground around it is as near
_LEAST_DEPTH_M = 0.02  # [m] in front of the camera


def without_legs(
    depth: NDArray[np.uint16], legs: Array, intrinsics: Intrinsics, sensor: DepthSensor
) -> tuple[NDArray[np.uint16], int]:
    """Remove the pixels of legs from a depth image.

    Args:
        depth: (h, w) raw depth, without distortion.
        legs: (6, 4, 3) [m] {camera} coxa axis, femur axis, knee and foot centre of each leg.
        intrinsics: Of the image.
        sensor: Range and raw unit of the camera.

    Returns:
        The image, a copy if something was removed; and the number of removed pixels.
    """
    made, removed = depth, 0
    for leg in legs:
        shank = leg[3] - leg[2]
        end = leg[2] + shank * max(1.0 - _FOOT_M / max(float(np.linalg.norm(shank)), 1e-9), 0.0)
        for a, b, radius in zip(leg[:3], (leg[1], leg[2], end), LINK_RADII_M, strict=True):
            reach = radius + _MARGIN_M
            if max(a[2], b[2]) + reach < sensor.min_range:  # too near to be measured, or behind the camera
                continue
            window = _window(a, b, reach, intrinsics)
            if window is None:
                continue
            hits = _hits(made[window], window, a, b, reach, intrinsics, sensor)
            if hits.any():
                made = depth.copy() if made is depth else made
                removed += int(np.count_nonzero(hits))
                made[window][hits] = TOO_NEAR if sensor.raw_bounds[0] > TOO_NEAR else 0
    return made, removed


def _window(a: Array, b: Array, reach: float, intrinsics: Intrinsics) -> tuple[slice, slice] | None:
    """Return rows and columns that points within `reach` [m] of the segment from a to b (3,) {camera} may cover, if any."""
    near = np.array([a, b])
    z = np.maximum(near[:, 2:] + [-reach, reach], _LEAST_DEPTH_M)  # (2, 2)
    spans = []
    for axis, focal, centre, size in (
        (1, intrinsics.fy, intrinsics.cy, intrinsics.height),
        (0, intrinsics.fx, intrinsics.cx, intrinsics.width),
    ):
        edges = centre + focal * (near[:, axis, None, None] + np.array([-reach, reach])[:, None]) / z[:, None, :]
        low, high = int(np.clip(np.floor(edges.min()), 0, size)), int(np.clip(np.ceil(edges.max()) + 1, 0, size))
        if low >= high:
            return None
        spans.append(slice(low, high))
    return spans[0], spans[1]


def _hits(
    depth: NDArray[np.uint16],
    window: tuple[slice, slice],
    a: Array,
    b: Array,
    reach: float,
    intrinsics: Intrinsics,
    sensor: DepthSensor,
) -> NDArray[np.bool_]:
    """Return the pixels of a window whose points lie within `reach` [m] of the segment from a to b (3,) {camera}."""
    hits = np.zeros(depth.shape, dtype=np.bool_)
    low, high = (max(min(a[2], b[2]) - reach, sensor.min_range), max(a[2], b[2]) + reach)
    rows, columns = np.nonzero((depth >= low * sensor.depth_scale) & (depth <= high * sensor.depth_scale))
    if not len(rows):
        return hits
    z = depth[rows, columns] / sensor.depth_scale
    x = (columns + window[1].start - intrinsics.cx) / intrinsics.fx * z
    y = (rows + window[0].start - intrinsics.cy) / intrinsics.fy * z
    from_a = np.column_stack((x, y, z)) - a
    along = b - a
    share = np.clip(from_a @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    off = from_a - share[:, None] * along
    hits[rows, columns] = np.einsum("ij,ij->i", off, off) <= reach * reach
    return hits
