"""Depth and colour pictures of the world without any graphics library: a z-buffer in plain loops.

The buffer holds inverse depth, because on a plane 1/z is linear in the pixel: a face costs one multiplication and addition a
pixel and is exact. Faces are drawn as convex polygons, the height field as its triangles, capsules by solving for the ray.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from services.simulator.solids import Boxes, Capsules, HeightField
from services.simulator.terrain import DEPTH, Terrain
from shared.camera import Intrinsics
from shared.compiled import compiled
from shared.geometry import Array, inverse

_NEAR = 1e-3  # [m] faces are clipped here
_EDGE = 1e-9  # [px] faces overlap by this, so that rounding leaves no crack between neighbours
_BLOCK = 16  # cells of a height field culled together
_LIGHT = np.array([-0.35, -0.45, 0.82])  # {world} toward the lamp
_SKY = (178, 200, 220)
_PLANE_COLOUR = (150, 148, 140)
_BOX_COLOUR = (188, 160, 122)
_FIELD_COLOUR = (142, 150, 112)
_ROBOT_COLOUR = (62, 74, 92)
# Corners of a box's six faces, outward and counter-clockwise, as signs along its axes.
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
    """Pictures of one terrain, and of whatever robot stands on it, by a pinhole camera.

    The terrain's faces are prepared once; a frame only projects them.
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
        self._robot_colours = _colours(_ROBOT_COLOUR, len(_FACES))
        self._plane = np.nan if terrain.plane is None else terrain.plane
        self._field = _FieldMesh(field, field_colour)
        self._camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
        # Numbers of rows and columns as floats: converting them in the inner loops would keep those from being vectorised.
        self._ramp = np.arange(max(intrinsics.width, intrinsics.height), dtype=np.float64)
        shape = intrinsics.height, intrinsics.width
        self._inverse_depth = np.zeros(shape, dtype=np.float32)
        self._rgb = np.zeros((*shape, 3), dtype=np.uint8)
        self._no_rgb = np.zeros((0, 0, 3), dtype=np.uint8)

    def inverse_depth(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.float32]:
        """Inverse depth (h, w) [1/m] seen from an optical camera pose (4, 4), zero where there is nothing.

        The array is the renderer's own and lasts until its next picture.

        Raises:
            ValueError: The pose is not (4, 4) or not finite.
        """
        return self._render(T_world_camera, robot, self._no_rgb)

    def depth(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.float32]:
        """Depth (h, w) [m] along the optical axis, infinite where there is nothing; otherwise as `inverse_depth`."""
        w = self._render(T_world_camera, robot, self._no_rgb)
        with np.errstate(divide="ignore"):
            return np.asarray(np.float32(1.0) / w)

    def rgb(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.uint8]:
        """Flat-shaded colour picture (h, w, 3) from an optical camera pose (4, 4)."""
        return self.colored(T_world_camera, robot)[0].copy()

    def colored(
        self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Flat-shaded colour picture (h, w, 3) and its inverse depth (h, w) [1/m]; both are the renderer's own, as above."""
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
        w, camera = self._inverse_depth, self._camera
        _draw_plane(w, rgb, camera, self._ramp, T_camera_world, self._plane, self._plane_colour, light)
        _draw_quads(w, rgb, camera, self._ramp, T_camera_world, self._quads, self._colours, light)
        mesh = self._field
        if len(mesh.blocks):
            _draw_field(w, rgb, camera, self._ramp, T_camera_world, mesh.heights, mesh.grid, mesh.blocks, mesh.colour, light)
        if robot is not None:
            boxes, capsules = robot
            colours = self._robot_colours
            _draw_quads(w, rgb, camera, self._ramp, T_camera_world, _box_quads(boxes), colours, light)
            _draw_capsules(w, rgb, camera, T_camera_world, capsules.start, capsules.end, capsules.radius, colours[0], light)
        return w


class _FieldMesh:
    """A height field in blocks, each with its box for culling."""

    def __init__(self, field: HeightField | None, colour: Array):
        self.heights = np.zeros((0, 0)) if field is None else np.ascontiguousarray(field.heights)
        self.grid = np.zeros(3) if field is None else np.array([*field.origin, field.resolution])
        self.colour = colour
        blocks = []
        for i in range(0, max(self.heights.shape[0] - 1, 0), _BLOCK):
            for j in range(0, self.heights.shape[1] - 1, _BLOCK):
                tile = self.heights[i : i + _BLOCK + 1, j : j + _BLOCK + 1]
                x, y, step = self.grid
                low = [x + i * step, y + j * step, tile.min()]
                high = [x + (i + tile.shape[0] - 1) * step, y + (j + tile.shape[1] - 1) * step, tile.max()]
                blocks.append([i, j, *low, *high])
        self.blocks = np.array(blocks).reshape(-1, 8)


def _own_colour(own: Array | None, usual: tuple[int, int, int]) -> Array:
    """A surface's own colour (3,), or where it has none the usual one."""
    return np.array(usual, dtype=np.float64) if own is None or np.isnan(own).any() else own


def _box_quads(boxes: Boxes) -> Array:
    """Faces (6 n, 4, 3) [m] {world} of boxes."""
    corners = np.einsum("nij,fkj,nj->nfki", boxes.R, _FACES, boxes.half) + boxes.centre[:, None, None]
    return np.asarray(corners.reshape(-1, 4, 3))


def _colours(colour: ArrayLike, n: int) -> Array:
    """One colour (n, 3) for n faces."""
    return np.tile(np.asarray(colour, dtype=np.float64), (n, 1))


def _skirt(field: HeightField) -> Array:
    """The sides and the base (n, 4, 3) [m] {world} of a height field: it is as solid as in the physics."""
    z, low = field.heights, float(field.heights.min())
    nx, ny = z.shape
    x = field.origin[0] + field.resolution * np.arange(nx)
    y = field.origin[1] + field.resolution * np.arange(ny)
    walls = []
    rims = (  # counter-clockwise around the field
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


@compiled
def _draw_plane(
    w: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    camera: Array,
    ramp: Array,
    T: Array,
    height: float,
    colour: Array,
    light: Array,
) -> None:
    """Fill the buffer with level ground, or with nothing for a height of NaN; in colour it is chequered every 0.1 m."""
    rows, columns = w.shape
    fx, fy, cx, cy = camera
    n = T[:3, 2]
    d = height + n[0] * T[0, 3] + n[1] * T[1, 3] + n[2] * T[2, 3]  # n . p = d for points p of the plane, seen from above if < 0
    if not d < 0.0:
        w[:] = 0.0
        return
    a, b = n[0] / (fx * d), n[1] / (fy * d)
    c = n[2] / d - a * cx - b * cy
    for row in range(rows):
        start = b * row + c
        line = w[row]
        for column in range(columns):
            value = np.float32(start + a * ramp[column])
            line[column] = value if value > 0.0 else np.float32(0.0)
    if rgb.shape[0] > 0:
        bright = 0.45 + 0.55 * max(0.0, n[0] * light[0] + n[1] * light[1] + n[2] * light[2])
        for row in range(rows):
            for column in range(columns):
                if w[row, column] > 0.02:
                    z = 1.0 / w[row, column]
                    px = z * (column - cx) / fx - T[0, 3]
                    py = z * (row - cy) / fy - T[1, 3]
                    pz = z - T[2, 3]
                    x = T[0, 0] * px + T[1, 0] * py + T[2, 0] * pz
                    y = T[0, 1] * px + T[1, 1] * py + T[2, 1] * pz
                    odd = (int(np.floor(x * 10.0)) + int(np.floor(y * 10.0))) & 1
                    for k in range(3):
                        rgb[row, column, k] = np.uint8(colour[k] * bright * (0.93 if odd else 1.0))


@compiled
def _shade(normal_x: float, normal_y: float, normal_z: float, light: Array) -> float:
    """Brightness of a surface with a normal of any length: half of it from all sides, half from the lamp."""
    length = np.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
    cosine = (normal_x * light[0] + normal_y * light[1] + normal_z * light[2]) / length
    return float(0.45 + 0.55 * max(0.0, cosine))


@compiled
def _draw_polygon(
    w: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    camera: Array,
    ramp: Array,
    corners: Array,
    count: int,
    scratch: Array,
    spans: NDArray[np.int32],
    nearer: NDArray[np.float32],
    colour: Array,
    light: Array,
) -> None:
    """Draw a convex face (count, 3) [m] {camera}, counter-clockwise seen from outside; its back is not drawn."""
    rows, columns = w.shape
    fx, fy, cx, cy = camera
    p, q, r = corners[0], corners[1], corners[2]
    ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    bx, by, bz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    d = nx * p[0] + ny * p[1] + nz * p[2]
    if not d < 0.0:
        return
    behind = 0
    for i in range(count):
        if corners[i, 2] < _NEAR:
            behind += 1
    if behind == count:
        return
    # 1. Clip at the near plane (Sutherland-Hodgman) and project.
    m = 0
    lowest, highest = np.inf, -np.inf
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        z0, z1 = corners[i, 2], corners[j, 2]
        if z0 >= _NEAR:
            scratch[m, 0] = fx * corners[i, 0] / z0 + cx
            scratch[m, 1] = fy * corners[i, 1] / z0 + cy
            m += 1
        if (z0 >= _NEAR) != (z1 >= _NEAR):
            s = (_NEAR - z0) / (z1 - z0)
            scratch[m, 0] = fx * (corners[i, 0] + s * (corners[j, 0] - corners[i, 0])) / _NEAR + cx
            scratch[m, 1] = fy * (corners[i, 1] + s * (corners[j, 1] - corners[i, 1])) / _NEAR + cy
            m += 1
    for i in range(m):
        lowest, highest = min(lowest, scratch[i, 1]), max(highest, scratch[i, 1])
    first = int(np.ceil(max(lowest - _EDGE, 0.0)))
    last = int(np.floor(min(highest + _EDGE, rows - 1.0)))
    if first > last:
        return
    # 2. Edges: u where an edge crosses row zero, its slope; those that bound rows on the left, then those on the right.
    # Seen from outside in an image whose v points down, the corners run counter-clockwise: left edges go down. A side has
    # four edges at most, a clipped face having five corners; those that are missing bound nothing but the image.
    widest = columns - 1.0
    for i in range(4):
        scratch[i, 2], scratch[i, 3], scratch[i, 4], scratch[i, 5] = 0.0, 0.0, widest, 0.0
    lefts, rights = 0, 0
    for i in range(m):
        j = i + 1 if i + 1 < m else 0
        rise = scratch[j, 1] - scratch[i, 1]
        if abs(rise) > 1e-12:
            slope = (scratch[j, 0] - scratch[i, 0]) / rise
            crossing = scratch[i, 0] - scratch[i, 1] * slope
            if rise > 0.0:
                scratch[lefts, 2], scratch[lefts, 3] = crossing - _EDGE, slope
                lefts += 1
            else:
                scratch[rights, 4], scratch[rights, 5] = crossing + _EDGE, slope
                rights += 1
    # 3. Rows: the columns of each that the edges leave, without branches, so that it runs in vectors.
    p0, p1, p2, p3 = scratch[0, 2], scratch[1, 2], scratch[2, 2], scratch[3, 2]
    q0, q1, q2, q3 = scratch[0, 3], scratch[1, 3], scratch[2, 3], scratch[3, 3]
    r0, r1, r2, r3 = scratch[0, 4], scratch[1, 4], scratch[2, 4], scratch[3, 4]
    s0, s1, s2, s3 = scratch[0, 5], scratch[1, 5], scratch[2, 5], scratch[3, 5]
    for k in range(last - first + 1):
        v = ramp[first + k]
        left = np.ceil(max(max(p0 + q0 * v, p1 + q1 * v), max(p2 + q2 * v, p3 + q3 * v), 0.0))
        right = np.floor(min(min(r0 + s0 * v, r1 + s1 * v), min(r2 + s2 * v, r3 + s3 * v), widest))
        spans[0, k], spans[1, k] = np.int32(left), np.int32(right - left) + np.int32(1)
    # 4. Pixels.
    a, b = nx / (fx * d), ny / (fy * d)
    c = nz / d - a * cx - b * cy
    bright = _shade(nx, ny, nz, light) if rgb.shape[0] > 0 else 0.0
    for k in range(last - first + 1):
        if spans[1, k] <= 0:
            continue
        row, begin, size = np.uint64(first + k), np.uint64(spans[0, k]), np.uint64(spans[1, k])
        start = b * row + c
        if rgb.shape[0] == 0:
            start += a * begin
            for n in range(size):
                value, old = np.float32(start + a * ramp[n]), w[row, begin + n]
                nearer[n] = value if value > old else old  # stored in place it would be a branch, and no vector
            for n in range(size):
                w[row, begin + n] = nearer[n]
        else:
            for column in range(begin, begin + size):
                value = np.float32(start + a * column)
                if value > w[row, column]:
                    w[row, column] = value
                    for channel in range(3):
                        rgb[row, column, channel] = np.uint8(colour[channel] * bright)


@compiled
def _draw_quads(
    w: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    camera: Array,
    ramp: Array,
    T: Array,
    quads: Array,
    colours: Array,
    light: Array,
) -> None:
    """Draw four-cornered faces (n, 4, 3) [m] {world}, T being T_camera_world."""
    scratch, spans, nearer = np.empty((12, 6)), np.empty((2, w.shape[0]), np.int32), np.empty(w.shape[1], np.float32)
    corners = np.empty((4, 3))
    for face in range(len(quads)):
        for i in range(4):
            for k in range(3):
                corners[i, k] = (
                    T[k, 0] * quads[face, i, 0] + T[k, 1] * quads[face, i, 1] + T[k, 2] * quads[face, i, 2] + T[k, 3]
                )
        _draw_polygon(w, rgb, camera, ramp, corners, 4, scratch, spans, nearer, colours[face], light)


@compiled
def _draw_field(
    w: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    camera: Array,
    ramp: Array,
    T: Array,
    heights: Array,
    grid: Array,
    blocks: Array,
    colour: Array,
    light: Array,
) -> None:
    """Draw the triangles of a height field, T being T_camera_world; grid is x0, y0, spacing [m]."""
    rows, columns = w.shape
    fx, fy, cx, cy = camera
    # The pyramid of view: inward normals {camera}, all through the lens.
    sides = np.array(
        [
            [fx, 0.0, cx + 1.0],
            [-fx, 0.0, columns - cx],
            [0.0, fy, cy + 1.0],
            [0.0, -fy, rows - cy],
            [0.0, 0.0, 1.0],
        ]
    )
    size = _BLOCK + 1
    xs, ys, zs = np.empty((size, size)), np.empty((size, size)), np.empty((size, size))
    us, vs = np.empty((size, size)), np.empty((size, size))
    scratch, spans, nearer = np.empty((12, 6)), np.empty((2, w.shape[0]), np.int32), np.empty(w.shape[1], np.float32)
    corners = np.empty((3, 3))
    for block in range(len(blocks)):
        seen = True
        for side in range(5):
            reach = 0.0
            for k in range(3):
                n = sides[side, 0] * T[0, k] + sides[side, 1] * T[1, k] + sides[side, 2] * T[2, k]
                reach += n * (blocks[block, 5 + k] if n > 0.0 else blocks[block, 2 + k])
            reach += sides[side, 0] * T[0, 3] + sides[side, 1] * T[1, 3] + sides[side, 2] * T[2, 3]
            if reach < 0.0:
                seen = False
                break
        if not seen:
            continue
        i0, j0 = int(blocks[block, 0]), int(blocks[block, 1])
        i1, j1 = min(i0 + _BLOCK, heights.shape[0] - 1), min(j0 + _BLOCK, heights.shape[1] - 1)
        for i in range(i0, i1 + 1):
            x = grid[0] + i * grid[2]
            for j in range(j0, j1 + 1):
                y, z = grid[1] + j * grid[2], heights[i, j]
                px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
                py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
                pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
                xs[i - i0, j - j0], ys[i - i0, j - j0], zs[i - i0, j - j0] = px, py, pz
                us[i - i0, j - j0] = fx * px / pz + cx
                vs[i - i0, j - j0] = fy * py / pz + cy
        for i in range(i1 - i0):
            for j in range(j1 - j0):
                for half in range(2):
                    # Corners p, q, r: (i, j), then (i + 1, j) and (i + 1, j + 1), or (i + 1, j + 1) and (i, j + 1).
                    qi, qj, ri, rj = i + 1, j + half, i + 1 - half, j + 1
                    px, py, pz, pu, pv = xs[i, j], ys[i, j], zs[i, j], us[i, j], vs[i, j]
                    qx, qy, qz, qu, qv = xs[qi, qj], ys[qi, qj], zs[qi, qj], us[qi, qj], vs[qi, qj]
                    rx, ry, rz, ru, rv = xs[ri, rj], ys[ri, rj], zs[ri, rj], us[ri, rj], vs[ri, rj]
                    if min(pz, qz, rz) < _NEAR:
                        corners[0, 0], corners[0, 1], corners[0, 2] = px, py, pz
                        corners[1, 0], corners[1, 1], corners[1, 2] = qx, qy, qz
                        corners[2, 0], corners[2, 1], corners[2, 2] = rx, ry, rz
                        _draw_polygon(w, rgb, camera, ramp, corners, 3, scratch, spans, nearer, colour, light)
                        continue
                    top = int(np.ceil(max(min(pv, qv, rv) - _EDGE, 0.0)))
                    bottom = int(np.floor(min(max(pv, qv, rv) + _EDGE, rows - 1.0)))
                    leftmost = np.ceil(max(min(pu, qu, ru) - _EDGE, 0.0))
                    rightmost = np.floor(min(max(pu, qu, ru) + _EDGE, columns - 1.0))
                    if top > bottom or leftmost > rightmost:
                        continue
                    ax, ay, az = qx - px, qy - py, qz - pz
                    bx, by, bz = rx - px, ry - py, rz - pz
                    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                    d = nx * px + ny * py + nz * pz
                    if not d < 0.0:
                        continue
                    a, b = nx / (fx * d), ny / (fy * d)
                    c = nz / d - a * cx - b * cy
                    bright = _shade(nx, ny, nz, light) if rgb.shape[0] > 0 else 0.0
                    # Level edges have an infinite slope and bound no row.
                    pq, qr, rp = (qu - pu) / (qv - pv), (ru - qu) / (rv - qv), (pu - ru) / (pv - rv)
                    for row in range(top, bottom + 1):
                        left, right = leftmost, rightmost
                        if qv - pv > 1e-12:
                            left = max(left, pu + (row - pv) * pq - _EDGE)
                        elif qv - pv < -1e-12:
                            right = min(right, pu + (row - pv) * pq + _EDGE)
                        if rv - qv > 1e-12:
                            left = max(left, qu + (row - qv) * qr - _EDGE)
                        elif rv - qv < -1e-12:
                            right = min(right, qu + (row - qv) * qr + _EDGE)
                        if pv - rv > 1e-12:
                            left = max(left, ru + (row - rv) * rp - _EDGE)
                        elif pv - rv < -1e-12:
                            right = min(right, ru + (row - rv) * rp + _EDGE)
                        if not left <= right:
                            continue
                        start = b * row + c
                        for column in range(int(np.ceil(left)), int(np.floor(right)) + 1):
                            value = np.float32(start + a * column)
                            if value > w[row, column]:
                                w[row, column] = value
                                if rgb.shape[0] > 0:
                                    for k in range(3):
                                        rgb[row, column, k] = np.uint8(colour[k] * bright)


@compiled
def _span(x: float, z: float, radius: float, focal: float, centre: float, size: int) -> tuple[int, int]:
    """First and last pixel along one image axis that a sphere can cover."""
    if z <= radius + _NEAR:
        return 0, size - 1
    root = radius * np.sqrt(x * x + z * z - radius * radius)
    low = (x * z - root) / (z * z - radius * radius)
    high = (x * z + root) / (z * z - radius * radius)
    first = np.floor(focal * low + centre)
    last = np.ceil(focal * high + centre)
    return int(min(max(first, 0.0), float(size))), int(max(min(last, size - 1.0), -1.0))


@compiled
def _ray_sphere(dx: float, dy: float, centre: Array, radius: float) -> float:
    """Depth where the ray (dx, dy, 1) enters a sphere {camera}; infinite if it misses."""
    a = dx * dx + dy * dy + 1.0
    b = dx * centre[0] + dy * centre[1] + centre[2]
    c = centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2 - radius * radius
    root = b * b - a * c
    if root < 0.0:
        return np.inf
    depth = (b - np.sqrt(root)) / a
    return depth if depth > 0.0 else np.inf


@compiled
def _draw_capsules(
    w: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    camera: Array,
    T: Array,
    starts: Array,
    ends: Array,
    radii: Array,
    colour: Array,
    light: Array,
) -> None:
    """Draw capsules from start to end (n, 3) [m] {world}, T being T_camera_world."""
    rows, columns = w.shape
    fx, fy, cx, cy = camera
    sides = np.array(
        [
            [fx, 0.0, cx + 1.0],
            [-fx, 0.0, columns - cx],
            [0.0, fy, cy + 1.0],
            [0.0, -fy, rows - cy],
            [0.0, 0.0, 1.0],
        ]
    )
    for side in range(5):
        sides[side] /= np.sqrt(sides[side, 0] ** 2 + sides[side, 1] ** 2 + sides[side, 2] ** 2)
    p, e, axis = np.empty(3), np.empty(3), np.empty(3)
    for item in range(len(radii)):
        radius = radii[item]
        for k in range(3):
            p[k] = T[k, 3]
            e[k] = T[k, 3]
            for n in range(3):
                p[k] += T[k, n] * starts[item, n]
                e[k] += T[k, n] * ends[item, n]
        seen = True
        for side in range(5):
            at_start = sides[side, 0] * p[0] + sides[side, 1] * p[1] + sides[side, 2] * p[2]
            at_end = sides[side, 0] * e[0] + sides[side, 1] * e[1] + sides[side, 2] * e[2]
            if max(at_start, at_end) < -radius:
                seen = False
        if not seen:
            continue
        length = np.sqrt((e[0] - p[0]) ** 2 + (e[1] - p[1]) ** 2 + (e[2] - p[2]) ** 2)
        for k in range(3):
            axis[k] = (e[k] - p[k]) / length if length > 0.0 else 0.0
        p_axial = p[0] * axis[0] + p[1] * axis[1] + p[2] * axis[2]
        px, py, pz = p[0] - p_axial * axis[0], p[1] - p_axial * axis[1], p[2] - p_axial * axis[2]
        excess = px * px + py * py + pz * pz - radius * radius
        left0, right0 = _span(p[0], p[2], radius, fx, cx, columns)
        left1, right1 = _span(e[0], e[2], radius, fx, cx, columns)
        top0, bottom0 = _span(p[1], p[2], radius, fy, cy, rows)
        top1, bottom1 = _span(e[1], e[2], radius, fy, cy, rows)
        for row in range(min(top0, top1), max(bottom0, bottom1) + 1):
            dy = (row - cy) / fy
            for column in range(min(left0, left1), max(right0, right1) + 1):
                dx = (column - cx) / fx
                depth = min(_ray_sphere(dx, dy, p, radius), _ray_sphere(dx, dy, e, radius))
                d_axial = dx * axis[0] + dy * axis[1] + axis[2]
                ux, uy, uz = dx - d_axial * axis[0], dy - d_axial * axis[1], 1.0 - d_axial * axis[2]
                a = ux * ux + uy * uy + uz * uz
                b = ux * px + uy * py + uz * pz
                root = b * b - a * excess
                if length > 0.0 and root >= 0.0 and a > 0.0:
                    barrel = (b - np.sqrt(root)) / a
                    along = barrel * d_axial - p_axial
                    if barrel > 0.0 and 0.0 <= along <= length:
                        depth = min(depth, barrel)
                if depth < np.inf and np.float32(1.0 / depth) > w[row, column]:
                    w[row, column] = np.float32(1.0 / depth)
                    if rgb.shape[0] > 0:
                        x, y, z = depth * dx - p[0], depth * dy - p[1], depth - p[2]
                        s = min(max(x * axis[0] + y * axis[1] + z * axis[2], 0.0), length)
                        bright = _shade(x - s * axis[0], y - s * axis[1], z - s * axis[2], light)
                        for k in range(3):
                            rgb[row, column, k] = np.uint8(colour[k] * bright)
