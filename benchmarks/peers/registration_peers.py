"""Other methods for registering depth frames, with the interface of Sextant's.

Their speed and accuracy are compared with Sextant's. All get the same input: the raw frame, and the pose predicted by odometry
or by constant velocity. small_gicp and GenZ-ICP are measured twice: on the block means that Sextant registers, and on all
pixels, which they sample down themselves, as their authors describe. Reducing a frame to block means counts as their time.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.baselines.masri_mapping import WorldModel, cropped
from sextant.services.perception.config import Settings
from sextant.services.perception.registration.acceptance import Acceptance
from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.frame_registration import RegistrationMethod
from sextant.services.perception.registration.projective_icp import Registration
from sextant.services.perception.registration.registration_result import RegistrationResult
from sextant.shared.geometry import Array, inverse
from sextant.shared.robot.profile import Camera
from sextant.shared.runtime.compiled import compiled

_OPEN3D_VOXEL, _OPEN3D_GATE, _OPEN3D_ITERATIONS = 0.03, 0.10, 30


@dataclass(frozen=True, slots=True)
class GicpSetup:
    """Settings of small_gicp."""

    leaf: float  # [m] sampling of the points
    voxel: float  # [m] edge of the map's voxels
    gate: float  # [m] largest distance of a correspondence
    neighbours: int = 10  # for a point's covariance


# The best of those tried on rides with seeds 1100 and 1101, and on the recording itself: by error, and by time.
_GICP_FINE = GicpSetup(0.015, 0.04, 0.1)
_GICP_COARSE = GicpSetup(0.03, 0.05, 0.1)
_GICP_FINE_IN_HAND = GicpSetup(0.03, 0.1, 0.2)
_GICP_COARSE_IN_HAND = GicpSetup(0.05, 0.1, 0.2)


@dataclass(frozen=True, slots=True)
class GenzSetup:
    """Settings of GenZ-ICP, by the names of its configuration."""

    voxel_size: float = 0.03  # [m] edge of the map's voxels
    max_points_per_voxel: int = 1
    desired_num_voxelized_points: int = 2000
    planarity_threshold: float = 0.2
    initial_threshold: float = 0.1  # [m]
    min_motion_th: float = 0.005  # [m]


class _Sampling(Protocol):
    """How a method gets the points of a frame."""

    def of(self, depth: NDArray[np.uint16]) -> Array:
        """Return the points (n, 3) [m] {camera} of a raw frame."""
        ...


class BlockMeans:
    """The block means that Sextant's registration uses."""

    def __init__(self, camera: Camera, settings: Settings):
        """Use the range and the blocks of perception's settings."""
        sensor = replace(camera.sensor, max_range=min(camera.sensor.max_range, settings.registration_range))
        self._frame = BlockFrame(camera.intrinsics, sensor, settings.blocks_across)

    def of(self, depth: NDArray[np.uint16]) -> Array:
        """Return the means (n, 3) [m] {camera}; overwritten by the next frame."""
        self._frame.load(depth)
        return self._frame.points


class Pixels:
    """All measured pixels."""

    def __init__(self, camera: Camera, _: Settings):
        """Use the whole range of a camera."""
        i = camera.intrinsics
        self._x = np.asarray((np.arange(i.width) - i.cx) / i.fx, np.float64)
        self._y = np.asarray((np.arange(i.height) - i.cy) / i.fy, np.float64)
        self._scale = 1.0 / camera.sensor.depth_scale
        self._points = np.empty((i.height * i.width, 3))

    def of(self, depth: NDArray[np.uint16]) -> Array:
        """Return the points (n, 3) [m] {camera}; overwritten by the next frame."""
        return self._points[: _deproject(depth, self._scale, self._x, self._y, self._points)]


@compiled
def _deproject(depth: NDArray[Any], scale: float, x: Array, y: Array, out: Array) -> int:
    n = 0
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            if depth[i, j] > 0:
                z = scale * depth[i, j]
                out[n, 0], out[n, 1], out[n, 2] = z * x[j], z * y[i], z
                n += 1
    return n


