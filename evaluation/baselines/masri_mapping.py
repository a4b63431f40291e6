"""Masri's terrain modelling as published (2016, chapter 4): his registration of scans, his world model and his foothold map.

`--registration masri` localizes by it. The thesis names his steps and most sizes; the comment of each constant says what is
assumed. He uses the Point Cloud Library, and this is code of our own for the same steps.

1. Points of a scan within a box ahead (4.1.1), thinned to a voxel grid of 5 cm (4.3).
2. Fifty iterations of ICP with normals against the world model, from the expected motion (4.2).
3. The scan joins the model, in voxels of 1 cm (4.3).
4. Moving least squares, then the highest point of each cell and the mean of its normals (4.4).
5. The foothold map without edges, deep ground and steep normals (4.5), its closing, and the evaluation function (4.6).
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.plugins import Frame, NoPose, Pose, RobotProfile
from sextant.services.mapper.footholds.foothold_map import closed, signed_manhattan
from sextant.services.mapper.passage_map.moving_least_squares import smooth
from sextant.shared.geometry import Array, apply, exp_so3, inverse, transform

BOX: Final = (2.7, 0.75, 0.75)  # [m] ahead, to each side and below the camera: the points that are kept (4.1.1)
COARSE_M: Final = 0.05  # [m] voxels of the registration (4.3)
FINE_M: Final = 0.01  # [m] voxels of the model, and cells of the map (4.3, 4.4)
ITERATIONS: Final = 50  # (4.2.1)
DEPTH_LIMIT_M: Final = 0.25  # [m] below the body, from which ground is inaccessible (4.5)
SLOPE_LIMIT_RAD: Final = math.pi / 4  # of a normal from the vertical (4.4)
CLOSING: Final = 5  # [cells] edge of the square of the closing (4.6)
BOUND: Final = 5  # [cells] of the evaluation function (4.6)
REACH: Final = 15  # [cells] outside, beyond which all cells are equal; as in Sextant's map
_GATE_M: Final = 0.15  # [m] longest correspondence, assumed
_EDGE_M: Final = 0.02  # [m] height difference of two neighbouring cells that makes an edge, assumed
_NEIGHBOURS: Final = 12  # points of a normal, assumed
_FEWEST: Final = 50  # correspondences of a pose, assumed
_SIGMA: Final = (0.005, 0.005)  # [m] and [rad] of a pose, assumed; he states no covariance
_CONVERGED: Final = 1e-6


@dataclass(frozen=True, slots=True)
class HeightMap:
    """Grid of the world model."""

    origin: Array  # (2,) [m] {world} centre of cell (0, 0)
    elevation: NDArray[np.float32]  # (nx, ny) [m] {world}, NaN for vacant cells
    normals: Array  # (nx, ny, 3) unit, NaN for vacant cells


class Nearest:
    """Nearest neighbours in a cloud."""

    def __init__(self, points: Array):
        """Index points (n, 3) [m], at least one."""
        self._points = np.ascontiguousarray(points, dtype=np.float32)
        tree_of: Any = cv2.flann_Index  # type: ignore[attr-defined]
        self._index: Any = tree_of(self._points, {"algorithm": 4})  # a single k-d tree, which is exact

    def of(self, points: Array, count: int = 1) -> tuple[NDArray[np.int64], Array]:
        """Return the indices (m, count) and distances (m, count) [m] of the neighbours of points (m, 3) [m]."""
        query = np.ascontiguousarray(points, dtype=np.float32)
        index, squared = self._index.knnSearch(query, count, params={"checks": -1})
        return index.astype(np.int64), np.sqrt(np.maximum(squared, 0.0)).astype(np.float64)


def cropped(points: Array) -> Array:
    """Return the points (m, 3) of (n, 3) [m] {camera} within the box; z is forward, y down.

    His camera looks along the ground, so that his box lies along its axes. Here it looks down: the box is a distance.
    """
    length, aside, below = BOX
    return points[(points[:, 2] < length) & (np.abs(points[:, 0]) < aside) & (np.abs(points[:, 1]) < below)]


def centroids(points: Array, voxel: float) -> Array:
    """Return the centroid (m, 3) [m] of the points (n, 3) in each voxel (4.3)."""
    cells = np.floor(points / voxel).astype(np.int64) + (1 << 19)
    keys = (cells[:, 0] << 40) | (cells[:, 1] << 20) | cells[:, 2]
    _, which, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.asarray(np.stack([np.bincount(which, points[:, k]) for k in range(3)], axis=1) / count[:, None])


def normals_of(points: Array, near: Nearest) -> Array:
    """Return the normal (n, 3) at each point of a cloud: the direction of its neighbours' least spread."""
    around, _ = near.of(points, min(_NEIGHBOURS, len(points)))
    spread = points[around] - points[around].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    return np.asarray(axes[:, :, 0])


def registered(scan: Array, model: Array, T: Array, normals: bool = True, iterations: int = ITERATIONS) -> tuple[Array, Array]:
    """Align a scan with a model by ICP (4.2).

    Args:
        scan: (n, 3) [m] points {camera}.
        model: (m, 3) [m] points {world}.
        T: (4, 4) expected T_world_camera.
        normals: Whether the distance is that along the model's normals, (4.3), else that of the points, (4.2).
        iterations: Their number.

    Returns:
        (4, 4) T_world_camera, and the mean squared distance [m^2] after each iteration.
    """
    near = Nearest(model)
    surface = normals_of(model, near) if normals else None
    errors = []
    for _ in range(iterations):
        moved = apply(T, scan)
        nearest, distance = near.of(moved)
        close = distance[:, 0] < _GATE_M
        if close.sum() < _FEWEST:
            break
        p, q = moved[close], model[nearest[close, 0]]
        errors.append(float(np.mean(distance[close, 0] ** 2)))
        motion = _to_points(p, q) if surface is None else _to_planes(p, q, surface[nearest[close, 0]])
        T = motion @ T
        if np.abs(motion - np.eye(4)).max() < _CONVERGED:
            break
    return T, np.array(errors)


