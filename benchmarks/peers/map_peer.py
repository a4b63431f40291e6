"""Map update in plain NumPy, to compare speed and results.

It does the same work and computes the same map. It is optimised as usual in NumPy: whole arrays, no loops over points or cells.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import ESTABLISHED
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.services.mapper.elevation.height_drift import height_sigma
from sextant.services.mapper.elevation.params import HeightDriftParams, RayClearingParams
from sextant.shared.geometry import Array

Layer = NDArray[np.float32]
Cells = NDArray[np.bool_]

_RAYS, _DRIFT = RayClearingParams(), HeightDriftParams()


class NumpyGrid:
    """`sextant.ElevationGrid` in NumPy.

    It has a circular buffer, and a Kalman filter and a rival height for each cell.
    """

    def __init__(self, size: int, resolution: float, model: FusionModel):
        self._size, self._resolution, self._model = size, resolution, model
        self._low = np.full(2, -(size // 2), dtype=np.int64)
        self._height, self._variance, self._rival, self._rival_variance = (
            np.full(size * size, np.nan, dtype=np.float32) for _ in range(4)
        )
        self._first = np.full(size * size, np.nan, dtype=np.float32)
        self._support, self._votes, self._through, self._fell = (np.full(size * size, 0, dtype=np.uint8) for _ in range(4))
        self._drift, self._lasts, self._scans = 0.0, 0, 0
        self._slot, self._entry = (np.full(size * size, -1, dtype=np.int64) for _ in range(2))

    def move_to(self, p_world_xy: Array) -> None:
        """Centre the window on a point (2,) [m] {world}."""
        n = self._size
        low = np.floor(p_world_xy / self._resolution).astype(np.int64) - n // 2
        for axis in range(2):
            shift = int(low[axis] - self._low[axis])
            leaving = min(abs(shift), n)
            first = self._low[axis] if shift > 0 else self._low[axis] + n - leaving
            lines = np.arange(first, first + leaving) % n
            where: Any = lines if axis == 0 else (slice(None), lines)
            for layer in (self._height, self._variance, self._first):
                layer.reshape(n, n)[where] = np.nan
            self._fell.reshape(n, n)[where] = 0
        self._low = low

    def fuse(self, points: Array, count: Array, spread: Array, p_world_camera: Array, pose_covariance: Array) -> None:
        """Fuse one reduced scan; arguments as in `ElevationGrid.fuse`."""
        n, model = self._size, self._model
        # 1. The cell of each point within the window, and the variance of its height.
        ij = np.floor(points[:, :2] / self._resolution).astype(np.int64)
        inside: Cells = np.asarray(((ij >= self._low) & (ij < self._low + n)).all(axis=1))
        slope = self._slopes(ij, inside)
        random, systematic = self._height_variance(points - p_world_camera, count, spread, pose_covariance, slope)
        ij = ij[inside] % n
        cell, z, random, systematic = ij[:, 0] * n + ij[:, 1], points[inside, 2], random[inside], systematic[inside]
        # 2. Merge points of one cell, all first ones with all second ones and so on; scans have few of them.
        one = self._first_of(cell)
        cells, out_z, out_random, out_systematic = cell[one], z[one], random[one], systematic[one]
        if not one.all():
            self._entry[cells] = np.arange(len(cells))
            left = np.flatnonzero(~one)
            while len(left):
                first = self._first_of(cell[left])
                now, left = left[first], left[~first]
                e = self._entry[cell[now]]
                step = z[now] - out_z[e]
                apart = (np.abs(step) > model.step_in(self._resolution)) & (
                    step * step > model.gate**2 * (random[now] + out_random[e] + systematic[now])
                )
                gain = (out_random[e] + 1e-12) / (out_random[e] + random[now] + 2e-12)
                upper = apart & (step > 0)
                out_z[e] = np.where(upper, z[now], np.where(apart, out_z[e], out_z[e] + gain * step))
                out_random[e] = np.where(upper, random[now], np.where(apart, out_random[e], out_random[e] * (1.0 - gain)))
                own = np.maximum(gain * (1.0 - gain) * step * step - random[now], 0.0)
                most = np.maximum(out_systematic[e], systematic[now]) + own
                out_systematic[e] = np.where(upper, systematic[now], np.where(apart, out_systematic[e], most))
        # 3. Filter the heights without the drift of the pose's height; clear the lines of sight.
        self._follow_drift(cells, out_z, (points[inside] - p_world_camera).mean(axis=0), pose_covariance)
        self._update(cells, out_z - self._drift, out_random + out_systematic, out_systematic)
        self._look_through(points[self._scans % _RAYS.every :: _RAYS.every], p_world_camera)
        self._scans += 1

    def _follow_drift(self, cells: NDArray[np.int64], z: Array, ray: Array, S: Array) -> None:
        """`sextant.services.mapper.elevation.height_drift.HeightDrift.follow`."""
        c = cells[:: _DRIFT.every]
        off, first = z[:: _DRIFT.every] - self._drift - self._first[c], self._first[c]
        tells = (np.abs(off) < _DRIFT.same_ground_m) & (self._votes[c] == 0)
        tells &= self._variance[c] < _DRIFT.max_sigma_m**2
        off = off[tells & (np.abs(self._height[c] - first) < _DRIFT.same_ground_m)]
        if len(off) < _DRIFT.min_cells:
            return
        gap = float(np.partition(off, len(off) // 2)[len(off) // 2])
        compensating = abs(self._lasts) >= _DRIFT.scans
        if abs(gap) <= (_DRIFT.end_m if compensating else _DRIFT.begin_m):
            self._lasts = 0
            return
        spread = (
            1.25
            * 1.48
            * float(np.partition(np.abs(off - gap), len(off) // 2)[len(off) // 2])
            / math.sqrt(len(off) / _DRIFT.correlated_cells)
        )
        noise = math.hypot(height_sigma(ray, S), spread)
        sign = 1 if gap > 0 else -1
        if abs(gap) <= (noise if compensating else 3.0 * noise):
            self._lasts = 0
            return
        self._lasts = self._lasts + sign if self._lasts * sign >= 0 else sign
        if abs(self._lasts) >= _DRIFT.scans:
            self._drift += max(-_DRIFT.rate_m, min(_DRIFT.rate_m, gap))

    def _look_through(self, ends: Array, camera: Array) -> None:
        """`sextant.services.mapper.elevation.ray_clearing.RayClearing.look`.

        Each line is a row, each of its steps a column.
        """
        n, heights = self._size, self._height
        highest = float(np.fmax.reduce(heights)) if len(ends) else -math.inf
        if not len(ends) or not highest - _RAYS.well_below_m > float(ends[:, 2].min()) - self._drift:
            return
        # 1. The steps of the lines in the window, up to where they are above all heights.
        u, v = (ends[:, k] / self._resolution - self._low[k] for k in (0, 1))
        du, dv = (camera[k] / self._resolution - self._low[k] - at for k, at in ((0, u), (1, v)))
        z = ends[:, 2] - self._drift
        dz, way = camera[2] - self._drift - z, np.maximum(np.abs(du), np.abs(dv))
        with np.errstate(divide="ignore", invalid="ignore"):
            over0 = z + 0.75 * dz / way + _RAYS.well_below_m
            last = np.minimum(way, (highest - over0) / dz * way)
        kept = (way > _RAYS.short_cells) & (dz > 0.0) & (last >= _RAYS.short_cells)
        if not kept.any():
            return
        u, v, du, dv, dz, way, over0, last = (a[kept, None] for a in (u, v, du, dv, dz, way, over0, last))
        steps = np.arange(_RAYS.short_cells, int(last.max()) + 1)
        s = steps / way
        i, j = np.floor(u + s * du), np.floor(v + s * dv)
        over = over0 + s * dz
        inside = (steps < np.floor(way)) & (i >= 1) & (j >= 1) & (i < n - 1) & (j < n - 1) & (over <= highest)
        i, j, over = i[inside].astype(np.int64), j[inside].astype(np.int64), over[inside]
        # 2. The cells well above the lines whose neighbours are high, too.
        c = ((i + self._low[0]) % n) * n + (j + self._low[1]) % n
        stands = heights[c] > over + 3.0 * np.minimum(np.sqrt(self._variance[c]), _RAYS.max_sigma_m)
        i, j, c, over = i[stands], j[stands], c[stands], over[stands]
        standing, fallen, low = (np.zeros(len(c), dtype=np.int64) for _ in range(3))
        for p in (-1, 0, 1):
            for q in (-1, 0, 1):
                if p or q:
                    beside = ((i + p + self._low[0]) % n) * n + (j + q + self._low[1]) % n
                    height, above = heights[beside], heights[beside] > over
                    fell = ~above & (self._fell[beside] != 0)
                    standing, fallen, low = standing + above, fallen + fell, low + (~above & ~fell & (height == height))
        within = ((low == 0) & (standing + fallen >= 6)) | (fallen >= _RAYS.cleared_neighbours)
        support, through = self._support.astype(np.int64), self._through.astype(np.int64)
        counts = within | (_RAYS.scans_per_measurement * support[c] <= 255)
        seen, first = np.unique(c[counts], return_index=True)  # the first line through a cell tells whether it lies within
        within = within[counts][first]
        # 3. Clear cells after enough observations.
        self._through[seen] = np.minimum(through[seen] + 1, 255)
        needed = _RAYS.scans_per_measurement * np.maximum(support[seen], 1)
        gone = seen[self._through[seen] >= np.where(within, np.minimum(needed, _RAYS.scans_inside), needed)]
        for layer in (self._height, self._variance, self._first):
            layer[gone] = np.nan
        for counter in (self._support, self._votes, self._through):
            counter[gone] = 0
        self._fell[gone] = 1

    def _slopes(self, ij: NDArray[np.int64], inside: Cells) -> Array:
        """Gradient (k, 2) of the map at cells (k, 2).

        It is the smaller one of the differences to both sides, 0 where their signs differ.
        """
        n = self._size
        out = np.full(ij.shape, np.nan)
        here = self._height[(ij[:, 0] % n) * n + ij[:, 1] % n]
        for axis in (0, 1):
            sides = []
            for by in (1, -1):
                beside = ij.copy()
                beside[:, axis] += by
                known = inside & (beside[:, axis] >= self._low[axis]) & (beside[:, axis] < self._low[axis] + n)
                height = self._height[(beside[:, 0] % n) * n + beside[:, 1] % n]
                sides.append(np.where(known, by * (height - here), np.nan))
            up, down = sides
            smaller = np.where(np.abs(up) < np.abs(down), up, down) / self._resolution
            out[:, axis] = np.where(up * down > 0, smaller, np.where(up * down <= 0, 0.0, np.nan))
        return out

    def _height_variance(self, ray: Array, count: Array, spread: Array, S: Array, slope: Array) -> tuple[Array, Array]:
        """`FusionModel.height_variance` of points at rays (k, 3) [m] from the camera."""
        model = self._model
        x, y, z = ray.T
        flat2 = x * x + y * y
        range2 = np.maximum(flat2 + z * z, 1e-12)
        leverage2 = (np.abs(z) + model.terrain_slope * np.sqrt(flat2)) ** 2 / range2
        pixel = (model.depth_sigma * range2 + model.range_sigma) ** 2 * leverage2
        # Rows of (1, -[r]x): how the point's x, y and z move with the pose's twist.
        zero, one = np.zeros_like(x), np.ones_like(x)
        along = np.stack(
            [[one, zero, zero, zero, z, -y], [zero, one, zero, -z, zero, x], [zero, zero, one, y, -x, zero]]
        ).transpose(2, 0, 1)
        P = along @ S @ along.transpose(0, 2, 1)
        known = np.isfinite(slope)
        n = np.concatenate([np.where(known, -slope, 0.0), one[:, None]], axis=1)
        unknown = 0.5 * model.terrain_slope**2 * (~known[:, 0] * P[:, 0, 0] + ~known[:, 1] * P[:, 1, 1])
        pose = np.einsum("ki,kij,kj->k", n, P, n) + unknown
        quantised = (model.quantisation_sigma * range2) ** 2 * leverage2
        own = np.maximum(spread.astype(np.float64) ** 2 - pixel, 0.0)
        random = pixel / np.minimum(count, model.independent_pixels)
        return random, model.floor_sigma**2 + quantised + np.maximum(pose, 0.0) + own

    def _first_of(self, cell: NDArray[np.int64]) -> Cells:
        """Return which entries are the first of their cell."""
        order = np.arange(len(cell))
        self._slot[cell[::-1]] = order[::-1]
        return np.asarray(self._slot[cell] == order)

    def _update(self, cells: NDArray[np.int64], z: Array, noise: Array, systematic: Array) -> None:
        """Fuse one measurement per cell: into the filter, or as a vote for the rival."""
        gate2 = self._model.gate**2
        height, believed = self._height[cells].astype(np.float64), self._variance[cells].astype(np.float64)
        off = z - height
        new = np.isnan(height)
        good = ~new & (off * off <= gate2 * (believed + noise))
        # 1. Unknown cells take the measurement.
        c = cells[new]
        self._height[c], self._variance[c], self._support[c], self._votes[c] = z[new], noise[new], 1, 0
        self._through[c] = 0
        # 2. Inside the gate, it is filtered.
        c, b, m = cells[good], believed[good], noise[good]
        self._height[c] = height[good] + b / (b + m) * off[good]
        self._variance[c] = np.maximum(b * m / (b + m), np.minimum(b, systematic[good]))
        self._support[c] += self._support[c] < 255
        self._votes[c] -= self._votes[c] > 0
        self._through[c] = 0
        self._fell[c[self._support[c] >= _RAYS.settled_scans]] = 0
        c = c[self._support[c] == ESTABLISHED]
        self._first[c] = self._height[c]
        # 3. Outside the gate, it votes.
        bad = ~(new | good)
        c, z, m, systematic = cells[bad], z[bad], noise[bad], systematic[bad]
        votes, rival = self._votes[c].astype(np.int64), self._rival[c].astype(np.float64)
        b = self._rival_variance[c].astype(np.float64)
        off = z - rival
        agrees = (votes > 0) & (off * off <= gate2 * (b + m))
        begins = ~agrees & (votes <= 1)
        self._rival[c] = np.where(agrees, rival + b / (b + m) * off, np.where(begins, z, rival))
        filtered = np.maximum(b * m / (b + m), np.minimum(b, systematic))
        self._rival_variance[c] = np.where(agrees, filtered, np.where(begins, m, b))
        votes = np.where(agrees, np.minimum(votes + 1, 255), np.where(begins, 1, votes - 1))
        over = votes >= np.minimum(self._model.patience, self._support[c].astype(np.int64) + 1)
        self._votes[c] = np.where(over, 0, votes)
        c, support = c[over], votes[over]
        self._fell[c] = self._rival[c] < self._height[c] - _RAYS.well_below_m
        self._height[c], self._variance[c], self._support[c] = self._rival[c], self._rival_variance[c], support
        self._first[c], self._through[c] = np.where(support >= ESTABLISHED, self._height[c], np.nan), 0

    @property
    def elevation(self) -> Layer:
        """(n, n) [m] {world} in world order, NaN where unknown."""
        i, j = (self._low % self._size).tolist()
        height = self._height + np.float32(self._drift)
        return np.roll(height.reshape(self._size, self._size), (-i, -j), axis=(0, 1))
