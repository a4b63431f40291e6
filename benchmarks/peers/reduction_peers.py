"""Scan reduction with common libraries, to compare speed and results.

The result is one point per cell of a depth frame. It is the same except for rounding and ties; only Open3D's cloud has no rules
for edges and surfaces. The code is optimised as usual: whole arrays, single precision as in Sextant, no loops over pixels.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.reduction.params import ReductionParams
from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor, Intrinsics

Cells = NDArray[np.bool_]

_PARAMS = ReductionParams()


class Reduces(Protocol):
    """Reduces a depth frame to one point per map cell."""

    def reduce(self, depth: NDArray[np.uint16], T_world_camera: Array) -> Array:
        """Return points (n, 3) [m] {world} of a raw frame (h, w); camera pose (4, 4)."""
        ...


class NumpyReduction:
    """`sextant.services.perception.reduction.scan_reduction.reduce_scan` in NumPy."""

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor, resolution: float, max_range: float):
        self._x = ((np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx).astype(np.float32)
        self._y = ((np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy).astype(np.float32)[:, None]
        self._scale = np.float32(1.0 / sensor.depth_scale)
        self._bounds = sensor.min_range * sensor.depth_scale, sensor.max_range * sensor.depth_scale
        noise = _PARAMS.noise_sigmas * float(sensor.sigma(np.array(1.0), intrinsics.fx))
        self._jump, self._jump2 = np.float32(_PARAMS.jump_m * sensor.depth_scale), np.float32(noise / sensor.depth_scale)
        self._noise = np.float32(noise)
        self._dense = np.float32(0.25 * resolution * intrinsics.fx)
        self._resolution, self._range2 = resolution, np.float32(max_range**2)
        self._half = math.ceil(max_range / resolution) + 2
        rows, columns = np.indices((intrinsics.height, intrinsics.width), sparse=True)
        self._odd_row, self._every_second = rows % 2 == 1, (rows + columns) % 2 == 0
        self._every_fourth = ~self._odd_row & ((rows // 2 + columns) % 2 == 0)

    def reduce(self, depth: NDArray[np.uint16], T_world_camera: Array) -> Array:
        """Return the mean of the upper surface of each cell, rounded to millimetres."""
        origin = np.floor(T_world_camera[:3, 3] / self._resolution) * self._resolution
        R, t = T_world_camera[:3, :3].astype(np.float32), (T_world_camera[:3, 3] - origin).astype(np.float32)
        # 1. The sampled pixels, and their points relative to the camera, in world axes.
        z = depth * self._scale
        dx, dy, dz = (((R[k, 0] * self._x + (R[k, 1] * self._y + R[k, 2])) * z) for k in range(3))
        read = (depth >= self._bounds[0]) & (depth <= self._bounds[1]) & (dx * dx + dy * dy <= self._range2)
        read &= (z >= self._dense) | self._every_second
        # Rows with dense pixels on level ground are sampled one in two; their pixels count twice.
        farthest = np.where((depth >= self._bounds[0]) & (depth <= self._bounds[1]), z, 0.0).max(axis=1, keepdims=True)
        drop = -np.max(R[2, 0] * self._x[[0, -1]] + (R[2, 1] * self._y + R[2, 2]), axis=1, keepdims=True)
        crowded = (farthest < self._dense) & (farthest < self._dense * drop)
        read &= ~crowded | self._every_fourth
        weight = np.broadcast_to(1.0 + crowded, read.shape)
        # 2. Remove pixels between two surfaces.
        read &= ~self._flying(depth)
        dx, dy, dz, z, weight = dx[read], dy[read], dz[read], z[read], weight[read]
        # 3. The cell of each point, and the highest and lowest point of each cell.
        side = 2 * self._half
        per_cell = np.float32(1.0 / self._resolution)
        i = (dx * per_cell + (t[0] * per_cell + np.float32(self._half))).astype(np.int32)
        j = (dy * per_cell + (t[1] * per_cell + np.float32(self._half))).astype(np.int32)
        key = i * side + j
        band = _PARAMS.surface_m + self._noise * z * np.abs(dz)
        top, bottom = np.full(side * side, -np.inf, np.float32), np.full(side * side, np.inf, np.float32)
        np.maximum.at(top, key, dz)
        np.minimum.at(bottom, key, dz)
        # 4. The mean of the upper surface, or of the lower one if the upper one is only an edge.
        upper, lower = dz >= top[key] - band, dz <= bottom[key] + band
        count = np.bincount(key, weight, minlength=side * side)
        edge = np.bincount(key[upper], weight[upper], minlength=side * side) < _PARAMS.carrying_share * count
        chosen = np.where(edge[key], lower, upper)
        key, weight = key[chosen], weight[chosen]
        cells = np.flatnonzero(count)
        sums = np.stack([np.bincount(key, weight * d[chosen], minlength=side * side)[cells] for d in (dx, dy, dz)], axis=1)
        mean = sums / np.bincount(key, weight, minlength=side * side)[cells, None] + t
        # 5. Round, and move 1 mm inside the cell.
        mm, edge_mm = np.rint(1000.0 * mean), 1000.0 * self._resolution
        corner = edge_mm * (np.stack([cells // side, cells % side], axis=1) - self._half)
        mm[:, :2] = np.clip(mm[:, :2], np.floor(corner + 1.0), np.ceil(corner + edge_mm - 1.0))
        return np.asarray(origin + 1e-3 * mm.astype(np.int16))

    def _flying(self, depth: NDArray[np.uint16]) -> Cells:
        """Return pixels (h, w) that jump on both sides, along their row or column.

        One neighbour is in front, the other behind.
        """
        raw = depth.astype(np.int32)
        limit = (self._jump + self._jump2 * (raw.astype(np.float32) ** 2)).astype(np.int32)
        out = np.zeros(raw.shape, dtype=np.bool_)
        for axis in (0, 1):
            # A pixel at the border has itself as the missing neighbour, so it is never flying.
            before, after = _shifted(raw, axis, 2, raw), _shifted(raw, axis, -2, raw)
            steady = ((before != 0) & (np.abs(raw - before) <= limit)) | ((after != 0) & (np.abs(after - raw) <= limit))
            i, j = np.nonzero(~steady & (raw > 0))
            r, b, a, most = raw[i, j], before[i, j], after[i, j], limit[i, j]
            both = (b != 0) & (a != 0)
            thin = both & ((r > b) != (a > r))
            slope = np.zeros(len(r), dtype=np.int32)
            for side, near in ((4, b), (-4, a)):
                beyond = _shifted(raw, axis, side, np.zeros_like(raw))[i, j]
                slope = np.maximum(slope, np.where(beyond != 0, np.abs(near - beyond), 0))
            sloping = both & (2 * np.minimum(np.abs(r - b), np.abs(a - r)) <= 2 * most + 3 * slope)
            out[i, j] |= ~(thin | sloping)
        return out


def _shifted(image: NDArray[np.int32], axis: int, by: int, border: NDArray[np.int32]) -> NDArray[np.int32]:
    """Shift an image along an axis, and fill with `border`."""
    out = border.copy()
    to = (slice(None),) * axis + (slice(by, None) if by > 0 else slice(None, by),)
    of = (slice(None),) * axis + (slice(None, -by) if by > 0 else slice(-by, None),)
    out[to] = image[of]
    return out


class Open3dCloud:
    """Open3D: point cloud of a frame, reduced to the centroid of each voxel.

    A voxel has the size of a cell.
    """

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor, resolution: float, max_range: float):
        import open3d

        self._o3d: Any = open3d
        k = intrinsics
        self._intrinsics = open3d.camera.PinholeCameraIntrinsic(k.width, k.height, k.fx, k.fy, k.cx, k.cy)
        self._scale, self._far, self._resolution = sensor.depth_scale, sensor.max_range, resolution

    def reduce(self, depth: NDArray[np.uint16], T_world_camera: Array) -> Array:
        """Return centroids (n, 3) [m] {world}; at an edge, several above each other."""
        o3d = self._o3d
        cloud = o3d.geometry.PointCloud.create_from_depth_image(
            o3d.geometry.Image(depth), self._intrinsics, depth_scale=self._scale, depth_trunc=self._far
        )
        return np.asarray(cloud.transform(T_world_camera).voxel_down_sample(self._resolution).points)


REDUCTION: Mapping[str, Callable[[Intrinsics, DepthSensor, float, float], Reduces]] = {
    "NumPy": NumpyReduction,
    "Open3D cloud": Open3dCloud,
}
