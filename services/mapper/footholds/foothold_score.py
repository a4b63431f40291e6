"""Walkability score of map cells, lower is better (Lotriet 2024, section 6.2).

score = slope * |gradient| + proximity * |mean height difference| + roughness * deviation from the local plane.

The first two terms are those of the thesis, with two constants corrected. Its Sobel kernels (6.1)-(6.2) are divided by
8 * resolution, so that the slope is the true gradient, 0.27 for 15 degrees. Its Gaussian kernel (6.4) sums to one over the
known cells, and the further division by n^2 is omitted, so that the proximity is in metres. (6.4) also repeats a sum that the
Frobenius product already contains, and its floors give an odd kernel one cell too many on one side. `published_score` is the
form of the thesis. Its constraints of reach and stability (6.2.3) are tests of the planner, not terms of the sum.

The third term is added here. The signed differences of (6.4) are meant to cancel on a slope. They also cancel halfway between a
step up and a step down (a narrow tread) and on a saddle, where Sobel does not respond either. The root mean square distance of
the surrounding cells from their least-squares plane is zero on any slope and cancels nowhere. It also separates a low step two
cells away from noise better than (6.4), whose noise is that of the centre cell alone.
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.footholds.foothold_map import disc
from sextant.services.mapper.footholds.params import ScoreParams
from sextant.shared.runtime.compiled import compiled
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE

Scalar = TypeVar("Scalar", bound=np.generic)

_REFERENCE_STEP = 0.0625  # [m]


@dataclass(frozen=True, slots=True)
class Walkability:
    """Score of each cell.

    It is NaN and not acceptable if the cell is unknown or too close to an unknown one.
    """

    score: NDArray[np.float32]  # (nx, ny) weighted sum of the three terms, relative to the limit of the parameters
    acceptable: NDArray[np.bool_]  # (nx, ny) score of at most `MAX_FOOTHOLD_SCORE`


@dataclass(frozen=True, slots=True)
class ScoreTerms:
    """Terms of a score, NaN where the score is NaN."""

    slope: NDArray[np.float32]  # (nx, ny) [m/m] magnitude of the gradient
    proximity: NDArray[np.float32]  # (nx, ny) [m] magnitude of the weighted mean height difference
    roughness: NDArray[np.float32]  # (nx, ny) [m] deviation from the local plane beyond the noise


class WalkabilityScorer:
    """Scorer of maps of one shape, or of their parts.

    The scratch layers are reused; results of `score` are new arrays.
    """

    def __init__(self, shape: tuple[int, int], resolution: float, weights: ScoreParams | None = None) -> None:
        """Create a scorer for maps of a shape (nx, ny) and a resolution [m].

        Raises:
            ValueError: The map is smaller than 3x3, or flat_radius exceeds 25 cells; less than one counts as one.
        """
        self.weights = weights or ScoreParams()
        if len(shape) != 2 or min(shape) < 3:
            raise ValueError(f"map of at least 3x3 cells expected, found {shape}")
        if not 0 < resolution < math.inf:
            raise ValueError(f"positive resolution expected, found {resolution}")
        self.shape = shape
        self.resolution = resolution
        self._half = max(1, round(self.weights.flat_radius / resolution))
        if self._half > 25:
            raise ValueError(
                f"flat_radius of at most 25 cells expected, found {self.weights.flat_radius} m at {resolution} m per cell"
            )
        self._near_unknown = disc(self.weights.unknown_clearance / resolution)
        self._neighbours = disc(0.0)
        # [cells] range of the cells that a score depends on.
        self.halo = max(self._half, self._near_unknown.shape[0] // 2)
        self._floats = [np.full(shape, 0, dtype=np.float32) for _ in range(10)]
        self._bytes = [np.full(shape, 0, dtype=np.uint8) for _ in range(3)]
        for layer in self._floats[6:]:
            layer[:] = np.nan
        terms, masks = self._floats[6:], self._bytes
        self._scored = Scored(terms[0], terms[1], terms[2], terms[3], masks[0], masks[1], masks[2])

    def score(self, elevation: NDArray[np.float32]) -> Walkability:
        """Score a map; everything outside its border is unknown.

        Args:
            elevation: (nx, ny) [m], NaN where unseen; any constant may be added without changing the result.

        Raises:
            ValueError: The shape is not the scorer's, or a height is infinite.
        """
        h = np.ascontiguousarray(elevation, dtype=np.float32)
        if h.shape != self.shape:
            raise ValueError(f"map of shape {self.shape} expected, found {h.shape}")
        score = self.evaluate(h, reference_height(h)).score.copy()
        return Walkability(score, score <= np.float32(MAX_FOOTHOLD_SCORE))

    def evaluate(self, elevation: NDArray[np.float32], reference: float) -> "Scored":
        """Score a map or a part of it; the next call overwrites the result.

        1. Mask unknown cells with height 0 and weight 0. A cell is evaluable if neither its neighbours nor any cell within
           the clearance is unknown.
        2. Slope: Sobel over the 3x3 known cells (Lotriet 2024, eq. 6.1-6.3).
        3. Proximity: Gaussian mean of the known cells minus the cell (eq. 6.4), a normalised convolution.
        4. Roughness: deviation of the known cells from their least-squares plane.
        5. The weighted sum, relative to the limit.

        Args:
            elevation: (a, b) [m] contiguous, at most the scorer's shape, NaN where unseen; the outside is unknown.
            reference: [m] near the heights. It is subtracted from them, for accurate sums in single precision.
        """
        shape = elevation.shape
        height, known, gx, gy, mean, weight, slope, proximity, roughness, score = (_part(f, shape) for f in self._floats)
        seen, complete, evaluable = (_part(b, shape) for b in self._bytes)
        _mask_unknown(elevation.ravel(), np.float32(reference), height.ravel(), known.ravel(), seen.ravel())
        # The outside is unknown: the mask is eroded and blurred against zeros.
        for room, out in ((self._neighbours, complete), (self._near_unknown, evaluable)):
            cv2.erode(seen, room, dst=out, borderType=cv2.BORDER_CONSTANT, borderValue=[0.0])
        scale = 1.0 / (8.0 * self.resolution)
        cv2.Sobel(height, cv2.CV_32F, 0, 1, dst=gx, ksize=3, scale=scale)  # OpenCV's y is our first axis
        cv2.Sobel(height, cv2.CV_32F, 1, 0, dst=gy, ksize=3, scale=scale)
        kernel = (2 * self._half + 1, 2 * self._half + 1)
        sigma = self.weights.proximity_sigma / self.resolution
        cv2.GaussianBlur(height, kernel, sigma, dst=mean, borderType=cv2.BORDER_CONSTANT)
        cv2.GaussianBlur(known, kernel, sigma, dst=weight, borderType=cv2.BORDER_CONSTANT)
        w = self.weights
        _plane_deviation(height, known, complete, self._half, w.noise_sigma, roughness)
        flat = [layer.ravel() for layer in (slope, proximity, roughness)]
        _slope_and_proximity(gx.ravel(), gy.ravel(), height.ravel(), mean.ravel(), weight.ravel(), flat[0], flat[1])
        for term in flat:
            _mask(complete.ravel(), term)
        weights = w.slope / w.limit, w.proximity / w.limit, w.roughness / w.limit
        _weighted_sum(flat[0], flat[1], flat[2], weights, score.ravel())
        _mask(evaluable.ravel(), score.ravel())
        self._scored = Scored(slope, proximity, roughness, score, seen, complete, evaluable)
        return self._scored

    def terms(self) -> ScoreTerms:
        """Copy the terms of the last score, for display; all NaN before the first."""
        s = self._scored
        return ScoreTerms(*(np.where(s.evaluable, term, np.float32(np.nan)) for term in (s.slope, s.proximity, s.roughness)))


@dataclass(frozen=True, slots=True)
class Scored:
    """Part of a map with its score and terms."""

    slope: NDArray[np.float32]  # (a, b) [m/m] as in `ScoreTerms`, where complete
    proximity: NDArray[np.float32]  # (a, b) [m] where complete
    roughness: NDArray[np.float32]  # (a, b) [m] where complete
    score: NDArray[np.float32]  # (a, b) where evaluable
    seen: NDArray[np.uint8]  # (a, b) 1 where there is a height
    complete: NDArray[np.uint8]  # (a, b) 1 where the eight neighbours also have one
    evaluable: NDArray[np.uint8]  # (a, b) 1 where all cells within the clearance have one


def reference_height(elevation: NDArray[np.float32]) -> float:
    """Return a height [m] near the mean of a map (nx, ny), or 0 for an unknown map.

    It is rounded so that it rarely changes.

    Raises:
        ValueError: A height is infinite.
    """
    total = np.zeros((2, elevation.shape[1]), dtype=np.float32)
    _add_known(elevation, total[0], total[1])
    number = float(total[1].sum(dtype=np.float64))
    mean = float(total[0].sum(dtype=np.float64)) / max(number, 1.0)
    if not math.isfinite(mean):
        raise ValueError("heights finite or NaN expected, found an infinite one")
    return round(mean / _REFERENCE_STEP) * _REFERENCE_STEP


def published_score(
    elevation: NDArray[np.float32], slope: float, proximity: float, kernel: int = 5, sigma: float = 1.5
) -> NDArray[np.float32]:
    """Compute the score as in the thesis, for comparison.

    It is the sum of (6.3) and (6.4) with all their constants, without the roughness.

    Args:
        elevation: (nx, ny) [m], NaN where unseen.
        slope: [1/m] C_g, factor of the sum of Sobel's kernel, which is 8 cell edges times the gradient.
        proximity: [1/m] C_p, factor of the mean, which is divided by n^2 once more.
        kernel: [cells] n, odd.
        sigma: [cells] standard deviation of the Gaussian kernel K, which sums to one.

    Returns:
        (nx, ny) score, NaN where a kernel reaches an unknown cell or the border.

    Raises:
        ValueError: The kernel is even or smaller than 3.

    Source: Lotriet 2024, eq. (6.1)-(6.4).
    """
    if kernel < 3 or kernel % 2 == 0:
        raise ValueError(f"an odd kernel of at least 3 cells expected, found {kernel}")
    nan = float(np.nan)
    frame = kernel // 2
    h = cv2.copyMakeBorder(elevation, frame, frame, frame, frame, cv2.BORDER_CONSTANT, value=[nan])
    gx, gy = cv2.Sobel(h, cv2.CV_32F, 0, 1, ksize=3), cv2.Sobel(h, cv2.CV_32F, 1, 0, ksize=3)
    column = cv2.getGaussianKernel(kernel, sigma, cv2.CV_32F)
    difference = cv2.filter2D(h, cv2.CV_32F, column @ column.T) - h
    score = slope * np.sqrt(gx**2 + gy**2) + proximity * np.abs(difference / kernel**2)
    return np.asarray(score[frame:-frame, frame:-frame], dtype=np.float32)


def _part(layer: NDArray[Scalar], shape: tuple[int, ...]) -> NDArray[Scalar]:
    """Return the memory of a scratch layer as a contiguous one of a smaller shape."""
    return layer if layer.shape == shape else layer.reshape(-1)[: shape[0] * shape[1]].reshape(shape)


@compiled
def _add_known(elevation: NDArray[np.float32], total: NDArray[np.float32], number: NDArray[np.float32]) -> None:
    """Add the known heights of a map (nx, ny), and their number, to column sums (ny,)."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for i in range(len(elevation)):
        row = elevation[i]
        for j in range(len(row)):
            z = row[j]
            total[j] += z if z == z else zero
            number[j] += one if z == z else zero