def _to_points(p: Array, q: Array) -> Array:
    """Return the motion (4, 4) with the least squared distance of points (n, 3) to points (n, 3), eq. (4.2)."""
    middle_p, middle_q = p.mean(axis=0), q.mean(axis=0)
    u, _, vt = np.linalg.svd((p - middle_p).T @ (q - middle_q))
    R = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return transform(R, middle_q - R @ middle_p)


def _to_planes(p: Array, q: Array, n: Array) -> Array:
    """Return the motion (4, 4) with the least squared distance of points (n, 3) to planes at (n, 3) (Chen and Medioni 1991)."""
    middle = p.mean(axis=0)
    J = np.concatenate([n, np.cross(p - middle, n)], axis=1)
    step = np.linalg.lstsq(J, -np.einsum("ij,ij->i", p - q, n), rcond=1e-9)[0]
    R = exp_so3(step[3:])
    return transform(R, middle + step[:3] - R @ middle)


class WorldModel:
    """Cloud of all scans in voxels of 1 cm, each registered against the ones before."""

    def __init__(self) -> None:
        """Begin without points."""
        self.points: Array = np.zeros((0, 3))  # (n, 3) [m] {world}

    def add(self, scan: Array, T: Array) -> Array | None:
        """Register and merge a scan (n, 3) [m] {camera}, expected at T (4, 4); return its T_world_camera.

        Without enough correspondences it returns None, and the scan is left out.
        """
        if len(self.points):
            T, errors = registered(centroids(scan, COARSE_M), centroids(self.points, COARSE_M), T)
            if not len(errors):
                return None
        self.points = centroids(np.concatenate([self.points, apply(T, centroids(scan, FINE_M))]), FINE_M)
        return T

    def height_map(self, low: Array, shape: tuple[int, int], smoothed: bool = True) -> HeightMap:
        """Return the grid from the corner `low` (2,) [m] {world}, of cells of 1 cm (4.4)."""
        size = FINE_M * np.array(shape)
        p = self.points[((self.points[:, :2] >= low) & (self.points[:, :2] < low + size)).all(axis=1)]
        normals = np.tile([0.0, 0.0, 1.0], (len(p), 1))
        if smoothed and len(p):
            surface = smooth(p, np.ones(len(p)))
            p, normals = surface.points, surface.normals
        elevation = np.full(shape, np.nan, dtype=np.float32)
        total = np.zeros((*shape, 3))
        i, j = np.floor((p[:, :2] - low) / FINE_M).astype(int).T
        inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
        i, j, p, normals = i[inside], j[inside], p[inside], normals[inside]
        np.fmax.at(elevation, (i, j), p[:, 2].astype(np.float32))  # the maximum rule
        np.add.at(total, (i, j), np.nan_to_num(normals))
        length = np.linalg.norm(total, axis=2, keepdims=True)
        mean = np.where(length > 0, total / np.maximum(length, 1e-12), np.nan)
        return HeightMap(low + FINE_M / 2, elevation, mean)


def accessible(ground: HeightMap, body_z: float) -> NDArray[np.uint8]:
    """Return the foothold map B (nx, ny), 1 for accessible cells, of a body at a height [m] {world} (4.5)."""
    z = ground.elevation
    known = np.isfinite(z)
    highest = cv2.dilate(np.where(known, z, np.float32(-1e3)), np.ones((3, 3), np.uint8))
    lowest = cv2.erode(np.where(known, z, np.float32(1e3)), np.ones((3, 3), np.uint8))
    edge = (highest - lowest) > _EDGE_M
    with np.errstate(invalid="ignore"):
        steep = ground.normals[..., 2] < math.cos(SLOPE_LIMIT_RAD)
        deep = z < body_z - DEPTH_LIMIT_M
    return np.asarray(known & ~edge & ~deep & ~steep, dtype=np.uint8)


def evaluation(B: NDArray[np.uint8], bound: int = BOUND) -> NDArray[np.int8]:
    """Return the evaluation function (nx, ny) [cells] of a foothold map, closed with a square of 5 cm (4.6)."""
    return signed_manhattan(closed(B, CLOSING // 2), bound, REACH)


class Registration:
    """His localization as a plug-in: each frame is registered against the world model of all frames before."""

    def __init__(self, profile: RobotProfile) -> None:
        """Register frames of a robot's camera."""
        self._intrinsics = profile.camera.intrinsics
        self._model = WorldModel()
        self._covariance = np.diag([_SIGMA[0] ** 2] * 3 + [_SIGMA[1] ** 2] * 3)

    def register(self, frame: Frame) -> Pose | NoPose:
        """Return the pose of a frame."""
        points = cropped(scan_of(frame.depth, self._intrinsics))
        if len(points) < _FEWEST:
            return NoPose("too few points within the box ahead")
        T = self._model.add(points, frame.T_world_camera)
        if T is None:
            return NoPose("too few correspondences with the world model")
        return Pose(T, self._covariance)


def scan_of(depth: NDArray[np.float32], intrinsics: Any) -> Array:
    """Return the points (n, 3) [m] {camera} of a depth frame (h, w) [m], 0 where there is no measurement."""
    return np.asarray(intrinsics.points(np.where(depth > 0, depth, 1.0))[depth > 0], dtype=np.float64)


def error_between(T: Array, truth: Array) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] of a pose (4, 4) from the true one."""
    off = inverse(truth) @ T
    return float(np.linalg.norm(off[:3, 3])), float(math.acos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
