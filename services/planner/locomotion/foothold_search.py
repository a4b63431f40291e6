"""Foothold search: Lotriet's semi-radial search with limits of reach and distance.

The thesis searches squares of growing size, so a corner cell may win over a nearer one. Here cells are tried in the order of
their true distance (Lotriet 2024, section 6.3).
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.terrain import GOOD, NONE, Terrain
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import HAZARDS

Reachable = Callable[[Array], NDArray[np.bool_]]


@dataclass(frozen=True, slots=True)
class Foothold:
    """A place for a foot."""

    p_world: Array  # (3,) [m] ground under the foot
    moved: float  # [m] from its nominal place
    room: float  # suitability, see `Terrain.suitability`


@dataclass(frozen=True, slots=True)
class NoFoothold:
    """Reason why there is no foothold."""

    reason: str
    unseen: bool = False  # most of the candidate cells are unseen


def offsets_by_distance(radius: float, resolution: float) -> Array:
    """Return offsets (n, 2) [m] of all cells within a radius, the nearest first.

    Equal distances have a fixed order.
    """
    n = int(np.ceil(radius / resolution))
    i, j = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij")
    offsets = np.stack([i.ravel(), j.ravel()], axis=1)
    squared = (offsets**2).sum(axis=1)
    order = np.lexsort((offsets[:, 1], offsets[:, 0], squared))
    near = order[squared[order] * resolution**2 <= radius**2 + 1e-12]
    return np.asarray(offsets[near] * resolution)


def nearest_foothold(
    terrain: Terrain, nominal: Array, offsets: Array, others: Array, min_distance: float, reachable: Reachable
) -> Foothold | NoFoothold:
    """Find the most suitable foothold near a nominal one; of equals, the nearest.

    `Terrain.suitability` rates the places.

    Args:
        terrain: The map.
        nominal: (2,) [m] {world} where the foot would land on unobstructed ground.
        offsets: (n, 2) [m] of the cells to try, in order; the first is (0, 0).
        others: (k, 2) [m] {world} feet to keep away from.
        min_distance: [m] from them.
        reachable: Returns (m,) for points (m, 3) [m] {world} on the ground whether the leg reaches them.

    Returns:
        The foothold, or the number of cells that failed each test.
    """
    # The nominal place is usually good, so it is tried alone first.
    found = _search(terrain, nominal[None], others, min_distance, reachable)
    if isinstance(found, Foothold):
        return found
    xy = terrain.centres(nominal) + offsets
    return _search(terrain, xy, others, min_distance, reachable, nominal)


def _search(
    terrain: Terrain, xy: Array, others: Array, min_distance: float, reachable: Reachable, nominal: Array | None = None
) -> Foothold | NoFoothold:
    """Return the best of (n, 2) [m] {world} places, the nearest to the nominal one.

    Without a nominal place, return the first of the best.
    """
    suitability = terrain.suitability(xy)
    footing = terrain.footing(xy)
    unknown = np.isnan(suitability) | ~np.isfinite(footing)
    rough = ~unknown & (suitability == NONE)
    near = ((xy[:, None] - others) ** 2).sum(axis=2).min(axis=1, initial=np.inf) < min_distance**2
    candidates = np.flatnonzero(~unknown & ~rough & ~near)
    points = np.column_stack([xy[candidates], footing[candidates]])
    within = reachable(points) if len(points) else np.zeros(0, dtype=bool)
    best = GOOD if nominal is None or not within.any() else float(suitability[candidates][within].max())
    within = within & (suitability[candidates] == best)
    if within.any():
        if nominal is None:
            return Foothold(points[int(np.argmax(within))], 0.0, best)
        # The cells are ordered around the centre of the nominal cell, so the distance from the nominal place is computed again.
        moved = np.where(within, np.linalg.norm(points[:, :2] - nominal, axis=1), np.inf)
        nearest = int(np.argmin(moved))
        return Foothold(points[nearest], float(moved[nearest]), best)
    hazards = np.where(rough, terrain.hazards(xy), 0)
    counts = Counter(
        {
            "not seen": int(unknown.sum()),
            "too steep or too near an edge": int((rough & (hazards == 0)).sum()),
            **{name: int((hazards == number).sum()) for number, name in enumerate(HAZARDS) if number},
            "too near another foot": int((near & ~unknown & ~rough).sum()),
            "out of reach or too tight for the leg": len(points),
        }
    )
    words = ", ".join(f"{n} {what}" for what, n in counts.most_common() if n)
    radius = 0.0 if nominal is None else float(np.linalg.norm(xy[-1] - nominal))
    reason = f"no foothold within {radius * 100:.0f} cm of its nominal place ({len(xy)} cells: {words})"
    return NoFoothold(reason, unseen=2 * int(unknown.sum()) > len(xy))