@compiled
def _mask_unknown(
    elevation: NDArray[np.float32],
    reference: np.float32,
    height: NDArray[np.float32],
    known: NDArray[np.float32],
    seen: NDArray[np.uint8],
) -> None:
    """Write heights relative to the reference, or 0, and the mask. Arrays flat."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for k in range(len(elevation)):
        z = elevation[k]
        height[k] = z - reference if z == z else zero
        known[k] = one if z == z else zero
    for k in range(len(elevation)):
        seen[k] = elevation[k] == elevation[k]


@compiled
def _add_moments(
    source: NDArray[np.float32],
    x: float,
    zeroth: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
) -> None:
    """Add a row, multiplied by 1, x and x^2, to three rows."""
    x1, x2 = np.float32(x), np.float32(x * x)
    for j in range(len(source)):
        z = source[j]
        zeroth[j] += z
        first[j] += x1 * z
        second[j] += x2 * z


@compiled
def _add_two_moments(source: NDArray[np.float32], x: float, zeroth: NDArray[np.float32], first: NDArray[np.float32]) -> None:
    """Add a row, multiplied by 1 and x, to two rows."""
    x1 = np.float32(x)
    for j in range(len(source)):
        z = source[j]
        zeroth[j] += z
        first[j] += x1 * z


@compiled
def _add(source: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Add a row to another row."""
    for j in range(len(source)):
        total[j] += source[j]


