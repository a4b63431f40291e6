"""Terrain types of the map, learned from colours of scans and touchdowns of feet."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.foot_evidence import MAX_HEIGHT_ERROR_M
from sextant.services.mapper.elevation.start_ground import nearest_seen_ground
from sextant.services.mapper.footholds.foothold_feedback import FirstStanceDetector
from sextant.services.mapper.footholds.terrain_type import TerrainType, TypeMap
from sextant.shared.color import from_codes
from sextant.shared.wire.messages import ActuatorState, BodyPose, Scan


class TerrainTypeMapping:
    """Terrain types of one map, from its first scan with colour on."""

    def __init__(self, settings: Settings, foot_radius_m: float):
        """Start without types."""
        self._settings = settings
        self._type: TerrainType | None = None
        self._stances = FirstStanceDetector(foot_radius_m)
        self._knows_start = False  # whether the colour of the ground at the start is known

    @property
    def has_types(self) -> bool:
        """Return whether there was a scan with colour."""
        return self._type is not None

    def reset(self) -> None:
        """Forget the types, because the map restarts."""
        self._type, self._knows_start = None, False

    def update(self, scan: Scan, grid: ElevationGrid, pose: BodyPose | None, legs: ActuatorState | None) -> None:
        """Update the types with the scan's colours and the newest touchdowns.

        Args:
            scan: Newest scan.
            grid: Elevation map with this scan.
            pose: Newest body pose, if any.
            legs: Newest state of the legs, if any.
        """
        settings = self._settings
        if self._type is None:
            self._type = TerrainType(settings.shape, settings.resolution, grid.low)
        known = self._type
        known.move_to(grid.low)
        if len(scan.color):
            known.add_colors(scan.points[:, :2], from_codes(scan.color))
        if pose is None or legs is None:
            return
        if not self._knows_start:
            self._knows_start = known.learn_start_ground(nearest_seen_ground(grid, settings, pose.T_world_body))
        for stance in self._stances.update(legs, pose):
            sink = float(grid.heights(stance.p_world[:2])) - float(stance.p_world[2])
            if abs(sink) <= MAX_HEIGHT_ERROR_M:  # and not NaN
                known.touch(stance.p_world[:2], sink if stance.carries else None)

    def classify(self, slope: NDArray[np.float32], roughness: NDArray[np.float32]) -> TypeMap:
        """Return the types of all cells from their slope and roughness, see `TerrainType.classify`."""
        assert self._type is not None
        return self._type.classify(slope, roughness)

    def rgb(self) -> NDArray[np.uint8]:
        """Return the colours (nx, ny, 3) of the cells."""
        assert self._type is not None
        return self._type.rgb()


def without_hazards(evaluation: NDArray[np.int8], hazard: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Return the evaluation function with the cells of a hazard marked as no foothold."""
    return np.where(hazard > 0, np.maximum(evaluation, np.int8(1)), evaluation)
