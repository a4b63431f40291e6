"""How far the poses of scans have drifted in height, by ground that is well known."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.cell_layers import Cells
from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled

TELLS = 8  # every how many cells are asked
KNOWN_WELL = 0.004  # [m] one sigma of a cell that tells of drift; beside an edge it is more
SAME_GROUND = 0.03  # [m] further off it is not the same ground
FEWEST = 50  # cells that can tell of drift
ALIKE = 6  # neighbouring cells share their errors: so many of those asked count as one
DRIFTED, LEVEL_AGAIN = 0.002, 0.0005  # [m] offset from which on, and down to which, drift is compensated
PERSISTS = 3  # scans in a row that must show it
RATE = 0.002  # [m] by which the compensation changes in a scan, at most


class HeightDrift:
    """By how much newer poses lie higher than those that a map was begun with.

    Ground as it was first seen tells, where it is well known and not disputed: by the median over all such cells, and only if
    that is off by more than the sensor's own errors at different distances come to, and than the scan's noise, for a few
    scans in a row. Then it is led back, no faster than a pose drifts. A pose that leaps has been corrected, or is wrong;
    either way it is no drift: it disputes the cells, and disputed cells tell nothing.

    Source: the drift compensation of elevation_mapping_cupy (Miki et al. 2022, section III-B), there of the mean error and
    without a dead band, which a map that does not move with its robot needs against its own noise.
    """

    def __init__(self) -> None:
        """Begin without any."""
        self.value = 0.0  # [m]
        self._lasts = 0  # for how many scans in a row it has been off, negative where downward

    def follow(self, cells: Cells, touched: NDArray[np.int64], z: Array, ray: Array, covariance: Array) -> None:
        """Amend it by a scan.

        Args:
            cells: Of the map, before the scan is fused.
            touched: (m,) flat indices of those that the scan measures.
            z: (m,) [m] the heights that it gives them.
            ray: (3,) [m] from the camera to the middle of them.
            covariance: (6, 6) of the camera's pose: position, then rotation, in world axes.
        """
        off = _offsets(
            touched, z, cells.height.ravel(), cells.variance.ravel(), cells.first.ravel(), cells.votes.ravel(),
            self.value, KNOWN_WELL**2, SAME_GROUND,
        )  # fmt: skip
        if len(off) < FEWEST:
            return
        gap = _median(off)
        compensating = abs(self._lasts) >= PERSISTS
        if abs(gap) <= (LEVEL_AGAIN if compensating else DRIFTED):
            self._lasts = 0
            return
        spread = 1.25 * 1.48 * _median(np.abs(off - gap)) / math.sqrt(len(off) / ALIKE)
        noise = math.hypot(height_sigma(ray, covariance), spread)
        if abs(gap) <= (noise if compensating else 3.0 * noise):
            self._lasts = 0
            return
        sign = 1 if gap > 0 else -1
        self._lasts = self._lasts + sign if self._lasts * sign >= 0 else sign
        if abs(self._lasts) >= PERSISTS:
            self.value += max(-RATE, min(RATE, gap))


def _median(values: NDArray[np.float64]) -> float:
    """The upper median of at least one number; np.median looks for both middle numbers and for NaN."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def height_sigma(ray: NDArray[np.float64], S: NDArray[np.float64]) -> float:
    """One sigma [m] by which a pose covariance (6, 6) lifts points around a ray (3,) [m] from the camera."""
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
) -> NDArray[np.float64]:
    """How far heights less the drift lie over where the ground was first seen, of every few cells that can tell (n,) [m]."""
    out = np.empty(len(cells) // TELLS + 1)
    n = 0
    for k in range(0, len(cells), TELLS):
        c = np.uint64(cells[k])
        off = z[k] - drift - first[c]
        # Ground that has sunk or risen since, by itself or by one wrong look, tells nothing.
        tells = (abs(off) < same) & (votes[c] == 0) & (variance[c] < most_variance) & (abs(height[c] - first[c]) < same)
        out[n] = off
        n += int(tells)
    return out[:n]
