"""Drift of the poses in height, measured on well-known ground."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import CellLayers
from sextant.services.mapper.elevation.params import HeightDriftParams
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled


class HeightDrift:
    """Height offset of the newest poses from those at the start of the map.

    The offset is the median over well-known, undisputed cells, relative to their first established height. It counts only if
    it exceeds the sensor's errors at different distances and the noise of the scan, in several consecutive scans. It is then
    compensated, no faster than a pose drifts. A pose that jumps was corrected, or is wrong. This is no drift: it disputes the
    cells, and disputed cells are not used.

    Source: the drift compensation of elevation_mapping_cupy (Miki et al. 2022, section III-B). It uses the mean error
    and has no dead band. A map that does not move with its robot needs a dead band against its own noise.
    """

    def __init__(self, params: HeightDriftParams) -> None:
        """Start without drift."""
        self._params = params
        self.value = 0.0  # [m]
        self._lasts = 0  # consecutive scans with an offset, negative if downward

    def follow(self, cells: CellLayers, touched: NDArray[np.int64], z: Array, ray: Array, covariance: Array) -> None:
        """Update the drift with a scan.

        Args:
            cells: Cells of the map, before the scan is fused.
            touched: (m,) flat indices of the cells that the scan measures.
            z: (m,) [m] heights of the scan there.
            ray: (3,) [m] from the camera to the mean of the points.
            covariance: (6, 6) of the camera's pose: position, then rotation, in world axes.
        """
        params = self._params
        off = _offsets(
            touched, z, cells.height.ravel(), cells.variance.ravel(), cells.first.ravel(), cells.votes.ravel(),
            self.value, params.max_sigma_m**2, params.same_ground_m, params.every,
        )  # fmt: skip
        if len(off) < params.min_cells:
            return
        gap = _median(off)
        compensating = abs(self._lasts) >= params.scans
        if abs(gap) <= (params.end_m if compensating else params.begin_m):
            self._lasts = 0
            return
        spread = 1.25 * 1.48 * _median(np.abs(off - gap)) / math.sqrt(len(off) / params.correlated_cells)
        noise = math.hypot(height_sigma(ray, covariance), spread)
        if abs(gap) <= (noise if compensating else 3.0 * noise):
            self._lasts = 0
            return
        sign = 1 if gap > 0 else -1
        self._lasts = self._lasts + sign if self._lasts * sign >= 0 else sign
        if abs(self._lasts) >= params.scans:
            self.value += max(-params.rate_m, min(params.rate_m, gap))


def _median(values: NDArray[np.float64]) -> float:
    """Return the upper median of at least one number, faster than np.median."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def height_sigma(ray: NDArray[np.float64], S: NDArray[np.float64]) -> float:
    """Return the height sigma [m] of points near a ray (3,) [m] by the pose."""
    lift = np.array([0.0, 0.0, 1.0, ray[1], -ray[0], 0.0])
    return math.sqrt(max(float(lift @ S @ lift), 0.0))


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
    every: int,
) -> NDArray[np.float64]:
    """Return offsets (n,) [m] of usable cells from their first height, less drift."""
    out = np.empty(len(cells) // every + 1)
    n = 0
    for k in range(0, len(cells), every):
        c = np.uint64(cells[k])
        off = z[k] - drift - first[c]
        # Ground that has sunk or risen since, or that seems to after one wrong measurement, is not used.
        tells = (abs(off) < same) & (votes[c] == 0) & (variance[c] < most_variance) & (abs(height[c] - first[c]) < same)
        out[n] = off
        n += int(tells)
    return out[:n]