@compiled
def _add_height_moments(
    source: NDArray[np.float32],
    x: float,
    zeroth: NDArray[np.float32],
    first: NDArray[np.float32],
    square: NDArray[np.float32],
) -> None:
    """Add z, x * z and z^2 of a row of heights z to three rows."""
    x1 = np.float32(x)
    for j in range(len(source)):
        z = source[j]
        zeroth[j] += z
        first[j] += x1 * z
        square[j] += z * z


@compiled
def _divide_by_count(n: NDArray[np.float32], a: NDArray[np.float32], b: NDArray[np.float32], h: NDArray[np.float32]) -> None:
    """Convert three sums to means, in place; the count becomes its inverse."""
    for j in range(len(n)):
        w = np.float32(1.0) / max(n[j], np.float32(1.0))  # an empty window is masked later
        n[j] = w
        a[j] *= w
        b[j] *= w
        h[j] *= w


@compiled
def _central(
    moment: NDArray[np.float32], w: NDArray[np.float32], mean: NDArray[np.float32], other: NDArray[np.float32]
) -> None:
    """Convert a sum of products to a covariance, in place."""
    for j in range(len(moment)):
        moment[j] = moment[j] * w[j] - mean[j] * other[j]


@compiled
def _residual(
    aa: NDArray[np.float32],
    bb: NDArray[np.float32],
    ab: NDArray[np.float32],
    ah: NDArray[np.float32],
    bh: NDArray[np.float32],
    hh: NDArray[np.float32],
    noise: float,
    out: NDArray[np.float32],
) -> None:
    """Compute the deviation of h from its regression on a and b, from covariances.

    The noise is subtracted in squares.
    """
    noise2, least, zero, two = np.float32(noise * noise), np.float32(1e-6), np.float32(0.0), np.float32(2.0)
    for j in range(len(out)):
        # The determinant is positive where a cell is evaluable, because its 3x3 neighbourhood is known.
        determinant = max(aa[j] * bb[j] - ab[j] * ab[j], least)
        explained = (bb[j] * ah[j] * ah[j] - two * ab[j] * ah[j] * bh[j] + aa[j] * bh[j] * bh[j]) / determinant
        out[j] = math.sqrt(max(hh[j] - explained - noise2, zero))


