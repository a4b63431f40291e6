"""Passage mapping on request: the merged cloud, its map and the next best view."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationSnapshot
from sextant.services.mapper.elevation.start_ground import feet_plane
from sextant.services.mapper.footholds.foothold_score import Scalar
from sextant.services.mapper.footholds.layers import FootholdLayers
from sextant.services.mapper.footholds.params import FootholdLayersParams
from sextant.services.mapper.passage_map.next_best_view import (
    View,
    best_view,
    candidates,
    check_visibility,
    describe_unseen_cells,
    expected_heights,
)
from sextant.services.mapper.passage_map.passage_grid import (
    PassageGrid,
    cell_centres,
    cells_of,
    passage_grid,
    with_assumed,
)
from sextant.services.mapper.passage_map.voxel_cloud import Strip, VoxelCloud
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.profile import RobotProfile

_MIN_RADIUS_M = 0.025  # [m] minimum radius of moving least squares, absolute
_MIN_RADIUS_CELLS = 2.5  # [cells] the same in cells; the larger one counts
_SAME_VIEW_M, _SAME_VIEW_RAD = 0.01, 0.02  # [m] [rad] within which two views count as the same
_MAX_VIEWS = 8  # maximum number of stored views
_COPIED_WEIGHT = 8.0  # [pixels] weight of a height that is copied from the elevation map


@dataclass(frozen=True, slots=True, eq=False)
class ViewProposal:
    """Unseen cells of a strip, and the body pose that would show most of them."""

    reason: str  # description of the unseen cells and of the cause; empty if all are seen
    view: View | None  # None if no feasible pose shows enough cells


class PassageMapping:
    """Merged cloud over one strip, initialised from the elevation map.

    Poses drift in height. As in the elevation map (`height_drift.py`), stored heights refer to the poses of the start, and
    returned heights to the newest pose.
    """

    def __init__(
        self,
        profile: RobotProfile,
        strip: Strip,
        elevation_map: ElevationSnapshot,
        reach: float,
        params: FootholdLayersParams | None = None,
    ):
        """Start the mapping of a strip.

        Args:
            profile: Profile of the robot with its camera and legs.
            strip: Strip with a whole number of cells of the elevation map's resolution.
            elevation_map: Elevation map from which the cloud is initialized.
            reach: [m] maximum horizontal distance of scan points from the camera.
            params: Parameters of the foothold layers.

        Raises:
            ValueError: Length or width of the strip is not a whole number of cells.
        """
        self._centres, self._resolution = cell_centres(strip, elevation_map.resolution), elevation_map.resolution
        self._profile, self._reach, self._params = profile, reach, params or FootholdLayersParams()
        self._radius = max(_MIN_RADIUS_M, _MIN_RADIUS_CELLS * elevation_map.resolution)  # [m] of moving least squares
        self._cloud = VoxelCloud(strip, elevation_map.resolution, margin=2.0 * self._radius)
        self._layers = self._new_layers(elevation_map.resolution)
        self._view_poses: list[Array] = []  # (4, 4) optical poses, newest last
        self._copy_measured(elevation_map)

    @property
    def strip(self) -> Strip:
        """Strip that is mapped."""
        return self._cloud.strip

    def move_to(self, strip: Strip, elevation_map: ElevationSnapshot) -> None:
        """Map another strip, and keep the part of the cloud that lies on it.

        Raises:
            ValueError: Length or width is not a whole number of cells; the mapping then continues unchanged.
        """
        self._centres = cell_centres(strip, elevation_map.resolution)
        self._cloud.move_to(strip)
        self._layers = self._new_layers(elevation_map.resolution)
        self._copy_measured(elevation_map)

    def add(self, points: Array, count: NDArray[np.uint8], height_drift: float = 0.0) -> None:
        """Merge a scan.

        Args:
            points: (n, 3) [m] {world}.
            count: (n,) number of pixels of each point.
            height_drift: [m] height of the ground by the scan's pose minus that by the poses of the start.
        """
        self._cloud.insert(points - np.array([0.0, 0.0, height_drift]) if height_drift else points, count)

    def grid(self, elevation_map: ElevationSnapshot) -> PassageGrid:
        """Compute the map of the strip.

        Cells without a measurement get the height that the elevation map assumes there, if it does.

        Source: Masri 2016, sections 4.4 and 4.7.
        """
        cloud = self._cloud.snapshot()
        if elevation_map.height_drift:
            cloud = replace(cloud, points=cloud.points + np.array([0.0, 0.0, elevation_map.height_drift]))
        measured = passage_grid(cloud, self.strip, elevation_map.resolution, self._radius)
        assumed = np.where(elevation_map.assumed != 0, elevation_map.elevation, np.float32(np.nan))
        return with_assumed(measured, self.resample(assumed, elevation_map.origin, np.nan))

    def resample(self, layer: NDArray[Scalar], origin: Array, beyond: float) -> NDArray[Scalar]:
        """Return a layer of the elevation map at the strip's cells (nx, ny).

        Args:
            layer: Layer of the elevation map.
            origin: (2,) [m] {world} centre of the layer's cell (0, 0).
            beyond: Value of cells outside the layer.
        """
        cell = np.rint((self._centres - origin) / self._resolution).astype(np.int64)
        inside: NDArray[np.bool_] = np.all((cell >= 0) & (cell < layer.shape), axis=-1)
        i, j = np.moveaxis(np.where(inside[..., None], cell, 0), -1, 0)
        return np.where(inside, layer[i, j], layer.dtype.type(beyond))

    def evaluation(self, grid: PassageGrid, body_height: float, position_sigma: float) -> NDArray[np.int8]:
        """Compute Masri's evaluation function (nx, ny) [cells] of the strip's map.

        Ground outside the strip counts as vacant.

        Args:
            grid: Map of the strip.
            body_height: [m] {world} height of the body's centre, to which the depth limit refers.
            position_sigma: [m] standard deviation of the body position.

        Source: Masri 2016, sections 4.5 and 4.6.
        """
        variance = np.zeros(grid.elevation.shape, dtype=np.float32)
        return self._layers.update(
            grid.elevation, variance, np.zeros(2, dtype=np.int64), body_height, position_sigma
        ).evaluation

    def view_proposal(self, grid: PassageGrid, T_world_body: Array, feet: Array) -> ViewProposal:
        """Find the unseen cells of a map, and the body pose that would show most of them.

        Args:
            grid: Map of the strip.
            T_world_body: (4, 4) body pose.
            feet: (6, 3) [m] {body} foot centres, all on the ground.

        Source: Masri 2016, section 4.7.
        """
        camera = self._profile.camera
        feet_world = apply(T_world_body, feet)
        a, b, c = feet_plane(feet_world - [0.0, 0.0, self._profile.foot.radius])
        level = float(a + b * T_world_body[0, 3] + c * T_world_body[1, 3])
        T_world_camera = T_world_body @ camera.T_body_camera
        view_poses = self._views_with(T_world_camera)
        heights = expected_heights(grid, view_poses, camera, self._reach, level)
        why = check_visibility(grid, heights, grid.unseen, T_world_camera, camera, self._reach)
        poses = candidates(self._profile, T_world_body, feet_world, level)
        view = best_view(grid, heights, grid.unseen, view_poses, poses, camera, self._reach)
        return ViewProposal(describe_unseen_cells(grid, why), view)

    def _views_with(self, T_world_camera: Array) -> Array:
        """Return the optical poses (k, 4, 4) of the views so far, with this one last."""
        self._view_poses = [T for T in self._view_poses if not _is_same_view(T, T_world_camera)][1 - _MAX_VIEWS :]
        self._view_poses.append(T_world_camera)
        return np.array(self._view_poses)

    def _new_layers(self, resolution: float) -> FootholdLayers:
        return FootholdLayers.of(cells_of(self.strip, resolution), resolution, self._profile.foot.radius, self._params)

    def _copy_measured(self, elevation_map: ElevationSnapshot) -> None:
        """Copy measured heights of the elevation map into the cloud's empty columns."""
        i, j = np.nonzero(np.isfinite(elevation_map.elevation) & (elevation_map.assumed == 0))
        places = elevation_map.origin + elevation_map.resolution * np.column_stack([i, j])
        new = ~self._cloud.holds(places)
        points = np.column_stack([places, elevation_map.elevation[i, j] - elevation_map.height_drift])[new]
        self._cloud.insert(points, np.full(len(points), _COPIED_WEIGHT))


def _is_same_view(T: Array, other: Array) -> bool:
    turned = np.abs(T[:3, :3] - other[:3, :3]).max()
    return bool(np.linalg.norm(T[:3, 3] - other[:3, 3]) < _SAME_VIEW_M and turned < _SAME_VIEW_RAD)
