"""Other ways to do what the map stages do, with common libraries, to be timed and compared with ours.

Each comes to the same result but for rounding and ties, except for Open3D's cloud, which knows neither edges nor surfaces. They
are written as one would write them for speed: whole arrays, single precision where ours is, no loops over pixels or cells.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from services.mapper.cells import ESTABLISHED
from services.mapper.foothold_map import FootholdRules, disc
from services.mapper.fusion import FusionModel
from services.mapper.height_drift import (
    ALIKE,
    DRIFTED,
    FEWEST,
    KNOWN_WELL,
    LEVEL_AGAIN,
    PERSISTS,
    RATE,
    SAME_GROUND,
    TELLS,
    height_sigma,
)
from services.mapper.score import ScoreWeights
from services.mapper.sight_lines import FELL_AROUND, FOLLOWED, SETTLED, SHORT, SIGHTS_NEEDED, WELL_BELOW
from services.perception.reduction import CARRYING, JUMP, NOISE, SURFACE
from shared.camera import DepthSensor, Intrinsics
from shared.geometry import Array
from shared.messages import UNKNOWN

Layer = NDArray[np.float32]
Cells = NDArray[np.bool_]

# ------------------------------------------------------------------------------------------------- a frame to a point per cell


class Reduces(Protocol):
    """From a frame to a point per cell of the map."""

    def reduce(self, depth: NDArray[np.uint16], T_world_camera: Array) -> Array:
        """Points (n, 3) [m] {world} of a raw frame (h, w) seen from a pose (4, 4)."""
        ...


class NumpyReduction:
    """`services.perception.reduction.reduce_scan` in NumPy."""

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor, resolution: float, max_range: float):
        self._x = ((np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx).astype(np.float32)
        self._y = ((np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy).astype(np.float32)[:, None]
        self._scale = np.float32(1.0 / sensor.depth_scale)
        self._bounds = sensor.min_range * sensor.depth_scale, sensor.max_range * sensor.depth_scale
        noise = NOISE * float(sensor.sigma(np.array(1.0), intrinsics.fx))
        self._jump, self._jump2 = np.float32(JUMP * sensor.depth_scale), np.float32(noise / sensor.depth_scale)
        self._noise = np.float32(noise)
        self._dense = np.float32(0.25 * resolution * intrinsics.fx)
        self._resolution, self._range2 = resolution, np.float32(max_range**2)
        self._half = math.ceil(max_range / resolution) + 2
        rows, columns = np.indices((intrinsics.height, intrinsics.width), sparse=True)
        self._odd_row, self._every_second = rows % 2 == 1, (rows + columns) % 2 == 0
        self._every_fourth = ~self._odd_row & ((rows // 2 + columns) % 2 == 0)

    def reduce(self, depth: NDArray[np.uint16], T_world_camera: Array) -> Array:
        """The mean of the upper surface of each cell, rounded to millimetres."""
        origin = np.floor(T_world_camera[:3, 3] / self._resolution) * self._resolution
        R, t = T_world_camera[:3, :3].astype(np.float32), (T_world_camera[:3, 3] - origin).astype(np.float32)
        # 1. The pixels that are read, and where they lie from the camera, in world axes.
        z = depth * self._scale
        dx, dy, dz = (((R[k, 0] * self._x + (R[k, 1] * self._y + R[k, 2])) * z) for k in range(3))
        read = (depth >= self._bounds[0]) & (depth <= self._bounds[1]) & (dx * dx + dy * dy <= self._range2)
        read &= (z >= self._dense) | self._every_second
        # Rows that are crowded with pixels on level ground are read one in two, whose pixels count twice.
        farthest = np.where((depth >= self._bounds[0]) & (depth <= self._bounds[1]), z, 0.0).max(axis=1, keepdims=True)
        drop = -np.max(R[2, 0] * self._x[[0, -1]] + (R[2, 1] * self._y + R[2, 2]), axis=1, keepdims=True)
        crowded = (farthest < self._dense) & (farthest < self._dense * drop)
        read &= ~crowded | self._every_fourth
        weight = np.broadcast_to(1.0 + crowded, read.shape)
        # 2. Without those between two surfaces.
        read &= ~self._flying(depth)
        dx, dy, dz, z, weight = dx[read], dy[read], dz[read], z[read], weight[read]
        # 3. Their cells, and the highest and the lowest of each.
        side = 2 * self._half
        per_cell = np.float32(1.0 / self._resolution)
        i = (dx * per_cell + (t[0] * per_cell + np.float32(self._half))).astype(np.int32)
        j = (dy * per_cell + (t[1] * per_cell + np.float32(self._half))).astype(np.int32)
        key = i * side + j
        band = SURFACE + self._noise * z * np.abs(dz)
        top, bottom = np.full(side * side, -np.inf, np.float32), np.full(side * side, np.inf, np.float32)
        np.maximum.at(top, key, dz)
        np.minimum.at(bottom, key, dz)
        # 4. The mean of the upper surface, or of the lower one where the upper is but an edge.
        upper, lower = dz >= top[key] - band, dz <= bottom[key] + band
        count = np.bincount(key, weight, minlength=side * side)
        edge = np.bincount(key[upper], weight[upper], minlength=side * side) < CARRYING * count
        chosen = np.where(edge[key], lower, upper)
        key, weight = key[chosen], weight[chosen]
        cells = np.flatnonzero(count)
        sums = np.stack([np.bincount(key, weight * d[chosen], minlength=side * side)[cells] for d in (dx, dy, dz)], axis=1)
        mean = sums / np.bincount(key, weight, minlength=side * side)[cells, None] + t
        # 5. Rounded, and 1 mm inside the cell.
        mm, edge_mm = np.rint(1000.0 * mean), 1000.0 * self._resolution
        corner = edge_mm * (np.stack([cells // side, cells % side], axis=1) - self._half)
        mm[:, :2] = np.clip(mm[:, :2], np.floor(corner + 1.0), np.ceil(corner + edge_mm - 1.0))
        return np.asarray(origin + 1e-3 * mm.astype(np.int16))

    def _flying(self, depth: NDArray[np.uint16]) -> Cells:
        """Pixels (h, w) that jump on both sides, along their row or their column, one way in front and one way behind."""
        raw = depth.astype(np.int32)
        limit = (self._jump + self._jump2 * (raw.astype(np.float32) ** 2)).astype(np.int32)
        out = np.zeros(raw.shape, dtype=np.bool_)
        for axis in (0, 1):
            # Nothing beyond the image's border speaks against a pixel: it is its own neighbour there.
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
    """An image moved along an axis; what comes in is the border's."""
    out = border.copy()
    to = (slice(None),) * axis + (slice(by, None) if by > 0 else slice(None, by),)
    of = (slice(None),) * axis + (slice(None, -by) if by > 0 else slice(-by, None),)
    out[to] = image[of]
    return out


