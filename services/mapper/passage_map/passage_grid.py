"""Passage map: height, normal and roughness per cell of a strip, from the merged cloud.

A column is all voxels of the cloud above one another. The centre of cell (i, j) of a strip is (i + 1/2) cells along it and
(j + 1/2) cells to the left of its right side. Source: Masri 2016, sections 4.3, 4.4 and 4.7.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.passage_map.moving_least_squares import Surface, smooth
from sextant.services.mapper.passage_map.voxel_cloud import CloudSnapshot, Strip
from sextant.shared.geometry import Array

_SURFACE_DEPTH_M = 0.02  # [m] below the top of a column, within which points belong to the same surface
_MIN_UPPER_SHARE = 0.3  # [1] minimum share of a column's pixels at its top and above; fewer are an edge of an adjacent column
_SAME_TOP_M = 0.01  # [m] between the tops of one surface
_TOP_SIDE = (1, 2, 3)  # [columns] from a column, which form a side
_CRACK_SHARE = 0.4  # [1] share of the pixels on either side, below which a column is a crack ...
_CRACK_SIDE_PIXELS = 30.0  # ... if both sides have at least this many pixels per column
_CRACK_SIDE = (1, 2, 3)  # [columns] from the crack, which form a side
_HOLE_DEPTH_M = 0.05  # [m] below a top next to it, from which on a cell is a hole in it
_HOLE_RELIEF_M = 0.015  # [m] largest difference between the tops around a hole that is closed
_MIN_UPWARD = 0.5  # [1] upward part of a normal, below which the plane is too steep to extrapolate the height


@dataclass(frozen=True, slots=True, eq=False)
class PassageGrid:
    """Map of a strip."""

    strip: Strip
    resolution: float  # [m] edge of a cell
    elevation: NDArray[np.float32]  # (nx, ny) [m] {world} height, NaN where unknown
    normals: NDArray[np.float32]  # (nx, ny, 3) unit, upward, {world}; NaN where unknown or undefined
    roughness: NDArray[np.float32]  # (nx, ny) [m] rms distance of neighbouring points from their plane, NaN without a normal
    assumed: NDArray[np.bool_]  # (nx, ny) whether the height is from an assumed plane

    @property
    def unseen(self) -> NDArray[np.bool_]:
        """(nx, ny) cells without a height, not even an assumed one."""
        return np.asarray(np.isnan(self.elevation))


def cells_of(strip: Strip, resolution: float) -> tuple[int, int]:
    """Return the number of cells along and across a strip.

    Raises:
        ValueError: Length or width is not a whole number of cells.
    """
    size = np.array([strip.length, strip.width]) / resolution
    nx, ny = np.rint(size).astype(int).tolist()
    if min(nx, ny) < 1 or np.abs(size - (nx, ny)).max() > 1e-3:
        raise ValueError(
            f"whole cells of {resolution} m expected, found a strip of {strip.length} m x {strip.width} m: choose multiples"
        )
    return nx, ny


def cell_centres(strip: Strip, resolution: float) -> Array:
    """Return the centres (nx, ny, 2) [m] {world} of a strip's cells.

    Raises:
        ValueError: Length or width is not a whole number of cells.
    """
    return strip.world(local_centres(strip, resolution))


def local_centres(strip: Strip, resolution: float) -> Array:
    """Return the centres (nx, ny, 2) [m] of a strip's cells in the strip's frame.

    x points along the strip, y to the left of its middle line.
    """
    nx, ny = cells_of(strip, resolution)
    x = (np.arange(nx) + 0.5) * resolution
    y = (np.arange(ny) + 0.5) * resolution - strip.width / 2
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)


def passage_grid(cloud: CloudSnapshot, strip: Strip, resolution: float, radius: float = 0.025) -> PassageGrid:
    """Build the map of a strip from the cloud over it.

    1. Project points onto their surface by moving least squares, which also gives normals and roughness.
    2. Represent each column by its highest point, because the robot walks on top of objects. Higher points with less than
       30 % of the column's pixels are ignored, as noise or as the edge of an adjacent column, unless the tops on both sides
       are as high: then most pixels show a wall below an overhang. The normal is the mean over the points of the upper
       surface. The thesis uses all points of the column, but points on the floor below do not support the foot.
    3. Mark a column with few pixels between columns with many as unknown. It is a crack, into which a camera that looks along
       the ground hardly sees, and its pixels are stray.
    4. Assign each cell the column that contains its centre, and evaluate the plane of the column's point there. A column
       without a point leaves its cell unknown.
    5. Close thin holes in a top. Its near part may have been measured from afar alone, with gaps between the pixels, and from
       near the camera sees the wall below an overhang through these gaps.

    Args:
        cloud: Voxels with the edge `resolution`, which extend `radius` beyond the strip.
        strip: Strip with a whole number of cells.
        resolution: [m] edge of a cell.
        radius: [m] of the neighbourhoods of moving least squares.

    Raises:
        ValueError: Length or width of the strip is not a whole number of cells.

    Source: Masri 2016, sections 4.3 and 4.4.
    """
    centres = cell_centres(strip, resolution)
    shape = centres.shape[:2]
    surface = smooth(cloud.points, cloud.weight, radius)
    top, normals, roughness = _tops(cloud, surface)
    point_of = np.full(cloud.shape, -1, dtype=np.int64)
    point_of.ravel()[cloud.column[top]] = np.arange(len(top))
    pixels = np.bincount(cloud.column, weights=cloud.weight, minlength=point_of.size)
    point_of[_cracks(np.asarray(pixels, dtype=np.float64).reshape(cloud.shape))] = -1
    i, j = np.moveaxis(np.floor((centres - cloud.origin) / resolution + 0.5).astype(np.int64), -1, 0)
    inside = (i >= 0) & (i < cloud.shape[0]) & (j >= 0) & (j < cloud.shape[1])
    found = (
        np.where(inside, point_of[np.where(inside, i, 0), np.where(inside, j, 0)], -1) if point_of.size else np.full(shape, -1)
    )
    known = found >= 0
    of, places = found[known], centres[known]
    points, n = surface.points[top][of], normals[of]
    # Without a normal (NaN) or with a steep one, the slope is zero: the cell gets the height of its point.
    upward = np.where(n[:, 2] > _MIN_UPWARD, n[:, 2], np.inf)
    slope = -np.nan_to_num(n[:, :2]) / upward[:, None]
    elevation = np.full(shape, np.nan, dtype=np.float32)
    elevation[known] = points[:, 2] + ((places - points[:, :2]) * slope).sum(axis=1)
    cell_normals = np.full((*shape, 3), np.nan, dtype=np.float32)
    cell_normals[known] = n
    rough = np.full(shape, np.nan, dtype=np.float32)
    rough[known] = roughness[of]
    return close_thin_holes(PassageGrid(strip, resolution, elevation, cell_normals, rough, np.zeros(shape, dtype=np.bool_)))


def close_thin_holes(grid: PassageGrid) -> PassageGrid:
    """Return a map without the holes that no foot can enter: a cell wide, with tops of one height all around.

    The cells of a hole are unknown, or much lower than a cell next to them. They get the mean of the tops next to them. A
    crack between two blocks stays, because it leads to their edges.

    The layers are contiguous, as compiled functions expect them: for others they would be compiled again.
    """
    kernel = np.ones((3, 3), np.uint8)
    known = np.isfinite(grid.elevation)
    heights = np.where(known, grid.elevation, np.float32(-np.inf))
    hole = ~known | (heights < cv2.dilate(heights, kernel) - np.float32(_HOLE_DEPTH_M))
    wide = cv2.dilate(cv2.erode(hole.astype(np.uint8), np.ones((2, 2), np.uint8), borderValue=1), kernel) > 0
    count, label, box, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    closed = np.zeros(hole.shape, dtype=np.bool_)
    for k in range(1, count):
        x, y, width, height, _ = box[k].tolist()
        if min(x, y) < 1 or y + height >= hole.shape[0] or x + width >= hole.shape[1]:
            continue  # it leads out of the strip
        part = np.s_[y - 1 : y + height + 1, x - 1 : x + width + 1]
        cells = label[part] == k
        around = heights[part][(cv2.dilate(cells.astype(np.uint8), kernel) > 0) & ~cells]
        closed[part] |= cells & (np.ptp(around) <= _HOLE_RELIEF_M and not (cells & wide[part]).any())
    if not closed.any():
        return grid
    layers = np.dstack([grid.elevation, grid.normals, grid.roughness])
    usable = ~hole & np.isfinite(layers).all(axis=2)
    total = cv2.blur(np.where(usable[..., None], layers, 0.0), (3, 3), borderType=cv2.BORDER_CONSTANT)
    share = cv2.blur(usable.astype(np.float64), (3, 3), borderType=cv2.BORDER_CONSTANT)
    closed &= share > 0
    layers[closed] = total[closed] / share[closed, None]
    layers[closed, 1:4] /= np.linalg.norm(layers[closed, 1:4], axis=1, keepdims=True)
    elevation, normals, roughness = map(np.ascontiguousarray, (layers[..., 0], layers[..., 1:4], layers[..., 4]))
    return replace(grid, elevation=elevation, normals=normals, roughness=roughness)


def with_assumed(grid: PassageGrid, heights: Array) -> PassageGrid:
    """Return a map with its unknown cells filled with assumed heights (nx, ny) [m].

    The heights are in {world}. NaN leaves a cell unknown. The normals are those of the assumed surface. Measured cells are
    not changed (Masri 2016, section 4.7).

    Raises:
        ValueError: The shapes differ.
    """
    if heights.shape != grid.elevation.shape:
        raise ValueError(f"heights {grid.elevation.shape} expected, found {heights.shape}")
    assumed = grid.unseen & np.isfinite(heights)
    if not assumed.any():
        return grid
    slopes = np.stack([_slope(heights, axis, grid.resolution) for axis in range(2)], axis=-1)
    turned = grid.strip.world(slopes) - grid.strip.origin
    n = np.concatenate([-turned, np.ones((*heights.shape, 1))], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    elevation, normals, roughness = grid.elevation.copy(), grid.normals.copy(), grid.roughness.copy()
    elevation[assumed], normals[assumed], roughness[assumed] = heights[assumed], n[assumed], 0.0
    return PassageGrid(grid.strip, grid.resolution, elevation, normals, roughness, assumed)


def _slope(heights: Array, axis: int, resolution: float) -> Array:
    """Return the slope (nx, ny) [m/m] of heights along an axis, as the mean difference to the two neighbours.

    It is one-sided next to a border or an unknown cell, and zero without a known neighbour.
    """
    step = np.diff(heights, axis=axis) / resolution
    pad = [(1, 1) if k == axis else (0, 0) for k in range(2)]
    padded = np.pad(step, pad, constant_values=np.nan)
    before, after = np.delete(padded, -1, axis), np.delete(padded, 0, axis)
    known = np.isfinite(before).astype(np.int64) + np.isfinite(after)
    return np.asarray((np.nan_to_num(before) + np.nan_to_num(after)) / np.maximum(known, 1))


def _cracks(pixels: Array) -> NDArray[np.bool_]:
    """Return columns (nx, ny) with few pixels between columns with many.

    This is tested along both axes and both diagonals.
    """
    nx, ny = pixels.shape
    far = max(_CRACK_SIDE)
    padded, few = np.pad(pixels, far), np.zeros(pixels.shape, dtype=np.bool_)
    for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
        sides = [
            np.median([padded[far + k * di :, far + k * dj :][:nx, :ny] for k in (sign * n for n in _CRACK_SIDE)], axis=0)
            for sign in (-1, 1)
        ]
        both = np.minimum(*sides)
        few |= (pixels < _CRACK_SHARE * both) & (both >= _CRACK_SIDE_PIXELS)
    return few


def _is_between_tops(height: Array, top: Array, column: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return whether heights (m,) [m] in columns (m,) continue the tops (m,) [m] of columns on both of their sides."""
    tops = np.full(shape, np.nan)
    tops.ravel()[column] = top
    far = max(_TOP_SIDE)
    padded = np.pad(tops, far, constant_values=np.nan)
    i, j = np.divmod(column, shape[1])
    found = np.zeros(len(column), dtype=np.bool_)
    for di, dj in ((1, 0), (0, 1)):
        sides = (
            [np.abs(padded[far + i + k * di, far + j + k * dj] - height) < _SAME_TOP_M for k in (sign * n for n in _TOP_SIDE)]
            for sign in (-1, 1)
        )
        found |= np.logical_and(*(np.any(side, axis=0) for side in sides))
    return found


