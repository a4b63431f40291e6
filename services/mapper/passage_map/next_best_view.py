"""Which cells a camera sees from where, and how the body has to stand to see those that are still unknown.

Masri 2016, section 4.7, always raises the body by some 7 cm for the look. Here the heights and attitudes that the standing
legs allow are compared by what each would show: what lies in the picture, in range, not too flat to return light, and not
behind what is known.
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

Cells = NDArray[np.bool_]

SEEN, NEAR, FAR, BESIDE, HIDDEN = 0, 1, 2, 3, 4
WHY: Mapping[int, str] = {
    NEAR: "nearer than the camera measures",
    FAR: "too far or too flat to the line of sight",
    BESIDE: "outside the picture",
    HIDDEN: "hidden behind what stands before",
    SEEN: "in view, without a return",
}
_GRAZING = 0.12  # [1] sine of the angle between ground and line of sight below which light does not come back for certain
_BORDER_PX = 2.5  # [px] of the picture's border, and beside an edge, that the filter against flying pixels takes
_CLEAR = 0.005  # [m] by which known ground must stand into the line of sight to hide what is behind
_JUMP = 0.02  # [m] by which what hides stands above what it hides
_LOWER = 0.03  # [m] below what was expected: another ground
_AROUND = 3  # cells beside those that were not seen where they were expected, to which the same applies
_WORTH = 20  # cells that a look must show
_AS_GOOD = 0.98  # of the best look's cells, with less effort
_PITCHES = np.radians([0.0, -8.0, 8.0])  # [rad] nose down positive
_YAWS = np.radians([0.0, -12.0, 12.0])
_HEIGHTS = 5
_SAMPLES = 1500  # cells at most by which poses are compared


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A body pose to look from."""

    T_world_body: Array  # (4, 4)
    sees: Cells  # (nx, ny) unseen cells that the picture from there will show


def sights(
    grid: PassageGrid, heights: Array, wanted: Cells, T_world_camera: Array, camera: Camera, reach: float
) -> NDArray[np.uint8]:
    """What hinders a camera from seeing cells, were their ground at given heights.

    A cell is seen (0) if its centre projects into the picture at a depth in range, not at a grazing angle, and no ground
    stands into the straight line from the camera.

    Args:
        grid: Where the cells lie.
        heights: (nx, ny) [m] {world} of the ground; NaN hides nothing.
        wanted: (nx, ny) those cells.
        T_world_camera: (4, 4) optical pose.
        camera: Its intrinsics and range.
        reach: [m] horizontally from the camera beyond which scans hold nothing.

    Returns:
        (n,) uint8 of SEEN, NEAR, FAR, BESIDE, HIDDEN for the n wanted cells, row by row.
    """
    return _Ground(grid, heights, wanted).sights(T_world_camera, camera, reach)


class _Ground:
    """Cells and what may hide them in the strip's frame: x along it, y to the left of its right side, z up."""

    def __init__(self, grid: PassageGrid, heights: Array, wanted: Cells):
        strip = grid.strip
        at = local_centres(strip, grid.resolution)[wanted] + [0.0, strip.width / 2]
        self._targets = np.column_stack([at, heights[wanted]])
        self._heights = np.ascontiguousarray(heights, dtype=np.float32)
        self._highest = float(np.nanmax(self._heights)) if np.isfinite(self._heights).any() else -math.inf
        self._resolution = grid.resolution
        right = strip.world([0.0, -strip.width / 2])
        self._T_strip_world = inverse(from_xyz_rpy((*right, 0.0), (0.0, 0.0, strip.heading)))

    def sights(self, T_world_camera: Array, camera: Camera, reach: float) -> NDArray[np.uint8]:
        intrinsics, sensor = camera.intrinsics, camera.sensor
        lens = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, intrinsics.width, intrinsics.height])
        out = np.empty(len(self._targets), dtype=np.uint8)
        _sights(
            self._targets, self._T_strip_world @ T_world_camera, lens, sensor.min_range, sensor.max_range, reach,
            self._heights, self._resolution, self._highest, out,
        )  # fmt: skip
        return out


