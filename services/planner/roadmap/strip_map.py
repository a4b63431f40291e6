"""Strip map for the search: heights, evaluation function and pose."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, from_xyz_rpy, inverse
from sextant.shared.wire.messages import UNKNOWN, PassageMap

KNOWN_SHARE = 0.3  # [1] known share of a row of cells, below which the known ground ends


@dataclass(frozen=True, eq=False)
class StripMap:
    """A strip with frame {strip}: x along it, y to the left, z up.

    The origin is in the middle of its near side at world height 0. Cell (i, j) is centred at
    resolution * (i + 1/2, j + 1/2 - ny / 2).
    """

    elevation: NDArray[np.float32]  # (nx, ny) [m] {strip}, NaN where unknown
    evaluation: NDArray[np.int8]  # (nx, ny) [cells] Masri's F, 127 where unknown
    resolution: float  # [m]
    T_world_strip: Array  # (4, 4)

    def __post_init__(self) -> None:
        if self.elevation.shape != self.evaluation.shape or self.elevation.ndim != 2 or min(self.elevation.shape) < 3:
            found = f"{self.elevation.shape} and {self.evaluation.shape}"
            raise ValueError(f"heights and evaluations of one shape, at least 3 x 3, expected, found {found}")
        if not 0.0 < self.resolution < np.inf:
            raise ValueError(f"a positive resolution expected, found {self.resolution}")

    @classmethod
    def of(cls, passage: PassageMap) -> "StripMap":
        """Convert the mapper's passage map."""
        along = np.array([np.cos(passage.heading), np.sin(passage.heading)])
        left = np.array([-along[1], along[0]])
        ny = passage.elevation.shape[1]
        near = passage.origin + passage.resolution * (-0.5 * along + (0.5 * ny - 0.5) * left)
        T = from_xyz_rpy([near[0], near[1], 0.0], (0.0, 0.0, passage.heading))
        evaluation = np.where(np.isfinite(passage.elevation), passage.evaluation, np.int8(UNKNOWN))
        return cls(np.ascontiguousarray(passage.elevation), np.ascontiguousarray(evaluation), passage.resolution, T)

    @cached_property
    def T_strip_world(self) -> Array:
        """Return the inverse (4, 4) of `T_world_strip`."""
        return inverse(self.T_world_strip)

    @property
    def first_cell(self) -> tuple[float, float]:
        """Return the centre of cell (0, 0) [m] {strip}."""
        return 0.5 * self.resolution, 0.5 * self.resolution * (1 - self.elevation.shape[1])

    @cached_property
    def top(self) -> NDArray[np.float32]:
        """Return the highest known ground (nx, ny) [m] of each cell and its neighbours.

        It is -inf where nothing is known.
        """
        h = np.where(np.isnan(self.elevation), np.float32(-np.inf), self.elevation)
        for axis in range(2):
            out = h.copy()
            first, last = [slice(None)] * 2, [slice(None)] * 2
            first[axis], last[axis] = slice(0, -1), slice(1, None)
            out[tuple(first)] = np.maximum(out[tuple(first)], h[tuple(last)])
            out[tuple(last)] = np.maximum(out[tuple(last)], h[tuple(first)])
            h = out
        return np.ascontiguousarray(h)

    def lowest_ground(self, place: Array) -> float:
        """Return the lowest known ground [m] around a place (2,) or (3,) [m] {strip}, or NaN.

        The 3x3 cells around the place count.
        """
        i, j = np.rint((place[:2] - self.first_cell) / self.resolution).astype(np.int64)
        around = self.elevation[max(i - 1, 0) : max(i + 2, 0), max(j - 1, 0) : max(j + 2, 0)]
        known = around[np.isfinite(around)]
        return float(known.min()) if known.size else np.nan

    def known_until(self, start: float, half_width: float) -> float:
        """Return the end [m] of the known ground from a place on.

        It is the end of the last row with a sufficient share of known cells. Rows before it may have unseen cells, such as the
        floor of a gap behind its edge. No foot goes there.

        Args:
            start: [m] start of the search.
            half_width: [m] of the band around the middle line that counts.
        """
        nx, ny = self.elevation.shape
        y = (np.arange(ny) + 0.5) * self.resolution - 0.5 * ny * self.resolution
        known = (self.evaluation != UNKNOWN)[:, np.abs(y) <= half_width].mean(axis=1)
        first = min(max(0, int(start / self.resolution)), nx)
        rows = np.flatnonzero(known[first:] >= KNOWN_SHARE)
        return float((first + (int(rows[-1]) + 1 if len(rows) else 0)) * self.resolution)
