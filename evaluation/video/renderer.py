"""Renderer of a robot on its ground: z-buffer first, then lighting."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.video.ground import RELIEF, Ground
from sextant.evaluation.video.robot_figure import COLORS, GROUND, occluders, robot_solids
from sextant.evaluation.video.shading import Grid, Scene, Shadow, light, shade_under
from sextant.shared.geometry import Array, inverse, transform
from sextant.shared.rendering.rasterizer import Canvas, draw_capsules, draw_faces, draw_field, field_blocks, new_canvas
from sextant.shared.robot.profile import RobotProfile

_SUN = np.array([-0.30, 0.62, 0.78])  # {world} toward it: to the side of a robot that starts along x
_SUN_AWAY = 60.0  # [m] so far that its rays are nearly parallel
_GROUND_TEXEL, _ROBOT_TEXEL = 0.003, 0.0016  # [m] of the shadows
_MOST_TEXELS = 5000  # along either axis of the ground's shadow map
_ROBOT_REACH = 0.45  # [m] half side of the shadow map around a robot of the PhantomX's size
_UNDER_STEP = 0.008  # [m] cell size of the sky occlusion below the robot
_SOFT = 0.007  # [m] width of a shadow's soft rim
_CURVE = 4096


@dataclass(frozen=True, slots=True)
class Figure:
    """The robot at one moment."""

    T_world_body: Array  # (4, 4)
    q: Array  # (6, 3) [rad]
    carries: NDArray[np.bool_]  # (6,)
    sunk: Array | None = None  # (k,) [m] depth of each weak box; None without any


@dataclass(frozen=True, slots=True)
class Mark:
    """A ring painted on the ground."""

    p: Array  # (3,) [m] {world}
    inner: float  # [m] radius
    outer: float  # [m]
    color: tuple[int, int, int]  # R, G, B as on a screen


@dataclass(frozen=True, slots=True)
class View:
    """Camera of a picture."""

    T_world_camera: Array  # (4, 4) optical: x right, y down, z forward
    focal: float  # [1] of the picture's height
    middle: float  # [m] to its target


class Renderer:
    """Renders pictures of one size; data of the ground are prepared once per ground."""

    def __init__(self, profile: RobotProfile, size: tuple[int, int], finer: int = 2):
        """Prepare the renderer.

        Args:
            profile: The robot.
            size: Width and height of its pictures [px].
            finer: Supersampling factor along each axis, which smooths edges.
        """
        self._profile, self.size, self._finer = profile, size, finer
        width, height = size
        self._canvas = new_canvas(width * finer, height * finer, (1.0, 1.0, 0.0, 0.0))
        self._linear = np.zeros((height, width, 3), dtype=np.float32)
        self._curve = np.round(255.0 * _encode(np.linspace(0.0, 1.0, _CURVE))).astype(np.uint8)
        self._ground: Ground | None = None
        self._sun = _SUN / np.linalg.norm(_SUN)
        self._reach = _ROBOT_REACH * max(1.0, (profile.links.femur + profile.links.tibia + profile.links.coxa) / 0.25)
        side = round(2 * self._reach / _ROBOT_TEXEL)
        self._robot_shadow = new_canvas(side, side, self._lamp_lens(side, side, _ROBOT_TEXEL), surfaces=False)

    def stand_on(self, ground: Ground) -> None:
        """Set the ground of the next pictures."""
        if ground is self._ground:
            return
        self._ground = ground
        self._around = Grid(ground.around, *ground.raster)
        self._ground_shadow = self._shadow_of(ground)
        self._materials = _materials(ground)
        self._relief = _decode(np.array(RELIEF, dtype=np.float64))

    def paint(self, figure: Figure, view: View, marks: Sequence[Mark] = (), way: Array | None = None) -> NDArray[np.uint8]:
        """Return a picture (h, w, 3) R, G, B.

        Args:
            figure: The robot.
            view: The camera.
            marks: Rings on the ground.
            way: (s, 2, 2) [m] {world} segments of a line on the ground.
        """
        ground, canvas = self._ground, self._canvas
        if ground is None:
            raise ValueError("no ground to paint; call stand_on first")
        solids = robot_solids(self._profile, figure.T_world_body, figure.q, figure.carries)
        faces, face_materials, starts, ends, radii, limb_materials = solids.arrays()
        # 1. Visible surfaces.
        rows, columns = canvas.w.shape
        focal = view.focal * rows
        canvas = canvas._replace(lens=(focal, focal, (columns - 1) / 2, (rows - 1) / 2))
        canvas.w.fill(0.0)
        canvas.material.fill(0)
        T = inverse(view.T_world_camera)
        draw_capsules(canvas, T, starts, ends, radii, limb_materials)
        draw_faces(canvas, T, faces, face_materials)
        _draw_ground(canvas, T, ground)
        loose = ground.sinking.reshape(-1, 4, 3)
        if figure.sunk is not None:
            loose = loose - np.repeat(figure.sunk, 6)[:, None, None] * (0.0, 0.0, 1.0)
        loose_materials = ground.sinking_materials.ravel()
        draw_faces(canvas, T, loose, loose_materials)
        # 2. Shadow and sky occlusion of the robot and other moving parts.
        T_lamp = self._lamp_at(figure.T_world_body[:3, 3])
        shadow = self._robot_shadow
        shadow.w.fill(0.0)
        draw_capsules(shadow, T_lamp, starts, ends, radii, limb_materials)
        draw_faces(shadow, T_lamp, faces, face_materials)
        draw_faces(shadow, T_lamp, loose, loose_materials)
        # 3. Lighting.
        painted = [[*m.p, m.inner, m.outer, *_decode(np.array(m.color, dtype=np.float64))] for m in marks]
        scene = Scene(
            self._sun,
            self._ground_shadow,
            Shadow(shadow, T_lamp, _SOFT / _ROBOT_TEXEL),
            self._around,
            self._under(figure, ground),
            self._materials,
            self._relief,
            ground.low,
            ground.high,
            np.array(painted).reshape(-1, 8),
            np.zeros((0, 2, 2)) if way is None else way,
            view.middle,
        )
        light(canvas, np.ascontiguousarray(view.T_world_camera, dtype=np.float64), scene, self._linear)
        return np.asarray(self._curve[(np.clip(self._linear, 0.0, 1.0) * (_CURVE - 1)).astype(np.intp)])

    def _under(self, figure: Figure, ground: Ground) -> Grid:
        """Return the share of the sky that the robot hides from the nearby ground."""
        x, y = figure.T_world_body[:2, 3] - self._reach
        n = round(2 * self._reach / _UNDER_STEP)
        x0, y0, step = ground.raster
        heights = ground.heights
        i = np.clip(np.round((x + _UNDER_STEP * np.arange(n) - x0) / step).astype(int), 0, heights.shape[0] - 1)
        j = np.clip(np.round((y + _UNDER_STEP * np.arange(n) - y0) / step).astype(int), 0, heights.shape[1] - 1)
        below = heights[np.ix_(i, j)]
        below = np.where(np.isfinite(below), below, np.float32(ground.low))
        out = np.empty((n, n), dtype=np.float32)
        shade_under(below, x, y, _UNDER_STEP, occluders(self._profile, figure.T_world_body, figure.q), out)
        return Grid(out, float(x), float(y), _UNDER_STEP)

    def _lamp_lens(self, width: int, height: int, texel: float) -> tuple[float, float, float, float]:
        return _SUN_AWAY / texel, _SUN_AWAY / texel, (width - 1) / 2, (height - 1) / 2

    def _lamp_at(self, p: Array) -> Array:
        """Return T_lamp_world of the sun when it looks at a place (3,) [m] {world}."""
        z = -self._sun
        x = np.cross(np.array([0.0, 1.0, 0.0]), z)
        x /= np.linalg.norm(x)
        R = np.column_stack([x, np.cross(z, x), z])
        return inverse(transform(R, p + _SUN_AWAY * self._sun))

    def _shadow_of(self, ground: Ground) -> Shadow:
        x0, y0, step = ground.raster
        nx, ny = ground.heights.shape
        middle = np.array([x0 + step * nx / 2, y0 + step * ny / 2, ground.low])
        T = self._lamp_at(middle)
        corners = middle + step / 2 * np.array([[a * nx, b * ny, 0.0] for a in (-1, 1) for b in (-1, 1)])
        seen = np.abs(corners @ T[:3, :3].T + T[:3, 3])[:, :2].max(axis=0) * 2
        texel = max(_GROUND_TEXEL, float(seen.max()) / _MOST_TEXELS)
        width, height = np.ceil(seen / texel).astype(int).tolist()
        canvas = new_canvas(width, height, self._lamp_lens(width, height, texel), surfaces=False)
        _draw_ground(canvas, T, ground)
        return Shadow(canvas, T, max(_SOFT / texel, 1.0))


def _draw_ground(canvas: Canvas, T: Array, ground: Ground) -> None:
    """Draw the fixed ground, for T_camera_world (4, 4)."""
    draw_faces(canvas, T, ground.faces, ground.materials)
    if ground.field.size:
        blocks = field_blocks(ground.field, ground.grid)
        draw_field(canvas, T, ground.field, ground.grid, blocks, ground.field_material)


def _materials(ground: Ground) -> Array:
    """Return the table of materials for `light`."""
    table = np.zeros((GROUND + 1 + len(ground.colors), 5))
    for number, (rgb, gloss) in COLORS.items():
        table[number, :3], table[number, 4] = _decode(np.array(rgb, dtype=np.float64)), gloss
    table[GROUND, 3] = 2.0
    for number, own in ground.colors:
        table[number, :3], table[number, 3] = _decode(np.array(own)), 1.0
    return table


def _decode(rgb: Array) -> Array:
    """Convert screen values, 0 to 255, to linear light."""
    return np.asarray((rgb / 255.0) ** 2.2)


def _encode(linear: Array) -> Array:
    """Convert linear light to screen values, 0 to 1."""
    return np.asarray(linear ** (1.0 / 2.2))