class _Vgicp:
    """small_gicp: generalised ICP with a growing map of Gaussian voxels, as in its example of scan-to-model odometry."""

    def __init__(self, points: _Sampling, setup: GicpSetup):
        import small_gicp

        self._gicp: Any = small_gicp
        self._points, self._setup = points, setup
        self._map = small_gicp.GaussianVoxelMap(setup.voxel)

    def update(
        self, depth_raw: NDArray[np.uint16], stamp_ns: int, T_world_camera_prior: Array, prior_covariance: Array
    ) -> RegistrationResult:
        cloud, _ = self._gicp.preprocess_points(
            self._points.of(depth_raw), self._setup.leaf, num_neighbors=self._setup.neighbours, num_threads=1
        )
        T = T_world_camera_prior
        if self._map.size():
            found = self._gicp.align(
                self._map, cloud, T_world_camera_prior, max_correspondence_distance=self._setup.gate, num_threads=1
            )
            T = np.asarray(found.T_target_source)
        self._map.insert(cloud, T)
        return _result(stamp_ns, T, prior_covariance)


class _Genz:
    """GenZ-ICP 0.3: the steps of its pipeline, from the given prior instead of a constant velocity.

    Source: Lee, Lim and Han 2025, GenZ-ICP, and `GenZICP.cpp` of its release.
    """

    def __init__(self, points: _Sampling, setup: GenzSetup, max_range: float):
        try:
            from genz_icp.pybind import genz_icp_pybind as genz
        except ModuleNotFoundError as error:
            raise ImportError(f"{error}; `pip install genz-icp` installs it, on x86-64") from error
        self._genz, self._points, self._setup = genz, points, setup
        self._registration = genz._Registration(100, 1e-4, 1)
        self._map = genz._VoxelHashMap(
            setup.voxel_size, max_range, 100.0, setup.planarity_threshold, setup.max_points_per_voxel
        )
        self._threshold = genz._AdaptiveThreshold(setup.initial_threshold, setup.min_motion_th, max_range)
        self._voxel = setup.voxel_size  # [m] adapts to the desired number of points
        self._T_first: Array | None = None
        self._moved = False

    def update(
        self, depth_raw: NDArray[np.uint16], stamp_ns: int, T_world_camera_prior: Array, prior_covariance: Array
    ) -> RegistrationResult:
        genz, setup, T_prior = self._genz, self._setup, T_world_camera_prior
        frame = genz._Vector3dVector(self._points.of(depth_raw))
        # 1. Sample down twice, so that about the desired number of points is left.
        found = len(genz._voxel_down_sample(frame, self._voxel))
        self._voxel = min(max(self._voxel * found / setup.desired_num_voxelized_points, 0.02), 2.0)
        kept = genz._voxel_down_sample(frame, max(0.5 * self._voxel, 0.02))
        source = genz._voxel_down_sample(kept, self._voxel)
        # 2. Align with the map, within a distance that adapts to the errors of the priors.
        sigma = self._threshold._compute_threshold() if self._moved else setup.initial_threshold
        with _without_output():
            T = np.asarray(self._registration._align_points_to_map(source, self._map, T_prior, 3.0 * sigma, sigma / 3.0))
        # 3. Update the threshold and the map.
        self._threshold._update_model_deviation(inverse(T_prior) @ T)
        self._map._update(kept, T)
        self._T_first = T if self._T_first is None else self._T_first
        self._moved = float(np.linalg.norm(T[:3, 3] - self._T_first[:3, 3])) > 5.0 * setup.min_motion_th
        return _result(stamp_ns, T, prior_covariance)


