"""Robot-centred elevation map with one Kalman filter per cell.

The map is a circular buffer in the world frame.

The window follows the robot, but its memory does not shift: a cell is stored at its world index modulo the size (Lotriet
2024, eq. 4.11). Each cell holds its height and one rival height. A measurement that fails the gate does not change the
height. It votes for the rival, and a persistent rival replaces the height, both upward and downward. The map therefore clears
an object that moved away, and symmetric noise causes no bias even if its size is guessed wrongly.

Rays clear such an object if the ground behind it is not measured. A cell becomes unseen again if the camera sees something
behind it, well below its height, in several scans. If the pose drifts in height relative to well-known ground, the drift is
subtracted from what is fused, so that early and late measurements agree. The published map has the drift added again, so that
it fits the newest pose, which its readers use.
"""

import math
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.mapper.elevation.cell_layers import ESTABLISHED, CellLayers
from sextant.services.mapper.elevation.fusion import (
    FilterCells,
    FilterRules,
    FusionModel,
    Measurements,
    merge,
    settle_cells,
    update_cells,
)
from sextant.services.mapper.elevation.height_drift import HeightDrift, height_sigma
from sextant.services.mapper.elevation.params import HeightDriftParams, RayClearingParams
from sextant.services.mapper.elevation.ray_clearing import RayClearing
from sextant.services.mapper.elevation.validated_scan import MAX_COORDINATE_M, ValidatedScan
from sextant.services.mapper.elevation.vertical_surfaces import limit_surface_updates
from sextant.shared.runtime.compiled import as_plain, compiled

# A scan contradicts the map if it is this far [m] from this share of the well-known cells, of which there are this many.
_CONTRADICTS_M, _CONTRADICTED_SHARE, _MIN_KNOWN = 0.05, 0.6, 300

_REFLECTED_M = 0.25  # [m] below the feet, from which the end of a ray may be seen by reflection

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True)
class FusionCount:
    """Counts of the points and cells of one fused scan."""

    updated: int  # cells whose height was updated by a measurement
    disputed: int  # cells whose measurement went to the rival, or was ignored at a vertical surface
    replaced: int  # cells whose rival became the height
    outside: int  # points outside the window
    cleared: int = 0  # cells that rays made unseen again
    contradiction: float = 0.0  # [m] median height of a scan over the map that it contradicts, which was not fused; else 0


@dataclass(frozen=True, slots=True)
class ElevationSnapshot:
    """Copy of the map in world order.

    Cell (i, j) is centred at origin + resolution * (i, j).
    """

    resolution: float  # [m] cell edge
    origin: NDArray[np.float64]  # (2,) [m] {world} centre of cell (0, 0)
    elevation: NDArray[np.float32]  # (nx, ny) [m] {world} height, NaN where never seen
    variance: NDArray[np.float32]  # (nx, ny) [m^2] of elevation, NaN where never seen
    assumed: NDArray[np.uint8]  # (nx, ny) 1 where the height is a seeded plane without a measurement
    height_drift: float = 0.0  # [m] height of the elevation above the first seen ground


