"""Downsampled map and filters over squares of cells: extremes, means, distances."""

from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array

Mask = NDArray[np.bool_]
Layer = TypeVar("Layer", bound=NDArray[Any])

_AGREE = 2  # cells of the map that must agree in height, so that one wrong measurement makes no wall


@dataclass(frozen=True, slots=True)
class DownsampledMap:
    """A downsampled map; its first cell has index `first` (2,) in the world grid."""

    first: NDArray[np.int64]
    layers: dict[str, Array]  # (n, m) each, by name


def downsample(terrain: Terrain, block: int) -> DownsampledMap:
    """Downsample a map to blocks of block x block cells, aligned with the world grid.

    Incomplete blocks at the border are dropped. Layers: known, share [1] of known cells; footing, share [1] of cells that carry
    a foot; bare, share [1] of the known cells without a foothold in reach; high and low [m] {world}, extreme heights on which
    `_AGREE` cells agree, NaN where nothing is known.
    """
    first_fine = np.floor(terrain.map.origin / terrain.map.resolution + 1e-6).astype(np.int64)
    first = -(-first_fine // block)
    skip = first * block - first_fine
    n, m = np.maximum(np.array(terrain.map.elevation.shape) - skip, 0) // block
    cut = np.s_[skip[0] : skip[0] + n * block, skip[1] : skip[1] + m * block]

    def blocks(layer: Layer) -> Layer:
        return cast(Layer, layer[cut].reshape(n, block, m, block).transpose(0, 2, 1, 3).reshape(n, m, block * block))

    height = terrain.map.elevation
    known, foothold = np.isfinite(height), terrain.footholds()
    reach = max(1, int(0.04 / terrain.map.resolution))  # a square within the search radius of 6 cm
    bare = known & ~dilated(foothold, reach)
    count = blocks(known).sum(axis=2)
    rank = np.clip(np.minimum(_AGREE, count) - 1, 0, None)[..., None]
    tops = np.sort(blocks(np.where(known, -height, np.inf)), axis=2)
    lows = np.sort(blocks(np.where(known, height, np.inf)), axis=2)
    nothing = count == 0
    layers = {
        "known": count / block**2,
        "footing": blocks(foothold).mean(axis=2),
        "bare": blocks(bare).sum(axis=2) / np.maximum(count, 1),
        "high": np.where(nothing, np.nan, -np.take_along_axis(tops, rank, axis=2)[..., 0]),
        "low": np.where(nothing, np.nan, np.take_along_axis(lows, rank, axis=2)[..., 0]),
    }
    return DownsampledMap(first, layers)


def shifted(layer: Layer, by: int, axis: int, fill: float) -> Layer:
    """Return a layer shifted along an axis, with a fill value at the border."""
    out = np.full_like(layer, fill)
    source, target = [slice(None), slice(None)], [slice(None), slice(None)]
    n = layer.shape[axis]
    if abs(by) < n:
        source[axis], target[axis] = slice(max(-by, 0), n - max(by, 0)), slice(max(by, 0), n + min(by, 0))
        out[tuple(target)] = layer[tuple(source)]
    return cast(Layer, out)


def over_square(layer: Layer, before: int, after: int, take: np.ufunc, fill: float) -> Layer:
    """Return the extreme of a layer over squares around each cell.

    The squares reach from `before` cells before to `after` cells behind the cell.
    """
    for axis in (0, 1):
        layer = take.reduce([shifted(layer, by, axis, fill) for by in range(-after, before + 1)])
    return layer


def dilated(mask: Mask, reach: int) -> Mask:
    """Return a mask dilated by `reach` cells to every side."""
    return over_square(mask, reach, reach, np.logical_or, False)


def wide(mask: Mask, width: int) -> Mask:
    """Return the part of a mask that squares of `width` cells inside the mask cover."""
    inside = over_square(mask, 0, width - 1, np.logical_and, False)
    return over_square(inside, width - 1, 0, np.logical_or, False)


def closed(low: Array, width: int) -> Array:
    """Return ground (n, m) [m] with depressions narrower than `width` cells filled.

    Unknown cells stay NaN.
    """
    reach = width // 2
    raised = over_square(np.where(np.isnan(low), -np.inf, low), reach, reach, np.maximum, -np.inf)
    lowered = over_square(np.where(np.isinf(raised), np.inf, raised), reach, reach, np.minimum, np.inf)
    return np.asarray(np.where(np.isnan(low), np.nan, lowered))


def lowest_around(ground: Array) -> Array:
    """Return the lowest known ground of each cell and its eight neighbours, else inf."""
    return over_square(np.where(np.isnan(ground), np.inf, ground), 1, 1, np.minimum, np.inf)


def mean_around(layer: Array, reach: int) -> Array:
    """Return the mean of a layer over squares of `reach` cells to every side.

    The border cells are repeated beyond the border.
    """
    wide = np.pad(layer, reach + 1, mode="edge")
    total = wide.cumsum(axis=0).cumsum(axis=1)
    k = 2 * reach + 1
    return np.asarray((total[k:-1, k:-1] - total[: -k - 1, k:-1] - total[k:-1, : -k - 1] + total[: -k - 1, : -k - 1]) / k**2)


def distance(mask: Mask, most: float) -> Array:
    """Return the distance (n, m) [cells] to the nearest cell of a mask, clipped."""
    reach = int(np.ceil(most))
    along = np.where(mask, 0.0, np.inf)
    for by in range(1, reach + 1):
        for sign in (1, -1):
            along = np.minimum(along, np.where(shifted(mask, sign * by, 0, False), float(by), np.inf))
    squared = along**2
    for by in range(1, reach + 1):
        for sign in (1, -1):
            squared = np.minimum(squared, shifted(along, sign * by, 1, np.inf) ** 2 + by**2)
    return np.asarray(np.minimum(np.sqrt(squared), most))
