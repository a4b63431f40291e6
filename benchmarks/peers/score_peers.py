"""Both foothold layers with filters of common libraries.

Their speed and results are compared. The results are the same except for rounding and ties.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.footholds.foothold_map import disc
from sextant.services.mapper.footholds.params import FootholdMapParams, ScoreParams
from sextant.shared.wire.messages import UNKNOWN

Layer = NDArray[np.float32]
Cells = NDArray[np.bool_]


class Scores(Protocol):
    """Evaluates how well each cell carries a foot, by both theses."""

    def layers(self, elevation: Layer) -> tuple[Layer, NDArray[np.int8]]:
        """Return score and evaluation function (nx, ny) of a map (nx, ny) [m].

        Formats are those of `mapper.footholds.layers.Layers`.
        """
        ...


class _Chain(ABC):
    """`sextant.FootholdLayers` with the filters of a library.

    It processes a whole map with certain heights.
    """

    def __init__(self, resolution: float, weights: ScoreParams, rules: FootholdMapParams):
        self._resolution, self._weights = resolution, weights
        self._flattest, self._evenest = math.tan(rules.slope_limit), rules.edge_deviation
        self._bound, self._reach = round(rules.bound / resolution), round(rules.reach / resolution)
        self._close = round((rules.closing / resolution - 1) / 2)
        self._square = np.ones((2 * self._close + 1, 2 * self._close + 1), dtype=np.bool_)
        self._vacant = disc(rules.unknown_clearance / resolution, least=0).astype(np.bool_)
        self._half = round(weights.flat_radius / resolution)
        self._sigma = weights.proximity_sigma / resolution
        self._disc = disc(weights.unknown_clearance / resolution).astype(np.bool_)
        self._neighbours = np.ones((3, 3), dtype=np.bool_)
        offsets = np.arange(-self._half, self._half + 1, dtype=np.float32)
        self._one, self._first, self._second = np.ones_like(offsets), offsets, offsets * offsets

    def layers(self, elevation: Layer) -> tuple[Layer, NDArray[np.int8]]:
        """Return both layers.

        They are the weighted sum of slope, proximity and roughness, and the signed distance on even ground that is not steep.
        """
        w = self._weights
        known = ~np.isnan(elevation)
        h = np.where(known, elevation - np.float32(np.nanmean(elevation)), np.float32(0.0))
        k = known.astype(np.float32)
        slope = np.hypot(self._sobel(h, 0), self._sobel(h, 1)) / np.float32(8.0 * self._resolution)
        proximity = np.abs(self._gaussian(h) / np.maximum(self._gaussian(k), np.float32(1e-6)) - h)
        roughness = self._roughness(h, k)
        score = w.slope * slope + w.proximity * proximity + w.roughness * roughness
        score = np.where(self._eroded(known, self._disc), score, np.float32(np.nan))
        complete = self._eroded(known, self._neighbours)
        even = (slope <= self._flattest) & (roughness <= self._evenest)
        return np.asarray(score, dtype=np.float32), self._evaluation(complete & even, complete & ~even, known)

    def _evaluation(self, accessible: Cells, refused: Cells, known: Cells) -> NDArray[np.int8]:
        """Return the signed distance.

        The accessible area is closed where nothing nearby was rejected, and excludes cells near vacant ground. The distance is
        inward or outward.
        """
        frame = 2 * self._close
        closed = self._closed(np.pad(accessible, frame), self._square)[frame:-frame, frame:-frame]
        ground = accessible | (closed & self._eroded(~refused, self._square))
        ground &= self._eroded(ground | known, self._vacant)
        inside = np.minimum(self._manhattan(np.pad(ground, 1))[1:-1, 1:-1], self._bound)
        outside = np.minimum(self._manhattan(~ground), self._reach) if ground.any() else np.full(ground.shape, self._reach)
        return np.where(known, np.where(ground, -inside, outside), UNKNOWN).astype(np.int8)

    def _roughness(self, h: Layer, k: Layer) -> Layer:
        """Return the deviation from a plane in each window.

        It uses ten masked moments, summed along one axis, then along the other.
        """
        one, first, second = self._one, self._first, self._second
        k0, k1, k2 = (self._along(k, weights, 0) for weights in (one, first, second))
        h0, h1 = (self._along(h, weights, 0) for weights in (one, first))
        square = self._along(h * h, one, 0)
        n = np.maximum(self._along(k0, one, 1), np.float32(1.0))
        a, b, z = self._along(k1, one, 1) / n, self._along(k0, first, 1) / n, self._along(h0, one, 1) / n
        aa = self._along(k2, one, 1) / n - a * a
        bb = self._along(k0, second, 1) / n - b * b
        ab = self._along(k1, first, 1) / n - a * b
        ah = self._along(h1, one, 1) / n - a * z
        bh = self._along(h0, first, 1) / n - b * z
        hh = self._along(square, one, 1) / n - z * z
        determinant = np.maximum(aa * bb - ab * ab, np.float32(1e-6))
        explained = (bb * ah * ah - np.float32(2.0) * ab * ah * bh + aa * bh * bh) / determinant
        noise = np.float32(self._weights.noise_sigma**2)
        return np.asarray(np.sqrt(np.maximum(hh - explained - noise, np.float32(0.0))))

    @abstractmethod
    def _sobel(self, image: Layer, axis: int) -> Layer:
        """Return the Sobel derivative along an axis."""

    @abstractmethod
    def _gaussian(self, image: Layer) -> Layer:
        """Smooth the image, with zeros beyond its border."""

    @abstractmethod
    def _along(self, image: Layer, weights: Layer, axis: int) -> Layer:
        """Return the sum over a window along an axis, with zeros beyond the border."""

    @abstractmethod
    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        """Erode cells; the outside of the border counts as False."""

    @abstractmethod
    def _closed(self, cells: Cells, square: Cells) -> Cells:
        """Morphological closing."""

    @abstractmethod
    def _manhattan(self, cells: Cells) -> NDArray[np.integer | np.floating]:
        """Return the Manhattan distance of each cell to the nearest False cell."""


class ScipyChain(_Chain):
    """SciPy's image filters."""

    def __init__(self, resolution: float, weights: ScoreParams, rules: FootholdMapParams):
        super().__init__(resolution, weights, rules)
        from scipy import ndimage

        self._nd: Any = ndimage

    def _sobel(self, image: Layer, axis: int) -> Layer:
        return np.asarray(self._nd.sobel(image, axis=axis))

    def _gaussian(self, image: Layer) -> Layer:
        return np.asarray(self._nd.gaussian_filter(image, self._sigma, radius=self._half, mode="constant"))

    def _along(self, image: Layer, weights: Layer, axis: int) -> Layer:
        if weights is self._one:  # a running sum, independent of the width
            return np.asarray(self._nd.uniform_filter1d(image, len(weights), axis=axis, mode="constant")) * len(weights)
        return np.asarray(self._nd.correlate1d(image, weights, axis=axis, mode="constant"))

    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        return np.asarray(self._nd.binary_erosion(cells, room))

    def _closed(self, cells: Cells, square: Cells) -> Cells:
        return np.asarray(self._nd.binary_closing(cells, square))

    def _manhattan(self, cells: Cells) -> NDArray[np.integer | np.floating]:
        return np.asarray(self._nd.distance_transform_cdt(cells, "taxicab"))


