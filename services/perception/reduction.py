"""From a depth frame to one point per map cell seen: what crosses the radio instead of the image.

Masri 2016, section 4.1.1, cuts a box out of the cloud; here the cloud is never built. Pixels are binned straight into
1 cm cells of the world, since by image block the floor 1.5 m ahead would be sampled every 6 cm.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.camera import DepthSensor, Intrinsics
from shared.compiled import compiled

Array = NDArray[Any]

_JUMP = 0.015  # [m] depth step over two pixels, beyond noise and slope, that parts two surfaces
_SURFACE = 0.010  # [m] height, beyond noise, by which a point lies below the surface a foot would stand on
_NOISE = 3.0  # [sigma] of the depth noise on top of either


@dataclass(frozen=True, slots=True, eq=False)
class ReducedScan:
    """One point per cell seen, nearest cells first where there were too many."""

    origin: NDArray[np.float64]  # (3,) [m] {world} on a cell corner next to the camera
    points: NDArray[np.int16]  # (n, 3) [mm] {world} from origin, mean of a cell's upper surface, 1 mm inside its border
    count: NDArray[np.uint8]  # (n,) pixels on that surface, 255 for more
    spread: NDArray[np.uint8]  # (n,) [mm] from the lowest to the highest pixel of the cell on any surface, 255 for more


def reduce_scan(
    depth_raw: NDArray[np.uint16],
    intrinsics: Intrinsics,
    sensor: DepthSensor,
    T_world_camera: NDArray[np.float64],
    *,
    resolution: float = 0.01,
    max_range: float = 2.0,
    max_points: int = 6000,
    ceiling: float = math.inf,
) -> ReducedScan:
    """Bin the pixels of a frame by world x and y; each cell keeps the mean of its upper surface.

    Pixels between two surfaces are dropped first: on both sides of such a pixel, along a row or a column, depth
    jumps, one way in front and the other way behind, or there is no return.

    Args:
        depth_raw: (h, w) raw depth, 0 = no return.
        intrinsics: Of that image.
        sensor: Range, noise and raw unit of the camera.
        T_world_camera: (4, 4) pose of the camera.
        resolution: [m] cell edge; cells are aligned with the world's origin.
        max_range: [m] horizontal distance from the camera beyond which cells are left out; at most 30.
        max_points: At most so many cells, the nearest to the camera.
        ceiling: [m] above the camera beyond which points are no ground.

    Raises:
        ValueError: A shape or type that differs, or a number out of range.
    """
    if depth_raw.shape != (intrinsics.height, intrinsics.width) or depth_raw.dtype != np.uint16:
        raise ValueError(
            f"uint16 depth image {(intrinsics.height, intrinsics.width)} expected, found {depth_raw.dtype} {depth_raw.shape}"
        )
    if T_world_camera.shape != (4, 4) or not np.isfinite(T_world_camera).all():
        raise ValueError(f"a finite (4, 4) pose expected, found {T_world_camera.tolist()}")
    if not (0.005 <= resolution <= 1.0 and resolution <= max_range <= 30.0 and max_points >= 1):
        raise ValueError(
            f"resolution in 0.005..1 m, max_range from it to 30 m and max_points >= 1 expected, "
            f"found {resolution}, {max_range} and {max_points}"
        )
    origin = np.floor(T_world_camera[:3, 3] / resolution) * resolution
    T = T_world_camera.copy()
    T[:3, 3] -= origin
    depth, noise, jump = _tables(sensor, intrinsics.fx)
    half = math.ceil(max_range / resolution) + 2
    cell_of = np.full((2 * half, 2 * half), -1, dtype=np.int32)
    cells = np.empty((min(depth_raw.size, cell_of.size), 8))
    n = _bin(
        depth_raw,
        depth,
        noise,
        jump,
        (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx,
        (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy,
        T,
        resolution,
        max_range,
        ceiling,
        0.25 * resolution * intrinsics.fx,
        cell_of,
        cells,
    )
    kept = cells[:n]
    if n > max_points:
        squares = (kept[:, 1] / kept[:, 0] - T[0, 3]) ** 2 + (kept[:, 2] / kept[:, 0] - T[1, 3]) ** 2
        farthest = np.partition(squares, max_points - 1)[max_points - 1]
        kept = kept[np.flatnonzero(squares <= farthest)[:max_points]]
    means = kept[:, 1:4] / kept[:, :1]
    millimetres = np.round(1000.0 * means)
    # Rounding must not carry a point across, or onto, the border of its cell.
    corner = 1000.0 * resolution * np.floor(means[:, :2] / resolution)
    millimetres[:, :2] = np.clip(millimetres[:, :2], np.floor(corner + 1.0), np.ceil(corner + 1000.0 * resolution - 1.0))
    points = np.clip(millimetres, -32767, 32767).astype(np.int16)
    count = np.minimum(kept[:, 0], 255).astype(np.uint8)
    spread = np.minimum(np.round(1000.0 * (kept[:, 6] - kept[:, 5])), 255).astype(np.uint8)
    return ReducedScan(origin, points, count, spread)


@lru_cache(maxsize=8)
def _tables(sensor: DepthSensor, fx: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """By raw value (65536,): depth [m], 0 where invalid; its noise as a share of it; the raw step that is a jump."""
    z = np.arange(65536) / sensor.depth_scale
    depth = np.where((z >= sensor.min_range) & (z <= sensor.max_range), z, 0.0)
    noise = _NOISE * sensor.sigma(z, fx)
    jump = np.minimum((_JUMP + noise) * sensor.depth_scale, 65536).astype(np.int32)
    return depth, noise / np.maximum(z, 1e-9), jump


@compiled
def _bin(
    raw: Array,
    depth: Array,
    noise: Array,
    jump: Array,
    x: Array,
    y: Array,
    T: Array,
    resolution: float,
    max_range: float,
    ceiling: float,
    dense: float,
    cell_of: Array,
    cells: Array,
) -> int:
    """Sum the pixels of each cell's upper surface: cells (n, 8) hold count, sums of x, y, z, top, lowest, highest.

    Rows run from the top of the image down, so that of a step the tread comes before its face. Nearer than `dense`
    four pixels or more fall side by side into a cell, and every second is read.
    """
    rows, columns = raw.shape
    half = cell_of.shape[0] // 2
    per_cell = 1.0 / resolution
    range2 = max_range * max_range
    tx, ty, tz = T[0, 3], T[1, 3], T[2, 3]
    n = 0
    for i in range(rows):
        ax, ay, az = T[0, 1] * y[i] + T[0, 2], T[1, 1] * y[i] + T[1, 2], T[2, 1] * y[i] + T[2, 2]
        for j in range(columns):
            r = np.int32(raw[i, j])
            z = depth[r]
            if z == 0.0 or (z < dense and (i + j) % 2 == 1):
                continue
            limit = jump[r]
            flying = False
            for along in range(2):
                di, dj = (0, 2) if along == 0 else (2, 0)
                # Beyond the image's border nothing speaks against the pixel.
                before = np.int32(raw[i - di, j - dj]) if i >= di and j >= dj else r
                if before != 0 and abs(r - before) <= limit:
                    continue
                after = np.int32(raw[i + di, j + dj]) if i + di < rows and j + dj < columns else r
                if after != 0 and abs(after - r) <= limit:
                    continue
                if before != 0 and after != 0:
                    if (r > before) != (after > r):  # nearer, or farther, than both sides: thin, but there
                        continue
                    # A slope seen at a grazing angle goes on beyond; a pixel in the air lies between two that do not.
                    slope = np.int32(0)
                    if i >= 2 * di and j >= 2 * dj and raw[i - 2 * di, j - 2 * dj] != 0:
                        slope = abs(before - np.int32(raw[i - 2 * di, j - 2 * dj]))
                    if i + 2 * di < rows and j + 2 * dj < columns and raw[i + 2 * di, j + 2 * dj] != 0:
                        other = abs(np.int32(raw[i + 2 * di, j + 2 * dj]) - after)
                        if other > slope:
                            slope = other
                    if 2 * min(abs(r - before), abs(after - r)) <= 2 * limit + 3 * slope:
                        continue
                flying = True
                break
            if flying:
                continue
            px = (T[0, 0] * x[j] + ax) * z + tx
            py = (T[1, 0] * x[j] + ay) * z + ty
            pz = (T[2, 0] * x[j] + az) * z + tz
            dx, dy, dz = px - tx, py - ty, pz - tz
            if dx * dx + dy * dy > range2 or dz > ceiling:
                continue
            a, b = int(px * per_cell + half), int(py * per_cell + half)  # positive, so that int() rounds down
            k = cell_of[a, b]
            if k < 0:
                cell_of[a, b] = n
                cells[n, 0] = 1.0
                cells[n, 1] = px
                cells[n, 2] = py
                cells[n, 3] = cells[n, 4] = cells[n, 5] = cells[n, 6] = pz
                n += 1
                continue
            band = _SURFACE + noise[r] * abs(dz)  # depth errs along the ray: its share in height
            top = cells[k, 4]
            if pz < cells[k, 5]:
                cells[k, 5] = pz
            if pz > cells[k, 6]:
                cells[k, 6] = pz
            if pz < top - band:  # a surface below the one kept
                continue
            if pz > top + band:  # one above it
                cells[k, 0] = cells[k, 1] = cells[k, 2] = cells[k, 3] = 0.0
            if pz > top:
                cells[k, 4] = pz
            cells[k, 0] += 1.0
            cells[k, 1] += px
            cells[k, 2] += py
            cells[k, 3] += pz
    return n
