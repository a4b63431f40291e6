"""The two foothold layers of a moving map, recomputed only where it changed.

Changes are found by comparing the map cell by cell with the previous one, so no writer has to report them. A cell of a layer
depends only on the cells within its halo. The rectangle of the changed cells and its halo are therefore scored, from a part of
the map that is one halo wider. If the window moved, its border is scored as well. The evaluation function is recomputed around
the changed cells of the foothold map, which are few as a rule, and everywhere if the window moved.

**Margin.** A foot that is aimed at a cell stands within `margin` of it. The margin is the foot's radius plus `sigmas` times the
position error, which combines those of the body and of the ground. The ground's error along the floor is taken to be as large
as in height, because both come from a depth along a ray that looks down at 30 to 45 degrees. The score already covers
`flat_radius`. The rest of the margin is added in cells. Lotriet's score of a cell becomes the worst score within that distance.
In Masri's map a cell stays accessible only if all cells within that distance are accessible.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.footholds.foothold_map import DISCS, TOO_WIDE, EvaluationFunction
from sextant.services.mapper.footholds.foothold_score import Scalar, WalkabilityScorer, reference_height
from sextant.services.mapper.footholds.hole_filling import fill_small_holes
from sextant.services.mapper.footholds.params import FootholdLayersParams, FootholdMapParams, ScoreParams
from sextant.shared.runtime.compiled import compiled
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE, UNKNOWN, BodyPose

_WHOLE = 0.8  # share of the map, above which all of it is recomputed
_BAND = 65536  # cells scored per pass

_DEFAULTS = FootholdLayersParams()

Rectangle = tuple[int, int, int, int]  # first row, end of rows, first column, end of columns


@dataclass(frozen=True, slots=True)
class Margin:
    """Distance from a cell within which an aimed foot may stand."""

    foot_radius: float = 0.01  # [m]
    sigmas: float = _DEFAULTS.margin_sigmas  # standard deviations of the position that are kept clear
    widest: float = _DEFAULTS.max_margin_m  # [m] largest margin beyond the score's own; a cell that needs more is no foothold

    def __post_init__(self) -> None:
        if not (0 < self.foot_radius < math.inf and 0 <= self.sigmas < math.inf and 0 <= self.widest < math.inf):
            raise ValueError(f"a positive foot radius, sigmas and widest of at least 0 expected, found {self}")


@dataclass(frozen=True, slots=True)
class Layers:
    """Foothold layers of a map, one according to each thesis."""

    score: NDArray[np.float32]  # (nx, ny) Lotriet's walkability, NaN if not known well enough
    evaluation: NDArray[np.int8]  # (nx, ny) [cells] Masri's evaluation function, see `EvaluationFunction.evaluate`
    rescored: float  # share of the cells that were scored again


class FootholdLayers:
    """Foothold layers of one map, kept from call to call."""

    def __init__(
        self,
        shape: tuple[int, int],
        resolution: float,
        margin: Margin | None = None,
        weights: ScoreParams | None = None,
        rules: FootholdMapParams | None = None,
        keep_terms: bool = False,
    ) -> None:
        """Create the layers of a map.

        Args:
            shape: (nx, ny) cells of the map.
            resolution: [m] cell edge.
            margin: Distance to keep from unsuitable ground.
            weights: Parameters of the score.
            rules: Parameters of the foothold map.
            keep_terms: Whether to keep the terms of the score for `terms`.

        Raises:
            ValueError: The scorer or the evaluation function refuses an argument.
        """
        self.shape = shape
        self._resolution = resolution
        self._margin = margin or Margin()
        self._scorer = WalkabilityScorer(shape, resolution, weights)
        self._evaluator = EvaluationFunction(resolution, rules)
        self._most = min(max(1, math.ceil(self._margin.widest / resolution)), TOO_WIDE - 1)  # [cells] largest added margin
        self._halo = self._scorer.halo + 1  # a filled hole shows its neighbours' heights
        self._first: NDArray[np.int64] | None = None  # world cell at (0, 0)
        self._reference = math.nan
        self._moved = True  # since the evaluation function was computed
        self._elevation = np.full(shape, np.nan, dtype=np.float32)  # of the previous call
        self._score = np.full(shape, np.nan, dtype=np.float32)
        self._terms = [np.full(shape, np.nan, dtype=np.float32) for _ in range(2 * keep_terms)]  # slope and roughness
        self._even = np.full(shape, 0, dtype=np.uint8)  # bits 0 and 1 of `_ground`, without the limit of depth
        # Input of the evaluation function: bit 0 accessible, bit 1 refused, bit 2 known, bits 4 to 7 added margin [cells].
        self._ground = np.full(shape, 0, dtype=np.uint8)
        self._evaluation = np.full(shape, 0, dtype=np.int8)

    @classmethod
    def of(
        cls,
        shape: tuple[int, int],
        resolution: float,
        foot_radius: float,
        params: FootholdLayersParams,
        keep_terms: bool = False,
    ) -> Self:
        """Create the layers of a map for a foot radius [m]; the other arguments are those of the constructor."""
        margin = Margin(foot_radius, params.margin_sigmas, params.max_margin_m)
        return cls(shape, resolution, margin, params.score, params.foothold_map, keep_terms)

    def update(
        self,
        elevation: NDArray[np.float32],
        variance: NDArray[np.float32],
        first: NDArray[np.int64],
        body_height: float = math.inf,
        position_sigma: float = 0.0,
    ) -> Layers:
        """Update both layers for a map.

        1. Shift the layers with the window.
        2. Score the changed cells, and separate even ground from edges and slopes.
        3. Widen by the margin.
        4. Recompute the evaluation function where the foothold map changed.

        Args:
            elevation: (nx, ny) [m] {world}, NaN where unseen.
            variance: (nx, ny) [m^2] of it; NaN counts as zero.
            first: (2,) world index of cell (0, 0): two maps of the same ground differ by whole cells.
            body_height: [m] {world} height of the body's centre, to which Masri's depth limit refers; infinite for none.
            position_sigma: [m] standard deviation of the body position along x and y.

        Raises:
            ValueError: A shape is not the map's, a height is infinite, or the sigma is not a number of at least 0.
        """
        h = np.ascontiguousarray(elevation, dtype=np.float32)
        if h.shape != self.shape or variance.shape != self.shape or np.shape(first) != (2,):
            raise ValueError(
                f"maps {self.shape} and a cell (2,) expected, found {h.shape}, {variance.shape}, {np.shape(first)}"
            )
        if not 0 <= position_sigma < math.inf:
            raise ValueError(f"a position_sigma of at least 0 m expected, found {position_sigma}")
        reference = reference_height(h)
        parts = self._move(np.asarray(first, dtype=np.int64), reference, h)
        known = _rectangle_of(np.isfinite(h)) if parts else self._all
        for part in parts:
            self._clear(part)
        rescored = sum(self._rescore(h, band) for part in parts for band in _bands(_common(part, known)))
        self._elevation = h.copy()
        level = self._level(np.asarray(variance, dtype=np.float32), position_sigma)
        score = self._score.copy() if level is None else _worst_within(self._score, level)
        self._evaluate(h, self._depth_limit(body_height), level)
        return Layers(score, self._evaluation.copy(), rescored / h.size)

    def terms(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return slope [m/m] and roughness [m] (nx, ny) of the last map, read-only.

        They are NaN where the score is NaN.

        Raises:
            ValueError: The layers were created without keep_terms.
        """
        if not self._terms:
            raise ValueError("layers made with keep_terms=True expected, found some without")
        return self._terms[0], self._terms[1]

    @property
    def _all(self) -> Rectangle:
        return 0, self.shape[0], 0, self.shape[1]

    def _move(self, first: NDArray[np.int64], reference: float, elevation: NDArray[np.float32]) -> list[Rectangle]:
        """Shift the layers to the new window and return the parts to score."""
        before, self._first = self._first, first
        if before is None or reference != self._reference or (np.abs(first - before) >= self.shape).any():
            self._reference = reference
            self._score[:] = np.nan
            self._even[:] = 0
            for term in self._terms:
                term[:] = np.nan
            self._moved = True
            return [self._all]
        shift = first - before
        if shift.any():
            self._elevation = _shifted(self._elevation, shift, np.float32(np.nan))
            self._score = _shifted(self._score, shift, np.float32(np.nan))
            self._even = _shifted(self._even, shift, np.uint8(0))
            self._terms = [_shifted(term, shift, np.float32(np.nan)) for term in self._terms]
            self._moved = True
        changed = _changed(elevation.view(np.int32), self._elevation.view(np.int32))
        parts = [self._wider(changed, self._halo)] if changed[1] > changed[0] else []
        (nx, ny), k = self.shape, self._halo
        if shift[0]:
            parts.append((0, min(k, nx), 0, ny) if shift[0] > 0 else (max(nx - k, 0), nx, 0, ny))
        if shift[1]:
            parts.append((0, nx, 0, min(k, ny)) if shift[1] > 0 else (0, nx, max(ny - k, 0), ny))
        if parts and (parts[0][1] - parts[0][0]) * (parts[0][3] - parts[0][2]) > _WHOLE * elevation.size:
            return [self._all]
        return parts

    def _wider(self, part: Rectangle, by: int) -> Rectangle:
        i0, i1, j0, j1 = part
        return max(i0 - by, 0), min(i1 + by, self.shape[0]), max(j0 - by, 0), min(j1 + by, self.shape[1])

    def _clear(self, part: Rectangle) -> None:
        """Reset a part to unknown, as it is outside the known cells' rectangle."""
        here = slice(*part[:2]), slice(*part[2:])
        self._even[here] = 0
        for layer in (self._score, *self._terms):
            layer[here] = np.nan

    def _rescore(self, elevation: NDArray[np.float32], part: Rectangle) -> int:
        """Score a part of the map and return its number of cells."""
        i0, i1, j0, j1 = part
        a0, a1, b0, b1 = self._wider(part, self._halo)
        scored = self._scorer.evaluate(fill_small_holes(elevation[a0:a1, b0:b1]), self._reference)
        here, there = (slice(i0, i1), slice(j0, j1)), (slice(i0 - a0, i1 - a0), slice(j0 - b0, j1 - b0))
        self._score[here] = scored.score[there]
        for term, new in zip(self._terms, (scored.slope, scored.roughness), strict=False):
            term[here] = new[there]
        rules = self._evaluator.rules
        even = np.empty(scored.seen.shape, dtype=np.uint8)
        _tell_even(
            scored.complete.ravel(), scored.slope.ravel(), scored.roughness.ravel(),
            np.float32(math.tan(rules.slope_limit)), np.float32(rules.edge_deviation), even.ravel(),
        )  # fmt: skip
        self._even[here] = even[there]
        return (i1 - i0) * (j1 - j0)

    def _depth_limit(self, body_height: float) -> np.float32:
        return (
            np.float32(body_height - self._evaluator.rules.depth_limit) if math.isfinite(body_height) else np.float32(-np.inf)
        )

    def _level(self, variance: NDArray[np.float32], position_sigma: float) -> NDArray[np.uint8] | None:
        """Return the added margin (nx, ny) [cells] of each cell, or None if all are 0."""
        margin, weights, r = self._margin, self._scorer.weights, self._resolution
        room = weights.flat_radius - margin.foot_radius + r / 2  # [m] of sigmas until the first cell is added
        steps = [room + k * r for k in range(self._most + 1)]
        fixed = sum(step < 0 for step in steps)  # cells that the foot radius alone requires
        levels = np.array([*range(self._most + 1), TOO_WIDE], dtype=np.uint8)
        if fixed == len(steps) or margin.sigmas == 0:
            return np.full(self.shape, levels[fixed], dtype=np.uint8) if fixed else None
        limits = [np.float32((step / margin.sigmas) ** 2 - position_sigma**2) for step in steps[fixed:]]
        # A foothold of either layer: ground too steep for one may be a foothold for the other.
        foothold = (self._score <= np.float32(MAX_FOOTHOLD_SCORE)) | (self._even == 1)
        if limits[0] < 0 or fixed:
            added = np.where(foothold, np.uint8(fixed), np.uint8(0))
            v = np.where(np.isnan(variance), np.float32(0.0), variance)
            for limit in limits:
                added += foothold & (v > limit)
            return np.asarray(levels[added])
        doubtful = np.flatnonzero(foothold & (variance > limits[0]))  # usually few or none
        if not len(doubtful):
            return None
        level = np.zeros(self.shape, dtype=np.uint8)
        level.ravel()[doubtful] = levels[np.searchsorted(np.array(limits), variance.ravel()[doubtful])]
        return level

    def _evaluate(self, elevation: NDArray[np.float32], lowest: np.float32, level: NDArray[np.uint8] | None) -> None:
        """Update the evaluation function.

        Its range is long, and therefore a moved window needs a new one everywhere.
        """
        ground = np.empty(self.shape, dtype=np.uint8)
        _tell_ground(elevation.ravel(), self._even.ravel(), lowest, ground.ravel())
        if level is not None:
            ground |= level << 4
        changed = self._all if self._moved else _changed(ground, self._ground)
        self._ground, self._moved = ground, False
        if changed[1] <= changed[0]:
            return
        halo = self._evaluator.halo + self._most
        i0, i1, j0, j1 = part = self._wider(changed, halo)
        self._evaluation[i0:i1, j0:j1] = UNKNOWN
        # There is no ground outside the known cells' rectangle, so that part stays unknown.
        known = _rectangle_of(ground)
        i0, i1, j0, j1 = _common(part, known)
        a0, a1, b0, b1 = _common(self._wider(part, halo), known)
        if i1 <= i0 or j1 <= j0:
            return
        accessible, refused, seen = (np.asarray(ground[a0:a1, b0:b1] >> bit & 1, dtype=np.uint8) for bit in range(3))
        F = self._evaluator.evaluate(accessible, refused, seen, None if level is None else level[a0:a1, b0:b1])
        self._evaluation[i0:i1, j0:j1] = F[i0 - a0 : i1 - a0, j0 - b0 : j1 - b0]