@contextmanager
def _without_output() -> Iterator[None]:
    """Discard what a library writes to the standard output: GenZ-ICP draws a bar for each frame."""
    kept, discarded = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(discarded, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(discarded)


class _Open3d:
    """Open3D: point-to-plane ICP on voxel grids, with the merged previous frames."""

    def __init__(self, points: _Sampling):
        import open3d

        self._o3d: Any = open3d
        self._points = points
        self._map: Any = None

    def update(
        self, depth_raw: NDArray[np.uint16], stamp_ns: int, T_world_camera_prior: Array, prior_covariance: Array
    ) -> RegistrationResult:
        o3d, icp = self._o3d, self._o3d.pipelines.registration
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self._points.of(depth_raw))).voxel_down_sample(_OPEN3D_VOXEL)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * _OPEN3D_VOXEL, 20))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        T = T_world_camera_prior
        if self._map is not None:
            limits = icp.ICPConvergenceCriteria(max_iteration=_OPEN3D_ITERATIONS)
            estimation = icp.TransformationEstimationPointToPlane()
            T = np.asarray(icp.registration_icp(cloud, self._map, _OPEN3D_GATE, T, estimation, limits).transformation)
        placed = cloud.transform(T)
        self._map = placed if self._map is None else (self._map + placed).voxel_down_sample(_OPEN3D_VOXEL)
        return _result(stamp_ns, T, prior_covariance)


class _Thesis:
    """Masri 2016, section 4.2: each scan against the world model of all before, from the predicted motion."""

    def __init__(self, points: _Sampling):
        self._points, self._model = points, WorldModel()

    def update(
        self, depth_raw: NDArray[np.uint16], stamp_ns: int, T_world_camera_prior: Array, prior_covariance: Array
    ) -> RegistrationResult:
        T = self._model.add(cropped(self._points.of(depth_raw)), T_world_camera_prior)
        return _result(stamp_ns, T_world_camera_prior if T is None else T, prior_covariance)


def _result(stamp_ns: int, T: Array, covariance: Array) -> RegistrationResult:
    return RegistrationResult(stamp_ns, T, covariance, 1.0, math.nan, np.zeros((0, 6)), True, "")


def _projective(camera: Camera, settings: Settings) -> RegistrationMethod:
    acceptance = Acceptance.of(settings.acceptance, settings.legs)
    return Registration(
        camera.intrinsics,
        camera.sensor,
        acceptance,
        max_range=settings.registration_range,
        blocks_across=settings.blocks_across,
    )


def _kiss_icp(camera: Camera, settings: Settings) -> RegistrationMethod:
    from sextant.services.perception.registration.kiss_icp_adapter import KissRegistration  # it has no wheel for every Python

    if settings.legs:
        return KissRegistration(camera.intrinsics, camera.sensor)
    return KissRegistration(camera.intrinsics, camera.sensor, threshold=None)


def _vgicp(
    points: Callable[[Camera, Settings], _Sampling], on_ride: GicpSetup, in_hand: GicpSetup
) -> Callable[[Camera, Settings], RegistrationMethod]:
    return lambda camera, settings: _Vgicp(points(camera, settings), on_ride if settings.legs else in_hand)


METHODS: Mapping[str, Callable[[Camera, Settings], RegistrationMethod]] = {
    "projective (default)": _projective,
    "VGICP, block means": _vgicp(BlockMeans, _GICP_FINE, _GICP_FINE_IN_HAND),
    "VGICP, block means, coarse": _vgicp(BlockMeans, _GICP_COARSE, _GICP_COARSE_IN_HAND),
    "VGICP, pixels": _vgicp(Pixels, _GICP_FINE, _GICP_FINE_IN_HAND),
    "GenZ-ICP, block means": lambda c, s: _Genz(BlockMeans(c, s), GenzSetup(), c.sensor.max_range),
    "GenZ-ICP, pixels": lambda c, s: _Genz(Pixels(c, s), GenzSetup(), c.sensor.max_range),
    "kiss-icp, block means": _kiss_icp,
    "Open3D, pixels": lambda c, s: _Open3d(Pixels(c, s)),
    "thesis ICP, pixels": lambda c, s: _Thesis(Pixels(c, s)),
}