class Open3dCloud:
    """Open3D: the cloud of a frame, placed and thinned to the centroid of each voxel as large as a cell."""

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor, resolution: float, max_range: float):
        import open3d

        self._o3d: Any = open3d
        k = intrinsics
        self._intrinsics = open3d.camera.PinholeCameraIntrinsic(k.width, k.height, k.fx, k.fy, k.cx, k.cy)
        self._scale, self._far, self._resolution = sensor.depth_scale, sensor.max_range, resolution

    def reduce(self, depth: NDArray[np.uint16], T_world_camera: Array) -> Array:
        """Centroids (n, 3) [m] {world}, several above each other at an edge."""
        o3d = self._o3d
        cloud = o3d.geometry.PointCloud.create_from_depth_image(
            o3d.geometry.Image(depth), self._intrinsics, depth_scale=self._scale, depth_trunc=self._far
        )
        return np.asarray(cloud.transform(T_world_camera).voxel_down_sample(self._resolution).points)


REDUCTION: Mapping[str, Callable[[Intrinsics, DepthSensor, float, float], Reduces]] = {
    "NumPy": NumpyReduction,
    "Open3D cloud": Open3dCloud,
}

# ------------------------------------------------------------------------------------------------------- a scan into the map


class NumpyGrid:
    """`services.mapper.elevation.ElevationGrid` in NumPy: a circular buffer, a Kalman filter and a rival in each cell."""

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
        """Take in one reduced scan; arguments as in `ElevationGrid.fuse`."""
        n, model = self._size, self._model
        # 1. The cell of each point within the window, and how sure its height is.
        ij = np.floor(points[:, :2] / self._resolution).astype(np.int64)
        inside: Cells = np.asarray(((ij >= self._low) & (ij < self._low + n)).all(axis=1))
        slope = self._slopes(ij, inside)
        random, systematic = self._height_variance(points - p_world_camera, count, spread, pose_covariance, slope)
        ij = ij[inside] % n
        cell, z, random, systematic = ij[:, 0] * n + ij[:, 1], points[inside, 2], random[inside], systematic[inside]
        # 2. Points of one cell are merged, the first of each with the second of each and so on; scans bring few such.
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
        # 3. Without the drift of the pose's height, into the filters; and what stands in a line of sight.
        self._follow_drift(cells, out_z, (points[inside] - p_world_camera).mean(axis=0), pose_covariance)
        self._update(cells, out_z - self._drift, out_random + out_systematic, out_systematic)
        self._look_through(points[self._scans % FOLLOWED :: FOLLOWED], p_world_camera)
        self._scans += 1

    def _follow_drift(self, cells: NDArray[np.int64], z: Array, ray: Array, S: Array) -> None:
        """`services.mapper.height_drift.HeightDrift.follow`."""
        c = cells[::TELLS]
        off, first = z[::TELLS] - self._drift - self._first[c], self._first[c]
        tells = (np.abs(off) < SAME_GROUND) & (self._votes[c] == 0) & (self._variance[c] < KNOWN_WELL**2)
        off = off[tells & (np.abs(self._height[c] - first) < SAME_GROUND)]
        if len(off) < FEWEST:
            return
        gap = float(np.partition(off, len(off) // 2)[len(off) // 2])
        compensating = abs(self._lasts) >= PERSISTS
        if abs(gap) <= (LEVEL_AGAIN if compensating else DRIFTED):
            self._lasts = 0
            return
        spread = (
            1.25 * 1.48 * float(np.partition(np.abs(off - gap), len(off) // 2)[len(off) // 2]) / math.sqrt(len(off) / ALIKE)
        )
        noise = math.hypot(height_sigma(ray, S), spread)
        sign = 1 if gap > 0 else -1
        if abs(gap) <= (noise if compensating else 3.0 * noise):
            self._lasts = 0
            return
        self._lasts = self._lasts + sign if self._lasts * sign >= 0 else sign
        if abs(self._lasts) >= PERSISTS:
            self._drift += max(-RATE, min(RATE, gap))

    def _look_through(self, ends: Array, camera: Array) -> None:
        """`services.mapper.sight_lines.SightLines.look`: each line is a row, each of its steps a column."""
        n, heights = self._size, self._height
        highest = float(np.fmax.reduce(heights)) if len(ends) else -math.inf
        if not len(ends) or not highest - WELL_BELOW > float(ends[:, 2].min()) - self._drift:
            return
        # 1. The steps of the lines in the window, up to where they are above everything.
        u, v = (ends[:, k] / self._resolution - self._low[k] for k in (0, 1))
        du, dv = (camera[k] / self._resolution - self._low[k] - at for k, at in ((0, u), (1, v)))
        z = ends[:, 2] - self._drift
        dz, way = camera[2] - self._drift - z, np.maximum(np.abs(du), np.abs(dv))
        with np.errstate(divide="ignore", invalid="ignore"):
            over0 = z + 0.75 * dz / way + WELL_BELOW
            last = np.minimum(way, (highest - over0) / dz * way)
        kept = (way > SHORT) & (dz > 0.0) & (last >= SHORT)
        if not kept.any():
            return
        u, v, du, dv, dz, way, over0, last = (a[kept, None] for a in (u, v, du, dv, dz, way, over0, last))
        steps = np.arange(SHORT, int(last.max()) + 1)
        s = steps / way
        i, j = np.floor(u + s * du), np.floor(v + s * dv)
        over = over0 + s * dz
        inside = (steps < np.floor(way)) & (i >= 1) & (j >= 1) & (i < n - 1) & (j < n - 1) & (over <= highest)
        i, j, over = i[inside].astype(np.int64), j[inside].astype(np.int64), over[inside]
        # 2. The cells that stand well above them, within a body.
        c = ((i + self._low[0]) % n) * n + (j + self._low[1]) % n
        stands = heights[c] > over + 3.0 * np.sqrt(self._variance[c])
        i, j, c, over = i[stands], j[stands], c[stands], over[stands]
        standing, fallen, low = (np.zeros(len(c), dtype=np.int64) for _ in range(3))
        for p in (-1, 0, 1):
            for q in (-1, 0, 1):
                if p or q:
                    beside = ((i + p + self._low[0]) % n) * n + (j + q + self._low[1]) % n
                    height, above = heights[beside], heights[beside] > over
                    fell = ~above & (self._fell[beside] != 0)
                    standing, fallen, low = standing + above, fallen + fell, low + (~above & ~fell & (height == height))
        seen = np.unique(c[((low == 0) & (standing + fallen >= 6)) | (fallen >= FELL_AROUND)])
        # 3. Looked through so often, they are gone.
        self._through[seen] += 1
        gone = seen[self._through[seen] >= SIGHTS_NEEDED]
        for layer in (self._height, self._variance, self._first):
            layer[gone] = np.nan
        for counter in (self._support, self._votes, self._through):
            counter[gone] = 0
        self._fell[gone] = 1

    def _slopes(self, ij: NDArray[np.int64], inside: Cells) -> Array:
        """Gradient (k, 2) of the map at cells (k, 2): of both sides' differences the smaller, 0 where their signs differ."""
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
        """`FusionModel.height_variance` of points at a ray (k, 3) [m] from the camera."""
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
        """Which entries are the first of their cell."""
        order = np.arange(len(cell))
        self._slot[cell[::-1]] = order[::-1]
        return np.asarray(self._slot[cell] == order)

    def _update(self, cells: NDArray[np.int64], z: Array, noise: Array, systematic: Array) -> None:
        """One measurement for each cell: filtered in, or a vote for the rival."""
        gate2 = self._model.gate**2
        height, believed = self._height[cells].astype(np.float64), self._variance[cells].astype(np.float64)
        off = z - height
        new = np.isnan(height)
        good = ~new & (off * off <= gate2 * (believed + noise))
        # 1. Unseen cells take the measurement.
        c = cells[new]
        self._height[c], self._variance[c], self._support[c], self._votes[c] = z[new], noise[new], 1, 0
        self._through[c] = 0
        # 2. Within the gate it is filtered in.
        c, b, m = cells[good], believed[good], noise[good]
        self._height[c] = height[good] + b / (b + m) * off[good]
        self._variance[c] = np.maximum(b * m / (b + m), np.minimum(b, systematic[good]))
        self._support[c] += self._support[c] < 255
        self._votes[c] -= self._votes[c] > 0
        self._through[c] = 0
        self._fell[c[self._support[c] >= SETTLED]] = 0
        c = c[self._support[c] == ESTABLISHED]
        self._first[c] = self._height[c]
        # 3. Outside of it, it votes.
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
        self._fell[c] = self._rival[c] < self._height[c] - WELL_BELOW
        self._height[c], self._variance[c], self._support[c] = self._rival[c], self._rival_variance[c], support
        self._first[c], self._through[c] = np.where(support >= ESTABLISHED, self._height[c], np.nan), 0

    @property
    def elevation(self) -> Layer:
        """(n, n) [m] {world} in world order, NaN where never seen."""
        i, j = (self._low % self._size).tolist()
        height = self._height + np.float32(self._drift)
        return np.roll(height.reshape(self._size, self._size), (-i, -j), axis=(0, 1))


# ------------------------------------------------------------------------------------------------------------------ the score


class Scores(Protocol):
    """How well each cell carries a foot, by either thesis."""

    def layers(self, elevation: Layer) -> tuple[Layer, NDArray[np.int8]]:
        """Score and evaluation function (nx, ny) of a map (nx, ny) [m], as `services.mapper.layers.Layers` has them."""
        ...


class _Chain:
    """`services.mapper.layers.FootholdLayers`, of a whole map whose heights are sure, on the filters of some library."""

    def __init__(self, resolution: float, weights: ScoreWeights, rules: FootholdRules):
        self._resolution, self._weights = resolution, weights
        self._flattest, self._evenest = math.tan(rules.slope_limit), rules.edge_deviation
        self._bound, self._reach = round(rules.bound / resolution), round(rules.reach / resolution)
        self._close = round((rules.closing / resolution - 1) / 2)
        self._square = np.ones((2 * self._close + 1, 2 * self._close + 1), dtype=np.bool_)
        self._vacant = disc(rules.unknown_clearance / resolution, least=0).astype(np.bool_)
        self._half = round(weights.flat_radius / resolution)
        self._sigma = weights.proximity_sigma / resolution
        self._disc = disc(weights.unknown_clearance / resolution).astype(np.bool_)
        self._neighbours = np.ones((3, 3), dtype=np.bool_)
        offsets = np.arange(-self._half, self._half + 1, dtype=np.float32)
        self._one, self._first, self._second = np.ones_like(offsets), offsets, offsets * offsets

    def layers(self, elevation: Layer) -> tuple[Layer, NDArray[np.int8]]:
        """The weighted sum of slope, proximity and roughness, and the signed distance on ground that is even and not steep."""
        w = self._weights
        known = ~np.isnan(elevation)
        h = np.where(known, elevation - np.float32(np.nanmean(elevation)), np.float32(0.0))
        k = known.astype(np.float32)
        slope = np.hypot(self._sobel(h, 0), self._sobel(h, 1)) / np.float32(8.0 * self._resolution)
        proximity = np.abs(self._gaussian(h) / np.maximum(self._gaussian(k), np.float32(1e-6)) - h)
        roughness = self._roughness(h, k)
        score = w.slope * slope + w.proximity * proximity + w.roughness * roughness
        score = np.where(self._eroded(known, self._disc), score, np.float32(np.nan))
        complete = self._eroded(known, self._neighbours)
        even = (slope <= self._flattest) & (roughness <= self._evenest)
        return np.asarray(score, dtype=np.float32), self._evaluation(complete & even, complete & ~even, known)

    def _evaluation(self, accessible: Cells, refused: Cells, known: Cells) -> NDArray[np.int8]:
        """Closed where nothing beside was refused, without what is near to vacant ground; then how far in, or out."""
        frame = 2 * self._close
        closed = self._closed(np.pad(accessible, frame), self._square)[frame:-frame, frame:-frame]
        ground = accessible | (closed & self._eroded(~refused, self._square))
        ground &= self._eroded(ground | known, self._vacant)
        inside = np.minimum(self._manhattan(np.pad(ground, 1))[1:-1, 1:-1], self._bound)
        outside = np.minimum(self._manhattan(~ground), self._reach) if ground.any() else np.full(ground.shape, self._reach)
        return np.where(known, np.where(ground, -inside, outside), UNKNOWN).astype(np.int8)

    def _roughness(self, h: Layer, k: Layer) -> Layer:
        """Deviation from the plane of each window: ten masked moments, summed along one axis, then along the other."""
        one, first, second = self._one, self._first, self._second
        k0, k1, k2 = (self._along(k, weights, 0) for weights in (one, first, second))
        h0, h1 = (self._along(h, weights, 0) for weights in (one, first))
        square = self._along(h * h, one, 0)
        n = np.maximum(self._along(k0, one, 1), np.float32(1.0))
        a, b, z = self._along(k1, one, 1) / n, self._along(k0, first, 1) / n, self._along(h0, one, 1) / n
        aa = self._along(k2, one, 1) / n - a * a
        bb = self._along(k0, second, 1) / n - b * b
        ab = self._along(k1, first, 1) / n - a * b
        ah = self._along(h1, one, 1) / n - a * z
        bh = self._along(h0, first, 1) / n - b * z
        hh = self._along(square, one, 1) / n - z * z
        determinant = np.maximum(aa * bb - ab * ab, np.float32(1e-6))
        explained = (bb * ah * ah - np.float32(2.0) * ab * ah * bh + aa * bh * bh) / determinant
        noise = np.float32(self._weights.noise_sigma**2)
        return np.asarray(np.sqrt(np.maximum(hh - explained - noise, np.float32(0.0))))

    def _sobel(self, image: Layer, axis: int) -> Layer:
        raise NotImplementedError

    def _gaussian(self, image: Layer) -> Layer:
        raise NotImplementedError

    def _along(self, image: Layer, weights: Layer, axis: int) -> Layer:
        raise NotImplementedError

    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        raise NotImplementedError

    def _closed(self, cells: Cells, square: Cells) -> Cells:
        raise NotImplementedError

    def _manhattan(self, cells: Cells) -> NDArray[np.integer | np.floating]:
        """Distance of each cell to the next that is False."""
        raise NotImplementedError


class ScipyChain(_Chain):
    """SciPy's image filters."""

    def __init__(self, resolution: float, weights: ScoreWeights, rules: FootholdRules):
        super().__init__(resolution, weights, rules)
        from scipy import ndimage

        self._nd: Any = ndimage

    def _sobel(self, image: Layer, axis: int) -> Layer:
        return np.asarray(self._nd.sobel(image, axis=axis))

    def _gaussian(self, image: Layer) -> Layer:
        return np.asarray(self._nd.gaussian_filter(image, self._sigma, radius=self._half, mode="constant"))

    def _along(self, image: Layer, weights: Layer, axis: int) -> Layer:
        if weights is self._one:  # a running sum, whatever the width
            return np.asarray(self._nd.uniform_filter1d(image, len(weights), axis=axis, mode="constant")) * len(weights)
        return np.asarray(self._nd.correlate1d(image, weights, axis=axis, mode="constant"))

    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        return np.asarray(self._nd.binary_erosion(cells, room))

    def _closed(self, cells: Cells, square: Cells) -> Cells:
        return np.asarray(self._nd.binary_closing(cells, square))

    def _manhattan(self, cells: Cells) -> NDArray[np.integer | np.floating]:
        return np.asarray(self._nd.distance_transform_cdt(cells, "taxicab"))


class ScikitImageChain(ScipyChain):
    """scikit-image where it has the filter; windows with weights and Manhattan distances it has not: those stay SciPy's."""

    def __init__(self, resolution: float, weights: ScoreWeights, rules: FootholdRules):
        super().__init__(resolution, weights, rules)
        from skimage import filters, morphology

        self._filters: Any = filters
        self._morphology: Any = morphology

    def _sobel(self, image: Layer, axis: int) -> Layer:
        return np.asarray(4.0 * (self._filters.sobel_h if axis == 0 else self._filters.sobel_v)(image))

    def _gaussian(self, image: Layer) -> Layer:
        truncate = self._half / self._sigma
        return np.asarray(self._filters.gaussian(image, self._sigma, mode="constant", truncate=truncate, preserve_range=True))

    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        return np.asarray(self._morphology.erosion(np.pad(cells, 1), room)[1:-1, 1:-1])

    def _closed(self, cells: Cells, square: Cells) -> Cells:
        return np.asarray(self._morphology.closing(cells, square))


class OpencvChain(_Chain):
    """OpenCV's filters, and NumPy between them."""

    def _sobel(self, image: Layer, axis: int) -> Layer:
        dx, dy = (0, 1) if axis == 0 else (1, 0)  # OpenCV's y is our first axis
        return np.asarray(cv2.Sobel(image, cv2.CV_32F, dx, dy), dtype=np.float32)

    def _gaussian(self, image: Layer) -> Layer:
        width = 2 * self._half + 1
        return np.asarray(cv2.GaussianBlur(image, (width, width), self._sigma, borderType=cv2.BORDER_CONSTANT))

    def _along(self, image: Layer, weights: Layer, axis: int) -> Layer:
        here = np.ones(1, np.float32)
        kx, ky = (here, weights) if axis == 0 else (weights, here)
        return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, kx, ky, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)

    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        eroded = cv2.erode(cells.view(np.uint8), room.view(np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=[0.0])
        return np.asarray(eroded, dtype=np.bool_)

    def _closed(self, cells: Cells, square: Cells) -> Cells:
        return np.asarray(cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_CLOSE, square.view(np.uint8)), dtype=np.bool_)

    def _manhattan(self, cells: Cells) -> NDArray[np.integer | np.floating]:
        return np.asarray(cv2.distanceTransform(cells.view(np.uint8), cv2.DIST_L1, cv2.DIST_MASK_3))


SCORE: Mapping[str, Callable[[float, ScoreWeights, FootholdRules], Scores]] = {
    "SciPy": ScipyChain,
    "scikit-image": ScikitImageChain,
    "OpenCV + NumPy": OpencvChain,
}
