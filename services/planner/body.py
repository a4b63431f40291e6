"""How high the body goes: Lotriet's floor height, section 6.4."""

import numpy as np

from services.planner.terrain import Terrain
from shared.geometry import Array


def floor_height(ground: Array) -> float:
    """Mean of the three highest of (6,) [m] {world} footholds (Lotriet 2024, section 6.4)."""
    return float(np.sort(ground)[-3:].mean())


def clear_of_ground(floor: float, terrain: Terrain, T_world_body: Array, size: tuple[float, float, float]) -> float:
    """The floor raised to the highest ground under the body's bounding box, legs left out (Lotriet 2024, section 6.4).

    Args:
        floor: [m] {world} floor height by the footholds.
        terrain: The map.
        T_world_body: (4, 4) where the body will be.
        size: [m] length, width and height of the body.
    """
    half = np.array(size[:2]) / 2
    corners = np.array([[-half[0], -half[1]], [half[0], -half[1]], [-half[0], half[1]]])
    under = terrain.highest_under(corners @ T_world_body[:2, :2].T + T_world_body[:2, 3])
    return max(floor, under)
