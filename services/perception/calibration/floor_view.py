"""The floor in a depth image, as mean inverse depths of blocks of pixels.

The inverse depth of a plane is an affine function of the pixel, so the floor is a plane in inverse depth, too.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.profile import Camera
from sextant.shared.wire.messages import FloorView

BLOCK_PX = 40  # [px] edge of a block
_FULL = 0.7  # share of a block's pixels that must have a depth
_ROUNDS = 10  # of the fit of the floor
_FIRST_SHARE, _LAST_SHARE = 0.25, 0.05  # [1] relative inverse depth by which the floor may differ, in the first and last round


def block_centres(lens: Intrinsics) -> tuple[Array, Array]:
    """Return the pixels u and v, each (blocks,), in the middle of the blocks."""
    rows, columns = lens.height // BLOCK_PX, lens.width // BLOCK_PX
    middle = (BLOCK_PX - 1) / 2
    v, u = np.mgrid[:rows, :columns] * BLOCK_PX + middle
    return u.ravel(), v.ravel()


def expected_floor(camera: Camera, soles: Array) -> Array:
    """Return the inverse depth (blocks,) [1/m] of the plane of soles (6, 3) [m] {body}; NaN beyond the camera's range."""
    lens = camera.intrinsics
    u, v = block_centres(lens)
    centre = soles.mean(axis=0)
    normal = np.linalg.svd(soles - centre)[2][2]
    rays = camera.T_body_camera[:3, :3] @ np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(len(u))])
    w = -(normal @ rays) / (normal @ (camera.T_body_camera[:3, 3] - centre))
    return np.where(w > 1.0 / camera.sensor.max_range, w, np.nan)


def floor_view(stamp_ns: int, raw: NDArray[np.uint16], camera: Camera, expected: Array) -> FloorView:
    """Find the floor in a depth image.

    Args:
        stamp_ns: [ns] of the image.
        raw: (h, w) depth image.
        camera: The camera; neither its depth error nor its distortion is corrected.
        expected: (blocks,) [1/m] inverse depth of the floor according to the robot's profile; NaN above the horizon.
    """
    lens = camera.intrinsics
    if raw.shape != (lens.height, lens.width):
        return FloorView(stamp_ns, np.full(len(expected), np.nan))
    blocks = _block_means(raw, lens, camera.sensor)
    u, v = block_centres(lens)
    design = np.stack([u / lens.fx, v / lens.fy, np.ones(len(u))], axis=1)
    floor = expected
    for share in np.geomspace(_FIRST_SHARE, _LAST_SHARE, _ROUNDS):
        near = np.abs(blocks - floor) < share * floor  # False for NaN
        if near.sum() < 2 * design.shape[1]:
            return FloorView(stamp_ns, np.full(len(u), np.nan))
        floor = design @ np.linalg.lstsq(design[near], blocks[near], rcond=None)[0]
    return FloorView(stamp_ns, np.where(np.abs(blocks - floor) < _LAST_SHARE * floor, blocks, np.nan))


def _block_means(raw: NDArray[np.uint16], lens: Intrinsics, sensor: DepthSensor) -> Array:
    """Return the mean inverse depth (blocks,) [1/m] of each block; NaN where too few pixels have a depth."""
    rows, columns = lens.height // BLOCK_PX, lens.width // BLOCK_PX
    low, high = sensor.raw_bounds
    tiles = raw[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX)
    seen = (tiles >= low) & (tiles <= high)
    inverse = np.divide(sensor.depth_scale, tiles, out=np.zeros(tiles.shape), where=seen)
    count = seen.sum(axis=(1, 3))
    enough = count >= _FULL * BLOCK_PX**2
    return np.where(enough, inverse.sum(axis=(1, 3)) / np.maximum(count, 1), np.nan).ravel()
