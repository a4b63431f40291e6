"""Model of the small grey image that a camera with colour sends with its depth: texture, light, blur and noise.

The texture is a periodic random pattern over world coordinates, so a point has the same brightness from all viewpoints. It is
read at the points that the renderer shows, with the resolution of the pixel there. The light changes over time and over the
ground. Each random number of a pixel is a hash of the camera's key, the frame number and the pixel.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.sensors.renderer import ROBOT
from sextant.shared.geometry import Array, exp_so3, inverse, log_so3
from sextant.shared.rendering.rasterizer import Canvas
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.runtime.compiled import compiled
from sextant.shared.scenario.scenario import Floor

_CELL_M = 0.004  # [m] edge of a cell of the texture
_CELLS = 512  # along x and along y, after which the texture repeats: 2 m
_LEVELS = 4  # resolutions of the texture, each half as fine as the one before
_FALL = 0.9  # exponent by which its amplitudes fall with the spatial frequency
_ALBEDO = {"textured": 110.0, "uniform": 110.0, "black": 4.0, "glossy": 70.0}  # [1/255] mean brightness of the ground
_MIRRORED = {"glossy": 0.25}  # [1] share of the light from above that the ground reflects
_PLAIN = {"uniform": 0.0, "glossy": 0.1}  # [1] factor of the contrast
_CEILING_M, _LAMP_PERIOD_M, _LAMP_M = 2.5, 0.9, 0.35  # [m] above the ground: what glossy ground reflects, with square lamps
_LAMP, _DARK = 255.0, 60.0  # [1/255] brightness of lamps and of the ceiling between them
_SHADE_M, _SHADE_M_S = 0.8, 0.03  # [m] wavelength of the light's variation over the ground, and [m/s] its speed
_SKY, _MOVER = 180.0, 60.0  # [1/255] brightness where there is no surface, and of robot and movers
_LIGHT = np.array([-0.348, -0.447, 0.824])  # direction to the light {world}


class GrayCamera:
    """Grey camera whose pixels cover squares of pixels of the depth camera."""

    def __init__(self, intrinsics: Intrinsics, floor: Floor, rng: np.random.Generator):
        """Draw the texture and the light of a run.

        Args:
            intrinsics: Of the depth camera.
            floor: Look of the ground.
            rng: Random generator, which is used only here.
        """
        self._factor, self._floor = intrinsics.gray_factor, floor
        self._key = np.uint32(rng.integers(1 << 32))
        self._phase, self._heading = rng.uniform(0.0, 2.0 * np.pi, 2)
        self._levels = _texture(rng)
        self._frames = 0
        self._last: tuple[float, Array] | None = None  # time [s] and camera pose (4, 4) of the last frame

    def picture(self, canvas: Canvas, T_world_camera: Array, time_s: float) -> NDArray[np.uint8]:
        """Return the grey image of rendered surfaces.

        Args:
            canvas: The surfaces, of the depth camera's size.
            T_world_camera: (4, 4) pose of the camera's optical frame.
            time_s: [s] simulated time.
        """
        floor, k = self._floor, self._factor
        image = np.empty((canvas.w.shape[0] // k, canvas.w.shape[1] // k), dtype=np.uint8)
        gain = 1.0 + floor.light * np.sin(2.0 * np.pi * time_s / floor.light_period_s + self._phase)
        drift = _SHADE_M_S * time_s * np.array([np.cos(self._heading), np.sin(self._heading)])
        look = np.array([
            gain * _ALBEDO[floor.look], floor.contrast * _PLAIN.get(floor.look, 1.0), _MIRRORED.get(floor.look, 0.0),
            floor.light, *drift, gain * _MOVER, np.sqrt(12.0) * floor.noise,
        ])  # fmt: skip
        poses = self._during(T_world_camera, time_s)
        key = np.uint32(self._key ^ np.uint32((self._frames * 0x9E3779B9) & 0xFFFFFFFF))
        _expose(canvas, k, ROBOT, poses, self._levels, look, key, image)
        self._frames += 1
        return image

    def skip_frame(self) -> None:
        """Skip a frame; later frames have the same noise as if it had been taken."""
        self._frames += 1

    def _during(self, T: Array, time_s: float) -> Array:
        """Return the poses (3, 3, 4) of the camera: now, and at two times of the exposure, whose mean has its blur."""
        last, self._last = self._last, (time_s, T.copy())
        poses = np.repeat(T[None, :3], 3, axis=0)
        if last is None or not 0.0 < time_s - last[0] < 0.5:
            return poses
        moved = T @ inverse(last[1])
        rate = log_so3(moved[:3, :3]) / (time_s - last[0])
        velocity = (T[:3, 3] - last[1][:3, 3]) / (time_s - last[0])
        for n, tau in ((1, -1.0), (2, 1.0)):
            tau *= self._floor.exposure_s / np.sqrt(12.0)  # standard deviation of a time within the exposure
            poses[n, :, :3], poses[n, :, 3] = exp_so3(tau * rate) @ T[:3, :3], T[:3, 3] + tau * velocity
        return poses


def _texture(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return a random periodic texture (level, n, n) of mean 0 and variance 1 at the finest level, then ever smoother."""
    f = np.hypot(np.fft.fftfreq(_CELLS)[:, None], np.fft.rfftfreq(_CELLS)[None])
    with np.errstate(divide="ignore"):
        amplitude = np.where((f > 1.0 / 64.0) & (f < 0.5), f**-_FALL, 0.0)
    spectrum = np.fft.rfft2(rng.standard_normal((_CELLS, _CELLS))) * amplitude
    levels = []
    for level in range(_LEVELS):
        fine = np.fft.irfft2(spectrum * np.exp(-0.5 * (f * np.pi * (2.0**level - 1.0) / 1.7) ** 2), (_CELLS, _CELLS))
        levels.append(fine)
    return np.asarray(np.stack(levels) / levels[0].std(), dtype=np.float32)


