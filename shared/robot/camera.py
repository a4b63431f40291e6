"""Pinhole depth camera: intrinsics, range, noise model, and points of its pixels.

The camera frame is the optical frame: x right, y down, z forward. Depth is the z coordinate of a point, not its distance.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.shared.files import config
from sextant.shared.wire import topics
from sextant.shared.wire.messages import MAX_GRAY

_GRAY_PIXELS = 320 * 240  # [px] of a grey image, approximately
_MOST_PIXELS = min(topics.cells_that_fit(topics.DEPTH), topics.cells_that_fit(topics.COLOR))


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole projection: u = fx * x / z + cx, v = fy * y / z + cy.

    Pixel centres have integer u and v.
    """

    width: int  # [px] of the picture
    height: int  # [px] of the picture
    fx: float  # [px] focal length along u
    fy: float  # [px] focal length along v
    cx: float  # [px] u of the optical axis
    cy: float  # [px] v of the optical axis

    checks = (
        *config.each("width height", lambda pixels: 1 <= pixels <= 4096, "1 to 4096 pixels"),
        *config.each("fx fy", lambda length: 1 <= length <= 1e5, "a focal length of 1 to 100000 pixels"),
        config.together(
            "width height",
            lambda width, height: width * height <= _MOST_PIXELS,
            f"at most {_MOST_PIXELS} pixels in all, which a message of {topics.DEPTH.key} has room for",
        ),
        *config.each("cx cy", lambda centre: abs(centre) <= 1e5, "at most 100000 pixels either way"),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def gray_factor(self) -> int:
        """Number of pixels of the depth image along each edge of a pixel of the grey image."""
        least = math.ceil(max(self.width, self.height) / MAX_GRAY)
        return max(least, round(math.sqrt(self.width * self.height / _GRAY_PIXELS)))

    @property
    def gray(self) -> "Intrinsics":
        """Intrinsics of the grey image."""
        k = self.gray_factor
        middle = (k - 1) / 2
        cx, cy = (self.cx - middle) / k, (self.cy - middle) / k
        return Intrinsics(self.width // k, self.height // k, self.fx / k, self.fy / k, cx, cy)

    def check_raw(self, depth: NDArray[np.uint16]) -> None:
        """Check that a raw depth image is a (h, w) uint16 array.

        Raises:
            ValueError: The shape or dtype is wrong.
        """
        if depth.shape != (self.height, self.width) or depth.dtype != np.uint16:
            raise ValueError(f"uint16 depth image {(self.height, self.width)} expected, found {depth.dtype} {depth.shape}")

    def points(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Compute the points (h, w, 3) [m] {camera} of a depth image (h, w) [m].

        NaN stays NaN.

        Source: Lotriet 2024, eq. (4.6)-(4.8).
        """
        if depth.shape != (self.height, self.width):
            raise ValueError(f"depth image {(self.height, self.width)} expected, found {depth.shape}")
        return self.points_of(np.arange(self.width), np.arange(self.height)[:, None], depth)

    def points_of(self, u: NDArray[np.integer], v: NDArray[np.integer], depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Compute the points (..., 3) [m] {camera} of pixels (u, v).

        u, v and depth [m] have the shape (...).
        """
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack([depth * x, depth * y, depth], axis=-1, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class DepthSensor:
    """Range, noise and quantisation of a depth camera.

    The noise of a triangulating camera is sigma = z^2 * disparity_sigma / (fx * baseline). PrimeSense devices also quantise the
    disparity.
    """

    rate_hz: float = 30.0  # [Hz] frames per second
    min_range: float = 0.5  # [m] nearer surfaces give no return
    max_range: float = 3.5  # [m] farther surfaces give no return
    baseline: float = 0.075  # [m] projector to sensor
    disparity_sigma: float = 0.05  # [px] Gaussian
    disparity_step: float = 0.125  # [px] quantisation, 0 for none
    depth_scale: float = 1000.0  # raw units per metre: 1000 for millimetres

    checks = (
        *config.each("rate_hz", lambda rate: 0.1 <= rate <= 1000, "0.1 to 1000 Hz"),
        *config.each("min_range max_range", lambda range_m: 0 < range_m <= 100, "more than 0 and at most 100 m"),
        *config.each("baseline", lambda length: 0 < length <= 10, "more than 0 and at most 10 m"),
        *config.each("depth_scale", lambda scale: 1 <= scale <= 1e6, "1 to 1000000 raw units per metre"),
        *config.each("disparity_sigma disparity_step", lambda noise: noise >= 0, "at least 0 pixels"),
        config.together("min_range max_range", lambda low, high: low < high, "min_range below max_range"),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def raw_bounds(self) -> tuple[int, int]:
        """Lowest and highest raw depth value within range."""
        lowest = math.ceil(self.min_range * self.depth_scale - 1e-6)
        return max(lowest, 1), min(math.floor(self.max_range * self.depth_scale + 1e-6), 65535)

    def sigma(self, z: NDArray[np.float64], fx: float) -> NDArray[np.float64]:
        """Compute the standard deviation [m] of the depth at z [m].

        It includes noise and quantisation.
        """
        disparity = np.hypot(self.disparity_sigma, self.disparity_step / np.sqrt(12.0))
        return np.asarray(z**2 * disparity / (fx * self.baseline))
