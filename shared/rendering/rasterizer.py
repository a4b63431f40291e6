"""Compiled z-buffer rasteriser of planes, faces, height fields and tapered capsules.

The simulated cameras and the video use it. The buffer holds inverse depth, because 1/z of a plane is linear in the pixel
coordinates. A face is therefore exact and costs one multiplication and one addition per pixel. Faces are drawn as convex
polygons, the height field as triangles, and capsules by ray casting. A canvas with surfaces also holds the normal and the
material of each pixel, so that the caller lights each pixel once afterwards. In all functions T is T_camera_world (4, 4).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled, written_into

BLOCK = 16  # [cells] edge of the blocks of a height field that are culled together
_NEAR = 1e-3  # [m] depth of the near plane, at which faces are clipped
_EDGE = 1e-9  # [px] overlap of faces, which prevents cracks by rounding between neighbours
_LEVEL = 1e-12  # [px] minimum rise of an edge that bounds rows

# Tuples of numbers stay in registers in the inner loops; arrays would need memory access and reference counting.
_Point = tuple[float, float, float]  # [m] {camera}, or a direction
_Lens = tuple[float, float, float, float]  # [px] fx, fy, cx, cy
_Vertex = tuple[float, float, float, float, float]  # x, y, z [m] {camera} and u, v [px]


class Canvas(NamedTuple):
    """Output buffers and intrinsics."""

    w: NDArray[np.float32]  # (h, w) [1/m] inverse depth, 0 without a surface
    normal: NDArray[np.float32]  # (h, w, 3) {world} unit normal of the visible surface; (0, 0, 3) without surfaces
    material: NDArray[np.uint16]  # (h, w) number of the visible material; (0, 0) without surfaces
    lens: _Lens
    ramp: Array  # (n,) 0.0, 1.0, 2.0 ...; row and column numbers as floats, so that the inner loops are vectorised


def new_canvas(width: int, height: int, lens: tuple[float, float, float, float], surfaces: bool = True) -> Canvas:
    """Return an empty canvas of a size [px], with buffers of normals and materials if `surfaces`."""
    shape = (height, width) if surfaces else (0, 0)
    return Canvas(
        np.zeros((height, width), np.float32),
        np.zeros((*shape, 3), np.float32),
        np.zeros(shape, np.uint16),
        lens,
        np.arange(max(width, height), dtype=np.float64),
    )


class _Workspace(NamedTuple):
    """Scratch arrays for drawing a face."""

    corners: Array  # (4, 3) [m] {camera}
    image: Array  # (12, 2) [px] corners of the clipped face
    edges: Array  # (12, 4) [px] left edges: u at row 0 and slope; right edges: u at row 0 and slope
    spans: NDArray[np.int32]  # (2, rows) first column and number of columns of each row
    nearer: NDArray[np.float32]  # (columns,) new inverse depth of a row


class _Surface(NamedTuple):
    """Values that a canvas with surfaces stores for each pixel of a face."""

    x: np.float32  # unit normal {world}
    y: np.float32
    z: np.float32
    material: np.uint16


_NO_SURFACE = _Surface(np.float32(0.0), np.float32(0.0), np.float32(0.0), np.uint16(0))


@compiled
def draw_plane(canvas: Canvas, T: Array, height: float, material: int) -> None:
    """Fill the buffers with level ground at a height [m] {world}; NaN clears the depth."""
    w, ramp = canvas.w, canvas.ramp
    rows, columns = w.shape
    n = T[:3, 2]
    d = height + n[0] * T[0, 3] + n[1] * T[1, 3] + n[2] * T[2, 3]  # plane n . p = d, seen from above if d < 0
    if not d < 0.0:
        w[:] = 0.0
        return
    a, b, c = _inverse_depth_of(canvas.lens, n[0], n[1], n[2], d)
    for row in range(rows):
        start = b * row + c
        line = w[row]
        for column in range(columns):
            value = np.float32(start + a * ramp[column])
            line[column] = value if value > 0.0 else np.float32(0.0)
    canvas.normal[:, :, :2] = 0.0
    canvas.normal[:, :, 2] = 1.0
    canvas.material[:] = material


@compiled
def draw_faces(canvas: Canvas, T: Array, faces: Array, materials: NDArray[np.uint16]) -> None:
    """Draw quadrilateral faces (n, 4, 3) [m] {world}, whose corners are counterclockwise as seen from outside."""
    work = _workspace(canvas)
    corners = work.corners
    for face in range(len(faces)):
        for i in range(4):
            for k in range(3):
                corners[i, k] = (
                    T[k, 0] * faces[face, i, 0] + T[k, 1] * faces[face, i, 1] + T[k, 2] * faces[face, i, 2] + T[k, 3]
                )
        _draw_polygon(canvas, work, T, 4, materials[face])


@compiled
def field_blocks(heights: Array, grid: Array) -> Array:
    """Return the blocks of a height field for `draw_field`; those without a known height are left out.

    Args:
        heights: (nx, ny) [m] {world} heights of the cell corners, NaN where unknown.
        grid: (3,) [m] x and y {world} of the first corner, and the spacing.

    Returns:
        (b, 8) row and column of the first cell, lowest and highest corner {world} of the bounding box of each block.
    """
    x, y, step = grid[0], grid[1], grid[2]
    nx, ny = heights.shape
    blocks = np.empty(((nx // BLOCK + 1) * (ny // BLOCK + 1), 8))
    n = 0
    for i in range(0, nx - 1, BLOCK):
        for j in range(0, ny - 1, BLOCK):
            last_i, last_j = min(i + BLOCK, nx - 1), min(j + BLOCK, ny - 1)
            low, high = np.inf, -np.inf
            for k in range(i, last_i + 1):
                for m in range(j, last_j + 1):
                    if heights[k, m] < low:
                        low = heights[k, m]
                    if heights[k, m] > high:
                        high = heights[k, m]
            if low <= high:
                blocks[n, 0], blocks[n, 1] = i, j
                blocks[n, 2], blocks[n, 3], blocks[n, 4] = x + i * step, y + j * step, low
                blocks[n, 5], blocks[n, 6], blocks[n, 7] = x + last_i * step, y + last_j * step, high
                n += 1
    return blocks[:n].copy()


@compiled
def draw_field(canvas: Canvas, T: Array, heights: Array, grid: Array, blocks: Array, material: int) -> None:
    """Draw the triangles of a height field, except those with an unknown corner.

    The arguments are those and the result of `field_blocks`, and the material of the field.
    """
    work, sides = _workspace(canvas), _pyramid(canvas)
    vertices = np.empty((BLOCK + 1, BLOCK + 1, 5))
    for block in range(len(blocks)):
        if not _in_view(sides, T, blocks[block]):
            continue
        i0, j0 = int(blocks[block, 0]), int(blocks[block, 1])
        i1, j1 = min(i0 + BLOCK, heights.shape[0] - 1), min(j0 + BLOCK, heights.shape[1] - 1)
        _project_vertices(canvas.lens, T, heights, grid, i0, i1, j0, j1, vertices)
        for i in range(i1 - i0):
            for j in range(j1 - j0):
                for half in range(2):
                    p, q = _vertex(vertices, i, j), _vertex(vertices, i + 1, j + half)
                    r = _vertex(vertices, i + 1 - half, j + 1)
                    if p[2] >= _NEAR and q[2] >= _NEAR and r[2] >= _NEAR:
                        _draw_triangle(canvas, T, p, q, r, material)
                        continue
                    for k in range(3):
                        work.corners[0, k], work.corners[1, k], work.corners[2, k] = p[k], q[k], r[k]
                    _draw_polygon(canvas, work, T, 3, material)  # draws nothing if a corner is NaN


@compiled
def draw_capsules(canvas: Canvas, T: Array, starts: Array, ends: Array, radii: Array, materials: NDArray[np.uint16]) -> None:
    """Draw tapered capsules, the hulls of two spheres at (n, 3) [m] {world} with radii (n, 2) [m]."""
    sides = _pyramid(canvas)
    for side in range(5):
        length = np.sqrt(sides[side, 0] ** 2 + sides[side, 1] ** 2 + sides[side, 2] ** 2)
        for k in range(3):
            sides[side, k] /= length
    for item in range(len(radii)):
        p, e = _in_camera(T, starts[item]), _in_camera(T, ends[item])
        seen = True
        for side in range(5):
            inward = (sides[side, 0], sides[side, 1], sides[side, 2])
            if max(_dot(inward, p), _dot(inward, e)) < -max(radii[item, 0], radii[item, 1]):
                seen = False
        if seen:
            _draw_capsule(canvas, T, p, e, radii[item, 0], radii[item, 1], materials[item])


# ------------------------------------------------------------------------------------------------------------- shared


@compiled
def _workspace(canvas: Canvas) -> _Workspace:
    rows, columns = canvas.w.shape
    return _Workspace(
        np.empty((4, 3)), np.empty((12, 2)), np.empty((12, 4)), np.empty((2, rows), np.int32), np.empty(columns, np.float32)
    )


@compiled
def _pyramid(canvas: Canvas) -> Array:
    """Return the inward normals (5, 3) {camera} of the view frustum.

    All planes contain the optical centre.
    """
    rows, columns = canvas.w.shape
    fx, fy, cx, cy = canvas.lens
    return np.array(
        [
            [fx, 0.0, cx + 1.0],
            [-fx, 0.0, columns - cx],
            [0.0, fy, cy + 1.0],
            [0.0, -fy, rows - cy],
            [0.0, 0.0, 1.0],
        ]
    )


@compiled
def _inverse_depth_of(lens: _Lens, nx: float, ny: float, nz: float, d: float) -> tuple[float, float, float]:
    """Return a, b, c of the inverse depth a u + b v + c of the plane n . p = d."""
    fx, fy, cx, cy = lens
    a, b = nx / (fx * d), ny / (fy * d)
    return a, b, nz / d - a * cx - b * cy


@compiled
def _surface(T: Array, nx: float, ny: float, nz: float, material: int) -> _Surface:
    """Return a surface whose normal has these components {camera} and any length."""
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    return _Surface(
        np.float32((T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz) / length),
        np.float32((T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz) / length),
        np.float32((T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz) / length),
        np.uint16(material),
    )


@written_into
def _set_surface(canvas: Canvas, row: int, column: int, surface: _Surface) -> None:
    canvas.normal[row, column, 0] = surface.x
    canvas.normal[row, column, 1] = surface.y
    canvas.normal[row, column, 2] = surface.z
    canvas.material[row, column] = surface.material


# ------------------------------------------------------------------------------------------------------------- faces


@compiled
def _draw_polygon(canvas: Canvas, work: _Workspace, T: Array, count: int, material: int) -> None:
    """Draw the convex face of the workspace's corners, and cull back faces.

    The corners are counterclockwise as seen from outside.
    """
    nx, ny, nz, d = _normal(work.corners[0], work.corners[1], work.corners[2])
    if not d < 0.0:
        return
    # 1. Clip at the near plane and project.
    m = _project(canvas.lens, work.corners, count, work.image)
    if m == 0:
        return
    # 2. Find the covered rows, and the span of columns of each row.
    first, last = _rows(work.image, m, canvas.w.shape[0])
    if first > last:
        return
    widest = canvas.w.shape[1] - 1.0
    _bound(work.image, m, widest, work.edges)
    _span_rows(work.edges, canvas.ramp, first, last, widest, work.spans)
    # 3. Fill the pixels.
    a, b, c = _inverse_depth_of(canvas.lens, nx, ny, nz, d)
    if len(canvas.material) == 0:
        _fill(canvas, work, first, last, a, b, c)
        return
    surface = _surface(T, nx, ny, nz, material)
    for k in range(last - first + 1):
        begin = work.spans[0, k]
        _fill_row(canvas, first + k, begin, begin + work.spans[1, k] - 1, a, b * (first + k) + c, surface)


@compiled
def _normal(p: Array | _Point, q: Array | _Point, r: Array | _Point) -> tuple[float, float, float, float]:
    """Return normal n and offset d of the plane n . p = d through three corners."""
    ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    bx, by, bz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return nx, ny, nz, nx * p[0] + ny * p[1] + nz * p[2]


@compiled
def _project(lens: _Lens, corners: Array, count: int, image: Array) -> int:
    """Clip a face at the near plane, project it, and return its number of corners.

    The clipping is that of Sutherland and Hodgman.
    """
    fx, fy, cx, cy = lens
    m = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        z0, z1 = corners[i, 2], corners[j, 2]
        if z0 >= _NEAR:
            image[m, 0] = fx * corners[i, 0] / z0 + cx
            image[m, 1] = fy * corners[i, 1] / z0 + cy
            m += 1
        if (z0 >= _NEAR) != (z1 >= _NEAR):
            s = (_NEAR - z0) / (z1 - z0)
            image[m, 0] = fx * (corners[i, 0] + s * (corners[j, 0] - corners[i, 0])) / _NEAR + cx
            image[m, 1] = fy * (corners[i, 1] + s * (corners[j, 1] - corners[i, 1])) / _NEAR + cy
            m += 1
    return m


@compiled
def _rows(image: Array, m: int, rows: int) -> tuple[int, int]:
    """Return the first and last image row that a face of m corners covers."""
    lowest, highest = np.inf, -np.inf
    for i in range(m):
        lowest, highest = min(lowest, image[i, 1]), max(highest, image[i, 1])
    return int(np.ceil(max(lowest - _EDGE, 0.0))), int(np.floor(min(highest + _EDGE, rows - 1.0)))


@compiled
def _bound(image: Array, m: int, widest: float, edges: Array) -> None:
    """Compute the left and the right edges of a face: u at row 0 and slope of each.

    The corners run counterclockwise as seen in the image, whose v points down, so left edges go down. A clipped face has at
    most five corners, so a side has at most four edges. Unused edges are the image borders.
    """
    for i in range(4):
        edges[i, 0], edges[i, 1], edges[i, 2], edges[i, 3] = 0.0, 0.0, widest, 0.0
    lefts, rights = 0, 0
    for i in range(m):
        j = i + 1 if i + 1 < m else 0
        rise = image[j, 1] - image[i, 1]
        if abs(rise) > _LEVEL:
            slope = (image[j, 0] - image[i, 0]) / rise
            crossing = image[i, 0] - image[i, 1] * slope
            if rise > 0.0:
                edges[lefts, 0], edges[lefts, 1] = crossing - _EDGE, slope
                lefts += 1
            else:
                edges[rights, 2], edges[rights, 3] = crossing + _EDGE, slope
                rights += 1


@compiled
def _span_rows(edges: Array, ramp: Array, first: int, last: int, widest: float, spans: NDArray[np.int32]) -> None:
    """Compute the span of columns of each row between the edges.

    The loop has no branches, so that it is vectorised.
    """
    p0, p1, p2, p3 = edges[0, 0], edges[1, 0], edges[2, 0], edges[3, 0]
    q0, q1, q2, q3 = edges[0, 1], edges[1, 1], edges[2, 1], edges[3, 1]
    r0, r1, r2, r3 = edges[0, 2], edges[1, 2], edges[2, 2], edges[3, 2]
    s0, s1, s2, s3 = edges[0, 3], edges[1, 3], edges[2, 3], edges[3, 3]
    for k in range(last - first + 1):
        v = ramp[first + k]
        left = np.ceil(max(max(p0 + q0 * v, p1 + q1 * v), max(p2 + q2 * v, p3 + q3 * v), 0.0))
        right = np.floor(min(min(r0 + s0 * v, r1 + s1 * v), min(r2 + s2 * v, r3 + s3 * v), widest))
        spans[0, k], spans[1, k] = np.int32(left), np.int32(right - left) + np.int32(1)


@compiled
def _fill(canvas: Canvas, work: _Workspace, first: int, last: int, a: float, b: float, c: float) -> None:
    """Write the inverse depth a u + b v + c into the spans of rows where it is nearer."""
    w, ramp, spans, nearer = canvas.w, canvas.ramp, work.spans, work.nearer
    for k in range(last - first + 1):
        if spans[1, k] <= 0:
            continue
        row, begin, size = np.uint64(first + k), np.uint64(spans[0, k]), np.uint64(spans[1, k])
        start = b * row + c
        start += a * begin
        for n in range(size):
            value, old = np.float32(start + a * ramp[n]), w[row, begin + n]
            nearer[n] = value if value > old else old  # a conditional store into w would prevent vectorisation
        for n in range(size):
            w[row, begin + n] = nearer[n]


@written_into
def _fill_row(canvas: Canvas, row: int, begin: int, end: int, a: float, start: float, surface: _Surface) -> None:
    """Write a surface into a row where it is nearer.

    The inverse depth is a u + start, in the columns begin to end (inclusive).
    """
    w, noted = canvas.w, len(canvas.material) > 0
    for column in range(begin, end + 1):
        value = np.float32(start + a * column)
        if value > w[row, column]:
            w[row, column] = value
            if noted:
                _set_surface(canvas, row, column, surface)


# ------------------------------------------------------------------------------------------------------------- height fields


@compiled
def _in_view(sides: Array, T: Array, block: Array) -> bool:
    """Return whether the bounding box of a block may intersect the view frustum."""
    for side in range(5):
        reach = 0.0
        for k in range(3):
            n = sides[side, 0] * T[0, k] + sides[side, 1] * T[1, k] + sides[side, 2] * T[2, k]
            reach += n * (block[5 + k] if n > 0.0 else block[2 + k])
        reach += sides[side, 0] * T[0, 3] + sides[side, 1] * T[1, 3] + sides[side, 2] * T[2, 3]
        if reach < 0.0:
            return False
    return True


@compiled
def _project_vertices(
    lens: _Lens, T: Array, heights: Array, grid: Array, i0: int, i1: int, j0: int, j1: int, vertices: Array
) -> None:
    """Compute x, y, z [m] {camera} and u, v [px] of the vertices of a block."""
    fx, fy, cx, cy = lens
    for i in range(i0, i1 + 1):
        x = grid[0] + i * grid[2]
        for j in range(j0, j1 + 1):
            y, z = grid[1] + j * grid[2], heights[i, j]
            px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            vertex = vertices[i - i0, j - j0]
            vertex[0], vertex[1], vertex[2] = px, py, pz
            vertex[3] = fx * px / pz + cx
            vertex[4] = fy * py / pz + cy


@compiled
def _vertex(vertices: Array, i: int, j: int) -> _Vertex:
    return vertices[i, j, 0], vertices[i, j, 1], vertices[i, j, 2], vertices[i, j, 3], vertices[i, j, 4]


@written_into
def _draw_triangle(canvas: Canvas, T: Array, p: _Vertex, q: _Vertex, r: _Vertex, material: int) -> None:
    """Draw a triangle in front of the near plane.

    Its corners are counterclockwise as seen from outside.
    """
    rows, columns = canvas.w.shape
    pu, pv, qu, qv, ru, rv = p[3], p[4], q[3], q[4], r[3], r[4]
    top = int(np.ceil(max(min(pv, qv, rv) - _EDGE, 0.0)))
    bottom = int(np.floor(min(max(pv, qv, rv) + _EDGE, rows - 1.0)))
    leftmost = np.ceil(max(min(pu, qu, ru) - _EDGE, 0.0))
    rightmost = np.floor(min(max(pu, qu, ru) + _EDGE, columns - 1.0))
    if top > bottom or leftmost > rightmost:
        return
    nx, ny, nz, d = _normal(p[:3], q[:3], r[:3])
    if not d < 0.0:
        return
    a, b, c = _inverse_depth_of(canvas.lens, nx, ny, nz, d)
    surface = _surface(T, nx, ny, nz, material) if len(canvas.material) > 0 else _NO_SURFACE
    # Level edges have an infinite slope; `_cut` ignores them.
    pq, qr, rp = (qu - pu) / (qv - pv), (ru - qu) / (rv - qv), (pu - ru) / (pv - rv)
    for row in range(top, bottom + 1):
        left, right = _cut(leftmost, rightmost, qv - pv, pu + (row - pv) * pq)
        left, right = _cut(left, right, rv - qv, qu + (row - qv) * qr)
        left, right = _cut(left, right, pv - rv, ru + (row - rv) * rp)
        if left <= right:
            _fill_row(canvas, row, int(np.ceil(left)), int(np.floor(right)), a, b * row + c, surface)


@compiled
def _cut(left: float, right: float, rise: float, at: float) -> tuple[float, float]:
    """Return the span of a row after clipping at an edge.

    The edge has a rise [px] and crosses the row at the column `at`.
    """
    if rise > _LEVEL:
        return max(left, at - _EDGE), right
    if rise < -_LEVEL:
        return left, min(right, at + _EDGE)
    return left, right


# ------------------------------------------------------------------------------------------------------------- capsules


@compiled
def _span(x: float, z: float, radius: float, focal: float, centre: float, size: int) -> tuple[int, int]:
    """Return the first and last pixel along one image axis that a sphere can cover."""
    if z <= radius + _NEAR:
        return 0, size - 1
    root = radius * np.sqrt(x * x + z * z - radius * radius)
    low = (x * z - root) / (z * z - radius * radius)
    high = (x * z + root) / (z * z - radius * radius)
    first = np.floor(focal * low + centre)
    last = np.ceil(focal * high + centre)
    return int(min(max(first, 0.0), float(size))), int(max(min(last, size - 1.0), -1.0))


@compiled
def _ray_sphere(ray: _Point, centre: _Point, radius: float) -> float:
    """Return the depth at which a ray enters a sphere {camera}.

    The ray is (x, y, 1). The depth is infinite without intersection.
    """
    a = ray[0] * ray[0] + ray[1] * ray[1] + 1.0
    b = ray[0] * centre[0] + ray[1] * centre[1] + centre[2]
    c = centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2 - radius * radius
    root = b * b - a * c
    if root < 0.0:
        return np.inf
    depth = (b - np.sqrt(root)) / a
    return depth if depth > 0.0 else np.inf


@compiled
def _in_camera(T: Array, p: Array) -> _Point:
    x = T[0, 3] + T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2]
    y = T[1, 3] + T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2]
    z = T[2, 3] + T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2]
    return x, y, z


@compiled
def _ray_capsule(ray: _Point, p: _Point, e: _Point, axis: _Point, length: float, radius: float, radius_end: float) -> float:
    """Return the depth at which a ray enters the hull of two spheres {camera}, neither of which contains the other.

    The depth is infinite without intersection. A cone touches both spheres. With taper = (r0 - r1) / length, a point at y along
    the axis and at distance rho from it is on the cone where rho^2 (1 - taper^2) = (r0 - taper y)^2. The cone touches the
    spheres at y = taper r0 and y = length + taper r1.
    """
    taper = (radius - radius_end) / length
    p_axial, ray_axial = _dot(p, axis), _dot(ray, axis)
    off, across = _beside(p, p_axial, axis), _beside(ray, ray_axial, axis)
    m0, m1, slim = radius + taper * p_axial, taper * ray_axial, 1.0 - taper * taper
    a, b = slim * _dot(across, across) - m1 * m1, slim * _dot(across, off) - m0 * m1
    if a > 0.0:
        root = b * b - a * (slim * _dot(off, off) - m0 * m0)
        if root < 0.0:  # the cone contains the spheres
            return np.inf
        depth = (b - np.sqrt(root)) / a
        along = depth * ray_axial - p_axial
        if depth > 0.0 and taper * radius <= along <= length + taper * radius_end:
            return float(depth)
    return min(_ray_sphere(ray, p, radius), _ray_sphere(ray, e, radius_end))


@compiled
def _dot(a: _Point, b: _Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _beside(a: _Point, along: float, axis: _Point) -> _Point:
    """Return a vector minus its component along an axis."""
    return a[0] - along * axis[0], a[1] - along * axis[1], a[2] - along * axis[2]


@compiled
def _draw_capsule(canvas: Canvas, T: Array, p: _Point, e: _Point, radius: float, radius_end: float, material: int) -> None:
    """Draw the hull of two spheres at p and e [m] {camera}."""
    w = canvas.w
    rows, columns = w.shape
    fx, fy, cx, cy = canvas.lens
    way = (e[0] - p[0], e[1] - p[1], e[2] - p[2])
    length = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    if length > abs(radius - radius_end):
        axis = (way[0] / length, way[1] / length, way[2] / length)
    else:  # one sphere contains the other
        axis, length = (0.0, 0.0, 0.0), 0.0
        if radius_end > radius:
            p, radius = e, radius_end
        else:
            e, radius_end = p, radius
    left0, right0 = _span(p[0], p[2], radius, fx, cx, columns)
    left1, right1 = _span(e[0], e[2], radius_end, fx, cx, columns)
    top0, bottom0 = _span(p[1], p[2], radius, fy, cy, rows)
    top1, bottom1 = _span(e[1], e[2], radius_end, fy, cy, rows)
    in_front = min(p[2] - radius, e[2] - radius_end) > _NEAR
    for row in range(min(top0, top1), max(bottom0, bottom1) + 1):
        dy, met = (row - cy) / fy, False
        for column in range(min(left0, left1), max(right0, right1) + 1):
            ray = ((column - cx) / fx, dy, 1.0)
            if length > 0.0:
                depth = _ray_capsule(ray, p, e, axis, length, radius, radius_end)
            else:
                depth = _ray_sphere(ray, p, radius)
            if depth == np.inf:
                if met and in_front:  # a convex solid covers one span of a row
                    break
                continue
            met = True
            if np.float32(1.0 / depth) > w[row, column]:
                w[row, column] = np.float32(1.0 / depth)
                if len(canvas.material) > 0:
                    hit = (depth * ray[0] - p[0], depth * ray[1] - p[1], depth - p[2])
                    taper = (radius - radius_end) / length if length > 0.0 else 0.0
                    centre = (_dot(hit, axis) - taper * radius) / (1.0 - taper * taper)  # of the sphere that touches there
                    nx, ny, nz = _beside(hit, min(max(centre, 0.0), length), axis)
                    _set_surface(canvas, row, column, _surface(T, nx, ny, nz, material))