def body_height_and_sigma(pose: BodyPose | None) -> tuple[float, float]:
    """Return the body's height [m] {world} and the standard deviation [m] of its place along the floor.

    The latter is that of the least certain horizontal axis. Without a pose the height is infinite, and so excludes no depth.
    """
    if pose is None:
        return math.inf, 0.0
    xy = pose.covariance[:2, :2]
    half, spread = (xy[0, 0] + xy[1, 1]) / 2, math.hypot((xy[0, 0] - xy[1, 1]) / 2, xy[0, 1])
    return float(pose.T_world_body[2, 3]), math.sqrt(max(0.0, half + spread))


def _rectangle_of(layer: NDArray[np.uint8] | NDArray[np.bool_]) -> Rectangle:
    """Return the bounding rectangle of nonzero cells, (0, 0, 0, 0) if there is none."""
    numbers = layer.view(np.uint8)
    return _changed(numbers, np.zeros_like(numbers))


def _common(a: Rectangle, b: Rectangle) -> Rectangle:
    return max(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), min(a[3], b[3])


def _bands(part: Rectangle) -> Iterator[Rectangle]:
    """Split a part into bands of rows whose scratch layers fit into the cache."""
    i0, i1, j0, j1 = part
    if i1 <= i0 or j1 <= j0:
        return
    number = max(1, round((i1 - i0) * (j1 - j0) / _BAND))
    for k in range(number):
        yield i0 + k * (i1 - i0) // number, i0 + (k + 1) * (i1 - i0) // number, j0, j1


