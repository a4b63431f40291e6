"""Compiled lighting loops: sun with soft shadows, sky, ambient occlusion and haze.

Colours are linear R, G, B from 0 to 1.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.rendering.rasterizer import Canvas
from sextant.shared.runtime.compiled import compiled, written_into

BY_HEIGHT, GLOSS = 3, 4  # columns of the table of materials, after R, G, B
_SUN = (0.99, 0.925, 0.82)  # multiplied by its cosine
_SKY, _EARTH = (0.36, 0.41, 0.48), (0.26, 0.23, 0.20)  # ambient light from above, and reflected from below
_ZENITH, _HORIZON = (0.40, 0.57, 0.80), (0.74, 0.81, 0.88)
_DEEP = (0.050, 0.064, 0.090)  # colour far below the course
_HAZE_FROM, _HAZE_TO = 1.6, 7.0  # [m] beyond the picture's middle where haze begins, and where it is complete
_WAY, _WAY_COLOR = 0.005, (0.05, 0.20, 0.70)  # [m] half width of the path on the ground
_GRID, _GRID_LINE = 0.10, 0.0011  # [m] spacing of lines on level ground, and half their width
_BIAS = 0.0015  # [m] offset toward the lamp against self-shadowing
_SMOOTH, _CREASE = 0.0014, 0.0035  # relative kinks of the inverse depth on a smooth surface at most, and at an edge at least
_EVEN = 0.02  # most difference of normals on an even face
_LEVEL = 0.7  # z of a normal above which a face is floor, not wall

# Tuples of numbers stay in registers in the inner loops; each array that a function takes costs time.
_Point = tuple[float, float, float]  # [m] {world}, or a direction
_Color = tuple[float, float, float]  # linear R, G, B


class Shadow(NamedTuple):
    """The view of a lamp."""

    canvas: Canvas
    T: Array  # (4, 4) T_lamp_world
    reach: float  # [px] width of its soft rim


class Grid(NamedTuple):
    """Values over the ground, (nx, ny); undefined outside.

    Value (0, 0) is at x, y [m] {world}; `step` [m] is the spacing.
    """

    values: NDArray[np.float32]
    x: float
    y: float
    step: float


class Scene(NamedTuple):
    """Lighting inputs in addition to the camera's view."""

    sun: Array  # (3,) {world} toward it
    ground_shadow: Shadow  # shadow of the ground
    robot_shadow: Shadow
    around: Grid  # [m] mean height of the surrounding ground
    under: Grid  # [1] share of the sky that the robot hides from the ground
    materials: Array  # (m, 5) R, G, B, whether height colours it, gloss
    heights: Array  # (n, 3) colours of heights from low to high
    low: float  # [m] {world}
    high: float  # [m] {world}
    marks: Array  # (k, 8) x, y, z [m] {world}, inner and outer radius [m], R, G, B painted on the ground
    way: Array  # (s, 2, 2) [m] {world} segments of a line painted on the ground
    middle: float  # [m] from the camera to the middle of the picture


