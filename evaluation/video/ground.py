"""Ground for rendering: a scenario's true terrain, else the robot's height map."""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.video.robot_figure import GROUND
from sextant.shared.geometry import Array
from sextant.shared.rendering.meshes import box_faces

if TYPE_CHECKING:
    from sextant.services.simulator.physics.terrain import Terrain

_FAR = 60.0  # [m] half extent of level ground
_FILM = 5e-4  # [m] height of puddles above the ground
_STEP = 0.01  # [m] cell size of the raster of the mean surrounding height
_AROUND = 0.035  # [m] standard deviation of that mean
_MOST = 3000  # most cells of that raster along either axis
_NARROWEST = 0.06  # [m] least range of the colours, so that level ground does not look mountainous
RELIEF = ((152, 170, 174), (182, 203, 184), (230, 225, 197), (240, 200, 143), (218, 142, 92))  # R, G, B from low to high


@dataclass(frozen=True, slots=True)
class Ground:
    """Geometry and colours of the ground; each own colour is a separate material."""

    faces: Array  # (n, 4, 3) [m] {world}
    materials: NDArray[np.uint16]  # (n,)
    field: NDArray[np.float64]  # (nx, ny) [m] {world} heights, NaN where there is none; (0, 0) without one
    grid: Array  # (3,) [m] x and y of its first cell, and their spacing
    field_material: int
    heights: NDArray[np.float32]  # (kx, ky) [m] {world} on a raster around the path
    raster: tuple[float, float, float]  # [m] x, y of its first cell, and its step
    low: float  # [m] {world} of the lowest colour
    high: float  # [m] {world}
    colors: tuple[tuple[int, tuple[float, float, float]], ...] = ()  # further materials: number, R, G, B
    sinking: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 6, 4, 3)))  # (k, 6, 4, 3) faces of weak boxes
    sinking_materials: NDArray[np.uint16] = dataclasses.field(default_factory=lambda: np.zeros((0, 6), dtype=np.uint16))

    @property
    def around(self) -> NDArray[np.float32]:
        """Local mean of the raster's heights."""
        known = np.where(np.isfinite(self.heights), self.heights, np.float32(self.low - 0.5))
        return np.asarray(cv2.GaussianBlur(known, (0, 0), _AROUND / self.raster[2]), dtype=np.float32)


def of_terrain(terrain: "Terrain", way: Array) -> Ground:
    """Build a scenario's terrain, coloured by heights along a path (n, 2) [m] {world}."""
    boxes, look = terrain.boxes, terrain.look
    corners = box_faces(boxes.centre, boxes.half, boxes.R)
    faces, materials = [corners.reshape(-1, 4, 3)], [np.full(6 * len(boxes), GROUND, dtype=np.uint16)]
    colors: list[tuple[int, tuple[float, float, float]]] = []

    def painted(color: Array | None) -> int:
        if color is None or not np.isfinite(color).all():
            return GROUND
        rgb = tuple(np.asarray(color, dtype=np.float64).tolist())
        for number, known in colors:
            if known == rgb:
                return number
        colors.append((GROUND + 1 + len(colors), rgb))
        return colors[-1][0]

    if look is not None:
        materials[0] = np.repeat([painted(color) for color in look.boxes], 6).astype(np.uint16)
    weak = np.zeros(len(boxes), dtype=bool)
    weak[terrain.weak.box] = True
    sinking, sinking_materials = corners[terrain.weak.box], materials[0].reshape(-1, 6)[terrain.weak.box]
    faces[0], materials[0] = corners[~weak].reshape(-1, 4, 3), materials[0].reshape(-1, 6)[~weak].ravel()
    if terrain.plane is not None:
        faces.append(_rectangle(way.mean(axis=0) - _FAR, way.mean(axis=0) + _FAR, terrain.plane)[None])
        materials.append(np.array([painted(look.plane if look else None)], dtype=np.uint16))
        for low, high, color in zip(terrain.hollows.low, terrain.hollows.high, terrain.hollows.color, strict=True):
            faces.append(_rectangle(low, high, terrain.plane + _FILM)[None])
            materials.append(np.array([painted(color)], dtype=np.uint16))
    field_, grid, field_material = np.zeros((0, 0)), np.zeros(3), GROUND
    if terrain.height_field is not None:
        field_ = np.ascontiguousarray(terrain.height_field.heights, dtype=np.float64)
        grid = np.array([*terrain.height_field.origin, terrain.height_field.resolution])
        field_material = painted(look.height_field if look else None)
    low, high = way.min(axis=0) - 1.0, way.max(axis=0) + 1.0
    step = max(_STEP, float((high - low).max()) / _MOST)
    nx, ny = np.ceil((high - low) / step).astype(int) + 1
    heights = terrain.raster(low[0], low[1], int(nx), int(ny), step).astype(np.float32)
    bottom, top = _limits(heights)
    return Ground(
        np.concatenate(faces), np.concatenate(materials), field_, grid, field_material,
        heights, (float(low[0]), float(low[1]), step), bottom, top, tuple(colors), sinking, sinking_materials,
    )  # fmt: skip


def of_map(elevation: NDArray[np.float32], origin: Array, resolution: float, limits: tuple[float, float]) -> Ground:
    """Build ground of a height map (nx, ny) [m] {world} between colour limits [m].

    NaN is unknown.
    """
    grid = np.array([*origin, resolution])
    raster = (float(origin[0]), float(origin[1]), resolution)
    none = np.zeros((0, 4, 3))
    return Ground(none, np.zeros(0, dtype=np.uint16), elevation.astype(np.float64), grid, GROUND, elevation, raster, *limits)


def limits_of(elevation: NDArray[np.float32]) -> tuple[float, float]:
    """Return heights [m] of the lowest and highest colour for a map; NaN is unknown."""
    return _limits(elevation)


def _limits(heights: NDArray[np.float32]) -> tuple[float, float]:
    known = heights[np.isfinite(heights)]
    if not len(known):
        return -_NARROWEST / 2, _NARROWEST / 2
    middle = float(np.median(known))
    near = known[np.abs(known - middle) < 0.4]  # an abyss is not part of the relief
    low, high = np.percentile(near, [1.0, 99.5]).tolist()
    spare = max(_NARROWEST - (high - low), 0.0) / 2
    return low - spare, max(high + spare, 2.0 * middle - low)  # most of the ground should not get the colours of high ground


def _rectangle(low: Array, high: Array, z: float) -> Array:
    """Return a level face (4, 3) [m] between two corners (2,) [m]."""
    (x0, y0), (x1, y1) = low, high
    return np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
