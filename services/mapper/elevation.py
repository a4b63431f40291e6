"""The height map around the robot: a circular buffer in the world frame, one Kalman filter per cell.

The window follows the robot, its memory never shifts: a cell's place is its world index modulo the size (Lotriet 2024,
eq. 4.11). Each cell holds the height it believes in and one rival. A measurement that fails the gate never drags the
height; it votes for the rival, and a rival that persists takes the cell over, upward and downward alike. So an object
that moved away is cleared in time, and symmetric noise leaves no bias, however badly its size was guessed.

Where the ground behind such an object is not measured, lines of sight clear it: a cell through which the camera looks at
something behind, well below its height and scan after scan, becomes unseen again. And where the pose's height drifts from
that of ground that is well known, the drift is taken out of what is fused, so that what was seen early and what is seen late
fit together; what the map tells fits the newest pose, by which its reader's feet go.
"""

import math
from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.camera import DepthSensor
from shared.compiled import compiled

Scalar = TypeVar("Scalar", bound=np.generic)

FAR = 1e6  # [m] coordinates beyond this are refused: a cell index must stay exact

_FOLLOWED = 8  # every how many points of a scan have their line of sight followed, other ones each time
_SHORT = 3  # cells before its end at which a line of sight stops: what it meets is thick, and not quite where it is mapped
_WELL_BELOW = 0.02  # [m] beyond three sigma of a cell, by which a line of sight must pass below its height
_SIGHTS_NEEDED = 8  # scans that look through a cell until it is cleared, without one that measures it
_FELL_AROUND = 3  # neighbours that have fallen, from which on a cell at the rim of what stood there may fall, too
_SETTLED = 2 * _FOLLOWED * _SIGHTS_NEEDED  # scans that measure a fallen cell, until what stands beside it is no remnant
_REFRESHED = 16  # scans after which the highest cell is looked for anew

