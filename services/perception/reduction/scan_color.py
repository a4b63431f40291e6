"""Colours of scan points from a colour camera aligned with the depth camera.

A colour image arrives later than the depth frame with the same stamp, and at a lower rate. Depth frames and their poses are
therefore kept until the image arrives, and then the points of the next scan are looked up in it. A point takes the colour of
its pixel, unless the depth frame shows something else there, such as a leg in front of it or an object that has moved since.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from sextant.shared.color import codes
from sextant.shared.geometry import Array, inverse
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.runtime.compiled import compiled

KEPT = 8  # depth frames kept for their colour image: 0.27 s at 30 Hz
_MAX_DEPTH_GAP_M = 0.015  # [m] maximum depth difference between a point and its pixel ...
_MAX_DEPTH_GAP_SHARE = 0.02  # [1] ... plus this share of the depth


class Coloring:
    """Colouring of points from colour images, paired with depth frames by stamp."""

    def __init__(self, intrinsics: Intrinsics, depth_scale: float):
        """Create a colouring for a camera with depth_scale raw units per metre."""
        self._intrinsics, self._unit = intrinsics, 1.0 / depth_scale
        self._frames: deque[tuple[int, NDArray[np.uint16], Array]] = deque(maxlen=KEPT)
        self._used_ns = -1
        self.problem = ""  # why the newest colour image was not used

    def keep(self, stamp_ns: int, depth_raw: NDArray[np.uint16], T_world_camera: Array) -> None:
        """Store a depth frame (h, w) with its camera pose (4, 4) for a later colour image."""
        self._frames.append((stamp_ns, depth_raw, T_world_camera))

    def colors(self, points: Array, stamp_ns: int, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return colour codes (n, 3) of points (n, 3) [m] {world}.

        The result is empty, (0, 3), if the image was already used.

        Args:
            points: Points to colour.
            stamp_ns: Stamp of the colour image.
            rgb: (h, w, 3) colour image aligned with the depth frame of that stamp.
        """
        none = np.zeros((0, 3), dtype=np.uint8)
        if stamp_ns <= self._used_ns:
            return none
        shape = self._intrinsics.height, self._intrinsics.width
        if rgb.shape[:2] != shape:
            self.problem = f"a colour picture of {shape} expected by the profile, found {rgb.shape[:2]}"
            return none
        frame = next((f for f in self._frames if f[0] == stamp_ns), None)
        if frame is None:
            self.problem = "no depth frame of the same stamp as the colour picture is known"
            return none
        self.problem = ""
        self._used_ns = stamp_ns
        _, depth, T_world_camera = frame
        i = self._intrinsics
        camera = np.array([i.fx, i.fy, i.cx, i.cy])
        T = np.ascontiguousarray(inverse(T_world_camera)[:3])
        found = _look_up(np.ascontiguousarray(points), T, camera, depth, self._unit, rgb)
        return codes(found) if np.isfinite(found).any() else none


@compiled
def _look_up(
    points: Array, T: Array, camera: Array, depth: NDArray[np.uint16], unit: float, rgb: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Compute the mean Y, Co, Cg (n, 3) of the 3x3 pixels around each point.

    It is NaN where the point is outside the image or hidden in it.
    """
    rows, columns = depth.shape
    fx, fy, cx, cy = camera
    out = np.full((len(points), 3), np.nan, dtype=np.float32)
    for n in range(len(points)):
        x, y, z = points[n]
        p = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        q = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        r = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if r < 0.05:
            continue
        u, v = int(np.rint(fx * p / r + cx)), int(np.rint(fy * q / r + cy))
        if not (1 <= u < columns - 1 and 1 <= v < rows - 1):
            continue
        seen = depth[v, u] * unit
        if seen == 0.0 or abs(seen - r) > _MAX_DEPTH_GAP_M + _MAX_DEPTH_GAP_SHARE * r:
            continue
        red = green = blue = 0.0
        for i in range(v - 1, v + 2):
            for j in range(u - 1, u + 2):
                red += rgb[i, j, 0]
                green += rgb[i, j, 1]
                blue += rgb[i, j, 2]
        red, green, blue = red / 9.0, green / 9.0, blue / 9.0
        out[n, 0] = 0.25 * red + 0.5 * green + 0.25 * blue
        out[n, 1] = red - blue
        out[n, 2] = green - 0.5 * (red + blue)
    return out
