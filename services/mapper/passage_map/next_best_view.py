"""Visibility of cells from a camera pose, and the next best view of unknown cells.

Masri 2016, section 4.7, always raises the body by about 7 cm for a view. Here the heights and attitudes that the standing legs
allow are compared by the cells that each would show. A cell is visible if it is inside the image and in range, at an angle
that returns light, and not hidden by known ground.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.passage_map.passage_grid import PassageGrid, local_centres
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, yaw_of
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import Camera, RobotProfile
from sextant.shared.runtime.compiled import compiled

CellMask = NDArray[np.bool_]

SEEN, NEAR, FAR, BESIDE, HIDDEN = 0, 1, 2, 3, 4
UNSEEN_REASONS: Mapping[int, str] = {
    NEAR: "closer than the camera's minimum range",
    FAR: "too far away or seen at too flat an angle",
    BESIDE: "outside the image",
    HIDDEN: "hidden behind an obstacle",
    SEEN: "in view, but without a measurement",
}
_GRAZING = 0.12  # [1] sine of the angle between ground and ray, below which a return is uncertain
_BORDER_PX = 2.5  # [px] removed by the flying-pixel filter at the image border and at edges
_CLEAR = 0.005  # [m] by which known ground must exceed the ray to hide cells behind it
_JUMP = 0.02  # [m] height of an occluder above the cell that it hides
_LOWER = 0.03  # [m] below the expected height: different ground
_AROUND = 3  # [cells] around cells that were not seen at their expected height, treated the same way
_MIN_VIEW_CELLS = 20  # minimum number of cells that a view must show
_AS_GOOD = 0.98  # times the cells of the best view: sufficient for a view with less effort
_PITCHES = np.radians([0.0, -8.0, 8.0])  # [rad] positive is nose down
_YAWS = np.radians([0.0, -12.0, 12.0])
_HEIGHTS = 5
_SAMPLES = 1500  # maximum number of cells used to compare poses


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Body pose for a view."""

    T_world_body: Array  # (4, 4)
    sees: CellMask  # (nx, ny) unseen cells that the view will show


def check_visibility(
    grid: PassageGrid, heights: Array, wanted: CellMask, T_world_camera: Array, camera: Camera, reach: float
) -> NDArray[np.uint8]:
    """Determine whether a camera sees cells with given heights, or why not.

    A cell is seen (0) if its centre projects into the image at a depth in range and not at a grazing angle, and no ground
    intersects the ray from the camera.

    Args:
        grid: Map with the cells.
        heights: (nx, ny) [m] {world} of the ground; NaN hides nothing.
        wanted: (nx, ny) mask of the cells.
        T_world_camera: (4, 4) optical pose.
        camera: Intrinsics and range.
        reach: [m] maximum horizontal distance of scan points from the camera.

    Returns:
        (n,) uint8, one of SEEN, NEAR, FAR, BESIDE and HIDDEN per wanted cell, row by row.
    """
    return _Ground(grid, heights, wanted).check_visibility(T_world_camera, camera, reach)


class _Ground:
    """Cells and their possible occluders in the frame of the strip.

    The x axis points along the strip, y to the left of its right side, z up.
    """

    def __init__(self, grid: PassageGrid, heights: Array, wanted: CellMask):
        strip = grid.strip
        at = local_centres(strip, grid.resolution)[wanted] + [0.0, strip.width / 2]
        self._targets = np.column_stack([at, heights[wanted]])
        self._heights = np.ascontiguousarray(heights, dtype=np.float32)
        self._highest = float(np.nanmax(self._heights)) if np.isfinite(self._heights).any() else -math.inf
        self._resolution = grid.resolution
        right = strip.world([0.0, -strip.width / 2])
        self._T_strip_world = inverse(from_xyz_rpy((*right, 0.0), (0.0, 0.0, strip.heading)))

    def check_visibility(self, T_world_camera: Array, camera: Camera, reach: float) -> NDArray[np.uint8]:
        intrinsics, sensor = camera.intrinsics, camera.sensor
        lens = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, intrinsics.width, intrinsics.height])
        out = np.empty(len(self._targets), dtype=np.uint8)
        _sights(
            self._targets, self._T_strip_world @ T_world_camera, lens, sensor.min_range, sensor.max_range, reach,
            self._heights, self._resolution, self._highest, out,
        )  # fmt: skip
        return out


