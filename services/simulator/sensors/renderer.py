"""Software renderer of depth and colour images, based on `raster.py`."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.simulator.physics.solids import Boxes, Capsules, HeightField
from sextant.services.simulator.physics.terrain import DEPTH, Terrain
from sextant.services.simulator.sensors.raster import BLOCK, Canvas, draw_capsules, draw_field, draw_plane, draw_quads
from sextant.shared.geometry import Array, inverse
from sextant.shared.robot.camera import Intrinsics

_LIGHT = np.array([-0.35, -0.45, 0.82])  # direction to the light {world}
_SKY = (178, 200, 220)
_PLANE_COLOUR = (150, 148, 140)
_BOX_COLOUR = (188, 160, 122)
_FIELD_COLOUR = (142, 150, 112)
_ROBOT_COLOUR = (62, 74, 92)
# Corners of the six faces of a box as signs along its axes, counterclockwise seen from outside.
_FACES = np.array(
    [
        [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
        [[-1, -1, -1], [-1, -1, 1], [-1, 1, 1], [-1, 1, -1]],
        [[-1, 1, -1], [-1, 1, 1], [1, 1, 1], [1, 1, -1]],
        [[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1]],
        [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
        [[-1, -1, -1], [-1, 1, -1], [1, 1, -1], [1, -1, -1]],
    ],
    dtype=np.float64,
)


class Renderer:
    """Pinhole camera renderer of one terrain with a robot.

    The faces of the terrain are computed once, and each frame only projects them.
    """

    def __init__(self, terrain: Terrain, intrinsics: Intrinsics):
        self.intrinsics = intrinsics
        look = terrain.look
        quads = _box_quads(terrain.boxes)
        colours = _colours(_BOX_COLOUR, len(quads))
        if look is not None:
            painted = np.repeat(look.boxes, 6, axis=0)
            colours = np.where(np.isfinite(painted), painted, colours)
        self._plane_colour = _own_colour(look.plane if look else None, _PLANE_COLOUR)
        field_colour = _own_colour(look.height_field if look else None, _FIELD_COLOUR)
        field = terrain.height_field
        if field is not None:
            skirt = _skirt(field)
            quads, colours = np.concatenate([quads, skirt]), np.concatenate([colours, _colours(field_colour, len(skirt))])
        self._quads, self._colours = quads, colours
        self._weak = (6 * terrain.weak.box[:, None] + np.arange(6)).ravel()  # indices of the faces of weak boxes
        self._unsunk = quads[self._weak]
        self._robot_colour = np.array(_ROBOT_COLOUR, dtype=np.float64)
        self._plane = np.nan if terrain.plane is None else terrain.plane
        self._field = _FieldMesh(field, field_colour)
        self._lens = float(intrinsics.fx), float(intrinsics.fy), float(intrinsics.cx), float(intrinsics.cy)
        # Row and column numbers as floats, because conversions in the inner loops would prevent vectorisation.
        self._ramp = np.arange(max(intrinsics.width, intrinsics.height), dtype=np.float64)
        shape = intrinsics.height, intrinsics.width
        self._inverse_depth = np.zeros(shape, dtype=np.float32)
        self._rgb = np.zeros((*shape, 3), dtype=np.uint8)
        self._no_rgb = np.zeros((0, 0, 3), dtype=np.uint8)

    def settle(self, sunk: Array) -> None:
        """Set the sinking depths (n,) [m] of the terrain's weak boxes for the next frames."""
        self._quads[self._weak] = self._unsunk - np.repeat(sunk, 6)[:, None, None] * (0.0, 0.0, 1.0)

    def inverse_depth(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.float32]:
        """Render inverse depth (h, w) [1/m], 0 without a surface.

        The returned array is a buffer of the renderer and is valid until the next frame.

        Args:
            T_world_camera: (4, 4) pose of the camera's optical frame.
            robot: Solids to draw in addition to the terrain.

        Raises:
            ValueError: The pose is not (4, 4) or not finite.
        """
        return self._render(T_world_camera, robot, self._no_rgb)

    def depth(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.float32]:
        """Render depth (h, w) [m] along the optical axis, infinite without a surface.

        The arguments are those of `inverse_depth`.
        """
        w = self._render(T_world_camera, robot, self._no_rgb)
        with np.errstate(divide="ignore"):
            return np.asarray(np.float32(1.0) / w)

    def rgb(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.uint8]:
        """Render a flat-shaded colour image (h, w, 3); arguments as in `inverse_depth`."""
        return self.colored(T_world_camera, robot)[0].copy()

    def colored(
        self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Render a flat-shaded colour image (h, w, 3) and its inverse depth (h, w) [1/m].

        Both are buffers of the renderer and are valid until the next frame.
        """
        self._rgb[:] = _SKY
        return self._rgb, self._render(T_world_camera, robot, self._rgb)

    def _render(
        self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None, rgb: NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        T = np.asarray(T_world_camera, dtype=np.float64)
        if T.shape != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError(f"a finite camera pose (4, 4) expected, found {T.shape} with {np.sum(~np.isfinite(T))} bad values")
        T_camera_world = inverse(T)
        light = T_camera_world[:3, :3] @ (_LIGHT / np.linalg.norm(_LIGHT))
        canvas = Canvas(self._inverse_depth, rgb, self._lens, self._ramp, (light[0], light[1], light[2]))
        draw_plane(canvas, T_camera_world, self._plane, self._plane_colour)
        draw_quads(canvas, T_camera_world, self._quads, self._colours)
        mesh = self._field
        if len(mesh.blocks):
            draw_field(canvas, T_camera_world, mesh.heights, mesh.grid, mesh.blocks, mesh.colour)
        if robot is not None:
            boxes, capsules = robot
            draw_quads(canvas, T_camera_world, _box_quads(boxes), _colours(_ROBOT_COLOUR, len(_FACES) * len(boxes)))
            draw_capsules(canvas, T_camera_world, capsules.start, capsules.end, capsules.radius, self._robot_colour)
        return self._inverse_depth


class _FieldMesh:
    """Height field divided into blocks, with a bounding box per block for culling."""

    def __init__(self, field: HeightField | None, colour: Array):
        self.heights = np.zeros((0, 0)) if field is None else np.ascontiguousarray(field.heights)
        self.grid = np.zeros(3) if field is None else np.array([*field.origin, field.resolution])
        self.colour = colour
        blocks = []
        for i in range(0, max(self.heights.shape[0] - 1, 0), BLOCK):
            for j in range(0, self.heights.shape[1] - 1, BLOCK):
                tile = self.heights[i : i + BLOCK + 1, j : j + BLOCK + 1]
                x, y, step = self.grid
                low = [x + i * step, y + j * step, tile.min()]
                high = [x + (i + tile.shape[0] - 1) * step, y + (j + tile.shape[1] - 1) * step, tile.max()]
                blocks.append([i, j, *low, *high])
        self.blocks = np.array(blocks).reshape(-1, 8)


def _own_colour(own: Array | None, usual: tuple[int, int, int]) -> Array:
    """Return the colour (3,) of a surface, the default colour if it is None or NaN."""
    return np.array(usual, dtype=np.float64) if own is None or np.isnan(own).any() else own


def _box_quads(boxes: Boxes) -> Array:
    """Return the faces (6 n, 4, 3) [m] {world} of boxes."""
    corners = np.einsum("nij,fkj,nj->nfki", boxes.R, _FACES, boxes.half) + boxes.centre[:, None, None]
    return np.asarray(corners.reshape(-1, 4, 3))


def _colours(colour: ArrayLike, n: int) -> Array:
    """Repeat one colour for n faces, as an array (n, 3)."""
    return np.tile(np.asarray(colour, dtype=np.float64), (n, 1))


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
        foot = np.stack([rim_x, rim_y, np.full_like(rim_z, low)], axis=1)
        walls.append(np.stack([foot[:-1], foot[1:], top[1:], top[:-1]], axis=1))
    size = np.array([x[-1] - x[0], y[-1] - y[0], DEPTH])
    middle = np.array([(x[0] + x[-1]) / 2, (y[0] + y[-1]) / 2, low - DEPTH / 2])
    return np.concatenate([*walls, _box_quads(Boxes(middle[None], size[None] / 2, np.eye(3)[None]))])