@compiled
def light(canvas: Canvas, T_world_camera: Array, scene: Scene, out: NDArray[np.float32]) -> None:
    """Light the view of a camera pose (4, 4) into a picture (h, w, 3).

    The view is an integer factor finer than the picture. A pixel that shows a single even face is lit once, any other pixel at
    each sample.
    """
    T = T_world_camera
    rows, columns, _ = out.shape
    times = len(canvas.w) // rows
    fx, fy, cx, cy = canvas.lens
    w, materials = canvas.w, scene.materials
    # Unpacked here, because unpacking per pixel would cost more than the lighting.
    ground_seen, T_ground, ground_reach = scene.ground_shadow.canvas.w, scene.ground_shadow.T, scene.ground_shadow.reach
    robot_seen, T_robot, robot_reach = scene.robot_shadow.canvas.w, scene.robot_shadow.T, scene.robot_shadow.reach
    ground_lens, robot_lens = scene.ground_shadow.canvas.lens, scene.robot_shadow.canvas.lens
    around_values, around_x, around_y, around_step = scene.around
    under_values, under_x, under_y, under_step = scene.under
    marks, way, normals, seen_materials, heights = scene.marks, scene.way, canvas.normal, canvas.material, scene.heights
    low, high, middle = scene.low, scene.high, scene.middle
    sun = (scene.sun[0], scene.sun[1], scene.sun[2])
    evens, means = np.empty(columns, dtype=np.bool_), np.empty(columns)
    for row in range(rows):
        _find_even(canvas, row * times, times, evens, means)
        for column in range(columns):
            even, top, left = evens[column], row * times, column * times
            total = (0.0, 0.0, 0.0)
            looks = 1 if even else times * times
            wide = 1.25 * times if even else 1.0  # [px] smoothing width of paint; ground is seen at a slant
            for look in range(looks):
                y, x = top + look // times, left + look % times
                near = means[column] if even else np.float64(w[y, x])
                aside = 0.5 * (times - 1) if even else 0.0
                dx, dy = (x + aside - cx) / fx, (y + aside - cy) / fy
                ray = (
                    T[0, 0] * dx + T[0, 1] * dy + T[0, 2],
                    T[1, 0] * dx + T[1, 1] * dy + T[1, 2],
                    T[2, 0] * dx + T[2, 1] * dy + T[2, 2],
                )
                long = np.sqrt(dx * dx + dy * dy + 1.0)
                if near <= 0.0:
                    upward = min(max(2.2 * ray[2] / long, 0.0), 1.0)
                    total = _sum(total, _mix(_HORIZON, _ZENITH, upward))
                    continue
                z = 1.0 / near
                p = (T[0, 3] + z * ray[0], T[1, 3] + z * ray[1], T[2, 3] + z * ray[2])
                normal = (normals[y, x, 0], normals[y, x, 1], normals[y, x, 2])
                # 1. Surface colour.
                material = seen_materials[y, x]
                ground = materials[material, BY_HEIGHT] > 0.0
                if materials[material, BY_HEIGHT] > 1.0:
                    color = _height_color(heights, (p[2] - low) / (high - low))
                    color = _mix(color, _DEEP, min(max((low - 0.10 - p[2]) / 0.25, 0.0), 1.0))
                else:
                    color = (materials[material, 0], materials[material, 1], materials[material, 2])
                if ground and normal[2] > _LEVEL:
                    color = _with_grid(color, p[0], p[1], wide * z / fx)
                    color = _with_marks(color, p, wide * z / fx, marks, way)
                elif ground:
                    color = _mix((0.0, 0.0, 0.0), color, 0.78)
                # 2. Incoming light.
                lit = max(normal[0] * sun[0] + normal[1] * sun[1] + normal[2] * sun[2], 0.0)
                if lit > 0.0:
                    lit *= _shadow(ground_seen, T_ground, ground_lens, ground_reach, p, normal)
                if lit > 0.0:
                    lit *= _shadow(robot_seen, T_robot, robot_lens, robot_reach, p, normal)
                around = _at(around_values, around_x, around_y, around_step, p[0], p[1])
                under = _at(under_values, under_x, under_y, under_step, p[0], p[1]) if ground else np.nan
                open_sky = _open_sky(around, under, p[2])
                # 3. Reflection toward the camera, and haze.
                gloss = materials[material, GLOSS]
                if gloss > 0.0:
                    gloss *= _reflection(sun, normal, (ray[0] / long, ray[1] / long, ray[2] / long), lit)
                haze = min(max((z * long - middle - _HAZE_FROM) / (_HAZE_TO - _HAZE_FROM), 0.0), 1.0)
                haze = haze * haze * (3.0 - 2.0 * haze)
                edge = 1.0 if even or not ground else 1.0 - 0.38 * _crease(w, y, x) * (1.0 - haze)
                sky = _mix(_EARTH, _SKY, 0.5 + 0.5 * normal[2])
                seen = (
                    edge * (color[0] * (_SUN[0] * lit + sky[0] * open_sky) + gloss),
                    edge * (color[1] * (_SUN[1] * lit + sky[1] * open_sky) + gloss),
                    edge * (color[2] * (_SUN[2] * lit + sky[2] * open_sky) + gloss),
                )
                total = _sum(total, _mix(seen, _HORIZON, haze))
            for k in range(3):
                out[row, column, k] = total[k] / looks


@written_into
def _sum(one: _Color, other: _Color) -> _Color:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


@written_into
def _mix(one: _Color, other: _Color, share: float) -> _Color:
    """Interpolate from one colour to another."""
    return (
        one[0] + share * (other[0] - one[0]),
        one[1] + share * (other[1] - one[1]),
        one[2] + share * (other[2] - one[2]),
    )