def expected_heights(grid: PassageGrid, view_poses: Array, camera: Camera, reach: float, level: float) -> Array:
    """Estimate the heights (nx, ny) [m] {world} of the ground; known heights are kept.

    1. A hidden cell has the height of the ground seen beyond it: the floor behind a block continues the floor beyond its
       shadow.
    2. Ground that would be in view at that height, and yet was not seen, is lower. It gets the lowest known height. This
       occurs in front of a pillar in a gap.
    3. A cell without known ground beyond it has the height of the nearest cell with one, or `level` [m] if none is known.

    Args:
        grid: Map of the strip.
        view_poses: (k, 4, 4) optical poses of the views so far, with the present one last.
        camera: Intrinsics and range.
        reach: [m] maximum horizontal distance of scan points from the camera.
        level: [m] {world} height of the ground under the robot.
    """
    towards = local_centres(grid.strip, grid.resolution) - grid.strip.local(view_poses[-1, :2, 3])
    towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-9)
    unseen = grid.unseen
    heights = np.where(unseen, _beyond(grid.elevation, np.ascontiguousarray(towards)), grid.elevation).astype(np.float64)
    behind = unseen & np.isfinite(heights)
    if behind.any():
        lowest = float(np.percentile(grid.elevation[~unseen], 1.0))
        absent = np.zeros(unseen.shape, dtype=np.bool_)
        absent[behind] = _in_view(grid, heights, behind, view_poses, camera, reach)
        around = cv2.dilate(absent.astype(np.uint8), np.ones((2 * _AROUND + 1,) * 2)) > 0
        heights[behind & around & (heights > lowest + _LOWER)] = lowest
    open_ = np.isnan(heights)
    if open_.all():
        return np.full(unseen.shape, level)
    if open_.any():
        _, label = cv2.distanceTransformWithLabels(
            open_.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        by_label = np.empty(int(label.max()) + 1)
        by_label[label[~open_]] = heights[~open_]
        heights[open_] = by_label[label[open_]]
    return heights


def candidates(profile: RobotProfile, T_world_body: Array, feet_world: Array, ground: float) -> Array:
    """Return the feasible body poses (k, 4, 4) of a view, least effort first.

    The feet stay in place.

    Args:
        profile: Profile of the robot, with the range of the body height.
        T_world_body: (4, 4) body pose; its x and y are kept.
        feet_world: (6, 3) [m] {world} foot centres.
        ground: [m] {world} height of the ground under the body, the zero of the body height.
    """
    low, high = profile.stance.body_height_range
    yaw, place = yaw_of(T_world_body), T_world_body[:3, 3]
    poses, effort = [], []
    for h in np.linspace(low, high, _HEIGHTS):
        for pitch in _PITCHES:
            for turn in _YAWS:
                poses.append(from_xyz_rpy((place[0], place[1], ground + h), (0.0, pitch, yaw + turn)))
                effort.append(abs(ground + h - place[2]) / 0.05 + (abs(pitch) + abs(turn)) / 0.1)
    T = np.array(poses)[np.argsort(effort, kind="stable")]
    feet_body = np.stack([apply(inverse(pose), feet_world) for pose in T])
    reachable = within_limits(profile, body_inverse(profile, feet_body)).all(axis=(1, 2))
    return np.asarray(T[reachable])


def best_view(
    grid: PassageGrid,
    heights: Array,
    wanted: CellMask,
    view_poses: Array,
    poses: Array,
    camera: Camera,
    reach: float,
) -> View | None:
    """Return the pose that shows the most wanted cells, or None if it shows too few.

    Cells that were in view before and are still unknown give no return, and are not counted.

    Args:
        grid: Map of the strip.
        heights: (nx, ny) [m] {world} expected heights of the wanted cells.
        wanted: (nx, ny) mask of the cells to be seen.
        view_poses: (k, 4, 4) optical poses of the views so far.
        poses: (m, 4, 4) feasible body poses, in order of preference among equally good ones.
        camera: Camera with its mounting pose.
        reach: [m] maximum horizontal distance of scan points from the camera.
    """
    if not wanted.any():
        return None
    T_body_camera = camera.T_body_camera
    wanted = wanted.copy()
    wanted[wanted] = ~_in_view(grid, heights, wanted, view_poses, camera, reach)
    if not wanted.any():
        return None
    every = max(1, math.ceil(np.count_nonzero(wanted) / _SAMPLES))
    sample = np.zeros(wanted.shape, dtype=np.bool_)
    sample.reshape(-1)[np.flatnonzero(wanted)[::every]] = True
    ground = _Ground(grid, heights, sample)
    shown = [ground.check_visibility(T @ T_body_camera, camera, reach) == SEEN for T in poses]
    counts = np.array([int(np.count_nonzero(s)) for s in shown], dtype=np.int64)
    if not len(counts) or every * counts.max() < _MIN_VIEW_CELLS:
        return None
    best = poses[int(np.argmax(counts >= _AS_GOOD * counts.max()))]
    sees = wanted.copy()
    sees[wanted] = check_visibility(grid, heights, wanted, best @ T_body_camera, camera, reach) == SEEN
    return View(np.asarray(best), sees)


def _in_view(grid: PassageGrid, heights: Array, wanted: CellMask, view_poses: Array, camera: Camera, reach: float) -> CellMask:
    """Return which wanted cells (n,) are seen from any of optical poses (k, 4, 4)."""
    ground = _Ground(grid, heights, wanted)
    return np.asarray(np.any([ground.check_visibility(T, camera, reach) == SEEN for T in view_poses], axis=0))


def describe_unseen_cells(grid: PassageGrid, why: NDArray[np.uint8]) -> str:
    """Describe the unseen cells of a strip and the reasons to the operator.

    Args:
        grid: Map of the strip.
        why: (n,) one of SEEN, NEAR, FAR, BESIDE and HIDDEN per unseen cell, row by row.
    """
    unseen = grid.unseen
    if not unseen.any():
        return ""
    along = local_centres(grid.strip, grid.resolution)[..., 0][unseen]
    parts = []
    for reason in sorted(UNSEEN_REASONS, key=lambda r: -int(np.count_nonzero(why == r))):
        x = along[why == reason]
        if len(x):
            parts.append(f"{len(x)} {UNSEEN_REASONS[reason]} ({x.min():.2f} to {x.max():.2f} m)")
    return f"{np.count_nonzero(unseen)} of {unseen.size} cells not seen: {', '.join(parts)}"


@compiled
def _sights(
    targets: Array,
    T: Array,
    lens: Array,
    min_range: float,
    max_range: float,
    reach: float,
    ground: NDArray[np.float32],
    resolution: float,
    highest: float,
    out: NDArray[np.uint8],
) -> None:
    fx, fy, cx, cy, width, height = lens
    rows, columns = ground.shape
    for k in range(len(targets)):
        dx, dy, dz = targets[k, 0] - T[0, 3], targets[k, 1] - T[1, 3], targets[k, 2] - T[2, 3]
        x = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz
        y = T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz
        depth = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
        flat = math.sqrt(dx * dx + dy * dy)
        distance = math.sqrt(flat * flat + dz * dz)
        if depth <= 0.0:
            out[k] = BESIDE
            continue
        u, v = fx * x / depth + cx, fy * y / depth + cy
        if not (_BORDER_PX <= u <= width - 1 - _BORDER_PX and v >= _BORDER_PX):
            out[k] = BESIDE
            continue
        if depth < min_range:
            out[k] = NEAR
            continue
        if v > height - 1 - _BORDER_PX:
            out[k] = BESIDE
            continue
        if depth > max_range or flat > reach or -dz < _GRAZING * distance:
            out[k] = FAR
            continue
        # From the cell towards the camera, until the ray is above all ground.
        out[k] = SEEN
        steps = int(flat / resolution)
        for n in range(1, steps):
            share = n * resolution / flat
            above = targets[k, 2] - share * dz
            if above > highest:
                break
            i = math.floor((targets[k, 0] - share * dx) / resolution)
            j = math.floor((targets[k, 1] - share * dy) / resolution)
            if not (0 <= i < rows and 0 <= j < columns):
                continue
            beside = _BORDER_PX / fy * (1.0 - share) * distance  # [m] height removed by the filter at an edge there
            over = ground[i, j] - above
            if over > _CLEAR or (over > -beside and ground[i, j] > targets[k, 2] + _JUMP):
                out[k] = HIDDEN
                break


@compiled
def _beyond(known: NDArray[np.float32], towards: Array) -> Array:
    """Return the first known height beyond each cell, NaN if there is none.

    The search runs along unit vectors `towards` (nx, ny, 2). Cells with a shorter vector, right at the camera, are omitted.
    """
    rows, columns = known.shape
    out = np.full((rows, columns), np.nan)
    for i in range(rows):
        for j in range(columns):
            if not np.isnan(known[i, j]) or abs(towards[i, j, 0]) + abs(towards[i, j, 1]) < 0.9:
                continue
            x, y = i + 0.5, j + 0.5
            while True:
                x, y = x + towards[i, j, 0], y + towards[i, j, 1]
                if not (0.0 <= x < rows and 0.0 <= y < columns):
                    break
                height = known[int(x), int(y)]
                if not np.isnan(height):
                    out[i, j] = height
                    break
    return out
