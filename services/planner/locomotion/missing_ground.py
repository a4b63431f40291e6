"""Places where a foot found no ground, whatever the camera says: no foot goes there again."""

from dataclasses import replace

import numpy as np

from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import HAZARDS, ActuatorState, TerrainMap

_RADIUS = 0.04  # [m] around such a place
_KEPT = 64  # places remembered, the newest
_NO_GROUND = HAZARDS.index("no ground by touch")
_REFUSED = 2.0  # a score that no foothold has


class Holes:
    """Remembers what feet have found by what the legs say of them."""

    def __init__(self) -> None:
        """Begin without any."""
        self.places: Array = np.zeros((0, 2))  # [m] {world}
        self._heard_ns = np.full(6, -1, dtype=np.int64)
        self._marked: tuple[TerrainMap, int, Terrain] | None = None  # for how many places a map was marked last
        self._count = 0

    def update(self, state: ActuatorState, T_world_odom: Array) -> None:
        """Take in the newest findings."""
        new = (state.touch_ns != self._heard_ns) & ~state.touch_carries & (state.touch_ns >= 0)
        self._heard_ns = state.touch_ns.copy()
        if new.any():
            found = apply(T_world_odom, state.touch[new])[:, :2]
            self.places = np.concatenate([self.places, found])[-_KEPT:]
            self._count += len(found)

    def marked(self, terrain: Terrain) -> Terrain:
        """The same terrain with these places refused."""
        if not len(self.places):
            return terrain
        if self._marked is None or self._marked[0] is not terrain.map or self._marked[1] != self._count:
            self._marked = (terrain.map, self._count, self._mark(terrain))
        return self._marked[2]

    def _mark(self, terrain: Terrain) -> Terrain:
        m = terrain.map
        x, y = (m.origin[k] + m.resolution * np.arange(m.elevation.shape[k]) for k in (0, 1))
        score, evaluation = m.score.copy(), m.evaluation.copy()
        hazard = m.hazard.copy() if m.hazard.size else np.zeros(m.score.shape, dtype=np.uint8)
        for place in self.places:
            i, j = (np.flatnonzero(np.abs(axis - at) <= _RADIUS) for axis, at in zip((x, y), place, strict=True))
            near = (x[i, None] - place[0]) ** 2 + (y[None, j] - place[1]) ** 2 <= _RADIUS**2
            box = np.ix_(i, j)
            score[box] = np.where(near, np.maximum(score[box], np.float32(_REFUSED)), score[box])
            evaluation[box] = np.where(near, np.maximum(evaluation[box], np.int8(1)), evaluation[box])
            hazard[box] = np.where(near, np.uint8(_NO_GROUND), hazard[box])
        return replace(terrain, map=replace(m, score=score, evaluation=evaluation, hazard=hazard))
