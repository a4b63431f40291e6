"""Fusion of a scan into map cells: error model, merging and filter."""

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import CellLayers
from sextant.services.mapper.elevation.params import FusionParams
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from sextant.shared.files import config
from sextant.shared.geometry import Array
from sextant.shared.robot.camera import DepthSensor
from sextant.shared.runtime.compiled import as_plain, compiled

_AT_A_TIME = 256  # points per block
_OVERHANG = 0.05  # [m] below a surface, from which a height may be that of a wall below an overhang
_CLEAR = 0.005**2  # [m^2] largest variance of a surface that was seen clearly: next to an edge it is larger
_SAME_TOP, _SIDE_CELLS = 0.01, 3  # [m] between cells of one surface, and [cells] to either side in which it continues


class ScanArrays(NamedTuple):
    """A scan for `_measure`, see `ValidatedScan`."""

    points: NDArray[Any]  # (n, 3) [unit] from the origin
    origin: Array  # (3,) [m] {world}
    unit: float  # [m]
    counts: NDArray[Any]  # (n,) pixels of each point
    spread: NDArray[Any]  # (n,) [unit] height range of these pixels


class MapWindow(NamedTuple):
    """The heights of a map for `_measure`."""

    height: NDArray[np.float32]  # (nx, ny) [m] circular buffer, NaN where unseen
    resolution: float  # [m]
    low_i: int  # world index, along x, of the lowest cell
    low_j: int  # world index, along y, of the lowest cell


class Measurements(NamedTuple):
    """Measured heights of cells, each cell once."""

    cells: NDArray[np.int64]  # (m,) flat buffer index
    z: Array  # (m,) [m] {world}
    random: Array  # (m,) [m^2] variance that averages out
    systematic: Array  # (m,) [m^2] variance that does not average out


class FilterCells(NamedTuple):
    """Flat layers of the map that `update_cells` changes, see `CellLayers`."""

    height: NDArray[np.float32]
    variance: NDArray[np.float32]
    support: NDArray[np.uint8]
    assumed: NDArray[np.uint8]
    rival: NDArray[np.float32]
    rival_variance: NDArray[np.float32]
    votes: NDArray[np.uint8]
    first: NDArray[np.float32]
    through: NDArray[np.uint8]
    fell: NDArray[np.uint8]

    @classmethod
    def of(cls, cells: CellLayers) -> Self:
        """Return flat views of the layers."""
        return cls(*(getattr(cells, name).ravel() for name in cls._fields))


class FilterRules(NamedTuple):
    """Limits of the filter in a cell."""

    gate: float  # [sigma] beyond which a measurement votes for the rival height
    patience: int  # [scans] of disagreement until a well-established height is replaced
    established: int  # [scans] after which a height counts as the first seen height
    settled: int  # [scans] after which a cleared cell counts as any other
    well_below: float  # [m] below the previous height, from which a new height shows that an object is gone
    columns: int  # cells of a row of the map


