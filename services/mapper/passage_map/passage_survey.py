"""Survey of a passage on request: its mapping, and the messages with the map."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.footholds.layers import body_height_and_sigma
from sextant.services.mapper.footholds.terrain_type_mapping import without_hazards
from sextant.services.mapper.passage_map.passage_grid import PassageGrid, cell_centres, cells_of
from sextant.services.mapper.passage_map.passage_mapping import PassageMapping, ViewProposal
from sextant.services.mapper.passage_map.voxel_cloud import Strip
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import Stages
from sextant.shared.wire.messages import ActuatorState, BodyPose, PassageMap, PassageRequest, Scan

_MIN_CELLS = 3  # [cells] minimum length and width of a passage; fewer have no slope
_MAX_BOX_RATIO = 10  # [1] maximum cells of the box around an oblique passage, relative to the maximum cells of a passage


class PassageSurvey:
    """Maps the requested passage, next to the elevation map."""

    def __init__(self, profile: RobotProfile, settings: Settings, stages: Stages):
        """Start without a passage.

        Args:
            profile: The robot.
            settings: Settings of the mapper.
            stages: Durations of the mapper's work.
        """
        self._profile, self._settings, self._stages = profile, settings, stages
        self._mapping: PassageMapping | None = None
        self._scans = 0  # scans since the mapping of this strip began

    @property
    def is_running(self) -> bool:
        """Whether a passage is being mapped."""
        return self._mapping is not None

    def end(self) -> None:
        """Discard the passage map."""
        self._mapping = None

    def add(self, request: PassageRequest, scan: Scan, grid: ElevationGrid) -> str:
        """Merge a scan into the map of the requested passage.

        Return why the request is invalid, or an empty string.
        """
        self._scans += 1
        try:
            strip = self._strip(request)
        except ValueError as error:
            self.end()
            return f"invalid map request: {error}"
        with self._stages("merge"):
            if self._mapping is None:
                reach, footholds = self._settings.scan_range, self._settings.footholds
                self._mapping = PassageMapping(self._profile, strip, grid.snapshot(), reach, footholds)
                self._scans = 1
            elif self._mapping.strip != strip:
                self._mapping.move_to(strip, grid.snapshot())
                self._scans = 1
            self._mapping.add(scan.points, scan.pixel_count, grid.height_drift)
        return ""

    @property
    def is_map_due(self) -> bool:
        """Whether to publish the map after this scan."""
        return self._scans % self._settings.passage_every == 0

    def passage_map(
        self,
        stamp_ns: int,
        grid: ElevationGrid,
        pose: BodyPose | None,
        legs: ActuatorState | None,
        hazards: tuple[NDArray[np.uint8], Array] | None,
    ) -> PassageMap:
        """Return the map of the passage as a message.

        Args:
            stamp_ns: [ns] of the newest scan.
            grid: Elevation map.
            pose: Newest body pose, if any.
            legs: Newest state of the legs, or None if it is old.
            hazards: Hazards (nx, ny) of the elevation map, and the centre (2,) [m] {world} of its cell (0, 0).
        """
        assert self._mapping is not None
        mapping = self._mapping
        with self._stages("passage"):
            passage = mapping.grid(grid.snapshot())
            evaluation = mapping.evaluation(passage, *body_height_and_sigma(pose))
        if hazards is not None:
            evaluation = without_hazards(evaluation, mapping.resample(*hazards, 0))
        unseen = passage.unseen
        T_world_body = np.eye(4) if pose is None else pose.T_world_body
        proposal = self._view_proposal(mapping, passage, T_world_body, None if pose is None else legs)
        view = proposal.view
        return PassageMap(
            stamp_ns=stamp_ns,
            resolution=passage.resolution,
            origin=cell_centres(passage.strip, passage.resolution)[0, 0],
            heading=passage.strip.heading,
            elevation=passage.elevation,
            normals=np.rint(np.nan_to_num(passage.normals) * 32767.0).astype(np.int16),
            roughness=passage.roughness,
            assumed=passage.assumed,
            evaluation=evaluation,
            unseen_share=float(unseen.mean()),
            reason=proposal.reason,
            T_world_next_view=T_world_body if view is None else view.T_world_body,
            next_view_cells=np.zeros(unseen.shape, dtype=np.bool_) if view is None else view.sees,
        )

    def _view_proposal(
        self, mapping: PassageMapping, passage: PassageGrid, T_world_body: Array, legs: ActuatorState | None
    ) -> ViewProposal:
        """Return the next best view; it is only computed for known feet that all stand."""
        if legs is not None and not legs.swing.any():
            with self._stages("look"):
                return mapping.view_proposal(passage, T_world_body, legs.feet)
        unseen = passage.unseen
        if not unseen.any():
            return ViewProposal("", None)
        words = f"{np.count_nonzero(unseen)} of {unseen.size} cells not seen"
        return ViewProposal(f"{words}; no view is proposed while legs swing or send no state", None)

    def _strip(self, request: PassageRequest) -> Strip:
        """Return the requested strip.

        Raises:
            ValueError: The strip is invalid or too large.
        """
        settings = self._settings
        strip = Strip((float(request.origin[0]), float(request.origin[1])), request.heading, request.length, request.width)
        nx, ny = cells_of(strip, settings.resolution)
        if min(nx, ny) < _MIN_CELLS:
            raise ValueError(f"at least {_MIN_CELLS} cells along and across expected, found {nx} x {ny}")
        if nx * ny > settings.passage_cells:
            raise ValueError(f"at most {settings.passage_cells} cells expected, found {nx} x {ny}")
        columns = math.prod(strip.box(settings.resolution)[1])
        if columns > _MAX_BOX_RATIO * settings.passage_cells:
            most = _MAX_BOX_RATIO * settings.passage_cells
            raise ValueError(
                f"at most {most} cells in the box around the strip expected, found {columns}: "
                "choose a heading along x or y, or a shorter strip"
            )
        return strip


def empty_passage_map(stamp_ns: int, request: PassageRequest, resolution: float, reason: str) -> PassageMap:
    """Return a passage map without cells, with the reason."""
    nothing = np.zeros((0, 0))
    return PassageMap(
        stamp_ns=stamp_ns,
        resolution=resolution,
        origin=request.origin,
        heading=request.heading,
        elevation=nothing.astype(np.float32),
        normals=np.zeros((0, 0, 3), dtype=np.int16),
        roughness=nothing.astype(np.float32),
        assumed=nothing.astype(np.bool_),
        evaluation=nothing.astype(np.int8),
        unseen_share=1.0,
        reason=reason,
        T_world_next_view=np.eye(4),
        next_view_cells=nothing.astype(np.bool_),
    )