class ScikitImageChain(ScipyChain):
    """scikit-image filters.

    For weighted windows and Manhattan distances it has none, so SciPy's are used.
    """

    def __init__(self, resolution: float, weights: ScoreParams, rules: FootholdMapParams):
        super().__init__(resolution, weights, rules)
        from skimage import filters, morphology

        self._filters: Any = filters
        self._morphology: Any = morphology

    def _sobel(self, image: Layer, axis: int) -> Layer:
        return np.asarray(4.0 * (self._filters.sobel_h if axis == 0 else self._filters.sobel_v)(image))

    def _gaussian(self, image: Layer) -> Layer:
        truncate = self._half / self._sigma
        return np.asarray(self._filters.gaussian(image, self._sigma, mode="constant", truncate=truncate, preserve_range=True))

    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        return np.asarray(self._morphology.erosion(np.pad(cells, 1), room)[1:-1, 1:-1])

    def _closed(self, cells: Cells, square: Cells) -> Cells:
        return np.asarray(self._morphology.closing(cells, square))


class OpencvChain(_Chain):
    """OpenCV filters, combined with NumPy."""

    def _sobel(self, image: Layer, axis: int) -> Layer:
        dx, dy = (0, 1) if axis == 0 else (1, 0)  # OpenCV's y is our first axis
        return np.asarray(cv2.Sobel(image, cv2.CV_32F, dx, dy), dtype=np.float32)

    def _gaussian(self, image: Layer) -> Layer:
        width = 2 * self._half + 1
        return np.asarray(cv2.GaussianBlur(image, (width, width), self._sigma, borderType=cv2.BORDER_CONSTANT))

    def _along(self, image: Layer, weights: Layer, axis: int) -> Layer:
        here = np.ones(1, np.float32)
        kx, ky = (here, weights) if axis == 0 else (weights, here)
        return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, kx, ky, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)

    def _eroded(self, cells: Cells, room: Cells) -> Cells:
        eroded = cv2.erode(cells.view(np.uint8), room.view(np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=[0.0])
        return np.asarray(eroded, dtype=np.bool_)

    def _closed(self, cells: Cells, square: Cells) -> Cells:
        return np.asarray(cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_CLOSE, square.view(np.uint8)), dtype=np.bool_)

    def _manhattan(self, cells: Cells) -> NDArray[np.integer | np.floating]:
        return np.asarray(cv2.distanceTransform(cells.view(np.uint8), cv2.DIST_L1, cv2.DIST_MASK_3))


SCORE: Mapping[str, Callable[[float, ScoreParams, FootholdMapParams], Scores]] = {
    "SciPy": ScipyChain,
    "scikit-image": ScikitImageChain,
    "OpenCV + NumPy": OpencvChain,
}
