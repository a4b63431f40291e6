"""Depth frame as an image of planes.

All computations use inverse depth, which is linear over the image of a plane. The mean over a block of pixels therefore lies
on the plane, its gradient gives the plane, and the noise of a triangulating camera is the same everywhere. The plane of a
pixel is pi = (A, B, C), its normal divided by its distance. A point p [m] in the camera frame lies on it if pi . p = 1.

A grid of blocks replaces the voxel grid of Masri 2016, section 4.3, and organised normals replace those of his eq. (4.3).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.runtime.compiled import compiled

Array = NDArray[Any]  # argument of compiled functions, any numeric type

_CORRELATION = 4.0  # pixels of a block that count as one, because neighbours share their disparity error
_MIN_FILLED = 0.5  # minimum share of measured pixels in a block
_USUAL_EVERY = 4  # every n-th row and column of blocks is sampled for the usual share
_MIN_OF_USUAL = 0.6  # of the usual share: the minimum where pixels are missing all over the frame
_AT_A_TIME = 64  # blocks per pass; their sums fit into the fastest cache
# Where the sums of 1, u, v, u^2, v^2, u v, w, w^2, u w and v w begin, behind the nearest pixel that w is relative to.
_N, _U, _V, _UU, _VV, _UV, _W, _WW, _UW, _VW = (np.uint64(k * _AT_A_TIME) for k in range(1, 11))


class BlockFrame:
    """One depth frame reduced to block means of inverse depth."""

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor, across: int = 160) -> None:
        """Create the frame of a camera with about `across` blocks per row.

        Raises:
            ValueError: There would be fewer than 8x8 blocks.
        """
        if across < 8:
            raise ValueError(f"at least 8 blocks across expected, found {across}")
        self._intrinsics = intrinsics
        self.block = max(1, round(intrinsics.width / across))
        self.shape = (intrinsics.height // self.block, intrinsics.width // self.block)
        if min(self.shape) < 8:
            raise ValueError(f"an image of at least 8x8 pixels expected, found {intrinsics.width}x{intrinsics.height}")
        middle = (self.block - 1) / 2
        self.x = (self.block * np.arange(self.shape[1]) + middle - intrinsics.cx) / intrinsics.fx
        self.y = (self.block * np.arange(self.shape[0]) + middle - intrinsics.cy) / intrinsics.fy
        self._bounds, self._scale = sensor.raw_bounds, sensor.depth_scale
        self.pixel_sigma = inverse_depth_sigma(intrinsics, sensor)
        self.sigma = self.pixel_sigma / math.sqrt(max(1.0, self.block**2 / _CORRELATION))
        self._sides = (0,) * self.block
        self.inverse_depth = np.zeros(self.shape)
        self._points = np.zeros((self.shape[0] * self.shape[1] + 1, 3))
        self._samples: tuple[int, NDArray[np.float32]] | None = None  # spacing and points of the last samples
        self.valid = 0
        self.usual_share = 1.0  # of measured pixels, in blocks that have any

    def load(self, depth_raw: NDArray[np.uint16]) -> None:
        """Reduce a frame (h, w) to blocks without edges and with enough pixels.

        A block needs at least half of its pixels. If pixels are missing all over the frame, 60 % of the usual share is enough.

        Raises:
            ValueError: The shape or type is not (h, w) uint16.
        """
        self._intrinsics.check_raw(depth_raw)
        max_variance = (3.0 * self.pixel_sigma) ** 2
        self._samples = None
        self.usual_share = _usual_share(depth_raw, self._bounds, self.block)
        self.valid = _reduce_blocks(
            depth_raw,
            self._bounds,
            self._scale,
            self._sides,
            min(_MIN_FILLED, _MIN_OF_USUAL * self.usual_share),
            max_variance,
            self.x,
            self.y,
            self.inverse_depth,
            self._points,
        )

    def fit_planes(self, planes: NDArray[np.float32]) -> None:
        """Write the planes (rows, columns, 4) of the loaded frame.

        The elements are A, B, C and the variance of the gradient. A, B and C are zero where there is no plane; the variance is
        then -1 at a measured block and 0 elsewhere.
        """
        _fit_planes(self.inverse_depth, self.x, self.y, self.sigma, 1.5 * self.pixel_sigma, planes)

    @property
    def points(self) -> NDArray[np.float64]:
        """Block means (n, 3) [m] {camera}, row by row; overwritten by the next frame."""
        return self._points[: self.valid]

    def samples(self, spacing: int, number: int) -> NDArray[np.float32]:
        """Return samples (number, 3, m) [m] {camera}: every `spacing`-th of the points, from the first, the second and so on.

        Samples with one point less than others end with zeros.
        """
        if self._samples is None or self._samples[0] != spacing or len(self._samples[1]) < number:
            made = np.zeros((number, 3, -(-self.valid // spacing)), dtype=np.float32)
            _sample(self.points, spacing, made)
            self._samples = spacing, made
        return self._samples[1]


def inverse_depth_sigma(intrinsics: Intrinsics, sensor: DepthSensor) -> float:
    """Return the one-sigma noise [1/m] of a pixel's inverse depth."""
    disparity_sigma = float(sensor.sigma(np.array(1.0), intrinsics.fx))
    rounding = 1.0 / (sensor.depth_scale * math.sqrt(12.0))
    return math.hypot(disparity_sigma, rounding)