@compiled
def _find_even(canvas: Canvas, top: int, times: int, evens: NDArray[np.bool_], means: Array) -> None:
    """Find which pixels of a row show a single even face, and the mean inverse depth [1/m] of their samples.

    `top` is the first of the row's `times` lines in the canvas.
    """
    w, normals, materials = canvas.w, canvas.normal, canvas.material
    for column in range(len(evens)):
        left, even, total = column * times, True, 0.0
        for y in range(top, top + times):
            for x in range(left, left + times):
                total += w[y, x]
                even = (
                    even
                    and materials[y, x] == materials[top, left]
                    and abs(normals[y, x, 0] - normals[top, left, 0]) < _EVEN
                    and abs(normals[y, x, 1] - normals[top, left, 1]) < _EVEN
                    and abs(normals[y, x, 2] - normals[top, left, 2]) < _EVEN
                    and (w[y, x] <= 0.0 or _kink(w, y, x) <= _SMOOTH * w[y, x])
                )
        evens[column], means[column] = even, total / (times * times)


@written_into
def _height_color(heights: Array, share: float) -> _Color:
    """Interpolate in a scale of colours (n, 3), from 0 at the first to 1 at the last."""
    at = min(max(share, 0.0), 1.0) * (len(heights) - 1)
    i = min(int(at), len(heights) - 2)
    return _mix(
        (heights[i, 0], heights[i, 1], heights[i, 2]), (heights[i + 1, 0], heights[i + 1, 1], heights[i + 1, 2]), at - i
    )


@written_into
def _open_sky(around: float, under: float, z: float) -> float:
    """Return the share of the sky that a place at a height [m] sees.

    `around` is the mean height of the surrounding ground [m], and `under` the share that the robot hides; NaN is unknown.
    """
    sky = 1.0
    if np.isfinite(around):
        sky = 1.0 - 0.6 * min(max((around - z) / 0.045, 0.0), 1.0)
    if np.isfinite(under):
        sky *= 1.0 - under
    return sky


@written_into
def _reflection(sun: _Point, normal: _Point, ray: _Point, lit: float) -> float:
    """Return the light that a glossy surface reflects along a unit ray that reaches it."""
    hx, hy, hz = sun[0] - ray[0], sun[1] - ray[1], sun[2] - ray[2]
    size = np.sqrt(hx * hx + hy * hy + hz * hz)
    shine = max((normal[0] * hx + normal[1] * hy + normal[2] * hz) / size, 0.0) ** 40
    rim = (1.0 - max(-(normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]), 0.0)) ** 4
    return float(shine * min(2.0 * lit, 1.0) + 0.35 * rim * (0.5 + 0.5 * normal[2]))


@written_into
def _with_grid(color: _Color, x: float, y: float, pixel: float) -> _Color:
    """Darken a colour on faint lines of the ground; they fade where a pixel is wider than a line."""
    for at in (x, y):
        off = abs(at - _GRID * np.round(at / _GRID))
        share = min(max((_GRID_LINE + 0.5 * pixel - off) / pixel, 0.0), 1.0) * min(2.0 * _GRID_LINE / pixel, 1.0)
        color = _mix(color, (0.0, 0.0, 0.0), 0.34 * share)
    return color


@written_into
def _with_marks(color: _Color, p: _Point, pixel: float, marks: Array, way: Array) -> _Color:
    """Paint rings with a tinted middle, and the path, over a colour of the ground.

    Their rims are as soft as a pixel is wide.
    """
    x, y, z = p
    for s in range(len(way)):
        ax, ay = way[s, 0, 0], way[s, 0, 1]
        bx, by = way[s, 1, 0] - ax, way[s, 1, 1] - ay
        size = bx * bx + by * by
        t = min(max(((x - ax) * bx + (y - ay) * by) / size, 0.0), 1.0) if size > 0.0 else 0.0
        off = np.sqrt((x - ax - t * bx) ** 2 + (y - ay - t * by) ** 2)
        color = _mix(color, _WAY_COLOR, min(max((_WAY - off) / pixel + 0.5, 0.0), 1.0))
    for k in range(len(marks)):
        dx, dy, reach = x - marks[k, 0], y - marks[k, 1], marks[k, 4] + pixel
        if dx * dx + dy * dy < reach * reach and abs(z - marks[k, 2]) < 0.03:
            off = np.sqrt(dx * dx + dy * dy)
            rim = min(max((off - marks[k, 3]) / pixel + 0.5, 0.0), 1.0) if marks[k, 3] > 0.0 else 1.0
            share = min(max((marks[k, 4] - off) / pixel + 0.5, 0.0), 1.0) * (0.30 + 0.62 * rim)
            color = _mix(color, (marks[k, 5], marks[k, 6], marks[k, 7]), share)
    return color


