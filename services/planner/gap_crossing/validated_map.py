"""Validation of a strip map: the requested strip, with plausible content."""

import numpy as np

from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, inverse, is_rigid, rpy_from_rotation
from sextant.shared.wire.messages import PassageMap

_RESOLUTIONS = (0.002, 0.1)  # [m] finest and coarsest plausible cells
_SAME_PLACE, _SAME_WAY = 0.5, 1e-3  # [cells] and [rad] maximum offset from the requested strip
_LOOK_AWAY = 0.2  # [m] maximum distance of a look from the body's pose
_LOOK_TURNED = np.radians(25.0)  # [rad] maximum turn about any axis


def validation_error(map_: PassageMap, T_world_strip: Array, size: tuple[float, float]) -> str:
    """Return why a map is invalid, or "".

    Args:
        map_: The received map.
        T_world_strip: (4, 4) requested strip.
        size: [m] requested length and width.
    """
    if map_.elevation.size == 0:
        return map_.reason or "the map has no cells"
    low, high = _RESOLUTIONS
    if not low <= map_.resolution <= high:
        return f"cells of {low} to {high} m expected, found {map_.resolution:.3g} m"
    wanted = tuple(round(length / map_.resolution) for length in size)
    if map_.elevation.shape != wanted:
        return f"{wanted[0]} x {wanted[1]} cells expected, found {map_.elevation.shape[0]} x {map_.elevation.shape[1]}"
    if np.isinf(map_.elevation).any():
        return "finite heights expected, found infinity"
    off = inverse(T_world_strip) @ StripMap.of(map_).T_world_strip
    turned = abs(float(rpy_from_rotation(off[:3, :3])[2]))
    if np.abs(off[:2, 3]).max() > _SAME_PLACE * map_.resolution or turned > _SAME_WAY:
        return "the map shows another strip"
    if not is_rigid(map_.T_world_next_view):
        return "the proposed viewing pose is not a rigid transform"
    return ""


def is_near(T_world_look: Array, T_world_body: Array) -> bool:
    """Return whether a look's pose (4, 4) is near the body's initial pose (4, 4)."""
    move = inverse(T_world_body) @ T_world_look
    turn = np.abs(rpy_from_rotation(move[:3, :3])).max()
    return bool(np.linalg.norm(move[:3, 3]) <= _LOOK_AWAY and turn <= _LOOK_TURNED)