@compiled
def _sample(points: Array, spacing: int, out: Array) -> None:
    """Write the samples of `BlockFrame.samples`."""
    for k in range(len(out)):
        for m, n in enumerate(range(k, len(points), spacing)):
            out[k, 0, m], out[k, 1, m], out[k, 2, m] = points[n, 0], points[n, 1], points[n, 2]


@compiled
def _usual_share(raw: Array, bounds: tuple[int, int], block: int) -> float:
    """Return the mean share of measured pixels in sampled blocks that have any, or 1."""
    first, last = bounds
    measured, blocks = 0, 0
    for i in range(0, raw.shape[0] - block + 1, _USUAL_EVERY * block):
        for j in range(0, raw.shape[1] - block + 1, _USUAL_EVERY * block):
            n = 0
            for a in range(i, i + block):
                for b in range(j, j + block):
                    n += int((raw[a, b] >= first) & (raw[a, b] <= last))
            measured += n
            blocks += int(n > 0)
    return measured / (blocks * block * block) if blocks else 1.0


@compiled
def _reduce_blocks(
    raw: Array,
    bounds: tuple[int, int],
    scale: float,
    sides: tuple[int, ...],
    min_filled: float,
    max_variance: float,
    x: Array,
    y: Array,
    out: Array,
    points: Array,
) -> int:
    """Compute the inverse depth at the centre of each block, and the points; return their number.

    The inverse depth comes from the plane through the block's pixels, or is 0. `sides` has one element per row of a block:
    its length is a constant of the compiled code.
    """
    rows, columns = out.shape
    block = len(sides)
    width = columns * block
    needed = np.float32(max(1, math.ceil(min_filled * block * block)))
    first, last, scale32 = np.int32(bounds[0]), np.int32(bounds[1]), np.float32(scale)
    w, means = np.empty((block, width), np.float32), np.empty(columns, np.float32)
    valid = 0
    for i in range(rows):
        bits = np.uint16(0)  # of all pixels: at least the largest of them
        for a in range(block):
            line = raw[i * block + a]
            for c in range(width):
                bits |= line[c]
        if bits < first:
            out[i, :] = 0.0
            continue
        for a in range(block):
            line, inverse = raw[i * block + a], w[a]
            for c in range(width):
                r = np.int32(line[c])
                inverse[c] = scale32 / np.float32(r) if (r >= first) & (r <= last) else np.float32(0.0)
        _fit_blocks(w, sides, needed, np.float32(max_variance), means)
        for j in range(columns):
            mean = np.float64(means[j])
            z = 1.0 / mean
            out[i, j] = mean
            points[valid, 0], points[valid, 1], points[valid, 2] = x[j] * z, y[i] * z, z
            valid += int(mean > 0.0)  # a point without depth is overwritten: missing blocks are scattered, and mispredicted
    return valid


