"""When weak terrain gave way, estimated from the feet that stood on it.

A recording does not contain this directly.
"""

from typing import TYPE_CHECKING

import numpy as np

from sextant.evaluation.video.timeline import Timeline
from sextant.shared.geometry import Array

if TYPE_CHECKING:
    from sextant.services.simulator.physics.terrain import Terrain

_GIVEN = 0.008  # [m] depth of a loaded foot below the top from which the box has given way
_BESIDE = 0.02  # [m] a foot may stand beyond its edge
_SPEED = 0.25  # [m/s] sinking speed, as in the simulator


class Sinking:
    """Depth of each weak box of a terrain over time."""

    def __init__(self, terrain: "Terrain", story: Timeline, radius: float):
        """Find when each box gave way, under feet of a radius [m]."""
        self._sinks = terrain.weak.sinks
        self._gave_ns = np.full(len(terrain.weak), np.inf)
        if not len(terrain.weak) or not story.truth.said:
            return
        feet = np.array([m.feet for m in story.truth.said])
        carries = np.array([m.contact for m in story.truth.said])
        boxes = terrain.boxes
        for k, box in enumerate(terrain.weak.box):
            p = (feet - boxes.centre[box]) @ boxes.R[box]
            over = (np.abs(p[..., :2]) < boxes.half[box, :2] + _BESIDE).all(axis=-1) & carries
            below = over & (p[..., 2] - radius < boxes.half[box, 2] - _GIVEN) & (p[..., 2] > -boxes.half[box, 2])
            found = np.flatnonzero(below.any(axis=1))
            if len(found):
                self._gave_ns[k] = story.truth.at_ns[found[0]] - _GIVEN / _SPEED * 1e9

    def at(self, t_ns: int) -> Array:
        """Return the depth (k,) [m] of each weak box at a time [ns]."""
        return np.asarray(np.clip((t_ns - self._gave_ns) * 1e-9 * _SPEED, 0.0, self._sinks))
