"""Merged point cloud over a strip of ground, with one centroid per voxel.

Masri 2016 keeps all camera data in one cloud and merges each scan into it. Points of one voxel count as the same point and are
replaced by their centroid (sections 4 and 4.3). The strip limits the memory: points outside are dropped.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.mapper.elevation.validated_scan import MAX_COORDINATE_M
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled

_NONE = -1  # end of a column's list
_SIDE_COLUMNS = 3  # columns to either side in which a surface continues


@dataclass(frozen=True, slots=True)
class Strip:
    """Rectangle of ground, defined by the middle of its near side and a heading."""

    origin: tuple[float, float]  # [m] {world} middle of the near side
    heading: float  # [rad] direction of its length, from the world's x axis
    length: float = 2.7  # [m]; Masri 2016, section 4.4
    width: float = 1.0  # [m]

    def __post_init__(self) -> None:
        if len(self.origin) != 2 or not all(abs(v) < MAX_COORDINATE_M for v in self.origin) or not abs(self.heading) < math.inf:
            raise ValueError(
                f"an origin of 2 coordinates within {MAX_COORDINATE_M:g} m and a finite heading expected, "
                f"found {self.origin} and {self.heading}"
            )
        if not (0 < self.length <= 100 and 0 < self.width <= 100):
            raise ValueError(f"a length and width of up to 100 m expected, found {self.length} m and {self.width} m")

    def local(self, p_world_xy: ArrayLike) -> Array:
        """Convert places (..., 2) [m] {world} to the strip's frame.

        The axes point along the strip and to the left of its middle line.
        """
        p = np.asarray(p_world_xy, dtype=np.float64) - self.origin
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.stack([c * p[..., 0] + s * p[..., 1], c * p[..., 1] - s * p[..., 0]], axis=-1)

    def world(self, p_strip: ArrayLike) -> Array:
        """Convert places (..., 2) [m] in the strip's frame to {world}; inverse of `local`."""
        p = np.asarray(p_strip, dtype=np.float64)
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.stack([c * p[..., 0] - s * p[..., 1], s * p[..., 0] + c * p[..., 1]], axis=-1) + self.origin

    def contains(self, p_world_xy: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Return whether places (..., 2) [m] {world} are within a margin [m] of the strip."""
        p = self.local(p_world_xy)
        along = (p[..., 0] >= -margin) & (p[..., 0] <= self.length + margin)
        return np.asarray(along & (np.abs(p[..., 1]) <= self.width / 2 + margin))

    def corners(self, margin: float = 0.0) -> Array:
        """(4, 2) [m] {world} corners in order."""
        x, y = self.length + margin, self.width / 2 + margin
        return self.world([[-margin, -y], [x, -y], [x, y], [-margin, y]])

    def box(self, resolution: float, margin: float = 0.0) -> tuple[NDArray[np.int64], tuple[int, int]]:
        """Return the axis-aligned box around the strip, in cells of an edge [m].

        The result is the world index (2,) of its lowest cell, and its size.
        """
        corners = self.corners(margin) / resolution
        low: NDArray[np.int64] = np.floor(corners.min(axis=0)).astype(np.int64)
        nx, ny = (np.floor(corners.max(axis=0)).astype(np.int64) - low + 1).tolist()
        return low, (nx, ny)


@dataclass(frozen=True, slots=True)
class MergeCount:
    """Counts of the points and voxels of one merged scan."""

    merged: int  # points merged into an existing voxel
    added: int  # points that created a voxel
    removed: int  # voxels removed after too many scans saw through them
    outside: int  # points outside the strip
    refused: int  # points refused because the cloud is full


@dataclass(frozen=True, slots=True, eq=False)
class CloudSnapshot:
    """Copy of the voxels, sorted by column and upward in each."""

    points: Array  # (n, 3) [m] {world} centroids
    weight: Array  # (n,) number of pixels
    column: NDArray[np.int64]  # (n,) column index, row by row over `shape`
    origin: Array  # (2,) [m] {world} centre of column (0, 0)
    shape: tuple[int, int]  # columns in x and y


class _Columns(NamedTuple):
    """Voxels in lists by column; see `VoxelCloud`."""

    low: NDArray[np.int64]  # (2,) world index of column (0, 0)
    head: NDArray[np.int32]  # (nx, ny) slot of the first voxel
    next_: NDArray[np.int32]  # (n,) slot of the following voxel of the column, or of the next free slot
    level: NDArray[np.int64]  # (n,) [voxels] height index
    centroid: Array  # (n, 3) [m] {world}
    weight: Array  # (n,) number of pixels
    missed: NDArray[np.uint8]  # (n,) consecutive scans that saw through the voxel
    judged: NDArray[np.int64]  # (n,) newest scan that hit the voxel or saw through it
    used: NDArray[np.int64]  # (3,) slots ever used, first free slot among them, voxels


class _MergeRules(NamedTuple):
    """Limits of the merging, see `VoxelCloud`."""

    resolution: float  # [m]
    see_through: float  # [m]
    patience: int  # [scans]


class VoxelCloud:
    """Voxels aligned with the world, stored as a short list per column of the strip.

    A voxel well above the ground that a scan shows in its column was seen through. Two such scans in a row may be noise at an
    edge. After `patience` of them without a hit in between, the voxel is removed. Ground that gave way thus leaves the cloud.
    A voxel of a surface that was not seen through on both of its sides stays: the camera looks below an overhang, at a wall.
    """

    def __init__(
        self,
        strip: Strip,
        resolution: float = 0.01,
        *,
        margin: float = 0.05,
        max_voxels: int = 200_000,
        see_through: float = 0.03,
        patience: int = 5,
    ):
        """Create an empty cloud.

        Args:
            strip: Area that is kept.
            resolution: [m] edge of a voxel.
            margin: [m] around the strip that is also kept, because neighbourhoods extend beyond its border.
            max_voxels: Maximum number of voxels; points that need more are refused.
            see_through: [m] height of a voxel above the ground seen in its column, from which it was seen through.
            patience: [scans] that see through a voxel until it is removed.
        """
        if not 0.001 <= resolution <= 1.0:
            raise ValueError(f"a resolution from 1 mm to 1 m expected, found {resolution} m")
        if not (0 <= margin <= 1.0 and max_voxels >= 1 and see_through > 0 and 1 <= patience <= 200):
            raise ValueError(
                "a margin of up to 1 m, max_voxels of at least 1, positive see_through and patience of 1 to 200 scans "
                f"expected, found {margin} m, {max_voxels}, {see_through} m and {patience}"
            )
        self.resolution, self.margin = resolution, margin
        self._see_through, self._patience = see_through, patience
        self._next = np.full(max_voxels, _NONE, dtype=np.int32)
        self._level = np.full(max_voxels, 0, dtype=np.int64)  # [voxels] height index
        self._centroid = np.full((max_voxels, 3), 0.0)
        self._weight = np.full(max_voxels, 0.0)
        self._missed = np.full(max_voxels, 0, dtype=np.uint8)
        self._judged = np.full(max_voxels, 0, dtype=np.int64)  # newest scan that hit a voxel or saw through it
        self._scans = 0
        self._lay(strip)

    def __len__(self) -> int:
        """Return the number of voxels."""
        return int(self._used[2])

    @property
    def strip(self) -> Strip:
        """Strip that is kept."""
        return self._strip

    def move_to(self, strip: Strip) -> None:
        """Keep another strip; only voxels outside it are dropped."""
        kept = self.snapshot()
        self._lay(strip)
        self.insert(kept.points, kept.weight)

    def insert(self, points: ArrayLike, count: ArrayLike) -> MergeCount:
        """Merge a scan; a voxel is the centroid of its points, weighted by pixels.

        Args:
            points: (n, 3) [m] {world}.
            count: (n,) number of pixels of each point, positive.

        Raises:
            ValueError: A shape is wrong, or a value is not finite or out of range; the cloud is then unchanged.

        Source: Masri 2016, section 4.3.
        """
        p = np.ascontiguousarray(points, dtype=np.float64)
        w = np.ascontiguousarray(count, dtype=np.float64)
        if p.ndim != 2 or p.shape[1] != 3 or w.shape != (len(p),):
            raise ValueError(f"points (n, 3) and counts (n,) expected, found {p.shape} and {w.shape}")
        if not (np.abs(p) < MAX_COORDINATE_M).all():
            raise ValueError(f"points finite and within {MAX_COORDINATE_M:g} m expected: drop invalid pixels before merging")
        if not ((w > 0) & (w < math.inf)).all():
            raise ValueError("positive finite counts expected: drop empty points before merging")
        strip = self._strip
        frame = np.array(
            [*strip.origin, math.cos(strip.heading), math.sin(strip.heading), strip.length, strip.width / 2, self.margin]
        )
        self._scans += 1
        columns = _Columns(
            self._low, self._head, self._next, self._level, self._centroid, self._weight, self._missed, self._judged, self._used
        )
        rules = _MergeRules(self.resolution, self._see_through, self._patience)
        merged, added, removed, outside, refused = _merge(p, w, frame, columns, self._scans, rules)
        return MergeCount(merged, added, removed, outside, refused)

    def holds(self, p_world_xy: Array) -> NDArray[np.bool_]:
        """Return whether the columns of places (n, 2) [m] {world} contain a voxel."""
        i, j = (np.floor(p_world_xy / self.resolution).astype(np.int64) - self._low).T
        inside = (i >= 0) & (i < self._head.shape[0]) & (j >= 0) & (j < self._head.shape[1])
        return np.asarray(inside & (self._head[np.where(inside, i, 0), np.where(inside, j, 0)] != _NONE))

    def snapshot(self) -> CloudSnapshot:
        """Return a copy of the voxels."""
        slots, column = _listed(self._head.reshape(-1), self._next, self._level, len(self))
        return CloudSnapshot(
            points=self._centroid[slots],
            weight=self._weight[slots],
            column=column,
            origin=np.asarray((self._low + 0.5) * self.resolution),
            shape=(self._head.shape[0], self._head.shape[1]),
        )

    def _lay(self, strip: Strip) -> None:
        """Create empty columns over a strip."""
        self._strip = strip
        self._low, shape = strip.box(self.resolution, self.margin)
        self._head = np.full(shape, _NONE, dtype=np.int32)
        self._used = np.array([0, _NONE, 0], dtype=np.int64)  # slots ever used, first free slot among them, voxels


@compiled
def _is_between_tops(columns: _Columns, i: int, j: int, at: int) -> bool:
    """Return whether voxels near a level were not seen through on both sides of a column."""
    for axis in range(2):
        sides = 0
        for sign in (-1, 1):
            found = False
            for k in range(1, _SIDE_COLUMNS + 1):
                a, b = (i + sign * k, j) if axis == 0 else (i, j + sign * k)
                if 0 <= a < columns.head.shape[0] and 0 <= b < columns.head.shape[1]:
                    slot = columns.head[a, b]
                    while slot >= 0 and not found:
                        found = columns.missed[slot] == 0 and abs(columns.level[slot] - at) <= 1
                        slot = columns.next_[slot]
            sides += found
        if sides == 2:
            return True
    return False


@compiled
def _merge(
    points: Array, count: Array, frame: Array, columns: _Columns, scan: int, rules: _MergeRules
) -> tuple[int, int, int, int, int]:
    """Merge points into their columns.

    Returns the numbers of points merged and added, voxels removed, points outside and refused.
    """
    low, head, next_, level, centroid, weight, missed, judged, used = columns
    resolution, see_through, patience = rules
    x0, y0, c, s, length, half, margin = frame
    merged = added = removed = outside = refused = 0
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        along, left = c * (x - x0) + s * (y - y0), c * (y - y0) - s * (x - x0)
        i, j = math.floor(x / resolution) - low[0], math.floor(y / resolution) - low[1]
        inside = -margin <= along <= length + margin and abs(left) <= half + margin
        if not (inside and 0 <= i < head.shape[0] and 0 <= j < head.shape[1]):
            outside += 1
            continue
        at = math.floor(z / resolution)
        found, before, slot = -1, -1, head[i, j]
        while slot >= 0:
            after = next_[slot]
            if level[slot] == at:
                found = slot
            elif centroid[slot, 2] > z + see_through and judged[slot] != scan:  # a scan counts once
                judged[slot] = scan
                missed[slot] += 1
                if missed[slot] >= patience and _is_between_tops(columns, i, j, level[slot]):
                    missed[slot] = 0
                elif missed[slot] >= patience:
                    if before < 0:
                        head[i, j] = after
                    else:
                        next_[before] = after
                    next_[slot], used[1] = used[1], slot
                    used[2] -= 1
                    removed += 1
                    slot = after
                    continue
            before, slot = slot, after
        if found >= 0:
            total = weight[found] + count[k]
            gain = count[k] / total
            centroid[found, 0] += gain * (x - centroid[found, 0])
            centroid[found, 1] += gain * (y - centroid[found, 1])
            centroid[found, 2] += gain * (z - centroid[found, 2])
            weight[found], missed[found], judged[found] = total, 0, scan
            merged += 1
            continue
        if used[1] >= 0:
            slot = used[1]
            used[1] = next_[slot]
        elif used[0] < len(next_):
            slot = used[0]
            used[0] += 1
        else:
            refused += 1
            continue
        centroid[slot, 0], centroid[slot, 1], centroid[slot, 2] = x, y, z
        weight[slot], level[slot], missed[slot], judged[slot] = count[k], at, 0, scan
        next_[slot], head[i, j] = head[i, j], slot
        used[2] += 1
        added += 1
    return merged, added, removed, outside, refused


@compiled
def _listed(
    head: NDArray[np.int32], next_: NDArray[np.int32], level: NDArray[np.int64], n: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return slots (n,) and columns (n,) of all voxels, sorted by column and upward."""
    slots, column = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    m = 0
    for c in range(len(head)):
        first = m
        slot = head[c]
        while slot >= 0:
            k = m
            while k > first and level[slots[k - 1]] > level[slot]:
                slots[k] = slots[k - 1]
                k -= 1
            slots[k] = slot
            column[m] = c
            m += 1
            slot = next_[slot]
    return slots, column
