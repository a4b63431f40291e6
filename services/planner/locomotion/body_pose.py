"""Body height from Lotriet's floor height (section 6.4), and lean for reach."""

import numpy as np

from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, inverse, rotation_from_rpy, transform, yaw_of

_UP = np.array([0.0, 0.0, 1.0])


def floor_height(ground: Array) -> float:
    """Return the mean of the three highest of (6,) [m] {world} footholds.

    Source: Lotriet 2024, section 6.4.
    """
    return float(np.sort(ground)[-3:].mean())


def clear_of_ground(floor: float, terrain: Terrain, T_world_body: Array, size: tuple[float, float, float]) -> float:
    """Return the floor raised to the highest ground under the body's rectangle.

    Ground under the legs does not count (Lotriet 2024, section 6.4).

    Args:
        floor: [m] {world} floor height by the footholds.
        terrain: The map.
        T_world_body: (4, 4) body pose at the end of the step.
        size: [m] length, width and height of the body.
    """
    half = np.array(size[:2]) / 2
    corners = np.array([[-half[0], -half[1]], [half[0], -half[1]], [-half[0], half[1]]])
    under = terrain.highest_under(corners @ T_world_body[:2, :2].T + T_world_body[:2, 3])
    return max(floor, under)


def slope_under(stance: Array, T_world_body: Array) -> Array:
    """Return roll and pitch (2,) [rad] of the plane through the ground under the feet.

    Args:
        stance: (6, 3) [m] {world} ground under the feet.
        T_world_body: (4, 4) level body.
    """
    feet = apply(inverse(T_world_body), stance)
    ahead, aside, _ = np.linalg.lstsq(np.column_stack([feet[:, :2], np.ones(len(feet))]), feet[:, 2], rcond=None)[0]
    pitch = -np.arctan(ahead)
    return np.array([np.arctan(aside * np.cos(pitch)), pitch])


def leaning(T_world_body: Array, lean: Array, stoop: Array | float) -> Array:
    """Return a level body pose (4, 4) with leans and lower heights, (..., 4, 4).

    A lean is roll and pitch (..., 2) [rad]; `stoop` (...) [m] lowers the body.
    """
    rpy = np.empty((*lean.shape[:-1], 3))
    rpy[..., :2], rpy[..., 2] = lean, yaw_of(T_world_body)
    return transform(rotation_from_rpy(rpy), T_world_body[:3, 3] - np.multiply.outer(stoop, _UP))
