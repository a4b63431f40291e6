"""From a depth frame to one point per map cell seen: what crosses the radio instead of the image.

Masri 2016, section 4.1.1, cuts a box out of the cloud; here the cloud is never built. Pixels are binned straight into
1 cm cells of the world, since by image block the floor 1.5 m ahead would be sampled every 6 cm.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.camera import DepthSensor, Intrinsics
from shared.compiled import compiled

_JUMP = 0.015  # [m] depth step over two pixels, beyond noise and slope, that parts two surfaces
_SURFACE = 0.010  # [m] height, beyond noise, by which a point lies below the surface a foot would stand on
_NOISE = 3.0  # [sigma] of the depth noise on top of either


@dataclass(frozen=True, slots=True, eq=False)
class ReducedScan:
    """One point per cell seen, nearest cells first where there were too many."""

    origin: NDArray[np.float64]  # (3,) [m] {world} on a cell corner next to the camera
    points: NDArray[np.int16]  # (n, 3) [mm] {world} relative to origin, mean of the cell's upper surface
    count: NDArray[np.uint8]  # (n,) pixels on that surface, 255 for more
    spread: NDArray[np.uint8]  # (n,) [mm] from the lowest to the highest pixel of the cell on any surface, 255 for more


def reduce_scan(
    depth_raw: NDArray[np.uint16],
    intrinsics: Intrinsics,
    sensor: DepthSensor,
    T_world_camera: NDArray[np.float64],
    *,
    resolution: float = 0.01,
    max_range: float = 2.5,
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
            f"uint16 depth image {(intrinsics.height, intrinsics.width)} expected, "
            f"found {depth_raw.dtype} {depth_raw.shape}"
        )
    if T_world_camera.shape != (4, 4) or not np.isfinite(T_world_camera).all():
        raise ValueError(f"a finite (4, 4) pose expected, found {T_world_camera.tolist()}")
    if not (0.001 <= resolution <= 1.0 and resolution <= max_range <= 30.0 and max_points >= 1):
        raise ValueError(
            f"resolution in 0.001..1 m, max_range from it to 30 m and max_points >= 1 expected, "
            f"found {resolution}, {max_range} and {max_points}"
        )
    position = T_world_camera[:3, 3]
    origin = np.floor(position / resolution) * resolution
    T = T_world_camera.copy()
    T[:3, 3] -= origin
    z = np.arange(65536) / sensor.depth_scale
    inside = (z >= sensor.min_range) & (z <= sensor.max_range)
    sigma = sensor.sigma(z, intrinsics.fx)
    depth = np.where(inside, z, 0.0)
    margin = _JUMP + _NOISE * sigma
    reach = math.ceil(max_range / resolution) + 1
    cell_of = np.full((2 * reach, 2 * reach), -1, dtype=np.int32)
    cells = np.empty((min(depth_raw.size, cell_of.size), 8))
    n = _bin(
        depth_raw,
        depth,
        margin,
        _NOISE * sigma,
        (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx,
        (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy,
        T,
        resolution,
        max_range,
        ceiling,
        cell_of,
        cells,
    )
    kept = cells[:n]
    if n > max_points:
        distance = np.hypot(kept[:, 1] / kept[:, 0] - T[0, 3], kept[:, 2] / kept[:, 0] - T[1, 3])
        kept = kept[np.sort(np.argsort(distance, kind="stable")[:max_points])]
    points = np.round(1000.0 * kept[:, 1:4] / kept[:, :1])
    points = np.clip(points, -32767, 32767).astype(np.int16)
    count = np.minimum(kept[:, 0], 255).astype(np.uint8)
    spread = np.minimum(np.round(1000.0 * (kept[:, 6] - kept[:, 5])), 255).astype(np.uint8)
    return ReducedScan(origin, points, count, spread)


@compiled
def _bin(raw, depth, margin, noise, x, y, T, resolution, max_range, ceiling, cell_of, cells):  # type: ignore[no-untyped-def]
    """Sum the pixels of each cell's upper surface: cells (n, 8) hold count, sums of x, y, z, and z top, lowest, highest.

    Rows run from the top of the image down, so that of a step the tread comes before its face.
    """
    rows, columns = raw.shape
    half = cell_of.shape[0] // 2
    per_cell = 1.0 / resolution
    range2 = max_range * max_range
    n = 0
    for i in range(rows):
        for j in range(columns):
            z = depth[raw[i, j]]
            if z == 0.0:
                continue
            limit = margin[raw[i, j]]
            flying = False
            for along in range(2):
                di, dj = (0, 2) if along == 0 else (2, 0)
                # Image borders repeat the pixel, which supports it.
                before = depth[raw[i - di, j - dj]] if i >= di and j >= dj else z
                after = depth[raw[i + di, j + dj]] if i + di < rows and j + dj < columns else z
                back = z - before
                ahead = after - z
                if (before != 0.0 and abs(back) <= limit) or (after != 0.0 and abs(ahead) <= limit):
                    continue
                if before != 0.0 and after != 0.0:
                    if back * ahead < 0.0:  # nearer than both sides: thin, but there
                        continue
                    # A slope seen at a grazing angle goes on beyond; a pixel in the air lies between two that do not.
                    slope = 0.0
                    if i >= 2 * di and j >= 2 * dj:
                        beyond = depth[raw[i - 2 * di, j - 2 * dj]]
                        if beyond != 0.0:
                            slope = abs(before - beyond)
                    if i + 2 * di < rows and j + 2 * dj < columns:
                        beyond = depth[raw[i + 2 * di, j + 2 * dj]]
                        if beyond != 0.0:
                            slope = max(slope, abs(beyond - after))
                    if min(abs(back), abs(ahead)) <= limit + 1.5 * slope:
                        continue
                flying = True
                break
            if flying:
                continue
            cx, cy = x[j] * z, y[i] * z
            px = T[0, 0] * cx + T[0, 1] * cy + T[0, 2] * z + T[0, 3]
            py = T[1, 0] * cx + T[1, 1] * cy + T[1, 2] * z + T[1, 3]
            pz = T[2, 0] * cx + T[2, 1] * cy + T[2, 2] * z + T[2, 3]
            dx, dy = px - T[0, 3], py - T[1, 3]
            if dx * dx + dy * dy > range2 or pz - T[2, 3] > ceiling:
                continue
            a = int(math.floor(px * per_cell)) + half
            b = int(math.floor(py * per_cell)) + half
            if a < 0 or b < 0 or a >= 2 * half or b >= 2 * half:
                continue
            # Depth errs along the ray: its share in height.
            band = _SURFACE + noise[raw[i, j]] * abs(pz - T[2, 3]) / z
            k = cell_of[a, b]
            if k < 0:
                cell_of[a, b] = n
                cells[n, 0] = 1.0
                cells[n, 1] = px
                cells[n, 2] = py
                cells[n, 3] = pz
                cells[n, 4] = cells[n, 5] = cells[n, 6] = pz
                n += 1
                continue
            cells[k, 5] = min(cells[k, 5], pz)
            cells[k, 6] = max(cells[k, 6], pz)
            if pz > cells[k, 4] + band:  # a surface above the one known
                cells[k, 0] = 0.0
                cells[k, 1] = cells[k, 2] = cells[k, 3] = 0.0
                cells[k, 4] = pz
            elif pz < cells[k, 4] - band:
                continue
            cells[k, 4] = max(cells[k, 4], pz)
            cells[k, 0] += 1.0
            cells[k, 1] += px
            cells[k, 2] += py
            cells[k, 3] += pz
    return n