@written_into
def _at(values: NDArray[np.float32], x0: float, y0: float, step: float, x: float, y: float) -> float:
    """Interpolate a grid at a place; NaN outside."""
    u, v = (x - x0) / step, (y - y0) / step
    nx, ny = values.shape
    if not (0.0 <= u < nx - 1 and 0.0 <= v < ny - 1):
        return np.nan
    i, j = int(u), int(v)
    u, v = u - i, v - j
    low = values[i, j] * (1.0 - u) + values[i + 1, j] * u
    high = values[i, j + 1] * (1.0 - u) + values[i + 1, j + 1] * u
    return float(low * (1.0 - v) + high * v)


@written_into
def _shadow(
    seen: NDArray[np.float32],
    T: Array,
    lens: tuple[float, float, float, float],
    reach: float,
    p: _Point,
    normal: _Point,
) -> float:
    """Return the share of a lamp's light that reaches a place on a face {world}.

    It is 1 outside the lamp's view. The face is extended as a plane around the place for comparison with the lamp's depths.
    """
    fx, fy, cx, cy = lens
    (x, y, z), (nx, ny, nz) = p, normal
    a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    u, v = fx * a / c + cx, fy * b / c + cy
    rows, columns = seen.shape
    margin = 2.0 * reach + 1.0
    if not (margin <= u < columns - 1 - margin and margin <= v < rows - 1 - margin):
        return 1.0
    la = T[0, 0] * nx + T[0, 1] * ny + T[0, 2] * nz
    lb = T[1, 0] * nx + T[1, 1] * ny + T[1, 2] * nz
    lc = T[2, 0] * nx + T[2, 1] * ny + T[2, 2] * nz
    d = min(la * a + lb * b + lc * c, -0.05 * c)  # below 0 where the lamp sees the front; limited for grazing light
    gu, gv = la / (fx * d), lb / (fy * d)  # change of the face's inverse depth from pixel to pixel
    own = (1.0 + _BIAS / c) / c
    u0, v0 = int(u + 0.5), int(v + 0.5)
    own += gu * (u0 - u) + gv * (v0 - v)
    # If the corners and the middle agree, so does mostly everything between them.
    free, r = 0, int(reach + 0.5)
    for i in (-1, 1):
        for j in (-1, 1):
            free += seen[v0 + r * i, u0 + r * j] <= own + r * (gu * j + gv * i)
    middle = seen[v0, u0] <= own
    if free == 0 and not middle:
        return 0.0
    if free == 4 and middle:
        return 1.0
    free = 0
    for i in range(-2, 3):
        for j in range(-2, 3):
            down, aside = int(np.round(0.5 * reach * i)), int(np.round(0.5 * reach * j))
            if seen[v0 + down, u0 + aside] <= own + gu * aside + gv * down:
                free += 1
    return float(free / 25.0)


@written_into
def _crease(w: NDArray[np.float32], row: int, column: int) -> float:
    """Return 1 at an edge and 0 on a smooth surface."""
    kink = _kink(w, row, column) / w[row, column]
    return float(min(max((kink - _SMOOTH) / (_CREASE - _SMOOTH), 0.0), 1.0))


@written_into
def _kink(w: NDArray[np.float32], row: int, column: int) -> float:
    """Return the kink of the inverse depth [1/m], which is 0 on a plane and at the border of the view."""
    rows, columns = w.shape
    if not (0 < row < rows - 1 and 0 < column < columns - 1):
        return 0.0
    across = w[row, column - 1] + w[row, column + 1] - 2.0 * w[row, column]
    along = w[row - 1, column] + w[row + 1, column] - 2.0 * w[row, column]
    return float(max(abs(across), abs(along)))


@compiled
def shade_under(heights: NDArray[np.float32], x: float, y: float, step: float, balls: Array, out: NDArray[np.float32]) -> None:
    """Compute the share of the sky that balls hide from level ground.

    Balls (n, 4) are x, y, z, radius [m]; ground heights are (nx, ny) [m].

    Source: a ball of radius r at distance d hides r^2 / d^2 times the cosine of the angle between it and the vertical.
    """
    nx, ny = heights.shape
    for i in range(nx):
        for j in range(ny):
            free = 1.0
            for k in range(len(balls)):
                dx, dy, dz = balls[k, 0] - x - i * step, balls[k, 1] - y - j * step, balls[k, 2] - heights[i, j]
                d2 = dx * dx + dy * dy + dz * dz
                r2 = balls[k, 3] ** 2
                if dz > 0.0:
                    free *= 1.0 - min(r2 / max(d2, r2) * dz / np.sqrt(d2), 0.9)
            out[i, j] = 1.0 - free