class ElevationGrid:
    """Height, variance and rival of nx x ny cells around the robot, in world axes.

    The window spans the cells [c - n // 2, c + n - n // 2) around the robot's cell c, along x and along y. It starts around
    the world's origin with every cell unseen.

    Source: Lotriet 2024, section 4.3.
    """

    def __init__(
        self,
        size: int | tuple[int, int] = 256,
        resolution: float = 0.01,
        model: FusionModel | None = None,
        clearing: RayClearingParams | None = None,
        drift: HeightDriftParams | None = None,
    ) -> None:
        """Create a map with every cell unseen.

        Args:
            size: [cells] along x and along y, one number for a square.
            resolution: [m] cell edge.
            model: Error model of the measurements.
            clearing: Parameters of the ray clearing.
            drift: Parameters of the compensation of height drift.

        Raises:
            ValueError: There are fewer than 8 cells along an axis, or the resolution is out of range.
        """
        shape = (size, size) if isinstance(size, int) else (int(size[0]), int(size[1]))
        if min(shape) < 8:
            raise ValueError(f"at least 8 cells a side expected, found {size}")
        if not 1e-4 <= resolution <= 1.0:
            raise ValueError(f"resolution from 0.0001 to 1 m expected, found {resolution}")
        self.shape = shape
        self.resolution = resolution
        self.model = model or FusionModel()
        self._size: NDArray[np.int64] = np.array(shape, dtype=np.int64)
        self._low: NDArray[np.int64] = -(self._size // 2)  # world index of the window's lowest cell
        self._cells = CellLayers.unseen(shape)
        self._filter_cells = as_plain(FilterCells.of(self._cells))
        self._slot = np.full(shape[0] * shape[1], -1, dtype=np.int32)  # entry of the scan for each cell, -1 outside fuse()
        self._clearing = clearing or RayClearingParams()
        self._filter_rules = as_plain(
            FilterRules(
                self.model.gate,
                self.model.patience,
                ESTABLISHED,
                self._clearing.settled_scans,
                self._clearing.well_below_m,
                shape[1],
            )
        )
        self._drift, self._ray_clearing = HeightDrift(drift or HeightDriftParams()), RayClearing(shape, self._clearing)

    @property
    def low(self) -> NDArray[np.int64]:
        """(2,) world index of the window's lowest cell, cell (0, 0) of a snapshot."""
        return self._low.copy()

    @property
    def height_drift(self) -> float:
        """[m] height offset of the newest poses from those at the start of the map.

        Heights are stored as first seen. They are returned with this offset, as the newest scans see them.
        """
        return self._drift.value

    @property
    def origin(self) -> NDArray[np.float64]:
        """(2,) [m] {world} centre of the window's lowest cell."""
        return np.asarray((self._low + 0.5) * self.resolution)

    def move_to(self, p_world_xy: ArrayLike) -> None:
        """Centre the window on the cell of p_world_xy (2,) [m] {world}.

        Only cells that leave the window are cleared.

        Raises:
            ValueError: The argument is not two finite coordinates within 1000 km.
        """
        centre = np.asarray(p_world_xy, dtype=np.float64)
        if centre.shape != (2,) or not (np.abs(centre) < MAX_COORDINATE_M).all():
            raise ValueError(f"two coordinates within {MAX_COORDINATE_M:g} m expected, found {p_world_xy!r}")
        before, n = self._low.tolist(), self.shape
        low = [math.floor(centre[axis] / self.resolution) - n[axis] // 2 for axis in range(2)]
        for axis in range(2):
            shift = low[axis] - before[axis]
            leaving = min(abs(shift), n[axis])
            if leaving:
                first = before[axis] if shift > 0 else before[axis] + n[axis] - leaving
                self._cells.forget(axis, first % n[axis], leaving)
        self._low = np.array(low, dtype=np.int64)

    def change_ground(self, change: NDArray[np.float64]) -> None:
        """Change all heights by a x + b y + c, where change is (a, b, c)."""
        a, b, c = (float(value) for value in change)
        x, y = (np.empty(n) for n in self.shape)
        for axis, along in enumerate((x, y)):
            i = self._low[axis] + np.arange(self.shape[axis])
            along[i % self.shape[axis]] = (i + 0.5) * self.resolution
        plane = (a * x[:, None] + b * y[None, :] + c).astype(np.float32)
        for heights in (self._cells.height, self._cells.rival, self._cells.first):
            heights += plane

    def fuse(self, scan: ValidatedScan, ground: float | None = None) -> FusionCount:
        """Fuse a reduced scan; each cell counts at most once per scan.

        `ground` is the height [m] {world} of the lowest foot, if the feet stand on the ground of the map. A scan that
        contradicts most of the well-known ground is then not fused; things that move or sink contradict only a part. Rays
        that end well below the feet then clear nothing: they may be reflected by a wet floor.

        1. Compute the variance of each point from the sensor model and from the pose covariance and the map's slope. The part
           that does not average out is the floor of a cell's variance.
        2. Merge points of the same cell, of which there are several if the scan's cells are smaller. Differences beyond noise
           belong to the ground, as does a point's spread. Across an edge, the upper point is used (Masri 2016, section 4.4).
        3. Update each cell. An unseen or assumed cell takes the measurement. A measurement within the gate is filtered, and the
           variance stays above its floor. A measurement outside votes for the rival (see the module).
        4. Clear cells that rays have passed through in several scans.

        Before step 3, the drift of the pose's height is subtracted (`height_drift`). Vertical surfaces are protected there
        (`vertical_surfaces`): what is seen of a wall at short range must not lower it.
        """
        cells = self._cells
        # 1. Cells of the points, and variances of their heights.
        touched, z, random, systematic, ray = self.model.measure(
            scan, cells.height, self.resolution, int(self._low[0]), int(self._low[1])
        )
        inside, silent = len(touched), 0
        # 2. One measurement for each cell, without the height drift of the pose.
        merged = merge(touched, z, random, systematic, self._slot, self.model.gate, self.model.step_in(self.resolution))
        touched, z, random, systematic = touched[:merged], z[:merged], random[:merged], systematic[:merged]
        contradiction = self._contradiction(touched, z) if ground is not None else 0.0
        if contradiction != 0.0:
            return FusionCount(0, 0, 0, len(scan.points) - inside, contradiction=contradiction)
        if inside:
            self._drift.follow(cells, touched, z, ray, scan.pose_covariance)
            z -= self._drift.value
            sigma = height_sigma(ray, scan.pose_covariance)
            merged = limit_surface_updates(cells, touched, z, random, systematic, self._slot, sigma, self._low)
            self._ray_clearing.note_height(float(z.max()))
            silent = len(touched) - merged
            touched, z, random, systematic = touched[:merged], z[:merged], random[:merged], systematic[:merged]
        # 3. Update the filters.
        measured = Measurements(touched, z, random, systematic)
        updated, disputed, replaced = update_cells(as_plain(measured), self._filter_cells, self._filter_rules)
        # 4. Clear cells along rays.
        at = (cells, self._low, self.resolution, self._drift.value, scan)
        points, sights = (_not_below(ground, scan, ends) for ends in (scan.points, scan.sights))
        self._ray_clearing.count_along_rays(*at, points, every=self._clearing.every)
        self._ray_clearing.count_along_rays(*at, sights, nearest=scan.nearest)
        cleared = self._ray_clearing.end_scan(cells)
        return FusionCount(updated, disputed + silent, replaced, len(scan.points) - inside, cleared)

    def _contradiction(self, touched: NDArray[np.int64], z: NDArray[np.float64]) -> float:
        """Return the median height [m] of a scan over the well-known ground if it contradicts most of it, else 0.

        Args:
            touched: (m,) flat indices of the measured cells.
            z: (m,) [m] {world} their measured heights.
        """
        first = self._cells.first.ravel()[touched]
        off = z - self._drift.value - first
        off = off[np.isfinite(off)]
        if len(off) < _MIN_KNOWN or np.count_nonzero(np.abs(off) > _CONTRADICTS_M) <= _CONTRADICTED_SHARE * len(off):
            return 0.0
        return float(np.median(off)) or _CONTRADICTS_M

    def touch(self, p_world: ArrayLike, sigma: float, radius: float) -> int:
        """Correct the cells under a foot's sole and return how many changed.

        The foot has found ground at this height, or none above it. A touchdown outweighs all scans: if it differs from the map
        by more than both errors allow, it counts for as many scans as needed.

        Args:
            p_world: (3,) [m] underside of the foot.
            sigma: [m] standard deviation of its height.
            radius: [m] of the sole.
        """
        p = np.asarray(p_world, dtype=np.float64)
        if p.shape != (3,) or not np.isfinite(p).all():
            raise ValueError(f"a finite point (3,) expected, found {p_world!r}")
        n = math.ceil(radius / self.resolution)
        i, j = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij")
        off = self.resolution * np.column_stack([i.ravel(), j.ravel()])
        sole = p[:2] + off[(off**2).sum(axis=1) <= radius**2]
        inside = _cell_indices(sole, self.resolution, int(self._low[0]), int(self._low[1]), *self.shape)
        known = np.unique(inside[inside >= 0])
        m = len(known)
        measured = Measurements(known, np.full(m, p[2] - self._drift.value), np.zeros(m), np.full(m, sigma**2))
        return int(settle_cells(as_plain(measured), self._filter_cells, self._filter_rules))

    def seed_plane(self, polygon: ArrayLike, plane: ArrayLike, sigma: float = 0.02) -> int:
        """Fill the unseen cells of a region with a plane, marked as assumed.

        The first measurement of a cell replaces it.

        Args:
            polygon: (k, 2) [m] {world} corners in order, k >= 3; cells whose centre lies inside (even-odd) are filled.
            plane: (3,) height is plane[0] + plane[1] * x + plane[2] * y, [m], [m/m], [m/m].
            sigma: [m] standard deviation of the assumed heights.

        Returns:
            The number of cells filled.

        Raises:
            ValueError: A shape is wrong, or a value is not finite or out of its range.

        Source: Masri 2016, section 4.7 (the ground under the robot is modelled as a plane until it is measured).
        """
        corners = np.asarray(polygon, dtype=np.float64)
        coefficients = np.asarray(plane, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not (np.abs(corners) < MAX_COORDINATE_M).all():
            raise ValueError(f"polygon of at least 3 finite corners (k, 2) expected, found {polygon!r}")
        if coefficients.shape != (3,) or not np.isfinite(coefficients).all():
            raise ValueError(f"plane of 3 finite coefficients expected, found {plane!r}")
        if not 0 < sigma < math.inf:
            raise ValueError(f"positive sigma expected, found {sigma}")
        low = np.maximum(np.floor(corners.min(axis=0) / self.resolution).astype(np.int64), self._low)
        high = np.minimum(np.floor(corners.max(axis=0) / self.resolution).astype(np.int64), self._low + self._size - 1)
        if (low > high).any():
            return 0
        i, j = (np.arange(low[axis], high[axis] + 1) for axis in range(2))
        x, y = ((i + 0.5) * self.resolution)[:, None], ((j + 0.5) * self.resolution)[None, :]
        box = np.ix_(i % self.shape[0], j % self.shape[1])
        fill = _inside_polygon(x, y, corners) & np.isnan(self._cells.height[box])
        rows, columns = np.nonzero(fill)
        filled = i[rows] % self.shape[0], j[columns] % self.shape[1]
        heights = coefficients[0] - self._drift.value + coefficients[1] * x + coefficients[2] * y
        self._cells.height[filled] = heights[rows, columns]
        self._cells.variance[filled] = sigma**2
        self._cells.assumed[filled] = 1
        self._cells.through[filled] = 0
        return len(rows)

    def heights(self, p_world_xy: ArrayLike) -> NDArray[np.float64]:
        """Return the heights (...) [m] {world} of the cells at p_world_xy (..., 2) [m].

        They are NaN where the map is unseen or outside the window.

        Raises:
            ValueError: The last axis is not 2.
        """
        p = np.asarray(p_world_xy, dtype=np.float64)
        if p.ndim == 0 or p.shape[-1] != 2:
            raise ValueError(f"points (..., 2) expected, found shape {p.shape}")
        near = np.where(np.abs(p) < MAX_COORDINATE_M, p, 2 * MAX_COORDINATE_M).reshape(-1, 2)  # NaN too lies outside
        # Lotriet 2024, eq. 4.11
        cell = _cell_indices(near, self.resolution, int(self._low[0]), int(self._low[1]), *self.shape)
        height = np.where(cell >= 0, self._cells.height.ravel()[cell] + self._drift.value, np.nan)  # -1 is masked
        return np.asarray(height.reshape(p.shape[:-1]), dtype=np.float64)

    def is_seen(self, p_world_xy: NDArray[np.float64]) -> bool:
        """Return whether the cells at all points (..., 2) [m] {world} have been measured, not only assumed."""
        points = np.asarray(p_world_xy, dtype=np.float64).reshape(-1, 2)
        cell = _cell_indices(points, self.resolution, int(self._low[0]), int(self._low[1]), *self.shape)
        assumed, height = self._cells.assumed.ravel()[cell], self._cells.height.ravel()[cell]
        return bool(((cell >= 0) & (assumed == 0) & np.isfinite(height)).all())

    def snapshot(self) -> ElevationSnapshot:
        """Copy the map in world order."""
        elevation = self._unrolled(self._cells.height)
        if self._drift.value != 0.0:
            elevation += np.float32(self._drift.value)
        return ElevationSnapshot(
            resolution=self.resolution,
            origin=self.origin,
            elevation=elevation,
            variance=self._unrolled(self._cells.variance),
            assumed=self._unrolled(self._cells.assumed),
            height_drift=self._drift.value,
        )

    def _unrolled(self, layer: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return a copy of a layer with the window's lowest cell first."""
        i, j = (int(low % n) for low, n in zip(self._low, self.shape, strict=True))
        out = np.empty_like(layer)
        m, n = self.shape[0] - i, self.shape[1] - j
        out[:m, :n], out[:m, n:] = layer[i:, j:], layer[i:, :j]
        out[m:, :n], out[m:, n:] = layer[:i, j:], layer[:i, :j]
        return out


def _not_below(ground: float | None, scan: ValidatedScan, ends: NDArray[Any]) -> NDArray[Any]:
    """Return the ends of rays (n, 3), in the scan's unit from its origin, without those well below the ground [m]."""
    if ground is None or not len(ends):
        return ends
    least = (ground - _REFLECTED_M - float(scan.origin[2])) / scan.unit
    return ends if ends[:, 2].min() >= least else ends[ends[:, 2] >= least]


def _inside_polygon(x: NDArray[np.float64], y: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Apply the even-odd rule on the grid x (nx, 1), y (1, ny)."""
    inside = np.zeros(np.broadcast_shapes(x.shape, y.shape), dtype=np.bool_)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if ay == by:
            continue
        crosses = (y < ay) != (y < by)
        inside ^= crosses & (x < ax + (y - ay) * ((bx - ax) / (by - ay)))
    return inside


@compiled
def _cell_indices(
    p_world_xy: NDArray[np.float64], resolution: float, low_i: int, low_j: int, rows: int, columns: int
) -> NDArray[np.int64]:
    """Return the flat buffer index (n,) of each point, or -1 outside the window.

    The window has rows x columns cells and starts at cell (low_i, low_j).
    """
    cell = np.empty(len(p_world_xy), dtype=np.int64)
    wrap_i, wrap_j = low_i % rows, low_j % columns
    for k in range(len(p_world_xy)):
        i = math.floor(p_world_xy[k, 0] / resolution) - low_i
        j = math.floor(p_world_xy[k, 1] / resolution) - low_j
        if 0 <= i < rows and 0 <= j < columns:
            i, j = i + wrap_i, j + wrap_j  # modulo the size, without a division
            cell[k] = (i if i < rows else i - rows) * columns + (j if j < columns else j - columns)
        else:
            cell[k] = -1
    return cell