@compiled
def _read(texture: NDArray[np.float32], x: float, y: float) -> float:
    """Return the texture at a point [cells], between its cells."""
    n = texture.shape[0]
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = np.float32(x - i), np.float32(y - j)
    a, b, c, d = i & (n - 1), j & (n - 1), (i + 1) & (n - 1), (j + 1) & (n - 1)
    low = texture[a, b] + (texture[a, d] - texture[a, b]) * v
    high = texture[c, b] + (texture[c, d] - texture[c, b]) * v
    return float(low + (high - low) * u)


@compiled
def _expose(
    canvas: Canvas,
    k: int,
    robot: int,
    poses: Array,
    levels: NDArray[np.float32],
    look: Array,
    key: np.uint32,
    out: NDArray[np.uint8],
) -> None:
    """Take the image: the texture where each pixel's ray meets the surface at two times, light, and noise.

    `k`: edge of a pixel [depth pixels]. `robot`: number of the robot's material.
    `look`: brightness of the ground, contrast, mirrored share, variation of the light over the ground, its displacement [m] in
    x and y, brightness of robot and movers, and range of the noise [1/255].
    """
    w = canvas.w
    fx, fy, cx, cy = canvas.lens
    middle = (k - 1) / 2.0
    T = poses[0]
    last = levels.shape[0] - 1
    for row in range(out.shape[0]):
        ry = (row * k + middle - cy) / fy
        for column in range(out.shape[1]):
            rx = (column * k + middle - cx) / fx
            total, number = np.float32(0.0), 0
            for i in range(row * k, row * k + k):
                for j in range(column * k, column * k + k):
                    total += w[i, j]
                    number += int(w[i, j] > np.float32(0.02))
            a, b = row * k + k // 2, column * k + k // 2
            if total < 0.02 * number or number == 0:
                value = _SKY
            elif canvas.material[a, b] == robot:
                n = canvas.normal[a, b]
                value = look[6] * (0.5 + 0.5 * max(n[0] * _LIGHT[0] + n[1] * _LIGHT[1] + n[2] * _LIGHT[2], 0.0))
            else:
                z = number / total
                n0, n1, n2 = canvas.normal[a, b, 0], canvas.normal[a, b, 1], canvas.normal[a, b, 2]
                dx = T[0, 0] * rx + T[0, 1] * ry + T[0, 2]
                dy = T[1, 0] * rx + T[1, 1] * ry + T[1, 2]
                dz = T[2, 0] * rx + T[2, 1] * ry + T[2, 2]
                x, y, h = z * dx + T[0, 3], z * dy + T[1, 3], z * dz + T[2, 3]
                # 1. The level at which a cell is as large as the pixel on the surface.
                length, across = np.sqrt(dx * dx + dy * dy + dz * dz), -(n0 * dx + n1 * dy + n2 * dz)
                size = k * z / (fx * _CELL_M) * np.sqrt(length / max(across, 0.05))  # [cells]
                coarse, part = 0, 0.0
                while size >= 2.0 and coarse < last:
                    size *= 0.5
                    coarse += 1
                if coarse < last and size > 1.0:
                    part = size - 1.0
                # 2. The texture, where the ray meets the plane of the surface at two times.
                grain = 0.0
                for time in range(1, 3):
                    E = poses[time]
                    ex = E[0, 0] * rx + E[0, 1] * ry + E[0, 2]
                    ey = E[1, 0] * rx + E[1, 1] * ry + E[1, 2]
                    ez = E[2, 0] * rx + E[2, 1] * ry + E[2, 2]
                    toward = n0 * ex + n1 * ey + n2 * ez
                    s = z
                    if toward < -0.02:
                        s = (n0 * (x - E[0, 3]) + n1 * (y - E[1, 3]) + n2 * (h - E[2, 3])) / toward
                    px, py, pz = s * ex + E[0, 3], s * ey + E[1, 3], s * ez + E[2, 3]
                    # The height shifts the texture, so that walls are textured vertically.
                    tx, ty = (px + 0.7 * pz) / _CELL_M, (py - 0.6 * pz) / _CELL_M
                    one = _read(levels[coarse], tx, ty)
                    if part > 0.0:
                        one += part * (_read(levels[coarse + 1], tx, ty) - one)
                    grain += 0.5 * one
                # 3. Light, and what the surface mirrors.
                shade = _read(levels[last], (x - look[4]) * (16.0 / _SHADE_M), (y - look[5]) * (16.0 / _SHADE_M))
                value = look[0] * (1.0 + look[1] * grain) * (1.0 + look[3] * shade)
                if look[2] > 0.0 and n2 > 0.5 and dz < -1e-3:
                    up = (_CEILING_M - h) / -dz
                    lx, ly = (x + up * dx) / _LAMP_PERIOD_M, (y + up * dy) / _LAMP_PERIOD_M
                    wide = _LAMP_M / _LAMP_PERIOD_M
                    lamp = lx - np.floor(lx) < wide and ly - np.floor(ly) < wide
                    value = value * (1.0 - look[2]) + look[2] * (_LAMP if lamp else _DARK)
            g = np.uint32(row * out.shape[1] + column) ^ key
            g = np.uint32((g ^ (g >> np.uint32(16))) * np.uint32(0x7FEB352D))
            g = np.uint32((g ^ (g >> np.uint32(15))) * np.uint32(0x846CA68B))
            g = np.uint32(g ^ (g >> np.uint32(16)))
            spark = look[7] * (float(np.int64(g >> np.uint32(8))) / 16777215.0 - 0.5)
            out[row, column] = np.uint8(min(max(value + spark + 0.5, 0.0), 255.0))