@compiled
def _fit_blocks(w: Array, sides: tuple[int, ...], needed: np.float32, max_variance: np.float32, means: Array) -> None:
    """Fit a plane to each block of a row of blocks, and write its inverse depth at the centre, or 0.

    The loops over blocks have no branches, and their sums lie in one array, so that the compiler vectorises them.

    Args:
        w: (block, width) [1/m] inverse depths of the pixels, 0 for none.
        sides: One element per row of a block.
        needed: Number of pixels that a block needs.
        max_variance: [1/m^2] of the pixels about the plane.
        means: (columns,) [1/m], written.
    """
    block, columns = len(sides), len(means)
    pixels = w.reshape(w.size)
    middle, zero, one = np.float32((block - 1) / 2.0), np.float32(0.0), np.float32(1.0)
    sums = np.empty(11 * _AT_A_TIME, np.float32)
    for begin in range(0, columns, _AT_A_TIME):
        some = np.uint64(min(_AT_A_TIME, columns - begin))
        sums[:] = zero
        for a in range(block):
            line = pixels[a * w.shape[1] + begin * block :]
            for j in range(some):
                nearest = sums[j]
                for b in range(block):
                    value = line[j * np.uint64(block) + np.uint64(b)]
                    nearest = value if value > nearest else nearest
                sums[j] = nearest
        for a in range(block):
            line, v = pixels[a * w.shape[1] + begin * block :], np.float32(a) - middle
            for j in range(some):
                n = su = suu = s = ss = swu = zero
                for b in range(block):
                    value, u = line[j * np.uint64(block) + np.uint64(b)], np.float32(b) - middle
                    there = one if value > zero else zero
                    d = value - sums[j] if value > zero else zero
                    n += there
                    su += u * there
                    suu += u * u * there
                    s += d
                    ss += d * d
                    swu += u * d
                sums[_N + j] += n
                sums[_U + j] += su
                sums[_V + j] += v * n
                sums[_UU + j] += suu
                sums[_VV + j] += v * v * n
                sums[_UV + j] += v * su
                sums[_W + j] += s
                sums[_WW + j] += ss
                sums[_UW + j] += swu
                sums[_VW + j] += v * s
        # The plane through the pixels, and whether its residual is only noise.
        for j in range(some):
            n, su, sv, s = sums[_N + j], sums[_U + j], sums[_V + j], sums[_W + j]
            per_n = one / max(n, one)
            mean = s * per_n
            cuu, cvv = sums[_UU + j] - su * su * per_n, sums[_VV + j] - sv * sv * per_n
            cuv = sums[_UV + j] - su * sv * per_n
            cwu, cwv = sums[_UW + j] - mean * su, sums[_VW + j] - mean * sv
            det = cuu * cvv - cuv * cuv
            per_det = one / max(det, np.float32(1e-6))
            gu, gv = (cwu * cvv - cwv * cuv) * per_det, (cwv * cuu - cwu * cuv) * per_det
            left = sums[_WW + j] - s * mean - gu * cwu - gv * cwv
            few = n < np.float32(4.0)  # for a plane and its residual
            flat = few | ((det > np.float32(1e-5) * cuu * cvv) & (left <= max_variance * (n - np.float32(3.0))))
            centre = mean if few else mean - (gu * su + gv * sv) * per_n
            means[np.uint64(begin) + j] = sums[j] + centre if (n >= needed) & flat else zero


@compiled
def _fit_planes(inverse_depth: Array, x: Array, y: Array, sigma: float, limit: float, out: Array) -> None:
    """Fit the planes of `BlockFrame.fit_planes` to 5x5 blocks where flat, else 3x3.

    The loops of the sums have no branches and use few arrays each, so that the compiler can vectorise them.
    """
    rows, columns = inverse_depth.shape
    dx, dy = x[1] - x[0], y[1] - y[0]
    # Sums down columns, and then over squares of blocks, of 1, w, w^2, a w and b w; a and b count from the middle.
    down, square = np.empty((4, columns)), np.empty((5, columns))
    for i in range(rows):
        for j in range(columns):
            out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = np.float32(0.0)
            out[i, j, 3] = np.float32(-1.0) if inverse_depth[i, j] != 0.0 else np.float32(0.0)
        for half in (1, 2):
            if i < half or i >= rows - half:
                continue
            down[:], square[:] = 0.0, 0.0
            for a in range(-half, half + 1):
                line = inverse_depth[i + a]
                _add(down[0], line, 0)
                _add(down[1], line, 1)
                _add(down[2], line, 2)
                _add_times(down[3], line, float(a))
            inside = columns - 2 * half
            for b in range(2 * half + 1):
                for part in range(4):
                    _add(square[part, :inside], down[part, b : b + inside], 1)
                _add_times(square[4, :inside], down[1, b : b + inside], float(b - half))
            n = (2.0 * half + 1.0) ** 2
            m = n * half * (half + 1.0) / 3.0  # sum of a * a, and of b * b
            variance = sigma * sigma / (m * dx * dy)
            for k in range(inside):
                s, ss, sa, sb = square[1, k], square[2, k], square[3, k], square[4, k]
                residual = (ss - s * s / n - (sa * sa + sb * sb) / m) / (n - 3.0)
                if square[0, k] < n or residual > limit * limit:
                    continue
                A, B, j = sb / (m * dx), sa / (m * dy), k + half
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = A, B, s / n - A * x[j] - B * y[i]
                out[i, j, 3] = variance


@compiled
def _add(total: Array, values: Array, power: int) -> None:
    """Add powers of values, where the power 0 of 0 is 0."""
    if power == 0:
        for j in range(len(total)):
            total[j] += 1.0 if values[j] != 0.0 else 0.0
    elif power == 1:
        for j in range(len(total)):
            total[j] += values[j]
    else:
        for j in range(len(total)):
            total[j] += values[j] * values[j]


@compiled
def _add_times(total: Array, values: Array, factor: float) -> None:
    """Add values times a factor."""
    for j in range(len(total)):
        total[j] += factor * values[j]
