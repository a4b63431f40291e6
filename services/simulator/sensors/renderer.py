"""Software renderer of depth images, based on `shared/rendering/rasterizer.py`."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.physics.solids import Boxes, Capsules, HeightField
from sextant.services.simulator.physics.terrain import DEPTH, Terrain
from sextant.shared.geometry import Array, inverse
from sextant.shared.rendering.meshes import box_faces
from sextant.shared.rendering.rasterizer import (
    Canvas,
    draw_capsules,
    draw_faces,
    draw_field,
    draw_plane,
    field_blocks,
    new_canvas,
)
from sextant.shared.robot.camera import Intrinsics

PLANE, ROBOT, FIELD, BOX = range(4)  # numbers of materials; those of boxes with their own colours follow
_COLOURS = ((150, 148, 140), (62, 74, 92), (142, 150, 112), (188, 160, 122))  # R, G, B of these materials


class Renderer:
    """Pinhole camera renderer of one terrain with a robot.

    The faces of the terrain are computed once, and each frame only projects them.
    """

    def __init__(self, terrain: Terrain, intrinsics: Intrinsics):
        self.intrinsics = intrinsics
        self.colours = np.array(_COLOURS, dtype=np.float64)  # (m, 3) R, G, B of the materials in full light
        look, boxes = terrain.look, terrain.boxes
        materials = np.full(len(boxes), BOX)
        if look is not None:
            colours, index = np.unique(look.boxes, axis=0, return_inverse=True)
            materials = np.where(np.isfinite(look.boxes).all(axis=1), len(_COLOURS) + index.ravel(), BOX)
            self.colours = np.concatenate([self.colours, colours])
            for material, colour in ((PLANE, look.plane), (FIELD, look.height_field)):
                if colour is not None and np.isfinite(colour).all():
                    self.colours[material] = colour
        faces, materials = _box_faces(boxes), np.repeat(materials, 6)
        field = terrain.height_field
        self._heights = np.zeros((0, 0))  # (nx, ny) [m] {world} of the height field
        self._grid = np.zeros(3)  # [m] its origin x, y and its resolution
        if field is not None:
            skirt = _skirt(field)
            faces, materials = np.concatenate([faces, skirt]), np.append(materials, np.full(len(skirt), FIELD))
            self._heights = np.ascontiguousarray(field.heights)
            self._grid = np.array([*field.origin, field.resolution])
        self._blocks = field_blocks(self._heights, self._grid)
        self._faces, self._materials = faces, materials.astype(np.uint16)
        loose = np.concatenate([terrain.weak.box, terrain.tipping.box])
        self._loose = (6 * loose[:, None] + np.arange(6)).ravel()  # indices of the faces of boxes that move
        self._plane = np.nan if terrain.plane is None else terrain.plane
        lens = float(intrinsics.fx), float(intrinsics.fy), float(intrinsics.cx), float(intrinsics.cy)
        self._canvas = new_canvas(intrinsics.width, intrinsics.height, lens, surfaces=False)
        self._colour_canvas: Canvas | None = None

    def settle(self, loose: Boxes) -> None:
        """Set the weak boxes, then the tipping boxes of the terrain, where they are in the next frames."""
        if len(loose):
            self._faces[self._loose] = _box_faces(loose)

    def inverse_depth(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.float32]:
        """Render inverse depth (h, w) [1/m], 0 without a surface.

        The returned array is a buffer of the renderer and is valid until the next frame.

        Args:
            T_world_camera: (4, 4) pose of the camera's optical frame.
            robot: Solids to draw in addition to the terrain.

        Raises:
            ValueError: The pose is not (4, 4) or not finite.
        """
        return self._render(T_world_camera, robot, self._canvas).w

    def depth(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.float32]:
        """Render depth (h, w) [m] along the optical axis, infinite without a surface.

        The arguments are those of `inverse_depth`.
        """
        w = self.inverse_depth(T_world_camera, robot)
        with np.errstate(divide="ignore"):
            return np.asarray(np.float32(1.0) / w)

    def surfaces(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> Canvas:
        """Render inverse depth, normals and materials; `colours` are those of the materials.

        The returned canvas is a buffer of the renderer and is valid until the next frame. The arguments are those of
        `inverse_depth`.
        """
        if self._colour_canvas is None:
            self._colour_canvas = new_canvas(self.intrinsics.width, self.intrinsics.height, self._canvas.lens)
        return self._render(T_world_camera, robot, self._colour_canvas)

    def _render(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None, canvas: Canvas) -> Canvas:
        T = np.asarray(T_world_camera, dtype=np.float64)
        if T.shape != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError(f"a finite camera pose (4, 4) expected, found {T.shape} with {np.sum(~np.isfinite(T))} bad values")
        T_camera_world = inverse(T)
        draw_plane(canvas, T_camera_world, self._plane, PLANE)
        draw_faces(canvas, T_camera_world, self._faces, self._materials)
        if len(self._blocks):
            draw_field(canvas, T_camera_world, self._heights, self._grid, self._blocks, FIELD)
        if robot is not None:
            boxes, capsules = robot
            faces, radii = _box_faces(boxes), np.column_stack([capsules.radius, capsules.radius])
            draw_faces(canvas, T_camera_world, faces, np.full(len(faces), ROBOT, dtype=np.uint16))
            materials = np.full(len(capsules), ROBOT, dtype=np.uint16)
            draw_capsules(canvas, T_camera_world, capsules.start, capsules.end, radii, materials)
        return canvas


def _box_faces(boxes: Boxes) -> Array:
    """Return the faces (6 n, 4, 3) [m] {world} of boxes."""
    return box_faces(boxes.centre, boxes.half, boxes.R).reshape(-1, 4, 3)


def _skirt(field: HeightField) -> Array:
    """Return the sides and the base (n, 4, 3) [m] {world} of a height field.

    They make it solid, as it is in the physics.
    """
    z, low = field.heights, float(field.heights.min())
    nx, ny = z.shape
    x = field.origin[0] + field.resolution * np.arange(nx)
    y = field.origin[1] + field.resolution * np.arange(ny)
    walls = []
    rims = (  # counterclockwise around the field
        (x, np.full(nx, y[0]), z[:, 0]),
        (np.full(ny, x[-1]), y, z[-1]),
        (x[::-1], np.full(nx, y[-1]), z[::-1, -1]),
        (np.full(ny, x[0]), y[::-1], z[0, ::-1]),
    )
    for rim_x, rim_y, rim_z in rims:
        top = np.stack([rim_x, rim_y, rim_z], axis=1)
        bottom = np.stack([rim_x, rim_y, np.full_like(rim_z, low)], axis=1)
        walls.append(np.stack([bottom[:-1], bottom[1:], top[1:], top[:-1]], axis=1))
    size = np.array([x[-1] - x[0], y[-1] - y[0], DEPTH])
    middle = np.array([(x[0] + x[-1]) / 2, (y[0] + y[-1]) / 2, low - DEPTH / 2])
    return np.concatenate([*walls, _box_faces(Boxes(middle[None], size[None] / 2, np.eye(3)[None]))])