_ESTABLISHED = 3  # scans behind a height, after which it counts as where the ground was first seen
_KNOWN_WELL = 0.004  # [m] one sigma of a cell that tells of drift; beside an edge it is more
_SAME_GROUND = 0.03  # [m] further off it is not the same ground
_FEWEST = 100  # cells that can tell of drift
_ALIKE = 12  # neighbouring cells share their errors: so many count as one
_DRIFTED, _LEVEL_AGAIN = 0.002, 0.0005  # [m] offset from which on, and down to which, drift is compensated
_PERSISTS = 3  # scans in a row that must show it
_RATE = 0.002  # [m] by which the compensation changes in a scan, at most


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
        spread beyond the noise of a pixel is the ground's own: a foot may meet any of it, so it does not average away,
        and a scan that saw a cell's face and top together yields to one that saw the top alone.

        A pose that is wrong by the twist (v, w) carries a point at r from the camera off by v + w x r, and the height
        that is noted at a place of ground with the gradient s off by n . (v + w x r), n = (-s, 1). So a pose covariance S
        adds J S J' with J = (n, r x n). Where s is unknown, it is taken as isotropic with `terrain_slope` for its rms.
        Pose errors are shared by all points of a scan and last from scan to scan, so they do not average away.

        Args:
            points: (n, 3) [m] {world} one point per cell, the mean of its pixels.
            count: (n,) pixels merged into each point.
            spread: (n,) [m] standard deviation of the heights merged.
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
        return _variances(
            np.asarray(points, dtype=np.float64), np.asarray(count, dtype=np.float64), np.asarray(spread, dtype=np.float64),
            np.asarray(p_world_camera, dtype=np.float64), covariance, gradient,
            self.depth_sigma, self.range_sigma, self.quantisation_sigma, self.floor_sigma, self.terrain_slope,
            self.independent_pixels,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class FusionCount:
    """What became of the points of one scan."""

    updated: int  # cells whose height took a measurement in
    disputed: int  # cells whose measurement failed the gate and went to the rival
    replaced: int  # cells taken over by their rival
    outside: int  # points beyond the window
    cleared: int = 0  # cells that lines of sight have made unseen again


@dataclass(frozen=True, slots=True)
class ElevationSnapshot:
    """The map in world order, detached from the grid. Cell (i, j) is centred at origin + resolution * (i, j)."""

    resolution: float  # [m] cell edge
    origin: NDArray[np.float64]  # (2,) [m] {world} centre of cell (0, 0)
    elevation: NDArray[np.float32]  # (nx, ny) [m] {world} height, NaN where never seen
    variance: NDArray[np.float32]  # (nx, ny) [m^2] of elevation, NaN where never seen
    assumed: NDArray[np.uint8]  # (nx, ny) 1 where the height is a seeded plane and nothing was measured yet


@dataclass(frozen=True, slots=True, eq=False)
class CheckedScan:
    """A reduced scan that can be fused, as `of` makes it; see `ElevationGrid.fuse`."""

    points: NDArray[np.float64]  # (n, 3) [m] {world}
    count: NDArray[np.float64]  # (n,)
    spread: NDArray[np.float64]  # (n,) [m]
    p_world_camera: NDArray[np.float64]  # (3,) [m]
    pose_covariance: NDArray[np.float64]  # (6, 6)
    sights: NDArray[np.float64]  # (m, 3) [m] {world}
    nearest: float  # [m]

    @classmethod
    def of(
        cls,
        points: NDArray[np.floating],
        count: NDArray[np.integer | np.floating],
        spread: NDArray[np.floating],
        p_world_camera: ArrayLike,
        pose_covariance: NDArray[np.float64] | None = None,
        sights: NDArray[np.floating] | None = None,
        nearest: float = 0.0,
    ) -> Self:
        """Check a scan; the arguments are those of `ElevationGrid.fuse`.

        Raises:
            ValueError: A shape is wrong, or a value is not finite or out of its range.
        """
        p, n, s, c = _checked_scan(points, count, spread, p_world_camera)
        covariance = _checked_covariance(pose_covariance)
        ends = np.empty((0, 3)) if sights is None else np.ascontiguousarray(sights, dtype=np.float64)
        if ends.ndim != 2 or ends.shape[1] != 3 or not (np.abs(ends) < FAR).all():
            raise ValueError(f"sights (m, 3), finite and within {FAR:g} m, expected, found shape {ends.shape}")
        if not 0 <= nearest < math.inf:
            raise ValueError(f"a nearest distance of at least 0 m expected, found {nearest}")
        return cls(p, n, s, c, covariance, ends, nearest)


class ElevationGrid:
    """Height, variance and rival of nx x ny cells around the robot, aligned with the world axes.

    The window spans the cells [c - n // 2, c + n - n // 2) around the robot's cell c, along x and along y. It starts
    around the world's origin with every cell unseen.

    Source: Lotriet 2024, section 4.3.
    """

    def __init__(self, size: int | tuple[int, int] = 256, resolution: float = 0.01, model: FusionModel | None = None) -> None:
        """Begin with every cell unseen.

        Args:
            size: [cells] along x and along y, one number for a square.
            resolution: [m] cell edge.
            model: Noise of the measurements.

        Raises:
            ValueError: Fewer than 8 cells along an axis, or a resolution out of its range.
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
        # np.full, not np.zeros: pages that are touched for the first time inside the hot loop are slow.
        self._height = np.full(shape, np.nan, dtype=np.float32)
        self._variance = np.full(shape, np.nan, dtype=np.float32)
        self._support = np.full(shape, 0, dtype=np.uint8)  # scans behind the height, at most 255
        self._assumed = np.full(shape, 0, dtype=np.uint8)
        self._rival = np.full(shape, np.nan, dtype=np.float32)
        self._rival_variance = np.full(shape, np.nan, dtype=np.float32)
        self._votes = np.full(shape, 0, dtype=np.uint8)  # scans for the rival less scans against it
        self._slot = np.full(shape[0] * shape[1], -1, dtype=np.int32)  # the scan's entry for a cell, -1 outside fuse()
        self._first = np.full(shape, np.nan, dtype=np.float32)  # [m] the height as it was established, NaN before
        self._through = np.full(shape, 0, dtype=np.uint8)  # scans that looked through the cell since it was last measured
        self._fell = np.full(shape, 0, dtype=np.uint8)  # 1 where something stood that is gone
        self._highest, self._scans = -math.inf, 0
        self._drift, self._drifted = 0.0, 0  # [m], and for how many scans in a row it has been off

    @property
    def low(self) -> NDArray[np.int64]:
        """(2,) world index of the window's lowest cell, that is of cell (0, 0) of a snapshot."""
        return self._low.copy()

    @property
    def height_drift(self) -> float:
        """[m] by which the poses of scans are believed to lie higher by now than those that the map was begun with.

        Heights are kept as they were first seen and told with this added, as the newest scans see them.
        """
        return self._drift

    @property
    def origin(self) -> NDArray[np.float64]:
        """(2,) [m] {world} centre of the window's lowest cell."""
        return np.asarray((self._low + 0.5) * self.resolution)

    def move_to(self, p_world_xy: ArrayLike) -> None:
        """Centre the window on the cell of p_world_xy (2,) [m] {world}; cells that leave it are forgotten, only those.

        Raises:
            ValueError: Not two finite coordinates within 1000 km.
        """
        centre = np.asarray(p_world_xy, dtype=np.float64)
        if centre.shape != (2,) or not (np.abs(centre) < FAR).all():
            raise ValueError(f"two coordinates within {FAR:g} m expected, found {p_world_xy!r}")
        low = np.floor(centre / self.resolution).astype(np.int64) - self._size // 2
        for axis in range(2):
            shift = int(low[axis] - self._low[axis])
            if shift == 0:
                continue
            n = self.shape[axis]
            leaving = min(abs(shift), n)
            first = self._low[axis] if shift > 0 else self._low[axis] + n - leaving
            lines = np.arange(first, first + leaving) % n
            self._forget((lines,) if axis == 0 else (slice(None), lines))
        self._low = low

    def fuse(
        self,
        points: NDArray[np.floating],
        count: NDArray[np.integer | np.floating],
        spread: NDArray[np.floating],
        p_world_camera: ArrayLike,
        *,
        pose_covariance: NDArray[np.float64] | None = None,
        sights: NDArray[np.floating] | None = None,
        nearest: float = 0.0,
    ) -> FusionCount:
        """Take one reduced scan into the map; a cell counts at most once per scan.

        1. Each point gets a variance from the sensor model and the pose's covariance through the map's own slope; the
           part that does not average away is its floor.
        2. Points of one cell, several where the scan's cells are smaller, are merged; what they differ by beyond their noise
           is the ground's own, as a point's spread is. Across an edge the upper one stands (Masri 2016, section 4.4).
        3. Each cell: an unseen or assumed cell takes the measurement outright; one within the gate is filtered in,
           its variance never below the floor; one outside votes for the rival (see the module).
        4. Cells that stand in a line of sight become unseen again after a while.
        Before 2, where well-known ground shows that the pose's height has drifted, that is taken out (`height_drift`).

        Args:
            points: (n, 3) [m] {world} one point per cell seen, of the upper surface where a cell holds two.
            count: (n,) pixels merged into each point, at least 1.
            spread: (n,) [m] standard deviation of the merged heights, at least 0.
            p_world_camera: (3,) [m] {world} optical centre.
            pose_covariance: (6, 6) [m^2, m rad, rad^2] of the camera's position, then rotation, in world axes.
            sights: (m, 3) [m] {world} points up to which there is nothing in the camera's sight, beside those of the scan.
            nearest: [m] from the camera up to which sights say nothing, since it measures nothing there.

        Raises:
            ValueError: A shape is wrong, or a value is not finite or out of its range; the map is then unchanged.
        """
        checked = CheckedScan.of(points, count, spread, p_world_camera, pose_covariance, sights, nearest)
        return self.fuse_checked(checked)

    def fuse_checked(self, scan: "CheckedScan") -> FusionCount:
        """Take a scan that is known to be one into the map, as `fuse` does."""
        p, n, s, c, covariance = scan.points, scan.count, scan.spread, scan.p_world_camera, scan.pose_covariance
        low_i, low_j = int(self._low[0]), int(self._low[1])
        cell, inside, middle = _survey(p, self.resolution, low_i, low_j, *self.shape)
        slope = _slopes(cell, self._height, self.resolution, low_i, low_j)
        random, systematic = self.model.height_variance(p, n, s, c, covariance, slope)
        touched, z, random, systematic = _merge_scan(
            cell, p[:, 2], random, systematic, self._slot, self.model.gate, self.model.step_in(self.resolution)
        )
        if inside:
            self._follow_drift(touched, z, _height_sigma(middle - c, covariance))
            z -= self._drift
            self._highest = max(self._highest, float(z.max()))
        updated, disputed, replaced = _update_cells(
            touched, z, random, systematic,
            self._height.ravel(), self._variance.ravel(), self._support.ravel(), self._assumed.ravel(),
            self._rival.ravel(), self._rival_variance.ravel(), self._votes.ravel(),
            self._first.ravel(), self._through.ravel(), self._fell.ravel(),
            self.model.gate, self.model.patience,
        )  # fmt: skip
        cleared = self._look_through(p, c, 0.0, _FOLLOWED) + self._look_through(scan.sights, c, scan.nearest, 1)
        self._scans += 1
        return FusionCount(updated, disputed, replaced, len(p) - inside, cleared)

    def _follow_drift(self, cells: NDArray[np.int64], z: NDArray[np.float64], sigma: float) -> None:
        """Amend the drift by the heights (m,) [m] that a scan gives to cells (m,), its pose known to sigma [m] in height.

        Ground as it was first seen tells, where it is well known and not disputed: by the median over all such cells, and
        only if that is off by more than the sensor's own errors at different distances come to, and than the scan's noise,
        for a few scans in a row. Then it is led back, no faster than a pose drifts. A pose that leaps has been corrected, or
        is wrong; either way it is no drift: it disputes the cells, and disputed cells tell nothing.

        Source: the drift compensation of elevation_mapping_cupy (Miki et al. 2022, section III-B), there of the mean error
        and without a dead band, which a map that does not move with its robot needs against its own noise.
        """
        off = _offsets(
            cells, z, self._height.ravel(), self._variance.ravel(), self._first.ravel(), self._votes.ravel(),
            self._drift, _KNOWN_WELL**2, _SAME_GROUND,
        )  # fmt: skip
        if len(off) < _FEWEST:
            return
        gap = _median(off)
        compensating = abs(self._drifted) >= _PERSISTS
        if abs(gap) <= (_LEVEL_AGAIN if compensating else _DRIFTED):
            self._drifted = 0
            return
        noise = math.hypot(sigma, 1.25 * 1.48 * _median(np.abs(off - gap)) / math.sqrt(len(off) / _ALIKE))
        if abs(gap) <= (noise if compensating else 3.0 * noise):
            self._drifted = 0
            return
        sign = 1 if gap > 0 else -1
        self._drifted = self._drifted + sign if self._drifted * sign >= 0 else sign
        if abs(self._drifted) >= _PERSISTS:
            self._drift += max(-_RATE, min(_RATE, gap))

    def _look_through(self, ends: NDArray[np.float64], camera: NDArray[np.float64], nearest: float, every: int) -> int:
        """Let every few lines of sight from a camera (3,) to points (n, 3) clear what stands in their way; cells cleared."""
        if self._scans % _REFRESHED == 0:
            self._highest = float(np.fmax.reduce(self._height, axis=None))
        if not len(ends) or not self._highest - _WELL_BELOW > float(ends[:, 2].min()) - self._drift:
            return 0  # nothing stands above what is seen, as on level ground
        cleared = _clear_along_sights(
            ends, self._scans % every, every, camera, self._drift, nearest,
            int(self._low[0]), int(self._low[1]), self.resolution, self._highest,
            self._height, self._variance, self._support, self._assumed, self._votes, self._first, self._through, self._fell,
            self._slot,
        )  # fmt: skip
        return int(cleared)

    def seed_plane(self, polygon: ArrayLike, plane: ArrayLike, sigma: float = 0.02) -> int:
        """Fill the unseen cells of a region with a plane, marked as assumed; the first measurement replaces each.

        Args:
            polygon: (k, 2) [m] {world} corners in order, k >= 3; cells whose centre lies inside (even-odd) are filled.
            plane: (3,) height is plane[0] + plane[1] * x + plane[2] * y, [m], [m/m], [m/m].
            sigma: [m] standard deviation given to the assumed heights.

        Returns:
            The number of cells filled.

        Raises:
            ValueError: A shape is wrong, or a value is not finite or out of its range.

        Source: Masri 2016, section 4.7 (the ground under the robot is modelled as a plane until it is measured).
        """
        corners = np.asarray(polygon, dtype=np.float64)
        coefficients = np.asarray(plane, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not (np.abs(corners) < FAR).all():
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
        fill = _inside_polygon(x, y, corners) & np.isnan(self._height[box])
        rows, columns = np.nonzero(fill)
        cells = i[rows] % self.shape[0], j[columns] % self.shape[1]
        self._height[cells] = (coefficients[0] - self._drift + coefficients[1] * x + coefficients[2] * y)[rows, columns]
        self._variance[cells] = sigma**2
        self._assumed[cells] = 1
        return len(rows)

    def heights(self, p_world_xy: ArrayLike) -> NDArray[np.float64]:
        """Heights (...) [m] {world} of the cells at p_world_xy (..., 2) [m]; NaN where unseen or outside the window.

        Raises:
            ValueError: The last axis is not 2.
        """
        p = np.asarray(p_world_xy, dtype=np.float64)
        if p.ndim == 0 or p.shape[-1] != 2:
            raise ValueError(f"points (..., 2) expected, found shape {p.shape}")
        near = np.where(np.abs(p) < FAR, p, 2 * FAR).reshape(-1, 2)  # NaN too lies outside
        cell, inside = self._cells(near)
        height = np.where(inside, self._height.ravel()[cell] + self._drift, np.nan)  # cell -1 is masked by inside
        return np.asarray(height.reshape(p.shape[:-1]), dtype=np.float64)

    def snapshot(self) -> ElevationSnapshot:
        """Copy the map in world order."""
        elevation = self._unrolled(self._height)
        if self._drift != 0.0:
            elevation += np.float32(self._drift)
        return ElevationSnapshot(
            resolution=self.resolution,
            origin=self.origin,
            elevation=elevation,
            variance=self._unrolled(self._variance),
            assumed=self._unrolled(self._assumed),
        )

    def _cells(self, p_world_xy: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Flat buffer index (n,), -1 outside the window, and whether inside (n,) (Lotriet 2024, eq. 4.11)."""
        cell = _cell_indices(p_world_xy, self.resolution, int(self._low[0]), int(self._low[1]), *self.shape)
        return cell, cell >= 0

    def _forget(self, lines: tuple[slice | NDArray[np.int64], ...]) -> None:
        """Make whole rows or columns of the buffer unseen."""
        for layer in (self._height, self._variance, self._rival, self._rival_variance, self._first):
            layer[lines] = np.nan
        for counter in (self._support, self._assumed, self._votes, self._through, self._fell):
            counter[lines] = 0

    def _unrolled(self, layer: NDArray[Scalar]) -> NDArray[Scalar]:
        """Copy of a layer with the window's lowest cell first."""
        i, j = (int(low % n) for low, n in zip(self._low, self.shape, strict=True))
        out = np.empty_like(layer)
        m, n = self.shape[0] - i, self.shape[1] - j
        out[:m, :n], out[:m, n:] = layer[i:, j:], layer[i:, :j]
        out[m:, :n], out[m:, n:] = layer[:i, j:], layer[:i, :j]
        return out


def fill_small_holes(elevation: NDArray[np.float32], max_relief: float = 0.015) -> NDArray[np.float32]:
    """Copy of a map with its small holes bridged, for the scorer; the map itself keeps unknown unknown.

    An unseen cell with at least seven seen ones among its eight neighbours, all within max_relief of each other, gets
    the mean over the opposite pairs both seen: it is interpolated, exact on a plane, never extrapolated. So single cells
    and pairs are bridged. Lines stay NaN, however narrow: a trench between two blocks, into which the camera does not
    see, looks the same. So do wider holes, the frontier and holes across an edge.

    Args:
        elevation: (nx, ny) [m], NaN where unseen.
        max_relief: [m] largest difference between the seen neighbours.

    Raises:
        ValueError: The map is not two-dimensional or max_relief is negative.
    """
    if elevation.ndim != 2:
        raise ValueError(f"map (nx, ny) expected, found shape {elevation.shape}")
    if not max_relief >= 0:
        raise ValueError(f"max_relief of at least 0 expected, found {max_relief}")
    filled = np.array(elevation, dtype=np.float32, order="C")
    _bridge_holes(np.ascontiguousarray(elevation, dtype=np.float32), max_relief, filled)
    return filled


def _checked_scan(
    points: NDArray[np.floating],
    count: NDArray[np.integer | np.floating],
    spread: NDArray[np.floating],
    p_world_camera: ArrayLike,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The scan as contiguous float64 arrays; ValueError where a shape or the camera is wrong."""
    p = np.ascontiguousarray(points, dtype=np.float64)
    n = np.ascontiguousarray(count, dtype=np.float64)
    s = np.ascontiguousarray(spread, dtype=np.float64)
    c = np.asarray(p_world_camera, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3:
        raise ValueError(f"points (n, 3) expected, found shape {p.shape}")
    if n.shape != (len(p),) or s.shape != (len(p),):
        raise ValueError(f"count and spread of shape {(len(p),)} expected, found {n.shape} and {s.shape}")
    if c.shape != (3,) or not (np.abs(c) < FAR).all():
        raise ValueError(f"camera position of 3 coordinates within {FAR:g} m expected, found {p_world_camera!r}")
    if not (np.abs(p) < FAR).all():
        raise ValueError(f"points finite and within {FAR:g} m expected: drop invalid pixels before fusing")
    if not ((n >= 1.0) & (n < np.inf)).all():
        raise ValueError("counts of at least 1 expected: drop empty cells before fusing")
    if not ((s >= 0.0) & (s < FAR)).all():
        raise ValueError("finite spreads of at least 0 m expected")
    return p, n, s, c


def _checked_covariance(covariance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """A (6, 6) covariance, zero for none; ValueError where it is none."""
    if covariance is None:
        return np.zeros((6, 6))
    out = np.ascontiguousarray(covariance, dtype=np.float64)
    if out.shape != (6, 6) or not np.isfinite(out).all():
        raise ValueError(f"a finite pose covariance (6, 6) expected, found {covariance!r}")
    size = float(np.abs(out).max())
    if np.abs(out - out.T).max() > 1e-6 * size or np.linalg.eigvalsh(out)[0] < -1e-6 * size:
        raise ValueError("a pose covariance that is symmetric and has no negative eigenvalue expected")
    return out


def _median(values: NDArray[np.float64]) -> float:
    """The upper median of at least one number; np.median takes four times as long."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def _height_sigma(ray: NDArray[np.float64], S: NDArray[np.float64]) -> float:
    """One sigma [m] by which a pose covariance (6, 6) lifts points around a ray (3,) [m] from the camera."""
    lift = np.array([0.0, 0.0, 1.0, ray[1], -ray[0], 0.0])
    return math.sqrt(max(float(lift @ S @ lift), 0.0))


def _inside_polygon(x: NDArray[np.float64], y: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Even-odd rule on the grid x (nx, 1), y (1, ny)."""
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
    """Flat buffer index (n,) of each point, -1 outside the window of rows x columns that starts at cell (low_i, low_j)."""
    cell = np.empty(len(p_world_xy), dtype=np.int64)
    wrap_i, wrap_j = low_i % rows, low_j % columns
    for k in range(len(p_world_xy)):
        i = math.floor(p_world_xy[k, 0] / resolution) - low_i
        j = math.floor(p_world_xy[k, 1] / resolution) - low_j
        if 0 <= i < rows and 0 <= j < columns:
            i, j = i + wrap_i, j + wrap_j  # the remainder by the size, without dividing
            cell[k] = (i if i < rows else i - rows) * columns + (j if j < columns else j - columns)
        else:
            cell[k] = -1
    return cell


@compiled
def _survey(
    p: NDArray[np.float64],
    resolution: float,
    low_i: int,
    low_j: int,
    rows: int,
    columns: int,
) -> tuple[NDArray[np.int64], int, NDArray[np.float64]]:
    """What there is to know of a scan before it is taken.

    Returns:
        cell: (n,) flat buffer index of each point, -1 outside the window of rows x columns that starts at (low_i, low_j).
        inside: How many points lie in the window.
        middle: (3,) [m] their mean.
    """
    cell = np.empty(len(p), dtype=np.int64)
    middle = np.zeros(3)
    wrap_i, wrap_j = low_i % rows, low_j % columns
    inside = 0
    for k in range(len(p)):
        cell[k] = -1
        x, y, z = p[k, 0], p[k, 1], p[k, 2]
        i, j = math.floor(x / resolution) - low_i, math.floor(y / resolution) - low_j
        if 0 <= i < rows and 0 <= j < columns:
            middle[0] += x
            middle[1] += y
            middle[2] += z
            inside += 1
            i, j = i + wrap_i, j + wrap_j  # the remainder by the size, without dividing
            cell[k] = (i if i < rows else i - rows) * columns + (j if j < columns else j - columns)
    return cell, inside, middle / max(inside, 1)


@compiled
def _slopes(
    cell: NDArray[np.int64], height: NDArray[np.float32], resolution: float, low_i: int, low_j: int
) -> NDArray[np.float64]:
    """Gradient (n, 2) [m/m] of the map at cells (n,), NaN where one of the neighbours along an axis is unknown.

    Of the differences to both sides the smaller, and none where they disagree in sign: on a plane that is its slope, beside
    a step it is that of the ground a foot would stand on, and not the step's.
    """
    rows, columns = height.shape
    first_i, first_j = low_i % rows, low_j % columns  # buffer index of the window's lowest cell
    per_cell = 1.0 / resolution
    out = np.empty((len(cell), 2))
    i, begin = 0, 0  # the row of the last cell, and its first cell: scans go row by row
    for k in range(len(cell)):
        out[k, 0] = out[k, 1] = np.nan
        c = cell[k]
        if c < 0:
            continue
        if not begin <= c < begin + columns:
            i = c // columns
            begin = i * columns
        j = c - begin
        here = height[i, j]
        # At the window's border the buffer goes on with its other side.
        after = i + 1 if i + 1 < rows else 0
        if i != first_i and after != first_i:
            out[k, 0] = _smaller(height[after, j] - here, here - height[i - 1 if i > 0 else rows - 1, j]) * per_cell
        after = j + 1 if j + 1 < columns else 0
        if j != first_j and after != first_j:
            out[k, 1] = _smaller(height[i, after] - here, here - height[i, j - 1 if j > 0 else columns - 1]) * per_cell
    return out


@compiled
def _smaller(a: float, b: float) -> float:
    """Of two numbers of one sign the smaller in size, 0 if their signs differ, NaN if one is."""
    if a * b > 0.0:
        return a if abs(a) < abs(b) else b
    return a * b * 0.0


@compiled
def _variances(
    points: NDArray[np.float64],
    count: NDArray[np.float64],
    spread: NDArray[np.float64],
    camera: NDArray[np.float64],
    S: NDArray[np.float64],
    slope: NDArray[np.float64],
    depth_sigma: float,
    range_sigma: float,
    quantisation_sigma: float,
    floor_sigma: float,
    terrain_slope: float,
    independent_pixels: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Random and systematic variance (n,) [m^2]; see `FusionModel.height_variance`."""
    n = len(points)
    random, systematic = np.empty(n), np.empty(n)
    unknown2 = 0.5 * terrain_slope**2  # of either component of an isotropic gradient
    # Columns and numbers of their own and no branches, so that the loop runs in vectors.
    px, py, pz = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1]), np.ascontiguousarray(points[:, 2])
    slope_x, slope_y = np.ascontiguousarray(slope[:, 0]), np.ascontiguousarray(slope[:, 1])
    s00, s01, s02, s03, s04, s05 = S[0, 0], S[0, 1], S[0, 2], S[0, 3], S[0, 4], S[0, 5]
    s11, s12, s13, s14, s15 = S[1, 1], S[1, 2], S[1, 3], S[1, 4], S[1, 5]
    s22, s23, s24, s25 = S[2, 2], S[2, 3], S[2, 4], S[2, 5]
    s33, s34, s35, s44, s45, s55 = S[3, 3], S[3, 4], S[3, 5], S[4, 4], S[4, 5], S[5, 5]
    x0, y0, z0 = camera[0], camera[1], camera[2]
    floor2, most = floor_sigma**2, float(independent_pixels)
    for k in range(n):
        x, y, z = px[k] - x0, py[k] - y0, pz[k] - z0
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
def _merge_scan(
    cell: NDArray[np.int64],
    z: NDArray[np.float64],
    random: NDArray[np.float64],
    systematic: NDArray[np.float64],
    slot: NDArray[np.int32],
    gate: float,
    edge_step: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """One measurement per cell: cells (m,), heights, random and systematic variances; slot is -1 before and after."""
    n = len(cell)
    cells = np.empty(n, dtype=np.int64)
    out_z, out_random, out_systematic = np.empty(n), np.empty(n), np.empty(n)
    m = 0
    for k in range(n):
        c = cell[k]
        if c < 0:
            continue
        e = slot[c]
        if e < 0:
            slot[c] = m
            cells[m], out_z[m], out_random[m], out_systematic[m] = c, z[k], random[k], systematic[k]
            m += 1
            continue
        step = z[k] - out_z[e]
        if abs(step) > edge_step and step * step > gate * gate * (random[k] + out_random[e] + systematic[k]):
            if step > 0:
                out_z[e], out_random[e], out_systematic[e] = z[k], random[k], systematic[k]
            continue
        gain = (out_random[e] + 1e-12) / (out_random[e] + random[k] + 2e-12)
        out_z[e] += gain * step
        out_random[e] *= 1.0 - gain
        # Of their variance about the mean, what noise does not explain lasts.
        own = max(gain * (1.0 - gain) * step * step - random[k], 0.0)
        out_systematic[e] = max(out_systematic[e], systematic[k]) + own
    for e in range(m):
        slot[cells[e]] = -1
    return cells[:m], out_z[:m], out_random[:m], out_systematic[:m]


@compiled
def _update_cells(
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
) -> tuple[int, int, int]:
    """Filter one measurement into each cell; counts of cells updated, disputed and replaced."""
    updated = disputed = replaced = 0
    for k in range(len(cells)):
        c = cells[k]
        noise = random[k] + systematic[k]
        if assumed[c] or np.isnan(height[c]):
            height[c], variance[c], support[c], assumed[c], votes[c], through[c] = z[k], noise, 1, 0, 0, 0
            updated += 1
            continue
        believed = float(variance[c])
        off = z[k] - height[c]
        if off * off <= gate * gate * (believed + noise):
            height[c] += believed / (believed + noise) * off
            variance[c] = max(believed * noise / (believed + noise), min(believed, systematic[k]))
            support[c] = min(support[c] + 1, 255)
            if support[c] >= _SETTLED:
                fell[c] = 0
            votes[c] = max(votes[c] - 1, 0)
            through[c] = 0
            if support[c] == _ESTABLISHED:
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
            fell[c] = np.uint8(rival[c] < height[c] - _WELL_BELOW)
            height[c], variance[c], support[c], votes[c], through[c] = rival[c], rival_variance[c], votes[c], 0, 0
            first[c] = height[c] if support[c] >= _ESTABLISHED else np.nan
            replaced += 1
    return updated, disputed, replaced


@compiled
def _offsets(
    cells: NDArray[np.int64],
    z: NDArray[np.float64],
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    first: NDArray[np.float32],
    votes: NDArray[np.uint8],
    drift: float,
    most_variance: float,
    same: float,
) -> NDArray[np.float64]:
    """How far heights less the drift lie over where the ground was first seen, of every fourth cell that can tell (n,) [m]."""
    out = np.empty(len(cells) // 4 + 1)
    n = 0
    for k in range(0, len(cells), 4):
        c = cells[k]
        off = z[k] - drift - first[c]
        # Ground that has sunk or risen since, by itself or by one wrong look, tells nothing.
        if abs(off) < same and votes[c] == 0 and variance[c] < most_variance and abs(height[c] - first[c]) < same:
            out[n] = off
            n += 1
    return out[:n]


@compiled
def _clear_along_sights(
    ends: NDArray[np.float64],
    begin: int,
    every: int,
    camera: NDArray[np.float64],
    drift: float,
    nearest: float,
    low_i: int,
    low_j: int,
    resolution: float,
    highest: float,
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    support: NDArray[np.uint8],
    assumed: NDArray[np.uint8],
    votes: NDArray[np.uint8],
    first: NDArray[np.float32],
    through: NDArray[np.uint8],
    fell: NDArray[np.uint8],
    slot: NDArray[np.int32],
) -> int:
    """Count, once a scan, the cells that stand well above a line of sight, and clear those that have been so often.

    A cell counts only within a body: none of its eight neighbours is known to lie lower than the line but such as have
    fallen already, and at most two are unknown; so what is narrower than three cells, a rim that fills its cells in part,
    and a wall seen along its face are left to measurement. A body is eaten from within: a rim falls after what it was the
    rim of.

    Returns the number of cells cleared.
    """
    rows, columns = height.shape
    marked = np.empty(rows * columns, dtype=np.int64)
    m = 0
    wrap_i, wrap_j = low_i % rows, low_j % columns
    for k in range(begin, len(ends), every):
        u, v, z = ends[k, 0] / resolution - low_i, ends[k, 1] / resolution - low_j, ends[k, 2] - drift
        du, dv, dz = camera[0] / resolution - low_i - u, camera[1] / resolution - low_j - v, camera[2] - drift - z
        way = max(abs(du), abs(dv))
        length = resolution * math.sqrt(du * du + dv * dv)
        if way <= _SHORT or length <= nearest or dz <= 0.0:
            continue
        rise = 0.75 * dz / way  # from the middle of a cell to where the line is highest in it
        # Only the steps within the window: a line may be far longer than that.
        enters, leaves = _SHORT / way, 1.0 - nearest / length
        for at, along, end in ((u, du, rows - 1.0), (v, dv, columns - 1.0)):
            if along != 0.0:
                near, far = (1.0 - at) / along, (end - at) / along
                enters, leaves = max(enters, min(near, far)), min(leaves, max(near, far))
            elif not 1.0 <= at < end:
                leaves = -1.0
        if enters >= leaves:
            continue
        last = min(int(way * leaves) + 2, int(way * (1.0 - nearest / length)))  # rounding may take a step on either side
        for step in range(max(_SHORT, int(way * enters) - 1), last):
            s = step / way
            over = z + s * dz + rise + _WELL_BELOW
            if over > highest:
                break
            i, j = math.floor(u + s * du), math.floor(v + s * dv)
            if i < 1 or j < 1 or i >= rows - 1 or j >= columns - 1:
                continue
            a, b = i + wrap_i, j + wrap_j
            a, b = (a if a < rows else a - rows), (b if b < columns else b - columns)
            if not height[a, b] > over + 3.0 * math.sqrt(variance[a, b]):
                continue
            c = a * columns + b
            if slot[c] >= 0:
                continue
            standing = fallen = low = 0
            for p in range(-1, 2):
                for q in range(-1, 2):
                    if p == 0 and q == 0:
                        continue
                    e, f = a + p, b + q
                    e = e - rows if e >= rows else (e + rows if e < 0 else e)
                    f = f - columns if f >= columns else (f + columns if f < 0 else f)
                    if height[e, f] > over:
                        standing += 1
                    elif fell[e, f] != 0:
                        fallen += 1
                    elif height[e, f] == height[e, f]:
                        low += 1
            if (low == 0 and standing + fallen >= 6) or fallen >= _FELL_AROUND:
                slot[c] = 0
                marked[m] = c
                m += 1
    cleared = 0
    for k in range(m):
        c = marked[k]
        slot[c] = -1
        a, b = c // columns, c % columns
        through[a, b] += 1
        if through[a, b] < _SIGHTS_NEEDED:
            continue
        height[a, b] = variance[a, b] = first[a, b] = np.nan
        support[a, b] = assumed[a, b] = votes[a, b] = through[a, b] = 0
        fell[a, b] = 1
        cleared += 1
    return cleared


@compiled
def _bridge_holes(elevation: NDArray[np.float32], max_relief: float, filled: NDArray[np.float32]) -> None:
    """Write the interpolated heights of small holes into filled."""
    nx, ny = elevation.shape
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            if not np.isnan(elevation[i, j]):
                continue
            row_unseen = np.isnan(elevation[i, j - 1]) and np.isnan(elevation[i, j + 1])
            if row_unseen and np.isnan(elevation[i - 1, j]) and np.isnan(elevation[i + 1, j]):
                continue  # at most the four diagonal neighbours are left
            seen, pairs = 0, 0
            total, lowest, highest = 0.0, np.inf, -np.inf
            for di, dj in ((0, 1), (1, -1), (1, 0), (1, 1)):
                a, b = elevation[i + di, j + dj], elevation[i - di, j - dj]
                if not np.isnan(a):
                    seen += 1
                    lowest, highest = min(lowest, a), max(highest, a)
                if not np.isnan(b):
                    seen += 1
                    lowest, highest = min(lowest, b), max(highest, b)
                if not (np.isnan(a) or np.isnan(b)):
                    pairs += 1
                    total += 0.5 * (a + b)
            if seen >= 7 and highest - lowest <= max_relief:
                filled[i, j] = total / pairs