def _tops(cloud: CloudSnapshot, surface: Surface) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the index (m,), normal (m, 3) and roughness (m,) [m] of the top point of each column."""
    column, weight, points, normals, roughness = cloud.column, cloud.weight, surface.points, surface.normals, surface.roughness
    if not len(column):
        return np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty(0)
    first = np.flatnonzero(np.diff(column, prepend=-1))
    of = np.repeat(np.arange(len(first)), np.diff(first, append=len(column)))
    total = np.add.reduceat(weight, first)
    below = np.cumsum(weight)
    above = (below[first] - weight[first] + total)[of] - below + weight  # pixels of each point and those above it
    carries = np.where(above >= _MIN_UPPER_SHARE * total[of], np.arange(len(column)), -1)
    top = np.maximum.reduceat(carries, first)
    highest = np.append(first[1:], len(column)) - 1
    top = np.where(_is_between_tops(points[highest, 2], points[top, 2], column[first], cloud.shape), highest, top)
    depth = points[top, 2][of] - points[:, 2]  # [m] below the top point
    counts = (np.abs(depth) <= _SURFACE_DEPTH_M) & np.isfinite(roughness)
    sums = np.add.reduceat(np.where(counts[:, None], normals, 0.0), first)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    n = np.where(length > 0, sums / np.where(length > 0, length, 1.0), np.nan)
    worst = np.maximum.reduceat(np.where(counts, roughness, -1.0), first)
    return top, n, np.where(worst >= 0, worst, np.nan)
