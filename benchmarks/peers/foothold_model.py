"""Accuracy of the map model of Masri's thesis compared with the elevation map.

Both are built on the same rides, and evaluated on the same cells.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.true_ground import INTERIOR, TrueGround, rms
from sextant.shared.geometry import Array
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message, PassageMap, PassageRequest, TerrainMap, Tick

ORIGIN, LENGTH, WIDTH = (0.3, 0.0), 2.7, 1.0  # [m] of the strip, along the ride


class Asker:
    """Requests the survey of a strip ahead while it runs."""

    name = "asker"
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.PASSAGE_REQUEST,)

    def __init__(self) -> None:
        self.trigger = Every.hz(topics.PASSAGE_REQUEST.rate_hz)
        self.stages = Stages()

    def step(self, tick: Tick, _: Inbox) -> Iterator[Message]:
        """Repeat the request."""
        yield PassageRequest(tick.stamp_ns, np.array(ORIGIN), 0.0, LENGTH, WIDTH)

    def status(self) -> str:
        """Return the request as text."""
        return "asking for a passage"


@dataclass(frozen=True, slots=True)
class ModelFigures:
    """Accuracy of a strip survey.

    It is evaluated off edges, on cells that are also known in the elevation map.
    """

    rmse: float  # [m]
    elevation_rmse: float  # [m] of the elevation map
    normal_deg: float  # [deg] root mean square
    coverage: float  # share of the visible cells that are known


def judged(passage: PassageMap, terrain: TerrainMap, truth: TrueGround, seen: NDArray[np.bool_]) -> ModelFigures:
    """Compare a survey along x with the truth and the elevation map, where both exist.

    Args:
        passage: The survey.
        terrain: The elevation map.
        truth: The ground under the elevation map.
        seen: (nx, ny) cells of the elevation map that were in view.

    Raises:
        ValueError: The survey's cells are not aligned with those of the elevation map.
    """
    first = (passage.origin - terrain.origin) / terrain.resolution
    cell = np.round(first).astype(np.int64)
    if passage.resolution != terrain.resolution or passage.heading != 0.0 or np.abs(first - cell).max() > 1e-3:
        raise ValueError("a survey aligned with the cells of the elevation map expected, found one off the grid")
    low = np.maximum(cell, 0)
    high = np.minimum(cell + passage.elevation.shape, terrain.elevation.shape)
    here = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    there = tuple(slice(a - c, b - c) for a, b, c in zip(low, high, cell, strict=True))
    heights, model, elevation = truth.heights[here], passage.elevation[there], terrain.elevation[here]
    even = (truth.edge_distance[here] > INTERIOR) & np.isfinite(heights) & np.isfinite(model)
    both = even & np.isfinite(elevation)
    normals = passage.normals[there] / 32767.0
    cosine = (normals * _true_normals(truth)[here]).sum(axis=-1)[even & normals.any(axis=-1)]
    angle = np.degrees(np.arccos(np.clip(cosine[np.isfinite(cosine)], -1.0, 1.0)))
    return ModelFigures(
        rmse=rms((model - heights)[both]),
        elevation_rmse=rms((elevation - heights)[both]),
        normal_deg=rms(angle),
        coverage=float(np.isfinite(model)[seen[here]].mean()) if seen[here].any() else math.nan,
    )


def _true_normals(truth: TrueGround) -> Array:
    """Return upward normals (nx, ny, 3) of the true ground.

    They are computed from the differences of each cell's neighbours.
    """
    slopes = np.stack([np.gradient(truth.heights, truth.resolution, axis=k) for k in (0, 1)], axis=-1)
    n = np.concatenate([-slopes, np.ones((*truth.heights.shape, 1))], axis=-1)
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))
