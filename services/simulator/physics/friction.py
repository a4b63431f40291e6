"""Patches of ground with other friction."""

from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.scenario.terrain import Patches


@dataclass(frozen=True, slots=True)
class FrictionPatches:
    """Axis-aligned rectangles of the ground with their own friction."""

    low: Array  # (n, 2) [m] {world}
    high: Array  # (n, 2) [m] {world}
    friction: Array  # (n,) [1] coefficients of sliding friction

    def __len__(self) -> int:
        return len(self.friction)

    def at(self, xy: Array) -> Array:
        """Return the friction (m,) at points (m, 2) [m] {world}; NaN outside of all patches. The last patch counts."""
        found = np.full(len(xy), np.nan)
        for low, high, friction in zip(self.low, self.high, self.friction, strict=True):
            found[((xy >= low) & (xy <= high)).all(axis=1)] = friction
        return found


NO_PATCHES = FrictionPatches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def draw_patches(parts: list[Patches], rng: np.random.Generator) -> FrictionPatches:
    """Draw patches of friction at random places."""
    if not parts:
        return NO_PATCHES
    middle, edge, friction = list[Array](), list[Array](), list[Array]()
    for part in parts:
        middle.append(np.column_stack([rng.uniform(*part.x, part.count), rng.uniform(*part.y, part.count)]))
        edge.append(rng.uniform(*part.size, (part.count, 2)))
        friction.append(rng.choice(part.frictions, part.count))
    centre, half = np.concatenate(middle), np.concatenate(edge) / 2
    return FrictionPatches(centre - half, centre + half, np.concatenate(friction))
