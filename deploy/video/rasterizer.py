"""Compiled z-buffer loops for faces, height fields and tapered limbs.

The buffer holds inverse depth, because on a plane 1/z is linear in the pixel. Inverse depth, normal and material are stored per
pixel, and `light.py` lights each pixel once afterwards. T is T_camera_world (4, 4) everywhere.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled

_NEAR = 0.02  # [m] near clipping plane
_EDGE = 1e-7  # [px] overlap of faces, so that rounding leaves no crack between neighbours
_Point = tuple[float, float, float]


class Sight(NamedTuple):
    """View of a camera and its intrinsics; a shadow map is the view of a lamp."""

    w: NDArray[np.float32]  # (h, w) [1/m] inverse depth, zero where there is nothing
    normal: NDArray[np.float32]  # (h, w, 3) {world} of unit length; (0, 0, 3) if not needed
    material: NDArray[np.uint8]  # (h, w) number of the visible material; (0, 0) if not needed
    lens: tuple[float, float, float, float]  # [px] fx, fy, cx, cy


def blank(width: int, height: int, lens: tuple[float, float, float, float], only_depth: bool = False) -> Sight:
    """Return an empty view of a size [px]."""
    shape = (0, 0) if only_depth else (height, width)
    return Sight(np.zeros((height, width), np.float32), np.zeros((*shape, 3), np.float32), np.zeros(shape, np.uint8), lens)


@compiled
def draw_faces(sight: Sight, T: Array, faces: Array, materials: NDArray[np.uint8]) -> None:
    """Draw quadrilateral faces (n, 4, 3) [m] {world} with back-face culling.

    Corners are counter-clockwise as seen from outside.
    """
    corners = np.empty((8, 3))
    image = np.empty((8, 2))
    for k in range(len(faces)):
        for i in range(4):
            for axis in range(3):
                corners[i, axis] = (
                    T[axis, 0] * faces[k, i, 0] + T[axis, 1] * faces[k, i, 1] + T[axis, 2] * faces[k, i, 2] + T[axis, 3]
                )
        _draw_polygon(sight, T, corners, 4, image, materials[k])


@compiled
def draw_field(sight: Sight, T: Array, heights: Array, grid: Array, material: int) -> None:
    """Draw a height field as two triangles per cell; skip cells with a NaN corner.

    Args:
        sight: View to draw into.
        T: T_camera_world (4, 4).
        heights: (nx, ny) [m] {world} at the corners of its cells.
        grid: (3,) [m] x and y {world} of the first corner, and their spacing.
        material: Material of the field.
    """
    nx, ny = heights.shape
    rows, columns = sight.w.shape
    fx, fy, cx, cy = sight.lens
    corners, image = np.empty((8, 3)), np.empty((8, 2))
    seen = np.empty((2, ny, 5))  # x, y, z {camera}, u, v of two neighbouring rows of corners
    for i in range(nx):
        row = seen[i % 2]
        for j in range(ny):
            x, y, z = grid[0] + i * grid[2], grid[1] + j * grid[2], heights[i, j]
            for axis in range(3):
                row[j, axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
            near = max(row[j, 2], _NEAR)
            row[j, 3], row[j, 4] = fx * row[j, 0] / near + cx, fy * row[j, 1] / near + cy
        if i == 0:
            continue
        before = seen[(i - 1) % 2]
        for j in range(ny - 1):
            a, b, c, d = before[j], row[j], row[j + 1], before[j + 1]
            if not np.isfinite(a[2] + b[2] + c[2] + d[2]):
                continue
            if max(a[2], b[2], c[2], d[2]) < _NEAR:
                continue
            if min(a[2], b[2], c[2], d[2]) > _NEAR:
                if max(a[3], b[3], c[3], d[3]) < 0.0 or min(a[3], b[3], c[3], d[3]) > columns - 1.0:
                    continue
                if max(a[4], b[4], c[4], d[4]) < 0.0 or min(a[4], b[4], c[4], d[4]) > rows - 1.0:
                    continue
            for half in range(2):
                for axis in range(3):
                    corners[0, axis] = a[axis]
                    corners[1, axis] = b[axis] if half == 0 else c[axis]
                    corners[2, axis] = c[axis] if half == 0 else d[axis]
                _draw_polygon(sight, T, corners, 3, image, material)


@compiled
def draw_limbs(sight: Sight, T: Array, starts: Array, ends: Array, radii: Array, materials: NDArray[np.uint8]) -> None:
    """Draw limbs: hulls of two balls at (n, 3) [m] {world}, with radii (n, 2) [m]."""
    for k in range(len(radii)):
        p, e = _in_camera(T, starts[k]), _in_camera(T, ends[k])
        if min(p[2] - radii[k, 0], e[2] - radii[k, 1]) > _NEAR:  # anything closer is not drawn
            _draw_limb(sight, T, p, e, radii[k, 0], radii[k, 1], materials[k])


@compiled
def _draw_polygon(sight: Sight, T: Array, corners: Array, count: int, image: Array, material: int) -> None:
    """Draw a convex polygon of the first `count` corners (.., 3) [m] {camera}."""
    w, lens = sight.w, sight.lens
    rows, columns = w.shape
    fx, fy, cx, cy = lens
    # 1. Its plane: n . p = d, seen from the front where d < 0; 1/z = (n . ray) / d is linear in the pixel.
    ax, ay, az = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    bx, by, bz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    d = nx * corners[0, 0] + ny * corners[0, 1] + nz * corners[0, 2]
    if not d < 0.0:
        return
    a, b = nx / (fx * d), ny / (fy * d)
    c = nz / d - a * cx - b * cy
    # 2. Clip it at the near plane and project the rest.
    k = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here, there = corners[i, 2] - _NEAR, corners[j, 2] - _NEAR
        if here >= 0.0:
            image[k, 0] = fx * corners[i, 0] / corners[i, 2] + cx
            image[k, 1] = fy * corners[i, 1] / corners[i, 2] + cy
            k += 1
        if (here < 0.0) != (there < 0.0):
            s = here / (here - there)
            image[k, 0] = fx * (corners[i, 0] + s * (corners[j, 0] - corners[i, 0])) / _NEAR + cx
            image[k, 1] = fy * (corners[i, 1] + s * (corners[j, 1] - corners[i, 1])) / _NEAR + cy
            k += 1
    if k < 3:
        return
    # 3. Fill it row by row where it is nearer than the buffer.
    low, high = image[0, 1], image[0, 1]
    for i in range(1, k):
        low, high = min(low, image[i, 1]), max(high, image[i, 1])
    first, last = int(np.ceil(max(low - _EDGE, 0.0))), int(np.floor(min(high + _EDGE, rows - 1.0)))
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    n0 = np.float32((T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz) / length)
    n1 = np.float32((T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz) / length)
    n2 = np.float32((T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz) / length)
    noted = len(sight.material) > 0
    for row in range(first, last + 1):
        left, right = np.inf, -np.inf
        for i in range(k):
            j = i + 1 if i + 1 < k else 0
            v0, v1 = image[i, 1], image[j, 1]
            if min(v0, v1) - _EDGE <= row <= max(v0, v1) + _EDGE:
                s = (row - v0) / (v1 - v0) if abs(v1 - v0) > 1e-12 else 0.0
                s = min(max(s, 0.0), 1.0)
                u = image[i, 0] + s * (image[j, 0] - image[i, 0])
                left, right = min(left, u), max(right, u)
                if abs(v1 - v0) <= 1e-12:
                    left, right = min(left, image[j, 0]), max(right, image[j, 0])
        start = b * row + c
        from_column = int(np.ceil(max(left - _EDGE, 0.0)))
        to_column = int(np.floor(min(right + _EDGE, columns - 1.0)))
        for column in range(from_column, to_column + 1):
            value = np.float32(start + a * column)
            if value > w[row, column]:
                w[row, column] = value
                if noted:
                    sight.normal[row, column, 0] = n0
                    sight.normal[row, column, 1] = n1
                    sight.normal[row, column, 2] = n2
                    sight.material[row, column] = material


@compiled
def _in_camera(T: Array, p: Array) -> _Point:
    x = T[0, 3] + T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2]
    y = T[1, 3] + T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2]
    z = T[2, 3] + T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2]
    return x, y, z


@compiled
def _span(x: float, z: float, radius: float, focal: float, centre: float) -> tuple[float, float]:
    """Return the first and last coordinate of a ball along one image axis."""
    root = radius * np.sqrt(x * x + z * z - radius * radius)
    rest = z * z - radius * radius
    return focal * (x * z - root) / rest + centre, focal * (x * z + root) / rest + centre


@compiled
def _to_ball(ray: _Point, centre: _Point, radius: float) -> float:
    """Return the depth where a ray (x, y, 1) enters a ball {camera}; inf if it misses."""
    a = ray[0] * ray[0] + ray[1] * ray[1] + 1.0
    b = ray[0] * centre[0] + ray[1] * centre[1] + centre[2]
    root = b * b - a * (centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2 - radius * radius)
    return (b - np.sqrt(root)) / a if root >= 0.0 else np.inf


@compiled
def _draw_limb(sight: Sight, T: Array, p: _Point, e: _Point, radius: float, radius_end: float, material: int) -> None:
    """Draw the hull of two balls {camera}.

    Its mantle is the cone that touches both. With k = (r0 - r1) / length, a point at y along the axis and at distance rho from
    it is on that cone where rho sqrt(1 - k^2) = r0 - k y. The cone touches the balls at y = k r0 and y = length + k r1.
    """
    w, normal = sight.w, sight.normal
    rows, columns = w.shape
    fx, fy, cx, cy = sight.lens
    ax, ay, az = e[0] - p[0], e[1] - p[1], e[2] - p[2]
    length = np.sqrt(ax * ax + ay * ay + az * az)
    k = (radius - radius_end) / length if length > 1e-9 else 2.0
    cone = abs(k) < 1.0  # otherwise one ball contains the other
    if cone:
        ax, ay, az = ax / length, ay / length, az / length
    else:
        ax, ay, az, k = 0.0, 0.0, 1.0, 0.0
    cc = 1.0 - k * k
    left, right = _span(p[0], p[2], radius, fx, cx)
    left_end, right_end = _span(e[0], e[2], radius_end, fx, cx)
    top, bottom = _span(p[1], p[2], radius, fy, cy)
    top_end, bottom_end = _span(e[1], e[2], radius_end, fy, cy)
    first_row, last_row = int(max(np.floor(min(top, top_end)), 0.0)), int(min(np.ceil(max(bottom, bottom_end)), rows - 1.0))
    first, last = int(max(np.floor(min(left, left_end)), 0.0)), int(min(np.ceil(max(right, right_end)), columns - 1.0))
    p_axis, pp = p[0] * ax + p[1] * ay + p[2] * az, p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    noted = len(sight.material) > 0
    for row in range(first_row, last_row + 1):
        for column in range(first, last + 1):
            dx, dy = (column - cx) / fx, (row - cy) / fy
            ray = (dx, dy, 1.0)
            depth, nx, ny, nz = np.inf, 0.0, 0.0, 1.0
            to_start, to_end = _to_ball(ray, p, radius), _to_ball(ray, e, radius_end)
            if to_start < depth:
                depth = to_start
                nx, ny, nz = (depth * dx - p[0]) / radius, (depth * dy - p[1]) / radius, (depth - p[2]) / radius
            if to_end < depth:
                depth = to_end
                nx = (depth * dx - e[0]) / radius_end
                ny = (depth * dy - e[1]) / radius_end
                nz = (depth - e[2]) / radius_end
            if cone:
                d_axis, dd, dp = dx * ax + dy * ay + az, dx * dx + dy * dy + 1.0, dx * p[0] + dy * p[1] + p[2]
                # (|q|^2 - y^2) (1 - k^2) = (r0 - k y)^2 for q = t ray - p, y = q . axis
                m0, m1 = radius + k * p_axis, -k * d_axis
                a = cc * (dd - d_axis * d_axis) - m1 * m1
                b = cc * (-dp + d_axis * p_axis) - m0 * m1
                c = cc * (pp - p_axis * p_axis) - m0 * m0
                root = b * b - a * c
                if root >= 0.0 and a > 0.0:
                    t = (-b - np.sqrt(root)) / a
                    y = t * d_axis - p_axis
                    if t < depth and k * radius <= y <= length + k * radius_end:
                        depth = t
                        qx, qy, qz = t * dx - p[0] - y * ax, t * dy - p[1] - y * ay, t - p[2] - y * az
                        beside = np.sqrt(qx * qx + qy * qy + qz * qz)
                        c1 = np.sqrt(cc) / beside
                        nx, ny, nz = c1 * qx + k * ax, c1 * qy + k * ay, c1 * qz + k * az
            if depth < np.inf and depth > 0.0 and np.float32(1.0 / depth) > w[row, column]:
                w[row, column] = np.float32(1.0 / depth)
                if noted:
                    normal[row, column, 0] = T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz
                    normal[row, column, 1] = T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz
                    normal[row, column, 2] = T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz
                    sight.material[row, column] = material