@dataclass(frozen=True, slots=True)
class FusionModel(FusionParams):
    """Error model of a measured height, and when a cell accepts a different height.

    A depth error e moves a point along its ray. On ground of slope s seen at a grazing angle g, the height error is
    e * (sin g + s * cos g). The slope s is unknown, and `terrain_slope` is used for it.
    """

    depth_sigma: float = 1.27e-3  # [m] of one pixel at 1 m; grows with the squared distance and averages out
    quantisation_sigma: float = 0.92e-3  # [m] of a scan's cell at 1 m; grows the same way and is shared by the cell's pixels
    range_sigma: float = 0.0  # [m] noise of one pixel at any distance (scanners)

    def __post_init__(self) -> None:
        config.verify(self)
        for name in ("depth_sigma", "quantisation_sigma", "range_sigma"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} of at least 0 expected, found {getattr(self, name)}")

    def step_in(self, resolution: float) -> float:
        """Return the height difference [m] in one cell that separates edge from slope.

        The resolution is the cell edge [m].
        """
        return max(self.edge_step, 2.0 * self.terrain_slope * resolution)

    @classmethod
    def of_sensor(cls, sensor: DepthSensor, fx: float, params: FusionParams | None = None) -> Self:
        """Create the model of a triangulating camera with focal length fx [px] and parameters."""
        if not 0 < fx < math.inf:
            raise ValueError(f"positive focal length expected, found fx = {fx}")
        per_pixel = 1.0 / (fx * sensor.baseline)
        params = params or FusionParams()
        return cls(
            **{field.name: getattr(params, field.name) for field in fields(FusionParams)},
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
        """Compute the variance of measured heights, split by whether it averages out.

        The distance is used as the depth, which overstates the noise by at most 1/cos of the angle off the axis. A spread
        beyond the noise of a pixel belongs to the ground. A foot may meet any height within it, so the whole spread counts as
        one sigma and does not average out. A scan that saw both face and top of a cell therefore yields to one that saw only
        the top.

        A pose error twist (v, w) moves a point at r from the camera by v + w x r. The error of the height recorded for a place
        on ground of gradient s is n . (v + w x r) with n = (-s, 1). A pose covariance S therefore adds J S J' with
        J = (n, r x n). An unknown s is assumed isotropic with an rms of `terrain_slope`. All points of a scan share the pose
        error, and it persists over scans, so it does not average out.

        Args:
            points: (n, 3) [m] {world} one point per cell, the mean of its pixels.
            count: (n,) pixels merged into each point.
            spread: (n,) [m] height range of these pixels.
            p_world_camera: (3,) [m] {world} optical centre.
            pose_covariance: (6, 6) [m^2, m rad, rad^2] of the camera's position, then rotation, in world axes; None: exact.
            slope: (n, 2) [m/m] gradient of the ground at each point in x and y, NaN or None where it is unknown.

        Returns:
            random, systematic: (n,) [m^2] each.

        Source: Fankhauser et al. 2014, "Robot-centric elevation mapping with uncertainty estimates", section 3.1: the
        sensor's and the pose's covariance through the Jacobians of the height. Their model omits correlations, errors in x
        and y, and the slope.
        """
        covariance = np.zeros((6, 6)) if pose_covariance is None else np.asarray(pose_covariance, dtype=np.float64)
        gradient = np.full((len(points), 2), np.nan) if slope is None else np.asarray(slope, dtype=np.float64)
        ray = np.asarray(points, dtype=np.float64) - p_world_camera
        x, y, z, slope_x, slope_y = (np.ascontiguousarray(column) for column in (*ray.T, *gradient.T))
        number, width = np.asarray(count, dtype=np.float64), np.asarray(spread, dtype=np.float64)
        return _variances(x, y, z, number, width, slope_x, slope_y, covariance, self._noise)

    def measure(
        self, scan: ValidatedScan, height: NDArray[np.float32], resolution: float, low_i: int, low_j: int
    ) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
        """Compute the measurements that a scan contains for the cells of a map.

        Args:
            scan: The scan.
            height: (nx, ny) [m] circular buffer of the map, NaN where unseen; its slopes scale the pose error.
            resolution: [m] cell edge.
            low_i: World index, along x, of the lowest cell of the map's window.
            low_j: World index, along y, of the same cell.

        Returns:
            cells: (m,) flat buffer index of each point inside the window.
            z: (m,) [m] {world} its height.
            random, systematic: (m,) [m^2] as in `height_variance`.
            ray: (3,) [m] from the camera to the mean of those points.
        """
        return _measure(
            as_plain(ScanArrays(scan.points, scan.origin, scan.unit, scan.count, scan.spread)),
            scan.p_world_camera,
            scan.pose_covariance,
            self._noise,
            as_plain(MapWindow(height, resolution, low_i, low_j)),
        )

    @property
    def _noise(self) -> tuple[float, float, float, float, float, float]:
        """Parameters of `_variances`, in its order."""
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
    """Compute the variances (n,) [m^2] of points at x, y, z (n,) [m].

    See `FusionModel.height_variance`.
    """
    depth_sigma, range_sigma, quantisation_sigma, floor_sigma, terrain_slope, most = noise
    # Allocated here, so that the compiler knows that these arrays share no memory with others.
    random, systematic = np.empty(len(x_of)), np.empty(len(x_of))
    unknown2 = 0.5 * terrain_slope**2  # of each component of an isotropic gradient
    # Scalars and no branches, so that the compiler vectorises the loop.
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
        # A known component of the slope enters with its correlations, an unknown one with its spread.
        a, b = slope_x[k], slope_y[k]
        a, a2 = (a, a * a) if a == a else (0.0, unknown2)
        b, b2 = (b, b * b) if b == b else (0.0, unknown2)
        pose = zz + a2 * xx - 2 * a * xz + b2 * yy - 2 * b * yz + 2 * a * b * xy
        random[k] = pixel / min(count[k], most)
        systematic[k] = floor2 + quantised + max(pose, 0.0) + max(spread[k] * spread[k] - pixel, 0.0)
    return random, systematic


@compiled
def _measure(
    scan: ScanArrays, camera: Array, S: Array, noise: tuple[float, float, float, float, float, float], window: MapWindow
) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """Implement `FusionModel.measure` in blocks of points that fit into the cache."""
    points, origin, unit, count, spread = scan
    height, resolution, low_i, low_j = window
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
        # 1. The cell, and the slope of the map there. The slope is the smaller of the height differences to the two sides,
        # and zero if their signs differ. On a plane this is the plane's slope. Next to a step it is the slope of the ground
        # on which a foot would stand, and not that of the step.
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
            at = np.uint64(some)  # unsigned, so that no index counts from the end
            x, y, z_off = x - x0, y - y0, height_there - z0
            x_of[at], y_of[at], z_of[at] = x, y, z_off
            x_sum, y_sum, z_sum = x_sum + x, y_sum + y, z_sum + z_off
            count_of[at], spread_of[at] = count[np.uint64(k)], unit * spread[np.uint64(k)]
            a, b = i + wrap_i, j + wrap_j  # modulo the size, without a division
            a, b = a if a < rows else a - rows, b if b < columns else b - columns
            c = a * columns + b
            cells[np.uint64(m + some)], z[np.uint64(m + some)] = c, height_there
            # The buffer wraps around at its border, the window does not.
            lower, upper = c - columns if a > 0 else c + (rows - 1) * columns, c + columns if a + 1 < rows else b
            before, after = c - 1 if b > 0 else c + columns - 1, c + 1 if b + 1 < columns else c - b
            here = heights[np.uint64(c)]
            along_x = _smaller(heights[np.uint64(upper)] - here, here - heights[np.uint64(lower)])
            along_y = _smaller(heights[np.uint64(after)] - here, here - heights[np.uint64(before)])
            slope_x[at] = along_x * per_cell if 0 < i < rows - 1 else nowhere
            slope_y[at] = along_y * per_cell if 0 < j < columns - 1 else nowhere
            some += 1
        # 2. The variances.
        random_of, systematic_of = _variances(
            x_of[:some], y_of[:some], z_of[:some], count_of[:some], spread_of[:some], slope_x[:some], slope_y[:some], S, noise
        )
        for k in range(some):
            random[m + k], systematic[m + k] = random_of[k], systematic_of[k]
        m += some
    ray = np.array([x_sum, y_sum, z_sum]) / max(m, 1)
    return cells[:m], z[:m], random[:m], systematic[:m], ray


@compiled
def _smaller(a: np.float32, b: np.float32) -> np.float32:
    """Return the smaller of two numbers of the same sign, or 0 if the signs differ.

    Smaller refers to the absolute value. The result is NaN if a number is NaN. There is no branch to mispredict.
    """
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
    """Merge measurements to one per cell, in place, and return their number.

    slot is -1 before and after.
    """
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
        # The part of their variance about the mean that noise does not explain is permanent.
        own = max(gain * (1.0 - gain) * step * step - random[k], 0.0)
        systematic[d] = max(systematic[d], systematic[k]) + own
    for e in range(m):
        slot[np.uint64(cells[e])] = -1
    return m


@compiled
def _is_between_tops(layers: FilterCells, c: int, columns: int) -> bool:
    """Return whether a cell and undisputed cells on both sides are one surface, which was seen clearly.

    A much lower height in such a cell is that of a wall below an overhang.
    """
    height, variance, _, _, _, _, votes, _, _, _ = layers
    if variance[np.uint64(c)] > np.float32(_CLEAR):
        return False
    for step in (columns, 1):
        sides = 0
        for sign in (-1, 1):
            for k in range(1, _SIDE_CELLS + 1):
                other = np.uint64((c + sign * k * step) % len(height))
                if votes[other] == 0 and abs(height[other] - height[np.uint64(c)]) < _SAME_TOP:
                    sides += 1
                    break
        if sides == 2:
            return True
    return False


@compiled
def update_cells(
    measured: tuple[NDArray[np.int64], Array, Array, Array], layers: FilterCells, rules: FilterRules
) -> tuple[int, int, int]:
    """Filter one measurement (the fields of `Measurements`) into each cell and count the results.

    Returns the numbers of updated, disputed and replaced cells.
    """
    cells, z, random, systematic = measured
    height, variance, support, assumed, rival, rival_variance, votes, first, through, fell = layers
    gate, patience, established, settled, well_below, columns = rules
    updated = disputed = replaced = 0
    for k in range(len(cells)):
        c = np.uint64(cells[k])  # unsigned, so that no index counts from the end
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
        # A height seen once is replaced by a rival seen twice; an established one resists for `patience` scans.
        if votes[c] >= min(patience, support[c] + 1):
            if rival[c] < height[c] - _OVERHANG and support[c] >= established and _is_between_tops(layers, cells[k], columns):
                votes[c] = 0
                continue
            fell[c] = np.uint8(rival[c] < height[c] - well_below)
            height[c], variance[c], support[c], votes[c], through[c] = rival[c], rival_variance[c], votes[c], 0, 0
            first[c] = height[c] if support[c] >= established else np.nan
            replaced += 1
    return updated, disputed, replaced


@compiled
def settle_cells(measured: Measurements, layers: FilterCells, rules: FilterRules) -> int:
    """Filter each measurement repeatedly until it changes its cell; return how many cells changed."""
    cells, z, random, systematic = measured
    patience = rules[1]
    changed = 0
    for k in range(len(cells)):
        one = slice(k, k + 1)
        for _ in range(patience + 1):
            alone = (cells[one], z[one], random[one], systematic[one])
            updated, _, replaced = update_cells(alone, layers, rules)
            if updated or replaced:
                changed += 1
                break
    return changed