def _worst_within(score: NDArray[np.float32], level: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the highest score within `level` cells of each cell.

    It is NaN for `TOO_WIDE`, and if a cell within that distance has no score or is outside the map.
    """
    worst = score.copy()
    worst[level == TOO_WIDE] = np.nan
    level = np.where(level == TOO_WIDE, np.uint8(0), level)
    i0, i1, j0, j1 = _rectangle_of(level)
    if i1 == 0:
        return worst
    level = level[i0:i1, j0:j1]
    most = int(level.max())
    nan = float(np.nan)
    block = score[max(i0 - most, 0) : i1 + most, max(j0 - most, 0) : j1 + most]
    beyond = (max(most - i0, 0), max(i1 + most - score.shape[0], 0), max(most - j0, 0), max(j1 + most - score.shape[1], 0))
    known = np.asarray(cv2.copyMakeBorder(block, *beyond, cv2.BORDER_CONSTANT, value=[nan]), dtype=np.float32)
    known[np.isnan(known)] = np.inf
    inner = slice(most, most + i1 - i0), slice(most, most + j1 - j0)
    for k in np.unique(level[level > 0]).tolist():
        around = cv2.dilate(known, DISCS[k])[inner]
        np.copyto(worst[i0:i1, j0:j1], around, where=level == k)
    worst[np.isinf(worst)] = np.nan
    return worst


def _shifted(layer: NDArray[Scalar], shift: NDArray[np.int64], fill: Scalar) -> NDArray[Scalar]:
    """Return a layer as seen from a window that moved by (2,) cells."""
    out = np.empty_like(layer)
    to, source = [], []
    for n, by in zip(layer.shape, shift.tolist(), strict=True):
        to.append(slice(max(-by, 0), n - max(by, 0)))
        source.append(slice(max(by, 0), n - max(-by, 0)))
    out[tuple(to)] = layer[tuple(source)]
    rows, columns = to
    out[: rows.start], out[rows.stop :], out[:, : columns.start], out[:, columns.stop :] = fill, fill, fill, fill
    return out


@compiled
def _changed(new: NDArray[np.integer], old: NDArray[np.integer]) -> Rectangle:
    """Return the bounding rectangle of the entries (nx, ny) that differ in any bit.

    It is (0, 0, 0, 0) if there is none.
    """
    nx, ny = new.shape
    columns = np.zeros(ny, dtype=np.uint8)
    first, end = nx, 0
    for i in range(nx):
        a, b = new[i], old[i]
        different = 0
        for j in range(ny):
            different |= a[j] ^ b[j]
        if different:
            first, end = min(first, i), i + 1
            for j in range(ny):
                columns[j] |= a[j] != b[j]
    if end == 0:
        return 0, 0, 0, 0
    left, right = 0, ny
    while not columns[left]:
        left += 1
    while not columns[right - 1]:
        right -= 1
    return first, end, left, right


@compiled
def _tell_even(
    complete: NDArray[np.uint8],
    slope: NDArray[np.float32],
    roughness: NDArray[np.float32],
    steepest: np.float32,
    edge: np.float32,
    even: NDArray[np.uint8],
) -> None:
    """Write 1 for even cells, 2 for edges and slopes, 0 for unknown. All arrays flat."""
    for k in range(len(even)):
        good = (slope[k] <= steepest) & (roughness[k] <= edge)
        even[k] = complete[k] * (1 if good else 2)


@compiled
def _tell_ground(
    elevation: NDArray[np.float32], even: NDArray[np.uint8], lowest: np.float32, ground: NDArray[np.uint8]
) -> None:
    """Write bit 0 accessible, bit 1 refused, bit 2 known. All arrays flat."""
    for k in range(len(ground)):
        ground[k] = elevation[k] == elevation[k]
    for k in range(len(ground)):
        deep = np.uint8(elevation[k] < lowest)
        ground[k] = np.uint8(ground[k] << np.uint8(2)) | (np.uint8(2) if deep else even[k])