@compiled
def _plane_deviation(
    height: NDArray[np.float32],
    known: NDArray[np.float32],
    evaluable: NDArray[np.uint8],
    half: int,
    noise: float,
    out: NDArray[np.float32],
) -> None:
    """Compute the RMS distance [m] of the known cells of a window from their plane.

    The plane is the least-squares fit. The noise is subtracted in squares. `out` is written from the first to the last
    evaluable cell of each row. The ten masked moments of a square window (a along the first axis, b along the second, h the
    height) are separable. They are summed over its rows first, and then along the row. Each short loop uses few arrays, so
    that the compiler vectorises it.
    """
    nx, ny = height.shape
    rows = np.zeros((6, ny + 2 * half), dtype=np.float32)  # sums over the window's rows of 1, a, aa, h, ah, hh
    window = np.zeros((10, ny), dtype=np.float32)
    N, B, BB, A, AB, AA, H, BH, AH, HH = (
        window[0], window[1], window[2], window[3], window[4],
        window[5], window[6], window[7], window[8], window[9],
    )  # fmt: skip
    for i in range(nx):
        first, last = 0, ny - 1
        while first < ny and not evaluable[i, first]:
            first += 1
        if first == ny:
            continue
        while not evaluable[i, last]:
            last -= 1
        width = last + 1 - first
        rows[:] = 0.0
        window[:] = 0.0
        # Element 0 of a row of `rows` belongs to the cell first - half, element 0 of `window` to the cell first.
        low, high = max(first - half, 0), min(last + half + 1, ny)
        inner = slice(low - (first - half), high - (first - half))
        n, a, aa, h, ah, hh = (
            rows[0, inner], rows[1, inner], rows[2, inner], rows[3, inner], rows[4, inner], rows[5, inner],
        )  # fmt: skip
        for di in range(max(-half, -i), min(half, nx - 1 - i) + 1):
            _add_moments(known[i + di, low:high], di, n, a, aa)
            _add_height_moments(height[i + di, low:high], di, h, ah, hh)
        for dj in range(-half, half + 1):
            seen = slice(half + dj, half + dj + width)
            _add_moments(rows[0, seen], dj, N, B, BB)
            _add_two_moments(rows[1, seen], dj, A, AB)
            _add(rows[2, seen], AA)
            _add_two_moments(rows[3, seen], dj, H, BH)
            _add(rows[4, seen], AH)
            _add(rows[5, seen], HH)
        _divide_by_count(N, A, B, H)
        _central(AA, N, A, A)
        _central(BB, N, B, B)
        _central(AB, N, A, B)
        _central(AH, N, A, H)
        _central(BH, N, B, H)
        _central(HH, N, H, H)
        _residual(AA, BB, AB, AH, BH, HH, noise, out[i, first : last + 1])


