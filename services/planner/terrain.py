"""Terrain map access: heights, scores and footholds at places in {world}."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.compiled_terrain import Choice, Grid, Ground, footing_at, suitability_at
from sextant.services.planner.params import FootholdParams
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE, UNKNOWN, TerrainMap

STEEPEST = float(np.tan(np.radians(12.0)))  # maximum slope of a plane through feet; feet on stones can suggest a steeper one
Layer = Literal["score", "evaluation"]

_LAST_FOOTHOLD = -1  # [cells] highest evaluation of a cell that carries a foot
DEEP = -100  # [cells] evaluation function on unlimited level ground

_RESOLUTIONS = (0.002, 0.1)  # [m] finest and coarsest plausible cells
MAX_SAMPLED_LINE_M = 20.0  # [m] maximum length of a line that is sampled cell by cell; longer ones are sampled more coarsely
_HIGHEST_LEG_M = 0.05  # [m] largest plausible difference of a leg and the camera, which the mapper's parameters allow
_FAR = 1e6  # [m] beyond it a cell index is no longer exact


@dataclass(frozen=True)
class Terrain:
    """A terrain map; everything outside it is unknown."""

    map: TerrainMap
    layer: Layer = "score"  # layer of the map that decides which cells carry a foot
    params: FootholdParams = field(default_factory=FootholdParams)

    def invalid_reason(self) -> str:
        """Return why the map is invalid, or ""."""
        low, high = _RESOLUTIONS
        if not low <= self.map.resolution <= high:
            return f"cells of {low} to {high} m expected, found {self.map.resolution:.3g} m"
        if self.map.elevation.size == 0:
            return "cells expected, found none"
        if np.abs(self.map.leg_heights).max() > _HIGHEST_LEG_M:
            return f"differences of the legs of at most {_HIGHEST_LEG_M} m expected, found {self.map.leg_heights.tolist()}"
        if np.abs(self.map.origin).max() > _FAR:
            return f"an origin within {_FAR:g} m expected, found {self.map.origin.tolist()}"
        return ""

    @cached_property
    def ground(self) -> Ground:
        """The map for compiled functions."""
        score = self.layer == "score"
        x, y = self.map.origin.tolist()
        return Ground(
            _read_only(self.map.elevation),
            _read_only(self.map.score if score else np.where(self.map.evaluation == UNKNOWN, np.nan, self.map.evaluation)),
            Grid(x, y, float(self.map.resolution)),
            Choice(
                by_score=score,
                most=float(MAX_FOOTHOLD_SCORE if score else _LAST_FOOTHOLD),
                room=float(self.params.room_m if score else self.map.resolution),
                firm=float(round(-self.params.firm_m / self.map.resolution)),
            ),
        )

    @cached_property
    def _last(self) -> NDArray[np.int64]:
        """Indices (2,) of the last cell."""
        return np.array(self.map.elevation.shape) - 1

    def cells(self, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return cell indices (..., 2), clipped, of points (..., 2) [m] {world}.

        Also return which (...) of the points are in the map.
        """
        ij = np.rint((xy - self.map.origin) / self.map.resolution).astype(np.int64)
        clipped = np.minimum(np.maximum(ij, 0), self._last)
        same = clipped == ij
        return clipped, np.asarray(same[..., 0] & same[..., 1])

    def heights(self, xy: Array) -> Array:
        """Return heights (...) [m] {world} at points (..., 2), NaN where unknown."""
        ij, inside = self.cells(xy)
        return np.where(inside, self.map.elevation[ij[..., 0], ij[..., 1]], np.nan)

    def scores(self, xy: Array) -> Array:
        """Return scores (...) at points (..., 2) [m] {world}, NaN where unknown."""
        ij, inside = self.cells(xy)
        return np.where(inside, self.map.score[ij[..., 0], ij[..., 1]], np.nan)

    def suitability(self, xy: Array) -> Array:
        """Return the suitability (n,) of places (n, 2) [m] {world} as footholds.

        The value is `NONE`, or from `POOR` to `GOOD`; it is NaN where unknown. With Lotriet's score, a place that carries a
        foot is good if the eight places around it, `room_m` away, also do, because feet do not land with millimetre accuracy.
        The fewer of them do, the poorer it is. With Masri's evaluation function (2016, section 5.2.1), a place is good where
        the function is strongly negative or has a local minimum. It is poor where the function is negative otherwise.
        """
        _, value, grid, choice = self.ground
        return np.array([suitability_at(value, grid, choice, x, y) for x, y in xy.tolist()])

    def footholds(self) -> NDArray[np.bool_]:
        """Return which cells (nx, ny) of the map carry a foot."""
        if self.layer == "score":
            return np.asarray(self.map.score <= MAX_FOOTHOLD_SCORE)
        return np.asarray(self.map.evaluation < 0)

    def carries(self, ij: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which (...) of the cells with indices (..., 2) carry a foot."""
        i, j = ij[..., 0], ij[..., 1]
        if self.layer == "score":
            return np.asarray(self.map.score[i, j] <= MAX_FOOTHOLD_SCORE)
        return np.asarray(self.map.evaluation[i, j] < 0)

    def hazards(self, xy: Array) -> NDArray[np.uint8]:
        """Return the hazard (n,) at points (n, 2) [m] {world}, as an index into `HAZARDS`.

        A hazard excludes a foothold on ground that is flat enough.
        """
        if not self.map.hazard.size:
            return np.zeros(len(xy), dtype=np.uint8)
        ij, inside = self.cells(xy)
        return np.where(inside, self.map.hazard[ij[..., 0], ij[..., 1]], 0).astype(np.uint8)

    def centres(self, xy: Array) -> Array:
        """Return the centres (n, 2) [m] {world} of the cells of points (n, 2)."""
        ij = np.rint((xy - self.map.origin) / self.map.resolution)
        return np.asarray(self.map.origin + self.map.resolution * ij)

    def footing(self, xy: Array) -> Array:
        """Return the height (n,) [m] {world} at which a foot at (n, 2) would stand.

        It is the mean of the known cells of the 3x3 cells around the place.
        """
        elevation, _, grid, _ = self.ground
        return np.array([footing_at(elevation, grid, x, y) for x, y in xy.tolist()])

    def highest_along(self, start: Array, end: Array, half_width: float = 0.02) -> Array:
        """Return the highest known ground (n,) [m] under lines, see `ground_along`."""
        return np.asarray(self.ground_along(start, end, half_width).max(axis=0))

    def ground_along(self, start: Array, end: Array, half_width: float = 0.02) -> Array:
        """Return the highest known ground [m] {world} along straight lines.

        Starts and ends are (n, 2) [m] {world}. A foot has a width and does not follow its path exactly, so each line is a band
        of `half_width` [m] to either side. The band narrows to zero at both ends, which are checked as footholds.

        Returns:
            (m, n) [m] at even shares of the lines from 0 to 1, at most one cell of the longest line apart; -inf for unknown
            ground.
        """
        way = end - start
        length = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        aside = np.column_stack([-way[:, 1], way[:, 0]]) / length
        along, across = (
            int(np.ceil(reach / self.map.resolution)) + 1
            for reach in (min(float(length.max()), MAX_SAMPLED_LINE_M), 2.0 * half_width)
        )
        s = np.linspace(0.0, 1.0, along)[:, None, None, None]
        offset = np.linspace(-half_width, half_width, across)[None, :, None, None] * np.sin(np.pi * s) ** 0.5
        heights = self.heights((start + s * way + offset * aside).reshape(-1, 2)).reshape(along, across, -1)
        return np.asarray(np.where(np.isfinite(heights), heights, -np.inf).max(axis=1))

    def highest_under(self, corners: Array) -> float:
        """Return the highest known ground [m] {world} under a rectangle.

        Three corners (3, 2) define it: origin, along, aside.
        """
        origin, along, aside = corners
        spacing = self.map.resolution
        n, m = (
            max(2, int(np.ceil(min(float(np.linalg.norm(side - origin)), MAX_SAMPLED_LINE_M) / spacing)) + 1)
            for side in (along, aside)
        )
        u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij")
        heights = self.heights(origin + u.reshape(-1, 1) * (along - origin) + v.reshape(-1, 1) * (aside - origin))
        return float(np.where(np.isfinite(heights), heights, -np.inf).max())


def _read_only(layer: NDArray[Any]) -> NDArray[np.float32]:
    """Return a layer as compiled functions take it: as in a received message, whose arrays are read-only."""
    same = np.ascontiguousarray(layer, dtype=np.float32).view()
    same.flags.writeable = False
    return same


def plane_of(stamp_ns: int, ground: Array) -> Terrain:
    """Return the plane of standing places (n, 3) [m] {world}, see `plane_through`."""
    return plane_terrain(stamp_ns, *plane_through(ground))


def plane_through(ground: Array) -> tuple[Array, float, Array]:
    """Fit a plane, no steeper than `STEEPEST`, to places (n, 3) [m] {world}, n >= 3.

    Return a place (2,), its height and the slope (2,).
    """
    xy = ground[:, :2].mean(axis=0)
    A = np.column_stack([np.ones(len(ground)), ground[:, :2] - xy])
    height, *slope = np.linalg.lstsq(A, ground[:, 2], rcond=None)[0]
    steep = max(float(np.linalg.norm(slope)) / STEEPEST, 1.0)
    return xy, float(height), np.array(slope) / steep


def flat_terrain(stamp_ns: int, centre: Array, height: float, half_size: float = 1.0, resolution: float = 0.01) -> Terrain:
    """Return level ground around a point; arguments as in `plane_terrain`."""
    return plane_terrain(stamp_ns, centre, height, np.zeros(2), half_size, resolution)


def plane_terrain(
    stamp_ns: int, centre: Array, height: float, slope: Array, half_size: float = 1.0, resolution: float = 0.01
) -> Terrain:
    """Return a plane around a point on which every cell is a good foothold.

    Args:
        stamp_ns: [ns] stamp of the map.
        centre: (2,) [m] {world}.
        height: [m] {world} ground height at the centre.
        slope: (2,) along x and y.
        half_size: [m] half edge of the map.
        resolution: [m] cell edge.
    """
    n = round(2 * half_size / resolution)
    off = resolution * np.arange(n) - half_size
    layer = (height + slope[0] * off[:, None] + slope[1] * off).astype(np.float32)
    even = TerrainMap(
        stamp_ns=stamp_ns,
        resolution=resolution,
        origin=np.asarray(centre - half_size, dtype=np.float64),
        elevation=layer,
        variance=np.zeros_like(layer),
        score=np.zeros_like(layer),
        assumed=np.ones((n, n), dtype=np.bool_),
        evaluation=np.full((n, n), DEEP, dtype=np.int8),
    )
    return Terrain(even)
