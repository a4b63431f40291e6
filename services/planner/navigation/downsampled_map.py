"""A map in coarse cells, and what is around each: extremes, means and distances over squares of cells."""

from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array

Mask = NDArray[np.bool_]
Layer = TypeVar("Layer", bound=NDArray[Any])

_AGREE = 2  # cells of the map that must be as high, so that one wrong measurement makes no wall


@dataclass(frozen=True, slots=True)
class CoarseMap:
    """A map in coarse cells, from the cell `first` (2,) of the world's grid on."""

    first: NDArray[np.int64]
    layers: dict[str, Array]  # (n, m) each, by name


def coarse(terrain: Terrain, block: int) -> CoarseMap:
    """A map by blocks of block x block cells that lie on the world's grid of them; what its border cuts off is left out.

    Layers: known, share [1] of the cell; footing, share of it that carries a foot; bare, share of what is known of it that has
    no foothold in reach; high and low [m] {world}, of as many cells as must agree, NaN where nothing is known.
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
    reach = max(1, int(0.04 / terrain.map.resolution))  # a square within the 6 cm that are searched
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
    return CoarseMap(first, layers)


def shifted(layer: Layer, by: int, axis: int, fill: float) -> Layer:
    """A layer moved along an axis, filled where nothing comes from."""
    out = np.full_like(layer, fill)
    source, target = [slice(None), slice(None)], [slice(None), slice(None)]
    n = layer.shape[axis]
    if abs(by) < n:
        source[axis], target[axis] = slice(max(-by, 0), n - max(by, 0)), slice(max(by, 0), n + min(by, 0))
        out[tuple(target)] = layer[tuple(source)]
    return cast(Layer, out)


def over_square(layer: Layer, before: int, after: int, take: np.ufunc, fill: float) -> Layer:
    """The extreme of a layer over squares from `before` cells before to `after` cells behind each."""
    for axis in (0, 1):
        layer = take.reduce([shifted(layer, by, axis, fill) for by in range(-after, before + 1)])
    return layer


def dilated(mask: Mask, reach: int) -> Mask:
    """A mask with so many cells more to every side."""
    return over_square(mask, reach, reach, np.logical_or, False)


def wide(mask: Mask, width: int) -> Mask:
    """What of a mask is covered by squares of so many cells that lie in it."""
    inside = over_square(mask, 0, width - 1, np.logical_and, False)
    return over_square(inside, width - 1, 0, np.logical_or, False)


def closed(low: Array, width: int) -> Array:
    """Ground (n, m) [m] with what is low and narrower than so many cells filled up to beside it; NaN where unknown."""
    reach = width // 2
    raised = over_square(np.where(np.isnan(low), -np.inf, low), reach, reach, np.maximum, -np.inf)
    lowered = over_square(np.where(np.isinf(raised), np.inf, raised), reach, reach, np.minimum, np.inf)
    return np.asarray(np.where(np.isnan(low), np.nan, lowered))


def lowest_around(ground: Array) -> Array:
    """The lowest known ground of each cell and its eight neighbours, inf for none."""
    return over_square(np.where(np.isnan(ground), np.inf, ground), 1, 1, np.minimum, np.inf)


def mean_around(layer: Array, reach: int) -> Array:
    """The mean of a layer over squares of so many cells to every side, the border's cells going on beyond it."""
    wide = np.pad(layer, reach + 1, mode="edge")
    total = wide.cumsum(axis=0).cumsum(axis=1)
    k = 2 * reach + 1
    return np.asarray((total[k:-1, k:-1] - total[: -k - 1, k:-1] - total[k:-1, : -k - 1] + total[: -k - 1, : -k - 1]) / k**2)


def distance(mask: Mask, most: float) -> Array:
    """Distance (n, m) [cells] to the nearest cell of a mask, at most so much."""
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
