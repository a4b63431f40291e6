"""Places where a foot found no ground.

They are never used as footholds again, even if the camera shows ground there.
"""

from dataclasses import replace

import numpy as np

from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import HAZARDS, MAX_FOOTHOLD_SCORE, ActuatorState, TerrainMap

_RADIUS = 0.04  # [m] around such a place that is refused
_KEPT = 64  # maximum number of places, the newest
_NO_GROUND = HAZARDS.index("no ground by touch")
_REFUSED = np.float32(MAX_FOOTHOLD_SCORE + 1.0)  # score of such a place


class MissingGround:
    """Remembers places where the actuator reported a foot without ground."""

    def __init__(self) -> None:
        """Start without places."""
        self.places: Array = np.zeros((0, 2))  # [m] {world}
        self._heard_ns = np.full(6, -1, dtype=np.int64)
        self._marked: tuple[TerrainMap, int, Terrain] | None = None  # map, count and result of the last call
        self.count = 0  # of all places so far

    def update(self, state: ActuatorState, T_world_odom: Array) -> None:
        """Add the newest places from the actuator's state."""
        new = (state.touchdown_ns != self._heard_ns) & ~state.touchdown_contact & (state.touchdown_ns >= 0)
        self._heard_ns = state.touchdown_ns.copy()
        if new.any():
            found = apply(T_world_odom, state.touchdown_point[new])[:, :2]
            self.places = np.concatenate([self.places, found])[-_KEPT:]
            self.count += len(found)

    def marked(self, terrain: Terrain) -> Terrain:
        """Return the terrain with these places marked as no footholds."""
        if not len(self.places):
            return terrain
        if self._marked is None or self._marked[0] is not terrain.map or self._marked[1] != self.count:
            self._marked = (terrain.map, self.count, self._mark(terrain))
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
            score[box] = np.where(near, np.maximum(score[box], _REFUSED), score[box])
            evaluation[box] = np.where(near, np.maximum(evaluation[box], np.int8(1)), evaluation[box])
            hazard[box] = np.where(near, np.uint8(_NO_GROUND), hazard[box])
        return replace(terrain, map=replace(m, score=score, evaluation=evaluation, hazard=hazard))
