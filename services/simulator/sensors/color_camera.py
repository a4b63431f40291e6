"""Model of a colour camera.

It simulates textured ground, uneven light, puddles that reflect the sky, and sensor noise. The texture is noise over world
coordinates, so a point has the same colour from all viewpoints. Light, white balance and texture are drawn once per run from
its seed.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.physics.solids import Boxes, Capsules
from sextant.services.simulator.physics.terrain import Terrain
from sextant.services.simulator.sensors.renderer import PLANE, Renderer
from sextant.shared.geometry import Array
from sextant.shared.rendering.rasterizer import Canvas
from sextant.shared.runtime.compiled import compiled

_EXPOSURE = 0.20  # [1] maximum relative deviation of a run's brightness
_BALANCE = 0.06  # [1] maximum relative deviation of red and of blue against green
_SHADE = 0.12  # [1] relative variation of light over the ground
_GRAIN = 0.16  # [1] relative variation of the ground's brightness
_TINT = 0.03  # [1] relative variation of the ground's colour
_SENSOR = 3.0  # [1/255] maximum sensor noise of a pixel, uniform
_SKY = (178.0, 200.0, 220.0)
_LIGHT = np.array([-0.35, -0.45, 0.82])  # direction to the light {world}
_AMBIENT = 0.45  # [1] share of the light that comes from all directions
_RIM = 0.008  # [m] amplitude of irregular puddle edges


class ColorCamera:
    """Colour camera whose pixels coincide with those of the depth camera."""

    def __init__(self, renderer: Renderer, terrain: Terrain, rng: np.random.Generator):
        """Draw the light of a run; the renderer provides the visible surfaces."""
        self._renderer = renderer
        self._key = np.uint32(rng.integers(1 << 32))
        balance = np.array([rng.uniform(-_BALANCE, _BALANCE), 0.0, rng.uniform(-_BALANCE, _BALANCE)])
        self._gain = (1.0 + rng.uniform(-_EXPOSURE, _EXPOSURE)) * (1.0 + balance)
        self._plane = np.nan if terrain.plane is None else terrain.plane
        hollows = terrain.hollows
        self._hollows = np.column_stack([hollows.low, hollows.high])
        self._hollow_colors = hollows.color
        self._frames = 0

    def picture(self, T_world_camera: Array, robot: tuple[Boxes, Capsules] | None = None) -> NDArray[np.uint8]:
        """Return the next colour image (h, w, 3).

        Args:
            T_world_camera: (4, 4) pose of the camera's optical frame.
            robot: Solids to draw in addition to the terrain.
        """
        canvas = self._renderer.surfaces(T_world_camera, robot)
        flat = np.empty((*canvas.w.shape, 3), dtype=np.uint8)
        T = np.ascontiguousarray(T_world_camera[:3], dtype=np.float64)
        _shade(canvas, T, self._renderer.colours, _LIGHT / np.linalg.norm(_LIGHT), PLANE, flat)
        _develop(flat, canvas.w, np.array(canvas.lens), T, self._gain, self._key, np.uint32(self._frames),
                 self._plane, self._hollows, self._hollow_colors)  # fmt: skip
        self._frames += 1
        return flat


@compiled
def _shade(canvas: Canvas, T: Array, colours: Array, light: Array, plane: int, out: NDArray[np.uint8]) -> None:
    """Light the surfaces of a canvas, and draw level ground up to a depth of 50 m as a 0.1 m checkerboard.

    T is T_world_camera (3, 4); colours (m, 3) are those of the materials, `plane` is that of level ground, and light (3,) is a
    unit vector {world}.
    """
    w = canvas.w
    fx, fy, cx, cy = canvas.lens
    for row in range(w.shape[0]):
        for column in range(w.shape[1]):
            material = canvas.material[row, column]
            level = material == plane
            if w[row, column] <= (0.02 if level else 0.0):
                for k in range(3):
                    out[row, column, k] = np.uint8(_SKY[k])
                continue
            n = canvas.normal[row, column]
            bright = _AMBIENT + (1.0 - _AMBIENT) * max(0.0, n[0] * light[0] + n[1] * light[1] + n[2] * light[2])
            if level:
                z = 1.0 / w[row, column]
                a, b = z * (column - cx) / fx, z * (row - cy) / fy
                x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * z + T[0, 3]
                y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * z + T[1, 3]
                odd = (int(np.floor(x * 10.0)) + int(np.floor(y * 10.0))) & 1
                bright *= 0.93 if odd else 1.0
            for k in range(3):
                out[row, column, k] = np.uint8(colours[material, k] * bright)


@compiled
def _mixed(x: np.uint32) -> np.uint32:
    """Hash 32 bits (Wellons 2018, `lowbias32`)."""
    x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D))
    x = np.uint32((x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@compiled
def _lattice(i: int, j: int, key: np.uint32) -> float:
    """Return the random number from -1 to 1 of a lattice point."""
    h = _mixed(np.uint32(np.uint32(i * 0x9E3779B1) ^ np.uint32(j * 0x85EBCA77)) ^ key)
    return float(np.int64(h >> np.uint32(8))) * (2.0 / 16777215.0) - 1.0


@compiled
def _noise(x: float, y: float, key: np.uint32) -> float:
    """Return smooth noise from -1 to 1 at a point of the plane, of wavelength 2."""
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    low = _lattice(i, j, key) * (1.0 - u) + _lattice(i + 1, j, key) * u
    high = _lattice(i, j + 1, key) * (1.0 - u) + _lattice(i + 1, j + 1, key) * u
    return float(low * (1.0 - v) + high * v)


@compiled
def _develop(
    picture: NDArray[np.uint8],
    w: NDArray[np.float32],
    camera: Array,
    T: Array,
    gain: Array,
    key: np.uint32,
    frame: np.uint32,
    plane: float,
    hollows: Array,
    hollow_colors: Array,
) -> None:
    """Apply light, texture, puddles and sensor noise to a flat-shaded image, in place.

    T is T_world_camera (3, 4); hollows (n, 4) are low x, low y, high x, high y [m] {world}.
    """
    rows, columns = w.shape
    fx, fy, cx, cy = camera
    color = np.empty(3)
    for row in range(rows):
        for column in range(columns):
            for k in range(3):
                color[k] = picture[row, column, k]
            if w[row, column] > 0.02:
                z = 1.0 / w[row, column]
                a, b = z * (column - cx) / fx, z * (row - cy) / fy
                x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * z + T[0, 3]
                y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * z + T[1, 3]
                height = T[2, 0] * a + T[2, 1] * b + T[2, 2] * z + T[2, 3]
                light = 1.0 + _SHADE * _noise(x / 0.5, y / 0.5, key ^ np.uint32(1))
                wet = -1
                if abs(height - plane) < 2e-3:  # false without a plane, whose height is NaN
                    for n in range(len(hollows)):
                        low_x, low_y, high_x, high_y = hollows[n]
                        if low_x - _RIM < x < high_x + _RIM and low_y - _RIM < y < high_y + _RIM:
                            ux = x + _RIM * _noise(x / 0.03, y / 0.03, key ^ np.uint32(2))
                            uy = y + _RIM * _noise(x / 0.03, y / 0.03, key ^ np.uint32(3))
                            if low_x < ux < high_x and low_y < uy < high_y:
                                wet = n
                if wet >= 0:
                    # Water reflects more sky at grazing incidence (Schlick 1994).
                    down = (T[2, 3] - height) / np.sqrt(a * a + b * b + z * z)
                    mirror = 0.02 + 0.98 * (1.0 - min(max(down, 0.0), 1.0)) ** 5
                    ripple = 1.0 + 0.03 * _noise(x / 0.02, y / 0.02, key ^ np.uint32(4))
                    for k in range(3):
                        color[k] = (hollow_colors[wet, k] * (1.0 - mirror) + _SKY[k] * mirror) * ripple
                else:
                    # The height shifts the texture, so that walls are textured vertically.
                    tx, ty = x + 0.7 * height, y - 0.6 * height
                    grain = _noise(tx / 0.04, ty / 0.04, key ^ np.uint32(5)) + _noise(
                        tx / 0.011, ty / 0.011, key ^ np.uint32(6)
                    )
                    tint = _TINT * _noise(tx / 0.06, ty / 0.06, key ^ np.uint32(7))
                    light *= 1.0 + 0.5 * _GRAIN * grain
                    color[0] *= 1.0 + tint
                    color[2] *= 1.0 - tint
                for k in range(3):
                    color[k] *= light * gain[k]
            h = _mixed(np.uint32(row * columns + column) ^ np.uint32(frame * np.uint32(0x9E3779B1)) ^ key)
            for k in range(3):
                spark = float(np.int64((h >> np.uint32(8 * k)) & np.uint32(255))) * (2.0 * _SENSOR / 255.0) - _SENSOR
                picture[row, column, k] = np.uint8(min(max(color[k] + spark, 0.0), 255.0))
