"""Compiled lighting loops: sun with soft shadows, sky, ambient occlusion and haze.

Colours are linear R, G, B from 0 to 1.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.deploy.video.rasterizer import Sight
from sextant.shared.geometry import Array
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
_CREASE = 0.0035  # relative kink of the inverse depth that counts as an edge
_EVEN = 0.02  # most difference of normals on an even face
_LEVEL = 0.7  # z of a normal above which a face is floor, not wall


class Shadow(NamedTuple):
    """The view of a lamp."""

    sight: Sight
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
def light(sight: Sight, T_world_camera: Array, scene: Scene, out: NDArray[np.float32]) -> None:
    """Light the view of a camera pose (4, 4) into a picture (h, w, 3).

    The view is an integer factor finer than the picture. A pixel that shows a single even face is lit once, any other pixel at
    each sample.
    """
    T = T_world_camera
    rows, columns, _ = out.shape
    times = len(sight.w) // rows
    fx, fy, cx, cy = sight.lens
    w, sun, materials = sight.w, scene.sun, scene.materials
    # Unpacked here, because unpacking per pixel would cost more than the lighting.
    ground_seen, T_ground, ground_reach = scene.ground_shadow.sight.w, scene.ground_shadow.T, scene.ground_shadow.reach
    robot_seen, T_robot, robot_reach = scene.robot_shadow.sight.w, scene.robot_shadow.T, scene.robot_shadow.reach
    ground_lens, robot_lens = scene.ground_shadow.sight.lens, scene.robot_shadow.sight.lens
    around_values, around_x, around_y, around_step = scene.around
    under_values, under_x, under_y, under_step = scene.under
    marks, way, normals, seen_materials, heights = scene.marks, scene.way, sight.normal, sight.material, scene.heights
    low, high, middle = scene.low, scene.high, scene.middle
    sun_x, sun_y, sun_z = sun[0], sun[1], sun[2]
    color = np.empty(3)
    shades = len(heights) - 1
    total = np.empty(3)
    for row in range(rows):
        for column in range(columns):
            even, mean = True, 0.0
            top, left = row * times, column * times
            for y in range(top, top + times):
                for x in range(left, left + times):
                    mean += w[y, x]
                    even = even and seen_materials[y, x] == seen_materials[top, left]
                    for k in range(3):
                        even = even and abs(normals[y, x, k] - normals[top, left, k]) < _EVEN
                    even = even and (w[y, x] <= 0.0 or _crease(w, y, x) <= 0.0)
            total[:] = 0.0
            looks = 1 if even else times * times
            wide = 1.25 * times if even else 1.0  # [px] smoothing width of paint; ground is seen at a slant
            for look in range(looks):
                y, x = top + look // times, left + look % times
                near = mean / (times * times) if even else np.float64(w[y, x])
                aside = 0.5 * (times - 1) if even else 0.0
                dx, dy = (x + aside - cx) / fx, (y + aside - cy) / fy
                rx = T[0, 0] * dx + T[0, 1] * dy + T[0, 2]
                ry = T[1, 0] * dx + T[1, 1] * dy + T[1, 2]
                rz = T[2, 0] * dx + T[2, 1] * dy + T[2, 2]
                long = np.sqrt(dx * dx + dy * dy + 1.0)
                upward = min(max(2.2 * rz / long, 0.0), 1.0)
                if near <= 0.0:
                    for k in range(3):
                        total[k] += _HORIZON[k] + upward * (_ZENITH[k] - _HORIZON[k])
                    continue
                z = 1.0 / near
                px, py, pz = T[0, 3] + z * rx, T[1, 3] + z * ry, T[2, 3] + z * rz
                nx, ny, nz = normals[y, x, 0], normals[y, x, 1], normals[y, x, 2]
                material = seen_materials[y, x]
                # 1. Surface colour.
                ground = materials[material, 3] > 0.0
                if materials[material, 3] > 1.0:
                    at = min(max((pz - low) / (high - low), 0.0), 1.0) * shades
                    i = min(int(at), shades - 1)
                    deep = min(max((low - 0.10 - pz) / 0.25, 0.0), 1.0)
                    for k in range(3):
                        color[k] = heights[i, k] + (at - i) * (heights[i + 1, k] - heights[i, k])
                        color[k] += deep * (_DEEP[k] - color[k])
                else:
                    for k in range(3):
                        color[k] = materials[material, k]
                if ground:
                    if nz > _LEVEL:
                        _draw_grid(color, px, py, wide * z / fx)
                        _draw_marks(color, px, py, pz, wide * z / fx, marks, way)
                    else:
                        for k in range(3):
                            color[k] *= 0.78
                # 2. Incoming light.
                cosine = nx * sun_x + ny * sun_y + nz * sun_z
                lit = max(cosine, 0.0)
                if lit > 0.0:
                    lit *= _shadow(ground_seen, T_ground, ground_lens, ground_reach, px, py, pz, nx, ny, nz)
                if lit > 0.0:
                    lit *= _shadow(robot_seen, T_robot, robot_lens, robot_reach, px, py, pz, nx, ny, nz)
                open_sky = 1.0
                around = _at(around_values, around_x, around_y, around_step, px, py)
                if np.isfinite(around):
                    open_sky = 1.0 - 0.6 * min(max((around - pz) / 0.045, 0.0), 1.0)
                if ground:
                    under = _at(under_values, under_x, under_y, under_step, px, py)
                    if np.isfinite(under):
                        open_sky *= 1.0 - under
                half = 0.5 + 0.5 * nz
                # 3. Reflection toward the camera, and haze.
                gloss = 0.0
                if materials[material, 4] > 0.0:
                    hx, hy, hz = sun_x - rx / long, sun_y - ry / long, sun_z - rz / long
                    size = np.sqrt(hx * hx + hy * hy + hz * hz)
                    shine = max((nx * hx + ny * hy + nz * hz) / size, 0.0) ** 40
                    rim = (1.0 - max(-(nx * rx + ny * ry + nz * rz) / long, 0.0)) ** 4
                    gloss = materials[material, 4] * (shine * min(2.0 * lit, 1.0) + 0.35 * rim * half)
                haze = min(max((z * long - middle - _HAZE_FROM) / (_HAZE_TO - _HAZE_FROM), 0.0), 1.0)
                haze = haze * haze * (3.0 - 2.0 * haze)
                edge = 1.0 if even or not ground else 1.0 - 0.38 * _crease(w, y, x) * (1.0 - haze)
                for k in range(3):
                    sky = _EARTH[k] + half * (_SKY[k] - _EARTH[k])
                    seen = color[k] * (_SUN[k] * lit + sky * open_sky) + gloss
                    total[k] += (1.0 - haze) * seen * edge + haze * _HORIZON[k]
            for k in range(3):
                out[row, column, k] = total[k] / looks


@written_into
def _draw_grid(color: Array, x: float, y: float, pixel: float) -> None:
    """Draw faint lines on the ground; they fade where a pixel is wider than a line."""
    for at in (x, y):
        off = abs(at - _GRID * np.round(at / _GRID))
        share = min(max((_GRID_LINE + 0.5 * pixel - off) / pixel, 0.0), 1.0) * min(2.0 * _GRID_LINE / pixel, 1.0)
        for k in range(3):
            color[k] *= 1.0 - 0.34 * share


@written_into
def _draw_marks(color: Array, x: float, y: float, z: float, pixel: float, marks: Array, way: Array) -> None:
    """Draw rings with a tinted middle, and the path, on the ground.

    Their rims are as soft as a pixel is wide.
    """
    for s in range(len(way)):
        ax, ay = way[s, 0, 0], way[s, 0, 1]
        bx, by = way[s, 1, 0] - ax, way[s, 1, 1] - ay
        size = bx * bx + by * by
        t = min(max(((x - ax) * bx + (y - ay) * by) / size, 0.0), 1.0) if size > 0.0 else 0.0
        off = np.sqrt((x - ax - t * bx) ** 2 + (y - ay - t * by) ** 2)
        share = min(max((_WAY - off) / pixel + 0.5, 0.0), 1.0)
        for i in range(3):
            color[i] += share * (_WAY_COLOR[i] - color[i])
    for k in range(len(marks)):
        mark = marks[k]
        dx, dy, reach = x - mark[0], y - mark[1], mark[4] + pixel
        if dx * dx + dy * dy < reach * reach and abs(z - mark[2]) < 0.03:
            off = np.sqrt(dx * dx + dy * dy)
            rim = min(max((off - mark[3]) / pixel + 0.5, 0.0), 1.0) if mark[3] > 0.0 else 1.0
            share = min(max((mark[4] - off) / pixel + 0.5, 0.0), 1.0) * (0.30 + 0.62 * rim)
            for i in range(3):
                color[i] += share * (mark[5 + i] - color[i])


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
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
) -> float:
    """Return the share of a lamp's light that reaches a place on a face {world}.

    It is 1 outside the lamp's view. The face is extended as a plane around the place for comparison with the lamp's depths.
    """
    fx, fy, cx, cy = lens
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
    """Return 1 at an edge: on a plane the inverse depth has no kink."""
    rows, columns = w.shape
    if not (0 < row < rows - 1 and 0 < column < columns - 1):
        return 0.0
    here = w[row, column]
    across = w[row, column - 1] + w[row, column + 1] - 2.0 * here
    along = w[row - 1, column] + w[row + 1, column] - 2.0 * here
    kink = max(abs(across), abs(along)) / here
    return float(min(max((kink - 0.4 * _CREASE) / (0.6 * _CREASE), 0.0), 1.0))


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