@compiled
def _slope_and_proximity(
    gx: NDArray[np.float32],
    gy: NDArray[np.float32],
    height: NDArray[np.float32],
    mean: NDArray[np.float32],
    weight: NDArray[np.float32],
    slope: NDArray[np.float32],
    proximity: NDArray[np.float32],
) -> None:
    """Compute the gradient's magnitude and the normalised mean minus the cell.

    The results are not masked. All arrays are flat.
    """
    least = np.float32(1e-6)
    for k in range(len(slope)):
        slope[k] = math.sqrt(gx[k] * gx[k] + gy[k] * gy[k])
    for k in range(len(proximity)):
        proximity[k] = abs(mean[k] / max(weight[k], least) - height[k])


@compiled
def _mask(evaluable: NDArray[np.uint8], layer: NDArray[np.float32]) -> None:
    """Set a layer to NaN where it is not evaluable. All arrays flat."""
    nan = np.float32(np.nan)
    for k in range(len(layer)):
        layer[k] = layer[k] if evaluable[k] else nan


@compiled
def _weighted_sum(
    slope: NDArray[np.float32],
    proximity: NDArray[np.float32],
    roughness: NDArray[np.float32],
    weights: tuple[float, float, float],
    score: NDArray[np.float32],
) -> None:
    """Compute the score, NaN where a term is NaN. All arrays flat."""
    c_slope, c_proximity, c_roughness = np.float32(weights[0]), np.float32(weights[1]), np.float32(weights[2])
    for k in range(len(score)):
        score[k] = c_slope * slope[k] + c_proximity * proximity[k] + c_roughness * roughness[k]
