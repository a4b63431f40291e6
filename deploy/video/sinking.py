"""When what is weak of a terrain gave way, told by the feet that stood on it: a recording does not say it otherwise."""

from typing import TYPE_CHECKING

import numpy as np

from sextant.deploy.video.story import Story
from sextant.shared.geometry import Array

if TYPE_CHECKING:
    from sextant.services.simulator.physics.terrain import Terrain

_GIVEN = 0.008  # [m] below its top, at which a foot that carries tells that it gave way
_BESIDE = 0.02  # [m] of its edge a foot may stand
_SPEED = 0.25  # [m/s] at which it goes down, as the simulator lets it


class Sinking:
    """How deep each weak box of a terrain has sunk at a time."""

    def __init__(self, terrain: "Terrain", story: Story, radius: float):
        """Find when each gave way, under feet of a radius [m]."""
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
        """(k,) [m]"""
        return np.asarray(np.clip((t_ns - self._gave_ns) * 1e-9 * _SPEED, 0.0, self._sinks))