def expected_heights(grid: PassageGrid, looked_from: Array, camera: Camera, reach: float, level: float) -> Array:
    """Heights (nx, ny) [m] {world} to expect of the ground, the known ones where there are any.

    1. What is hidden goes on as what is seen beyond it: behind a block lies the floor that shows past its shadow.
    2. Ground that would be in view at that height, and yet was not seen, lies lower: as low as the lowest ground known. So
       it is before a pillar in a gap.
    3. What has nothing known beyond it is as the nearest cell that has; `level` [m] where nothing is known at all.

    Args:
        grid: What is known.
        looked_from: (k, 4, 4) optical poses from which the strip was looked at, the present one last.
        camera: Its intrinsics and range.
        reach: [m] horizontally from the camera beyond which scans hold nothing.
        level: [m] {world} height of the ground under the robot.
    """
    towards = local_centres(grid.strip, grid.resolution) - grid.strip.local(looked_from[-1, :2, 3])
    towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-9)
    unseen = grid.unseen
    heights = np.where(unseen, _beyond(grid.elevation, np.ascontiguousarray(towards)), grid.elevation).astype(np.float64)
    behind = unseen & np.isfinite(heights)
    if behind.any():
        lowest = float(np.percentile(grid.elevation[~unseen], 1.0))
        absent = np.zeros(unseen.shape, dtype=np.bool_)
        absent[behind] = _in_view(grid, heights, behind, looked_from, camera, reach)
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
    """Body poses (k, 4, 4) for a look that the legs allow without moving a foot, the least effort first.

    Args:
        profile: Its height range bounds the body's height.
        T_world_body: (4, 4) where the body is; it keeps its place and turns about it.
        feet_world: (6, 3) [m] {world} foot centres.
        ground: [m] {world} height of the ground under the body, from which its height counts.
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
    wanted: Cells,
    looked_from: Array,
    poses: Array,
    camera: Camera,
    reach: float,
) -> View | None:
    """The pose that shows most of the wanted cells; None if none shows enough to be worth it.

    What was in view before and is still unknown gives no return, and would give none from there.

    Args:
        grid: What is known.
        heights: (nx, ny) [m] {world} expected, of the wanted cells.
        wanted: (nx, ny) cells to be seen.
        looked_from: (k, 4, 4) optical poses from which the strip was looked at.
        poses: (m, 4, 4) where the body could be, in the order of preference among those that show as much.
        camera: The camera and how it is mounted.
        reach: [m] horizontally from the camera beyond which scans hold nothing.
    """
    if not wanted.any():
        return None
    T_body_camera = camera.T_body_camera
    wanted = wanted.copy()
    wanted[wanted] = ~_in_view(grid, heights, wanted, looked_from, camera, reach)
    if not wanted.any():
        return None
    every = max(1, math.ceil(np.count_nonzero(wanted) / _SAMPLES))
    sample = np.zeros(wanted.shape, dtype=np.bool_)
    sample.reshape(-1)[np.flatnonzero(wanted)[::every]] = True
    ground = _Ground(grid, heights, sample)
    shown = [ground.sights(T @ T_body_camera, camera, reach) == SEEN for T in poses]
    counts = np.array([int(np.count_nonzero(s)) for s in shown], dtype=np.int64)
    if not len(counts) or every * counts.max() < _WORTH:
        return None
    best = poses[int(np.argmax(counts >= _AS_GOOD * counts.max()))]
    sees = wanted.copy()
    sees[wanted] = sights(grid, heights, wanted, best @ T_body_camera, camera, reach) == SEEN
    return View(np.asarray(best), sees)


def _in_view(grid: PassageGrid, heights: Array, wanted: Cells, looked_from: Array, camera: Camera, reach: float) -> Cells:
    """Which (n,) of the wanted cells are seen from any of some optical poses (k, 4, 4)."""
    ground = _Ground(grid, heights, wanted)
    return np.asarray(np.any([ground.sights(T, camera, reach) == SEEN for T in looked_from], axis=0))


def unseen_in_words(grid: PassageGrid, why: NDArray[np.uint8]) -> str:
    """What of a strip has not been seen and why, for the operator.

    Args:
        grid: What is known.
        why: (n,) of SEEN, NEAR, FAR, BESIDE, HIDDEN for its n unseen cells, row by row.
    """
    unseen = grid.unseen
    if not unseen.any():
        return ""
    along = local_centres(grid.strip, grid.resolution)[..., 0][unseen]
    parts = []
    for reason in sorted(WHY, key=lambda r: -int(np.count_nonzero(why == r))):
        x = along[why == reason]
        if len(x):
            parts.append(f"{len(x)} {WHY[reason]} ({x.min():.2f} to {x.max():.2f} m)")
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
        # From the cell towards the camera, until the line is above all that is ground.
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
            beside = _BORDER_PX / fy * (1.0 - share) * distance  # [m] beside an edge there
            over = ground[i, j] - above
            if over > _CLEAR or (over > -beside and ground[i, j] > targets[k, 2] + _JUMP):
                out[k] = HIDDEN
                break


@compiled
def _beyond(known: NDArray[np.float32], towards: Array) -> Array:
    """First known heights along unit vectors `towards` (nx, ny, 2) from each cell, NaN where there are none.

    A cell in the middle of which one stands has no beyond; its vector is shorter.
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
