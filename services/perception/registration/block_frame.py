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
        self.inverse_depth = np.zeros(self.shape)
        self._points = np.zeros((self.shape[0] * self.shape[1], 3))
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
        self.usual_share = _usual_share(depth_raw, self._bounds, self.block)
        self.valid = _reduce_blocks(
            depth_raw,
            self._bounds,
            self._scale,
            self.block,
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


def inverse_depth_sigma(intrinsics: Intrinsics, sensor: DepthSensor) -> float:
    """Return the one-sigma noise [1/m] of a pixel's inverse depth."""
    disparity_sigma = float(sensor.sigma(np.array(1.0), intrinsics.fx))
    rounding = 1.0 / (sensor.depth_scale * math.sqrt(12.0))
    return math.hypot(disparity_sigma, rounding)


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
    block: int,
    min_filled: float,
    max_variance: float,
    x: Array,
    y: Array,
    out: Array,
    points: Array,
) -> int:
    """Compute the inverse depth at the centre of each block, and the points.

    The inverse depth comes from the plane through the block's pixels, or is 0. The sums are first taken down the columns of
    a row of blocks. These loops have no branches and use few arrays each, so that the compiler can vectorise them.
    """
    rows, columns = out.shape
    width = columns * block
    middle = (block - 1) / 2.0
    whole = block * block
    needed = max(1, math.ceil(min_filled * whole))
    first, last, scale32 = np.int32(bounds[0]), np.int32(bounds[1]), np.float32(scale)
    there, w = np.empty(width, np.float32), np.empty(width, np.float32)
    # Per column: pixels, and the sums of v, v^2, w, w^2 and w v.
    pixels, of_v, of_vv = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    of_w, of_ww, of_wv = np.empty(width), np.empty(width), np.empty(width)
    sums, means = np.empty((10, columns)), np.empty(columns)
    valid = 0
    for i in range(rows):
        inside = np.int32(0)
        for a in range(block):
            line = raw[i * block + a]
            for c in range(width):
                r = np.int32(line[c])
                inside |= np.int32((r >= first) & (r <= last))
        out[i, :] = 0.0
        if inside == 0:
            continue
        pixels[:], of_v[:], of_vv[:], of_w[:], of_ww[:], of_wv[:] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(block):
            line = raw[i * block + a]
            v, v32, vv32 = a - middle, np.float32(a - middle), np.float32((a - middle) * (a - middle))
            for c in range(width):
                r = np.int32(line[c])
                known = (r >= first) & (r <= last)
                there[c] = np.float32(known)
                w[c] = scale32 / np.float32(r) if known else np.float32(0.0)
            for c in range(width):
                pixels[c] += there[c]
                of_v[c] += there[c] * v32
                of_vv[c] += there[c] * vv32
            for c in range(width):
                x64 = np.float64(w[c])
                of_w[c] += x64
                of_ww[c] += x64 * x64
                of_wv[c] += x64 * v
        # Per block: its pixels, and their sums of u, v, u^2, v^2, uv, w, w^2, w u and w v.
        for j in range(columns):
            n = su = suu = sv = svv = suv = s = ss = swu = swv = 0.0
            for b in range(block):
                at, u = np.uint64(j * block + b), b - middle
                n += pixels[at]
                su += u * pixels[at]
                suu += u * u * pixels[at]
                sv += of_v[at]
                suv += u * of_v[at]
                svv += of_vv[at]
                s += of_w[at]
                swu += u * of_w[at]
                ss += of_ww[at]
                swv += of_wv[at]
            sums[0, j], sums[1, j], sums[2, j], sums[3, j], sums[4, j] = n, su, sv, suu, svv
            sums[5, j], sums[6, j], sums[7, j], sums[8, j], sums[9, j] = suv, s, ss, swu, swv
        # The plane through them, and whether its residual is only noise. Missing pixels are scattered, so a branch would often
        # be mispredicted.
        for j in range(columns):
            n, su, sv, suu, svv = sums[0, j], sums[1, j], sums[2, j], sums[3, j], sums[4, j]
            suv, s, ss, swu, swv = sums[5, j], sums[6, j], sums[7, j], sums[8, j], sums[9, j]
            per_n = 1.0 / max(n, 1.0)
            mean = s * per_n
            cuu, cvv, cuv = suu - su * su * per_n, svv - sv * sv * per_n, suv - su * sv * per_n
            cwu, cwv = swu - mean * su, swv - mean * sv
            det = cuu * cvv - cuv * cuv
            per_det = 1.0 / max(det, 1e-9)
            gu, gv = (cwu * cvv - cwv * cuv) * per_det, (cwv * cuu - cwu * cuv) * per_det
            left = ss - s * mean - gu * cwu - gv * cwv
            few = n < 4.0  # for a plane and its residual
            flat = few | ((det >= 1e-9) & (left <= max_variance * (n - 3.0)))
            centre = mean if few else mean - (gu * su + gv * sv) * per_n
            means[j] = centre if (n >= needed) & flat else 0.0
        for j in range(columns):
            mean = means[j]
            if mean > 0.0:
                z = 1.0 / mean
                out[i, j] = mean
                points[valid, 0], points[valid, 1], points[valid, 2] = x[j] * z, y[i] * z, z
                valid += 1
    return valid


@compiled
def _fit_planes(inverse_depth: Array, x: Array, y: Array, sigma: float, limit: float, out: Array) -> None:
    """Fit the planes of `BlockFrame.fit_planes` to 5x5 blocks where flat, else 3x3."""
    rows, columns = inverse_depth.shape
    dx = x[1] - x[0]
    dy = y[1] - y[0]
    for i in range(rows):
        for j in range(columns):
            out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = out[i, j, 3] = 0.0
            centre = inverse_depth[i, j]
            if centre == 0.0:
                continue
            out[i, j, 3] = -1.0
            for half in (2, 1):
                if i < half or j < half or i >= rows - half or j >= columns - half:
                    continue
                s = ss = sa = sb = 0.0
                whole = True
                for a in range(-half, half + 1):
                    for b in range(-half, half + 1):
                        w = inverse_depth[i + a, j + b]
                        whole = whole and w != 0.0
                        d = w - centre
                        s += d
                        ss += d * d
                        sa += d * a
                        sb += d * b
                if not whole:
                    continue
                n = (2.0 * half + 1.0) ** 2
                m = n * half * (half + 1.0) / 3.0  # sum of a * a, and of b * b
                residual = (ss - s * s / n - (sa * sa + sb * sb) / m) / (n - 3.0)
                if residual > limit * limit:
                    continue
                A = sb / (m * dx)
                B = sa / (m * dy)
                out[i, j, 0] = A
                out[i, j, 1] = B
                out[i, j, 2] = centre + s / n - A * x[j] - B * y[i]
                out[i, j, 3] = sigma * sigma / (m * dx * dy)
                break
