"""Reduction of a depth frame to one point per visible map cell, for transmission.

Masri 2016, section 4.1.1, crops a box from the point cloud; here the cloud is never built. Pixels are binned directly into
1 cm cells of the world, because image blocks would sample the floor 1.5 m ahead only every 6 cm.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.reduction.params import ReductionParams
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.runtime.compiled import compiled

Array = NDArray[Any]

_RECORD = 16  # values per cell: one cache line


@dataclass(frozen=True, slots=True, eq=False)
class ReducedScan:
    """One point per visible cell, in the row order of the grid.

    If there are too many, it holds the nearest cells.
    """

    origin: NDArray[np.float64]  # (3,) [m] {world} on a cell corner next to the camera
    points: NDArray[np.int16]  # (n, 3) [mm] {world} from origin, mean of a cell's surface, at least 1 mm inside its border
    count: NDArray[np.uint8]  # (n,) pixels on that surface, 255 for more
    spread: NDArray[np.uint8]  # (n,) [mm] height range of all pixels of the cell, 255 for more


def reduce_scan(
    depth_raw: NDArray[np.uint16],
    intrinsics: Intrinsics,
    sensor: DepthSensor,
    T_world_camera: NDArray[np.float64],
    *,
    resolution: float = 0.01,
    max_range: float = 2.0,
    max_points: int = 20_000,
    ceiling: float = math.inf,
    params: ReductionParams | None = None,
) -> ReducedScan:
    """Bin the pixels of a frame by world x and y, with one mean surface per cell.

    The upper surface is used if it holds 30 % of the cell's pixels. A block that only reaches slightly into a cell, or noise
    at its edge, therefore does not fill the cell. Otherwise the lower surface is used, with two exceptions. If it is a face
    that rises to the upper surface, and no adjacent cell shows level ground at that height, the upper surface is used. A
    wall with its top out of view thus counts with its highest visible part, and not with its middle. The upper surface is also
    used between two cells of level ground at its height, if the lower one is deep below it: these pixels then show a wall below
    an overhang.

    Pixels between two surfaces are dropped first. On both sides of such a pixel, along a row or a column, the depth jumps,
    to the front on one side and to the back on the other, or there is no return.

    Args:
        depth_raw: (h, w) raw depth, 0 = no return.
        intrinsics: Of that image.
        sensor: Range, noise and raw unit of the camera.
        T_world_camera: (4, 4) pose of the camera.
        resolution: [m] cell edge; cells are aligned with the world's origin.
        max_range: [m] horizontal distance from the camera beyond which cells are omitted; at most 30.
        max_points: Maximum number of cells, the nearest to the camera.
        ceiling: [m] above the camera beyond which points are not ground.
        params: Which pixels belong to a surface.

    Raises:
        ValueError: A shape or type is wrong, or a number is out of range.
    """
    intrinsics.check_raw(depth_raw)
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
    half = math.ceil(max_range / resolution) + 2
    cell_of = np.full((2 * half) ** 2, -1, dtype=np.int32)
    cells = np.empty((min(depth_raw.size, cell_of.size), _RECORD), dtype=np.float32)
    params = params or ReductionParams()
    surfaces = _Surfaces(**{name: getattr(params, name) for name in _Surfaces._fields})
    noise = params.noise_sigmas * float(sensor.sigma(np.array(1.0), intrinsics.fx))  # [1/m] depth noise over squared depth
    rays = _Rays(
        (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx,
        (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy,
        sensor.raw_bounds,
        1.0 / sensor.depth_scale,
        noise,
    )
    region = _Region(resolution, max_range, ceiling, 0.25 * resolution * intrinsics.fx, half)
    n = _bin(depth_raw, rays, T, region, surfaces, cell_of, cells)
    chosen = _row_by_row(cell_of, n)
    if n > max_points:
        squares = _squares(cells[:n])
        farthest = np.partition(squares, max_points - 1)[max_points - 1]
        chosen = chosen[squares[chosen] <= farthest][:max_points]
    points = np.empty((len(chosen), 3), dtype=np.int16)
    count, spread = np.empty(len(chosen), dtype=np.uint8), np.empty(len(chosen), dtype=np.uint8)
    _write(cells, chosen, T[:3, 3].copy(), resolution, half, points, count, spread)
    return ReducedScan(origin, points, count, spread)


class _Surfaces(NamedTuple):
    """Values of `ReductionParams` for compiled functions."""

    jump_m: float
    surface_m: float
    carrying_share: float
    face_m: float
    rim_pixels: float


class _Rays(NamedTuple):
    """Rays of the pixels and properties of their depths."""

    x: Array  # (columns,) per depth
    y: Array  # (rows,) per depth
    bounds: tuple[int, int]  # smallest and largest valid raw depth
    unit: float  # [m] of raw depth
    noise: float  # [1/m] depth noise over squared depth


class _Region(NamedTuple):
    """Region that is reduced, around the camera."""

    resolution: float  # [m] cell edge
    max_range: float  # [m] horizontal distance
    ceiling: float  # [m] above the camera
    dense: float  # [m] depth, see `_bin`
    half: int  # [cells] half edge of the grid


@compiled
def _bin(raw: Array, rays: _Rays, T: Array, region: _Region, surfaces: _Surfaces, cell_of: Array, cells: Array) -> int:
    """Sum the pixels of each cell's upper and lower surface; return the cell count.

    cells (n, 16): pixels and sums of x, y, z of the upper surface and of the lower one, highest, lowest, pixels of any
    surface, and the cell indices; lengths are relative to the camera. A surface contains the pixels within noise of the
    highest, or the lowest, pixel. Nearer than `dense`, at least four adjacent pixels fall into a cell, and every second
    pixel is read. If on level ground at least four rows do so too, every second row is read, and its pixels count twice.

    Per-pixel values are computed in loops over a row without branches, which the compiler can vectorise.
    """
    x, y, bounds, unit, noise = rays
    resolution, max_range, ceiling, dense, half = region
    rows, columns = raw.shape
    side = 2 * half
    per_cell, scale = np.float32(1.0 / resolution), np.float32(unit)
    offset_x, offset_y = np.float32(T[0, 3] / resolution + half), np.float32(T[1, 3] / resolution + half)
    range2, ceiling32, dense32 = np.float32(max_range * max_range), np.float32(ceiling), np.float32(dense)
    first, last = np.int32(bounds[0]), np.int32(bounds[1])
    lowest, highest = np.float32(first), np.float32(last)
    jump, jump2 = np.float32(surfaces.jump_m / unit), np.float32(noise * unit)  # [raw units] of a depth in raw units
    surface, noise32 = np.float32(surfaces.surface_m), np.float32(noise)
    Txx, Tyx, Tzx = np.float32(T[0, 0]), np.float32(T[1, 0]), np.float32(T[2, 0])
    px, py, pz = np.empty(columns, np.float32), np.empty(columns, np.float32), np.empty(columns, np.float32)
    # Depths as 32-bit floats: the difference of two int32 is an int64.
    line, above, below = np.empty(columns, np.float32), np.empty(columns, np.float32), np.empty(columns, np.float32)
    band, key = np.empty(columns, np.float32), np.empty(columns, np.int32)
    limits = np.empty(columns, np.float32)
    read, steady = np.empty(columns, np.int32), np.empty(columns, np.int32)
    taken = np.empty(columns + 1, np.uint32)
    zero, one = np.float32(0.0), np.float32(1.0)
    n = 0
    for i in range(rows):
        # 1. Choose the pixels of the row by its farthest one. For a walking robot, half of the image is ground nearer than the
        # minimum range: rows without a return.
        farthest = np.int32(0)
        here = raw[i]
        for j in range(columns):
            r = np.int32(here[j])
            there = r if (r >= first) & (r <= last) else np.int32(0)
            farthest = there if there > farthest else farthest
        if farthest == 0:
            continue
        ax = np.float32(T[0, 1] * y[i] + T[0, 2])
        ay = np.float32(T[1, 1] * y[i] + T[1, 2])
        az = np.float32(T[2, 1] * y[i] + T[2, 2])
        hop, begin, weight = 1, 0, one
        if farthest * unit < dense:
            hop, begin = 2, i & 1
            drop = -max(az + Tzx * x[0], az + Tzx * x[-1])  # of the row's shallowest ray, relative to its depth
            if farthest * unit < dense * drop:
                if i & 1:
                    continue
                begin, weight = (i >> 1) & 1, np.float32(2.0)
        width = (columns - begin + hop - 1) // hop
        over, under = raw[i - 2 if i >= 2 else i], raw[i + 2 if i + 2 < rows else i]
        if hop == 1:
            for j in range(width):
                line[j], above[j], below[j] = np.float32(here[j]), np.float32(over[j]), np.float32(under[j])
        else:
            for j in range(width):
                c = np.uint64(begin + 2 * j)
                line[j], above[j], below[j] = np.float32(here[c]), np.float32(over[c]), np.float32(under[c])
        left, along = np.float32(x[begin]), np.float32(hop * (x[1] - x[0]))
        # 2. Compute which pixels are read, their positions and their cells.
        odd, whole = np.int32(i & 1), np.int32(hop == 1)
        for j in range(width):
            r = line[j]
            z = r * scale
            u = left + np.float32(j) * along
            dx, dy, dz = (Txx * u + ax) * z, (Tyx * u + ay) * z, (Tzx * u + az) * z
            px[j], py[j], pz[j] = dx, dy, dz
            limits[j] = jump + jump2 * (r * r)
            band[j] = surface + noise32 * z * abs(dz)
            near = (dx * dx + dy * dy <= range2) & (dz <= ceiling32)
            every = (z >= dense32) | (((np.int32(j) ^ odd) & whole) == np.int32(0))
            read[j] = np.int32((r >= lowest) & (r <= highest) & near & every)
        for j in range(width):
            # Positive, so that int() rounds down; pixels that are read are inside the grid.
            a, b = np.int32(px[j] * per_cell + offset_x), np.int32(py[j] * per_cell + offset_y)
            key[j] = (a * np.int32(side) + b) * read[j]
        # 3. Find the pixels that continue, within noise, to one side along the column and along the row. The image border
        # counts as a continuation.
        for j in range(width):
            r, a, b = line[j], above[j], below[j]
            limit = limits[j]
            steady[j] = np.int32(((abs(r - a) <= limit) & (a != zero)) | ((abs(b - r) <= limit) & (b != zero)))
        beside = 2 // hop
        before, middle, after = line[: width - 2 * beside], line[beside : width - beside], line[2 * beside : width]
        limits_there, steady_there = limits[beside : width - beside], steady[beside : width - beside]
        for j in range(len(middle)):
            r, a, b = middle[j], before[j], after[j]
            limit = limits_there[j]
            steady_there[j] &= np.int32(((abs(r - a) <= limit) & (a != zero)) | ((abs(b - r) <= limit) & (b != zero)))
        for j in range(width):
            if read[j] > steady[j]:
                steady[j] = np.int32(not _is_flying(raw, i, begin + hop * j, jump, jump2))
        # 4. Sum into the cells. Factors keep, reset or leave the sums: branches would be mispredicted.
        m = 0
        for j in range(width):
            taken[m] = np.uint32(j)
            m += read[j] & steady[j]
        for t in range(m):
            j = taken[t]
            height, reach = pz[j], band[j]
            k = cell_of[np.uint32(key[j])]
            if k < 0:
                k = cell_of[np.uint32(key[j])] = np.int32(n)
                n += 1
                cell = cells[np.uint32(k)]
                for part in range(8):
                    cell[part] = zero
                cell[10] = zero
                cell[8], cell[9] = -np.float32(np.inf), np.float32(np.inf)
                cell[11], cell[12] = np.float32(key[j] // side), np.float32(key[j] % side)
            cell = cells[np.uint32(k)]
            u, v = px[j], py[j]
            top, bottom = cell[8], cell[9]
            kept, added = one - np.float32(height > top + reach), weight * np.float32(height >= top - reach)
            count, x_sum, y_sum, z_sum = cell[0], cell[1], cell[2], cell[3]
            cell[0], cell[1] = count * kept + added, x_sum * kept + u * added
            cell[2], cell[3] = y_sum * kept + v * added, z_sum * kept + height * added
            kept, added = one - np.float32(height < bottom - reach), weight * np.float32(height <= bottom + reach)
            count, x_sum, y_sum, z_sum = cell[4], cell[5], cell[6], cell[7]
            cell[4], cell[5] = count * kept + added, x_sum * kept + u * added
            cell[6], cell[7] = y_sum * kept + v * added, z_sum * kept + height * added
            cell[8], cell[9] = max(top, height), min(bottom, height)
            cell[10] += weight
    for k in range(n):
        cell = cells[k]
        if cell[0] >= np.float32(surfaces.carrying_share) * cell[10]:
            continue
        if not (_is_wall(cells, cell_of, k, side, surfaces) or _is_between_tops(cells, cell_of, k, side, surfaces)):
            cell[0], cell[1], cell[2], cell[3] = cell[4], cell[5], cell[6], cell[7]
    return n


@compiled
def _is_wall(cells: Array, cell_of: Array, k: int, side: int, surfaces: _Surfaces) -> bool:
    """Return whether a cell holds a face without level ground next to its top."""
    cell = cells[k]
    if cell[7] <= (cell[9] + np.float32(surfaces.face_m)) * cell[4] or cell[0] < np.float32(surfaces.rim_pixels):
        return False
    a, b = int(cell[11]), int(cell[12])
    for i in range(max(a - 1, 0), min(a + 2, side)):
        for j in range(max(b - 1, 0), min(b + 2, side)):
            beside = cell_of[i * side + j]
            if beside < 0 or beside == k:
                continue
            other = cells[beside]
            level = other[8] - other[9] < np.float32(surfaces.face_m)
            if level and other[3] >= (cell[8] - np.float32(2.0 * surfaces.surface_m)) * other[0]:
                return False
    return True


@compiled
def _is_between_tops(cells: Array, cell_of: Array, k: int, side: int, surfaces: _Surfaces) -> bool:
    """Return whether level ground on both sides of a deep cell, at most two cells away, is as high as its upper surface."""
    cell = cells[k]
    if cell[8] - cell[9] < np.float32(2.0 * surfaces.face_m):
        return False
    i, j = int(cell[11]), int(cell[12])
    for di, dj in ((1, 0), (0, 1)):
        sides = 0
        for sign in (-1, 1):
            found = False
            for away in (1, 2):
                a, b = i + sign * away * di, j + sign * away * dj
                beside = cell_of[a * side + b] if 0 <= a < side and 0 <= b < side else np.int32(-1)
                if beside >= 0:
                    other = cells[beside]
                    level = other[8] - other[9] < np.float32(surfaces.face_m)
                    found |= level and abs(other[3] / other[0] - cell[3] / cell[0]) < np.float32(surfaces.surface_m)
            sides += found
        if sides == 2:
            return True
    return False


@compiled
def _is_flying(raw: Array, i: int, j: int, jump: np.float32, jump2: np.float32) -> bool:
    """Return whether a pixel lies between two surfaces along its row or column."""
    rows, columns = raw.shape
    r = np.int32(raw[i, j])
    limit = jump + jump2 * (np.float32(r) * np.float32(r))
    for along in range(2):
        di, dj = (0, 2) if along == 0 else (2, 0)
        # The image border counts as a continuation of the surface.
        before = np.int32(raw[i - di, j - dj]) if i >= di and j >= dj else r
        if before != 0 and abs(r - before) <= limit:
            continue
        after = np.int32(raw[i + di, j + dj]) if i + di < rows and j + dj < columns else r
        if after != 0 and abs(after - r) <= limit:
            continue
        if before != 0 and after != 0:
            if (r > before) != (after > r):  # nearer or farther than both sides: a thin object
                continue
            # A slope at a grazing angle continues on both sides; a flying pixel lies between two surfaces that do not.
            slope = np.int32(0)
            if i >= 2 * di and j >= 2 * dj and raw[i - 2 * di, j - 2 * dj] != 0:
                slope = abs(before - np.int32(raw[i - 2 * di, j - 2 * dj]))
            if i + 2 * di < rows and j + 2 * dj < columns and raw[i + 2 * di, j + 2 * dj] != 0:
                other = abs(np.int32(raw[i + 2 * di, j + 2 * dj]) - after)
                if other > slope:
                    slope = other
            if 2 * min(abs(r - before), abs(after - r)) <= 2 * limit + 3 * slope:
                continue
        return True
    return False


@compiled
def _row_by_row(cell_of: Array, n: int) -> Array:
    """Return the cells (n,) in grid order, so that similar neighbours are consecutive."""
    out = np.empty(n + 1, dtype=np.int32)
    m = 0
    for key in range(len(cell_of)):
        out[m] = cell_of[key]
        m += int(cell_of[key] >= 0)
    return out[:n]


@compiled
def _squares(cells: Array) -> Array:
    """Return the squared horizontal distance (n,) [m^2] of the cells from the camera."""
    out = np.empty(len(cells), dtype=np.float32)
    for k in range(len(cells)):
        x, y = cells[k, 1] / cells[k, 0], cells[k, 2] / cells[k, 0]
        out[k] = x * x + y * y
    return out


@compiled
def _write(
    cells: Array, chosen: Array, p: Array, resolution: float, half: int, points: Array, count: Array, spread: Array
) -> None:
    """Write the chosen cells in the format of the message; p (3,) [m] is the camera."""
    edge = 1000.0 * resolution
    x0, y0, z0 = 1000.0 * p[0], 1000.0 * p[1], 1000.0 * p[2]
    for m in range(len(chosen)):
        cell = cells[np.uint32(chosen[m])]
        mm = 1000.0 / cell[0]
        # Rounding must not move a point onto or across the border of its cell.
        corner_x, corner_y = edge * (cell[11] - half), edge * (cell[12] - half)
        x = min(max(np.rint(mm * cell[1] + x0), np.floor(corner_x + 1.0)), np.ceil(corner_x + edge - 1.0))
        y = min(max(np.rint(mm * cell[2] + y0), np.floor(corner_y + 1.0)), np.ceil(corner_y + edge - 1.0))
        z = np.rint(mm * cell[3] + z0)
        points[m, 0] = np.int16(min(max(x, -32767.0), 32767.0))
        points[m, 1] = np.int16(min(max(y, -32767.0), 32767.0))
        points[m, 2] = np.int16(min(max(z, -32767.0), 32767.0))
        count[m] = np.uint8(min(cell[0], 255.0))
        spread[m] = np.uint8(min(np.rint(1000.0 * (cell[8] - cell[9])), 255.0))
