"""Metrics of elevation maps against the true ground.

They cover the mosaic of all maps, the error per cell, and the coverage ahead.
Frame: {start}, as in `sextant.evaluation.trace.course`.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.true_ground import INTERIOR, TrueGround, rms
from sextant.evaluation.metrics.walk_metrics import HeightAt
from sextant.evaluation.report import CourseMap, MapError
from sextant.shared.geometry import Array, apply, yaw_of
from sextant.shared.robot.profile import Camera
from sextant.shared.wire.messages import TerrainMap

_MAP_RADIUS = 1.0  # [m] around the body in which maps are compared
_STRIP = ((0.6, 1.2), (-0.3, 0.3))  # [m] ahead and to the side: the area of the steps after the next
_GROUND_RESOLUTION = 0.02  # [m]
_SEEN_RANGE = 1.5  # [m] horizontal distance from the camera within which visible ground should be mapped
_STEP = 0.02  # [m] height difference that counts as an edge: blocks and stairs for a small robot are low
_SAMPLED = 2  # stride over rows and columns of a depth frame


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Mosaic of all maps of a run, with the newest measurement of each cell."""

    origin: Array  # (2,) [m] {start} centre of cell (0, 0)
    resolution: float  # [m]
    elevation: NDArray[np.float32]  # (nx, ny) [m] {start}, NaN where unknown
    unacceptable: NDArray[np.bool_]  # (nx, ny) no foothold by the map's score
    assumed: NDArray[np.bool_]  # (nx, ny) filled in, never measured
    color: NDArray[np.uint8] | None = None  # (nx, ny, 3) R, G, B, black where unknown; None without a colour camera

    @property
    def measured(self) -> NDArray[np.float32]:
        """Measured heights (nx, ny) [m] {start}, NaN elsewhere."""
        return np.where(self.assumed, np.float32(np.nan), self.elevation)

    def in_view(self, views: Iterable[tuple[NDArray[np.float32], Array]], camera: Camera) -> NDArray[np.bool_]:
        """Return the cells (nx, ny) that are visible in undisturbed depth frames.

        Each view is a depth frame (h, w) [m] and the camera pose (4, 4) {start}.
        """
        shape = self.elevation.shape
        seen = np.zeros(shape, dtype=bool)
        for depth, T in views:
            few = depth[::_SAMPLED, ::_SAMPLED]
            v, u = np.nonzero((few >= camera.sensor.min_range) & (few <= camera.sensor.max_range))
            points = apply(T, camera.intrinsics.points_of(_SAMPLED * u, _SAMPLED * v, few[v, u]))
            points = points[np.linalg.norm(points[:, :2] - T[:2, 3], axis=1) <= _SEEN_RANGE]
            i, j = np.round((points[:, :2] - self.origin) / self.resolution).astype(int).T
            on_map = (i >= 0) & (j >= 0) & (i < shape[0]) & (j < shape[1])
            seen[i[on_map], j[on_map]] = True
        return seen


class GroundHeights:
    """True ground under the path on a grid, for a fast query at every message."""

    def __init__(self, area: tuple[float, float, float, float], T_start_sim: Array, height_at: HeightAt):
        grid = Grid(area, _GROUND_RESOLUTION)
        self._height = height_at(grid.points()).reshape(grid.shape).tolist()
        self._last = grid.shape[0] - 1, grid.shape[1] - 1
        # transform from the simulator's world to cell indices
        to_cells = T_start_sim[:2, [0, 1, 3]] / _GROUND_RESOLUTION
        to_cells[:, 2] -= grid.origin / _GROUND_RESOLUTION
        self._rows = to_cells.tolist()

    def under(self, x: float, y: float) -> float:
        """Return the height [m] {start} of the grid point nearest to (x, y) [m] {sim}."""
        i, j = (min(max(round(a * x + b * y + c), 0), n) for (a, b, c), n in zip(self._rows, self._last, strict=True))
        return float(self._height[i][j])


class Grid:
    """Cell grid over an area, aligned with maps of one resolution and phase."""

    def __init__(self, area: tuple[float, float, float, float], resolution: float, phase: Array | None = None):
        x0, x1, y0, y1 = area
        self.resolution = resolution
        self.origin = np.round(np.array([x0, y0]) / resolution) * resolution + (0.0 if phase is None else phase)
        self.shape = round((x1 - x0) / resolution) + 1, round((y1 - y0) / resolution) + 1

    @classmethod
    def of(cls, area: tuple[float, float, float, float], terrain: TerrainMap) -> "Grid":
        """Return the grid that contains a map's cells."""
        r = terrain.resolution
        return cls(area, r, terrain.origin - np.round(terrain.origin / r) * r)

    def fits(self, terrain: TerrainMap) -> bool:
        """Return whether a map's cells lie on this grid."""
        cells = (terrain.origin - self.origin) / self.resolution
        return terrain.resolution == self.resolution and bool(np.all(np.abs(cells - np.round(cells)) < 1e-3))

    def first(self, terrain: TerrainMap) -> NDArray[np.int64]:
        """Return the cell (2,) on this grid of a map's cell (0, 0)."""
        return np.round((terrain.origin - self.origin) / self.resolution).astype(np.int64)

    def points(self) -> Array:
        """Return the centres (n, 2) [m] of the cells, row by row."""
        x, y = (self.origin[k] + self.resolution * np.arange(self.shape[k]) for k in (0, 1))
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


