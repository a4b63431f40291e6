"""Synthetic terrain maps."""

from collections.abc import Callable

import numpy as np
import pytest

from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import TerrainMap

RESOLUTION = 0.01


def terrain_of(
    height: Callable[[Array, Array], Array] = lambda x, y: 0.0 * x,
    score: Callable[[Array, Array], Array] = lambda x, y: 0.0 * x,
    evaluation: Callable[[Array, Array], Array] = lambda x, y: 0.0 * x - 5.0,
    stamp_ns: int = 0,
    half: float = 1.0,
    origin: tuple[float, float] = (0.0, 0.0),
) -> Terrain:
    """Return a map of heights [m], scores and evaluations [cells].

    The layers are functions of x and y [m] {world}.
    """
    n = round(2 * half / RESOLUTION) + 1
    low = np.array(origin) - half
    x, y = np.meshgrid(low[0] + RESOLUTION * np.arange(n), low[1] + RESOLUTION * np.arange(n), indexing="ij")
    elevation = np.asarray(height(x, y), dtype=np.float32)
    return Terrain(
        TerrainMap(
            stamp_ns=stamp_ns,
            resolution=RESOLUTION,
            origin=low,
            elevation=elevation,
            variance=np.full_like(elevation, 1e-6),
            score=np.asarray(score(x, y), dtype=np.float32),
            assumed=np.zeros(elevation.shape, dtype=bool),
            evaluation=np.asarray(evaluation(x, y), dtype=np.int8),
        )
    )


@pytest.fixture
def make_terrain() -> Callable[..., Terrain]:
    """Return the function that makes maps."""
    return terrain_of
