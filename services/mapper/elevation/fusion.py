"""A scan into the cells of a map: how far each height is off, one measurement for each cell, and its filter."""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.validated_scan import CheckedScan
from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor
from sextant.shared.runtime.compiled import compiled

_AT_A_TIME = 256  # points


@dataclass(frozen=True, slots=True)
class FusionModel:
    """How far a measured height is off, and when a cell changes its mind.

    A depth error e moves a point along its ray, so on ground of slope s seen at grazing angle g the height is off by
    e * (sin g + s * cos g); s is unknown and taken as `terrain_slope`.
    """

    depth_sigma: float = 1.27e-3  # [m] of one pixel at 1 m, grows with the square of the distance; averages away
    quantisation_sigma: float = 0.92e-3  # [m] of a scan's cell at 1 m, grows likewise; pixels of a cell share it
    range_sigma: float = 0.0  # [m] noise of one pixel at any distance (scanners)
    floor_sigma: float = 1.0e-3  # [m] error that no number of measurements averages away
    terrain_slope: float = 0.27  # [m/m] steepest ground to be mapped well
    independent_pixels: int = 8  # pixels of a cell beyond this many add nothing: their noise is correlated
    gate: float = 3.0  # [sigma] measurements further off vote for the rival
    edge_step: float = 0.01  # [m] points of one scan in one cell, further apart than this, are an edge: the upper wins
    patience: int = 5  # [scans] of disagreement until a well-established height is replaced

    def __post_init__(self) -> None:
        for name in ("depth_sigma", "quantisation_sigma", "range_sigma", "terrain_slope", "edge_step"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} of at least 0 expected, found {getattr(self, name)}")
        for name in ("floor_sigma", "gate"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"positive {name} expected, found {getattr(self, name)}")
        if self.independent_pixels < 1:
            raise ValueError(f"independent_pixels of at least 1 expected, found {self.independent_pixels}")
        if not 1 <= self.patience <= 200:
            raise ValueError(f"patience of 1 to 200 scans expected, found {self.patience}")

    def step_in(self, resolution: float) -> float:
        """[m] between points of one scan in a cell of that edge [m], beyond which they are an edge and not a slope."""
        return max(self.edge_step, 2.0 * self.terrain_slope * resolution)

    @classmethod
    def of_sensor(cls, sensor: DepthSensor, fx: float) -> Self:
        """The model of a triangulating camera with focal length fx [px]; the other fields keep their defaults."""
        if not 0 < fx < math.inf:
            raise ValueError(f"positive focal length expected, found fx = {fx}")
        per_pixel = 1.0 / (fx * sensor.baseline)
        return cls(
            depth_sigma=sensor.disparity_sigma * per_pixel,
            quantisation_sigma=sensor.disparity_step / math.sqrt(12.0) * per_pixel,
        )

    def height_variance(
        self,
        points: NDArray[np.float64],
        count: NDArray[np.float64],
        spread: NDArray[np.float64],
        p_world_camera: NDArray[np.float64],
        pose_covariance: NDArray[np.float64] | None = None,
        slope: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Variance of measured heights: the part that repeated measurement averages away, and the part it does not.

        The distance stands for the depth, which overstates the noise by at most 1/cos of the angle off the axis. A
        spread beyond the noise of a pixel is the ground's own: a foot may meet any of it, so the whole of it counts as one
        sigma and does not average away: a scan that saw a cell's face and top together yields to one that saw the top alone.

        A pose that is wrong by the twist (v, w) carries a point at r from the camera off by v + w x r, and the height
        that is noted at a place of ground with the gradient s off by n . (v + w x r), n = (-s, 1). So a pose covariance S
        adds J S J' with J = (n, r x n). Where s is unknown, it is taken as isotropic with `terrain_slope` for its rms.
        Pose errors are shared by all points of a scan and last from scan to scan, so they do not average away.

        Args:
            points: (n, 3) [m] {world} one point per cell, the mean of its pixels.
            count: (n,) pixels merged into each point.
            spread: (n,) [m] from the lowest to the highest height merged.
            p_world_camera: (3,) [m] {world} optical centre.
            pose_covariance: (6, 6) [m^2, m rad, rad^2] of the camera's position, then rotation, in world axes; none: exact.
            slope: (n, 2) [m/m] gradient of the ground at each point in x and y, NaN or none where it is unknown.

        Returns:
            random, systematic: (n,) [m^2] each.

        Source: Fankhauser et al. 2014, "Robot-centric elevation mapping with uncertainty estimates", section 3.1: the
        sensor's and the pose's covariance through the Jacobians of the height; there without correlations, x, y and slope.
        """
        covariance = np.zeros((6, 6)) if pose_covariance is None else np.asarray(pose_covariance, dtype=np.float64)
        gradient = np.full((len(points), 2), np.nan) if slope is None else np.asarray(slope, dtype=np.float64)
        ray = np.asarray(points, dtype=np.float64) - p_world_camera
        x, y, z, slope_x, slope_y = (np.ascontiguousarray(column) for column in (*ray.T, *gradient.T))
        number, width = np.asarray(count, dtype=np.float64), np.asarray(spread, dtype=np.float64)
        return _variances(x, y, z, number, width, slope_x, slope_y, covariance, self._noise)

    def measure(
        self, scan: CheckedScan, height: NDArray[np.float32], resolution: float, low_i: int, low_j: int
    ) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
        """What a scan has to say of a map.

        Args:
            scan: The scan.
            height: (nx, ny) [m] the map's circular buffer, NaN where never seen; its slopes carry the pose's error.
            resolution: [m] cell edge.
            low_i: World index, along x, of the lowest cell of the map's window.
            low_j: Likewise along y.

        Returns:
            cells: (m,) flat buffer index of each point that lies in the window.
            z: (m,) [m] {world} its height.
            random, systematic: (m,) [m^2] as of `height_variance`.
            ray: (3,) [m] from the camera to the middle of those points.
        """
        return _measure(
            scan.points, scan.origin, scan.unit, scan.count, scan.spread, scan.p_world_camera, scan.pose_covariance,
            self._noise, height, resolution, low_i, low_j,
        )  # fmt: skip

    @property
    def _noise(self) -> tuple[float, float, float, float, float, float]:
        """The numbers that `_variances` takes, in its order."""
        return (
            self.depth_sigma, self.range_sigma, self.quantisation_sigma, self.floor_sigma, self.terrain_slope,
            float(self.independent_pixels),
        )  # fmt: skip


@compiled
def _variances(
    x_of: Array,
    y_of: Array,
    z_of: Array,
    count: Array,
    spread: Array,
    slope_x: Array,
    slope_y: Array,
    S: Array,
    noise: tuple[float, float, float, float, float, float],
) -> tuple[Array, Array]:
    """Random and systematic variance (n,) [m^2] of points at x, y, z (n,) [m]; see `FusionModel.height_variance`."""
    depth_sigma, range_sigma, quantisation_sigma, floor_sigma, terrain_slope, most = noise
    # Made here: only of arrays of its own does the compiler know that no other shares their memory.
    random, systematic = np.empty(len(x_of)), np.empty(len(x_of))
    unknown2 = 0.5 * terrain_slope**2  # of either component of an isotropic gradient
    # Numbers of their own and no branches, so that the loop runs in vectors.
    s00, s01, s02, s03, s04, s05 = S[0, 0], S[0, 1], S[0, 2], S[0, 3], S[0, 4], S[0, 5]
    s11, s12, s13, s14, s15 = S[1, 1], S[1, 2], S[1, 3], S[1, 4], S[1, 5]
    s22, s23, s24, s25 = S[2, 2], S[2, 3], S[2, 4], S[2, 5]
    s33, s34, s35, s44, s45, s55 = S[3, 3], S[3, 4], S[3, 5], S[4, 4], S[4, 5], S[5, 5]
    floor2 = floor_sigma**2
    for k in range(len(x_of)):
        x, y, z = x_of[k], y_of[k], z_of[k]
        flat2 = x * x + y * y
        range2 = max(flat2 + z * z, 1e-12)
        leverage = abs(z) + terrain_slope * math.sqrt(flat2)
        leverage2 = leverage * leverage / range2
        pixel = depth_sigma * range2 + range_sigma
        pixel = pixel * pixel * leverage2
        quantised = quantisation_sigma * range2
        quantised = quantised * quantised * leverage2
        # Covariance of the point itself: rows of (1, -[r]x).
        zz = s22 + 2 * (y * s23 - x * s24) + y * y * s33 - 2 * x * y * s34 + x * x * s44
        xx = s00 + 2 * (z * s04 - y * s05) + z * z * s44 - 2 * y * z * s45 + y * y * s55
        yy = s11 + 2 * (x * s15 - z * s13) + x * x * s55 - 2 * x * z * s35 + z * z * s33
        xz = s02 + y * s03 - x * s04 + z * s24 - y * s25 + y * z * s34 - x * z * s44 - y * y * s35 + x * y * s45
        yz = s12 + y * s13 - x * s14 + x * s25 - z * s23 + x * y * s35 - x * x * s45 - y * z * s33 + x * z * s34
        xy = s01 + x * s05 - z * s03 + z * s14 - y * s15 + x * z * s45 - z * z * s34 - x * y * s55 + y * z * s35
        # A known component of the slope counts with its correlations, an unknown one with its spread.
        a, b = slope_x[k], slope_y[k]
        a, a2 = (a, a * a) if a == a else (0.0, unknown2)
        b, b2 = (b, b * b) if b == b else (0.0, unknown2)
        pose = zz + a2 * xx - 2 * a * xz + b2 * yy - 2 * b * yz + 2 * a * b * xy
        random[k] = pixel / min(count[k], most)
        systematic[k] = floor2 + quantised + max(pose, 0.0) + max(spread[k] * spread[k] - pixel, 0.0)
    return random, systematic


@compiled
def _measure(
    points: NDArray[Any],
    origin: Array,
    unit: float,
    count: NDArray[Any],
    spread: NDArray[Any],
    camera: Array,
    S: Array,
    noise: tuple[float, float, float, float, float, float],
    height: NDArray[np.float32],
    resolution: float,
    low_i: int,
    low_j: int,
) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """See `FusionModel.measure`; some points at a time, so that what is noted of each stays in the fastest memory."""
    n = len(points)
    cells, z, random, systematic = np.empty(n, dtype=np.int64), np.empty(n), np.empty(n), np.empty(n)
    xs, ys, zs = np.empty(_AT_A_TIME), np.empty(_AT_A_TIME), np.empty(_AT_A_TIME)
    rows_at, columns_at = np.empty(_AT_A_TIME), np.empty(_AT_A_TIME)
    x_of, y_of, z_of = np.empty(_AT_A_TIME), np.empty(_AT_A_TIME), np.empty(_AT_A_TIME)
    count_of, spread_of = np.empty(_AT_A_TIME), np.empty(_AT_A_TIME)
    slope_x, slope_y = np.empty(_AT_A_TIME), np.empty(_AT_A_TIME)
    rows, columns = height.shape
    heights = height.ravel()
    wrap_i, wrap_j = low_i % rows, low_j % columns
    per_cell, nowhere = np.float32(1.0 / resolution), np.float32(np.nan)
    x0, y0, z0 = camera[0], camera[1], camera[2]
    origin_x, origin_y, origin_z = origin[0], origin[1], origin[2]
    m, x_sum, y_sum, z_sum = 0, 0.0, 0.0, 0.0
    for begin in range(0, n, _AT_A_TIME):
        some = 0
        # 1. The cell, and the slope of the map there. Of the differences of height to both sides of a cell the smaller is its
        # slope, and none where they disagree in sign: on a plane that is the plane's, beside a step it is that of the ground
        # a foot would stand on, and not the step's.
        end = min(begin + _AT_A_TIME, n)
        for k in range(end - begin):
            xs[k], ys[k], zs[k] = points[begin + k, 0], points[begin + k, 1], points[begin + k, 2]
        for k in range(end - begin):
            xs[k], ys[k], zs[k] = origin_x + unit * xs[k], origin_y + unit * ys[k], origin_z + unit * zs[k]
        for k in range(end - begin):
            rows_at[k], columns_at[k] = np.floor(xs[k] / resolution) - low_i, np.floor(ys[k] / resolution) - low_j
        for k in range(begin, end):
            x, y, height_there = xs[k - begin], ys[k - begin], zs[k - begin]
            i, j = np.int64(rows_at[k - begin]), np.int64(columns_at[k - begin])
            if not (0 <= i < rows and 0 <= j < columns):
                continue
            at = np.uint64(some)  # unsigned, as an index that is never counted from the end
            x, y, z_off = x - x0, y - y0, height_there - z0
            x_of[at], y_of[at], z_of[at] = x, y, z_off
            x_sum, y_sum, z_sum = x_sum + x, y_sum + y, z_sum + z_off
            count_of[at], spread_of[at] = count[np.uint64(k)], unit * spread[np.uint64(k)]
            a, b = i + wrap_i, j + wrap_j  # the remainder by the size, without dividing
            a, b = a if a < rows else a - rows, b if b < columns else b - columns
            c = a * columns + b
            cells[np.uint64(m + some)], z[np.uint64(m + some)] = c, height_there
            # The buffer goes on at its border with its other side, the window does not.
            lower, upper = c - columns if a > 0 else c + (rows - 1) * columns, c + columns if a + 1 < rows else b
            before, after = c - 1 if b > 0 else c + columns - 1, c + 1 if b + 1 < columns else c - b
            here = heights[np.uint64(c)]
            along_x = _smaller(heights[np.uint64(upper)] - here, here - heights[np.uint64(lower)])
            along_y = _smaller(heights[np.uint64(after)] - here, here - heights[np.uint64(before)])
            slope_x[at] = along_x * per_cell if 0 < i < rows - 1 else nowhere
            slope_y[at] = along_y * per_cell if 0 < j < columns - 1 else nowhere
            some += 1
        # 2. Their variance.
        random[m : m + some], systematic[m : m + some] = _variances(
            x_of[:some], y_of[:some], z_of[:some], count_of[:some], spread_of[:some], slope_x[:some], slope_y[:some], S, noise
        )
        m += some
    ray = np.array([x_sum, y_sum, z_sum]) / max(m, 1)
    return cells[:m], z[:m], random[:m], systematic[:m], ray


@compiled
def _smaller(a: np.float32, b: np.float32) -> np.float32:
    """Of two numbers of one sign the smaller in size, 0 if their signs differ, NaN if one is; without a branch to guess."""
    size = abs(a) if abs(a) < abs(b) else abs(b)
    signed = size if a > np.float32(0.0) else -size
    product = a * b
    return signed if product > np.float32(0.0) else product * np.float32(0.0)


@compiled
def merge(
    cells: NDArray[np.int64],
    z: Array,
    random: Array,
    systematic: Array,
    slot: NDArray[np.int32],
    gate: float,
    edge_step: float,
) -> int:
    """Leave one measurement per cell, in place, and return how many there are; slot is -1 before and after."""
    m = 0
    for k in range(len(cells)):
        c = np.uint64(cells[k])
        if slot[c] < 0:
            slot[c] = m
            cells[m], z[m], random[m], systematic[m] = cells[k], z[k], random[k], systematic[k]
            m += 1
            continue
        d = np.uint64(slot[c])
        step = z[k] - z[d]
        if abs(step) > edge_step and step * step > gate * gate * (random[k] + random[d] + systematic[k]):
            if step > 0:
                z[d], random[d], systematic[d] = z[k], random[k], systematic[k]
            continue
        gain = (random[d] + 1e-12) / (random[d] + random[k] + 2e-12)
        z[d] += gain * step
        random[d] *= 1.0 - gain
        # Of their variance about the mean, what noise does not explain lasts.
        own = max(gain * (1.0 - gain) * step * step - random[k], 0.0)
        systematic[d] = max(systematic[d], systematic[k]) + own
    for e in range(m):
        slot[np.uint64(cells[e])] = -1
    return m


@compiled
def update_cells(
    cells: NDArray[np.int64],
    z: NDArray[np.float64],
    random: NDArray[np.float64],
    systematic: NDArray[np.float64],
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    support: NDArray[np.uint8],
    assumed: NDArray[np.uint8],
    rival: NDArray[np.float32],
    rival_variance: NDArray[np.float32],
    votes: NDArray[np.uint8],
    first: NDArray[np.float32],
    through: NDArray[np.uint8],
    fell: NDArray[np.uint8],
    gate: float,
    patience: int,
    established: int,
    settled: int,
    well_below: float,
) -> tuple[int, int, int]:
    """Filter one measurement into each cell; counts of cells updated, disputed and replaced."""
    updated = disputed = replaced = 0
    for k in range(len(cells)):
        c = np.uint64(cells[k])  # unsigned, as an index that is never counted from the end
        noise = random[k] + systematic[k]
        if assumed[c] or np.isnan(height[c]):
            height[c], variance[c], support[c], assumed[c], votes[c], through[c] = z[k], noise, 1, 0, 0, 0
            updated += 1
            continue
        believed = float(variance[c])
        off = z[k] - height[c]
        if off * off <= gate * gate * (believed + noise):
            gain = believed / (believed + noise)
            height[c] += gain * off
            variance[c] = max(gain * noise, min(believed, systematic[k]))
            support[c] = min(support[c] + 1, 255)
            if support[c] >= settled:
                fell[c] = 0
            votes[c] = max(votes[c] - 1, 0)
            through[c] = 0
            if support[c] == established:
                first[c] = height[c]
            updated += 1
            continue
        disputed += 1
        rivalry = float(rival_variance[c])
        off = z[k] - rival[c]
        if votes[c] > 0 and off * off <= gate * gate * (rivalry + noise):
            rival[c] += rivalry / (rivalry + noise) * off
            rival_variance[c] = max(rivalry * noise / (rivalry + noise), min(rivalry, systematic[k]))
            votes[c] = min(votes[c] + 1, 255)
        elif votes[c] > 1:
            votes[c] -= 1
        else:
            rival[c], rival_variance[c], votes[c] = z[k], noise, 1
        # A height seen once is no better than a rival seen twice; an established one waits for `patience` scans.
        if votes[c] >= min(patience, support[c] + 1):
            fell[c] = np.uint8(rival[c] < height[c] - well_below)
            height[c], variance[c], support[c], votes[c], through[c] = rival[c], rival_variance[c], votes[c], 0, 0
            first[c] = height[c] if support[c] >= established else np.nan
            replaced += 1
    return updated, disputed, replaced
