"""Other methods for registering depth frames, behind one interface.

Their speed and accuracy are compared with Sextant's. All get the same input, the raw frame and the pose predicted by odometry,
and compute their own points.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration import frame_registration
from sextant.services.perception.registration.projective_icp import Registration
from sextant.shared.geometry import Array, exp_so3, transform
from sextant.shared.robot.camera import DepthSensor, Intrinsics

_GICP_LEAF, _GICP_VOXEL, _GICP_NEIGHBOURS = 0.03, 0.05, 10  # [m] [m] [1] best of the values tried on seeds from 1000 up
_OPEN3D_VOXEL, _OPEN3D_GATE, _OPEN3D_ITERATIONS = 0.03, 0.10, 30
_THESIS_VOXEL, _THESIS_ITERATIONS, _THESIS_GATE = 0.05, 50, 0.15  # Masri 2016, section 4.2.1
_THESIS_NEIGHBOURS = 12
_CONVERGED = 1e-5


class RegistrationMethod(Protocol):
    """One method on one sequence."""

    def update(self, depth: NDArray[np.uint16], index: int, T_prior: Array, covariance: Array) -> Array:
        """Return the pose (4, 4) of the camera at the next frame.

        The prior is (4, 4) with a covariance (6, 6) [m, rad].
        """
        ...


class Registered:
    """A registration of Sextant's perception, its own or a plug-in's."""

    def __init__(self, registration: frame_registration.RegistrationMethod):
        """Use a registration."""
        self._registration = registration

    def update(self, depth: NDArray[np.uint16], index: int, T_prior: Array, covariance: Array) -> Array:
        """Return the pose (4, 4) of the next frame."""
        return self._registration.update(depth, index, T_prior, covariance).T_world_camera


def _kiss_icp(intrinsics: Intrinsics, sensor: DepthSensor) -> RegistrationMethod:
    from sextant.services.perception.registration.kiss_icp_adapter import KissRegistration  # it has no wheel for every Python

    return Registered(KissRegistration(intrinsics, sensor))


class _Points:
    """Converts frames to points {camera}."""

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor):
        self._x = ((np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx).astype(np.float32)
        self._y = ((np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy).astype(np.float32)[:, None]
        self._scale = np.float32(1.0 / sensor.depth_scale)

    def of(self, depth: NDArray[np.uint16]) -> Array:
        """Return the points (n, 3) [m] of a raw frame."""
        z = depth * self._scale
        seen = z > 0
        out = np.empty((int(seen.sum()), 3))
        out[:, 0], out[:, 1], out[:, 2] = (z * self._x)[seen], (z * self._y)[seen], z[seen]
        return out


class _Vgicp:
    """small_gicp: generalised ICP with a growing map of Gaussian voxels."""

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor):
        import small_gicp

        self._gicp: Any = small_gicp
        self._points = _Points(intrinsics, sensor)
        self._map = small_gicp.GaussianVoxelMap(_GICP_VOXEL)

    def update(self, depth: NDArray[np.uint16], index: int, T_prior: Array, covariance: Array) -> Array:
        cloud, _ = self._gicp.preprocess_points(
            self._points.of(depth), downsampling_resolution=_GICP_LEAF, num_neighbors=_GICP_NEIGHBOURS, num_threads=1
        )
        T = T_prior
        if index:
            found = self._gicp.align(
                self._map, cloud, init_T_target_source=T_prior, max_correspondence_distance=2 * _GICP_VOXEL, num_threads=1
            )
            T = np.asarray(found.T_target_source)
        self._map.insert(cloud, T)
        return T


class _Open3d:
    """Open3D: point-to-plane ICP on voxel grids, with the merged previous frames."""

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor):
        import open3d

        self._o3d: Any = open3d
        self._points = _Points(intrinsics, sensor)
        self._map: Any = None

    def update(self, depth: NDArray[np.uint16], index: int, T_prior: Array, covariance: Array) -> Array:
        o3d, icp = self._o3d, self._o3d.pipelines.registration
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self._points.of(depth))).voxel_down_sample(_OPEN3D_VOXEL)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * _OPEN3D_VOXEL, 20))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        T = T_prior
        if index:
            limits = icp.ICPConvergenceCriteria(max_iteration=_OPEN3D_ITERATIONS)
            estimation = icp.TransformationEstimationPointToPlane()
            T = np.asarray(icp.registration_icp(cloud, self._map, _OPEN3D_GATE, T_prior, estimation, limits).transformation)
        placed = cloud.transform(T)
        self._map = placed if self._map is None else (self._map + placed).voxel_down_sample(_OPEN3D_VOXEL)
        return T


class _Thesis:
    """Masri 2016, section 4.2: frame-to-frame point-to-plane registration.

    It uses a grid of centroids, and starts from the predicted motion.
    """

    def __init__(self, intrinsics: Intrinsics, sensor: DepthSensor):
        from scipy.spatial import cKDTree

        self._tree_of: Any = cKDTree
        self._points = _Points(intrinsics, sensor)
        self._before: tuple[Any, Array, Array] | None = None  # tree, points and normals {world}

    def update(self, depth: NDArray[np.uint16], index: int, T_prior: Array, covariance: Array) -> Array:
        points = _centroids(self._points.of(depth), _THESIS_VOXEL)
        T = T_prior
        if self._before is not None:
            tree, surface, normals = self._before
            for _ in range(_THESIS_ITERATIONS):
                moved = points @ T[:3, :3].T + T[:3, 3]
                distance, nearest = tree.query(moved)
                near = distance < _THESIS_GATE
                p, n = moved[near], normals[nearest[near]]
                J = np.concatenate([n, np.cross(p - T[:3, 3], n)], axis=1)
                residual = np.einsum("ij,ij->i", p - surface[nearest[near]], n)
                step = np.linalg.lstsq(J, -residual, rcond=1e-9)[0]
                T = transform(exp_so3(step[3:]) @ T[:3, :3], T[:3, 3] + step[:3])
                if np.abs(step).max() < _CONVERGED:
                    break
        placed = points @ T[:3, :3].T + T[:3, 3]
        tree = self._tree_of(placed)
        _, around = tree.query(placed, _THESIS_NEIGHBOURS)
        spread = placed[around] - placed[around].mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
        self._before = tree, placed, axes[:, :, 0]
        return T


def _centroids(points: Array, voxel: float) -> Array:
    """Return the mean (m, 3) [m] of the points (n, 3) in each voxel."""
    cells = np.floor(points / voxel).astype(np.int64) + 4096
    keys = (cells[:, 0] << 26) | (cells[:, 1] << 13) | cells[:, 2]
    _, which, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.asarray(np.stack([np.bincount(which, points[:, k]) for k in range(3)], axis=1) / count[:, None])


METHODS: Mapping[str, Callable[[Intrinsics, DepthSensor], RegistrationMethod]] = {
    "projective (default)": lambda i, s: Registered(Registration(i, s)),
    "kiss-icp": _kiss_icp,
    "small_gicp VGICP": _Vgicp,
    "Open3D": _Open3d,
    "thesis ICP": _Thesis,
}