class MapJudge:
    """The maps of a run: mosaic and comparison with the truth."""

    def __init__(self, grid: Grid, height_at: HeightAt):
        self.grid = grid
        self._height_at = height_at
        self._true = np.full(grid.shape, np.nan)  # computed only where needed: a query is expensive
        self._elevation = np.full(grid.shape, np.nan, dtype=np.float32)
        self._unacceptable = np.zeros(grid.shape, dtype=bool)
        self._assumed = np.zeros(grid.shape, dtype=bool)
        self._color: NDArray[np.uint8] | None = None
        self._errors: list[tuple[float, float, float]] = []
        self._coverage: list[float] = []

    def add(self, terrain: TerrainMap, T_world_body: Array, compare: bool) -> None:
        """Add a map to the mosaic, and compare it with the truth if `compare`.

        T_world_body (4, 4) is the body pose as the robot estimates it.
        """
        grid = self.grid
        first = grid.first(terrain)
        low = np.maximum(first, 0)
        high = np.minimum(first + terrain.elevation.shape, grid.shape)
        if np.any(low >= high):
            return
        here = (slice(low[0], high[0]), slice(low[1], high[1]))
        there = tuple(slice(a - f, b - f) for a, b, f in zip(low, high, first, strict=True))
        elevation, assumed, score = terrain.elevation[there], terrain.assumed[there], terrain.score[there]
        seen = np.isfinite(elevation)
        measured = seen & ~assumed
        fill = measured | (seen & (np.isnan(self._elevation[here]) | self._assumed[here]))
        np.copyto(self._elevation[here], elevation, where=fill)
        np.copyto(self._unacceptable[here], score > 1, where=fill & np.isfinite(score))  # the border of a map has no score
        np.copyto(self._assumed[here], assumed, where=fill)
        if terrain.color.size:
            if self._color is None:
                self._color = np.zeros((*grid.shape, 3), dtype=np.uint8)
            color = terrain.color[there]
            np.copyto(self._color[here], color, where=color.any(axis=-1, keepdims=True))
        if compare:
            x, y = (grid.origin[k] + grid.resolution * np.arange(low[k], high[k]) for k in (0, 1))
            near = (x[:, None] - T_world_body[0, 3]) ** 2 + (y - T_world_body[1, 3]) ** 2 <= _MAP_RADIUS**2
            self._compare(elevation, measured & near, here, (x, y))
            self._cover(terrain, T_world_body)

    def _compare(
        self,
        elevation: NDArray[np.float32],
        cells: NDArray[np.bool_],
        here: tuple[slice, slice],
        axes: tuple[Array, Array],
    ) -> None:
        true = self._true[here]
        i, j = np.nonzero(cells & np.isnan(true))
        true[i, j] = self._height_at(np.stack([axes[0][i], axes[1][j]], axis=1))
        error = elevation[cells] - true[cells]
        error = error[np.isfinite(error)]  # without ground there is no height to compare with
        if len(error):
            size = np.abs(error)
            rank = int(0.95 * (len(size) - 1))
            p95 = np.partition(size, rank)[rank]
            self._errors.append((float(np.sqrt(np.mean(error**2))), float(error.mean()), float(p95)))

    def _cover(self, terrain: TerrainMap, T_world_body: Array) -> None:
        (x0, x1), (y0, y1) = _STRIP
        r = terrain.resolution
        ahead, side = np.meshgrid(np.arange(x0 + r / 2, x1, r), np.arange(y0 + r / 2, y1, r), indexing="ij")
        yaw = yaw_of(T_world_body)
        c, s = np.cos(yaw), np.sin(yaw)
        i = np.round((T_world_body[0, 3] + c * ahead - s * side - terrain.origin[0]) / r).astype(int)
        j = np.round((T_world_body[1, 3] + s * ahead + c * side - terrain.origin[1]) / r).astype(int)
        nx, ny = terrain.elevation.shape
        inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
        i, j = np.where(inside, i, 0), np.where(inside, j, 0)
        known = inside & np.isfinite(terrain.elevation[i, j]) & ~terrain.assumed[i, j]
        self._coverage.append(float(known.mean()))

    def error(self) -> MapError:
        """Return the errors of the compared maps, averaged over the maps."""
        if not self._errors:
            return MapError(coverage=float(np.mean(self._coverage)) if self._coverage else np.nan)
        rmse, bias, p95 = np.mean(self._errors, axis=0).tolist()
        return MapError(rmse, bias, p95, float(np.mean(self._coverage)))

    def mosaic(self) -> Mosaic:
        """Return the mosaic of the maps."""
        return Mosaic(self.grid.origin, self.grid.resolution, self._elevation, self._unacceptable, self._assumed, self._color)


def judge_course(mosaic: Mosaic, height_at: HeightAt, seen: NDArray[np.bool_] | None = None) -> CourseMap:
    """Compare the mosaic of a run with the true ground.

    Args:
        mosaic: All maps of the run, the newest measurement on top.
        height_at: True heights (n,) [m] {start} at (n, 2) [m].
        seen: (nx, ny) cells that were in view; without them the coverage is NaN.
    """
    shape = mosaic.elevation.shape
    truth = TrueGround.under(height_at, mosaic.origin, (shape[0], shape[1]), mosaic.resolution, _STEP)
    measured = mosaic.measured
    error = np.where(np.isfinite(truth.heights), measured - truth.heights, np.nan)
    known = np.isfinite(error)
    if not known.any():
        return CourseMap()
    return CourseMap(
        rmse=rms(error[known]),
        off_edges=rms(error[known & (truth.edge_distance > INTERIOR)]),
        bias=float(error[known].mean()),
        edge=truth.edge_error(measured),
        coverage=float(np.isfinite(measured)[seen].mean()) if seen is not None and seen.any() else np.nan,
    )
