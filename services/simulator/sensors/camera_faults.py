"""Faults of the simulated camera: what light, surfaces, dirt or a wrong mode do to a depth image, and wrong stamps.

The patterns on the ground are fixed in {world}, those on the lens in the image.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.resampling import resampled
from sextant.shared.robot.camera import DepthSensor, Intrinsics

_SUN_PERIOD_M, _SUN_SHARE = 0.5, 0.7  # stripes of sunlight on the ground, as through a window, and their share of it
_SUN_LOSS = 0.3  # [1] share of the other pixels that are lost
_DARK_RANGE_M = 0.7  # [m] up to which a dark surface returns enough light; beyond, pixels are lost with the square of the range
_PUDDLE_M = 0.6  # [m] period of the pattern of puddles
_UNDERSIDE_M = 0.6  # [m] height above the ground of what the puddles mirror, for example a table
_DROPOUTS = 0.7  # [1] share of lost pixels
_BLOBS, _BLOB_PX = 16, (20, 70)  # number and radii [px] of the blobs without return in one image 640 pixels wide
_DIRT_M = (0.55, 0.60)  # [m] depth that dirt on the lens seems to have
_DIRT_PX = 110.0  # [px] radius of the dirt in an image 640 pixels wide
_ZOOM = 2.0  # [1] focal lengths of another resolution over those of the profile
_AHEAD_NS, _JUMP_NS, _LATE_NS = 1_000_000_000, 400_000_000, 1_000_000_000  # [ns] of stamps and of arrival
_BACKWARD = 2  # stamps run backward from the start of the fault, this many times as fast as time


class CameraFaults:
    """Applies the faults of one camera to its images."""

    def __init__(self, lens: Intrinsics, sensor: DepthSensor, seed: int):
        """Prepare the patterns.

        Args:
            lens: True intrinsics.
            sensor: Range of the camera.
            seed: Random seed of the run.
        """
        self._lens, self._sensor, self._seed = lens, sensor, seed
        v, u = np.mgrid[: lens.height, : lens.width].astype(np.float32)
        self._u, self._v = u, v
        self._rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)], axis=-1)
        self._px = lens.width / 640.0

    def replaced(self, kind: str, time_ns: int) -> NDArray[np.uint16] | None:
        """Return the raw image (h, w) of a camera that shows nothing of the scene, None for other faults."""
        shape = (self._lens.height, self._lens.width)
        if kind == "blind":
            return np.zeros(shape, dtype=np.uint16)
        if kind == "noise":
            high = min(65535, round(self._sensor.max_range * self._sensor.depth_scale))
            return np.random.default_rng([self._seed, time_ns]).integers(0, high, shape, dtype=np.uint16)
        return None

    def scene(self, kind: str, w: NDArray[np.float32], T_world_camera: Array) -> NDArray[np.float32]:
        """Apply a fault of the lens or the ground to true inverse depth (h, w) [1/m]; 0 means no surface."""
        lens = self._lens
        match kind:
            case "swapped":
                return self._seen_by(w, lens.fy, lens.fx, lens.cy, lens.cx)
            case "zoomed":
                return self._seen_by(w, _ZOOM * lens.fx, _ZOOM * lens.fy, lens.cx, lens.cy)
            case "wet":
                x, y, _ = self._points(w, T_world_camera)
                puddle = np.sin(2.0 * np.pi / _PUDDLE_M * x) * np.sin(2.0 * np.pi / _PUDDLE_M * y) > 0.0
                slope = -self._rays @ T_world_camera[2, :3].astype(np.float32)  # [m] downward per metre of depth
                with np.errstate(divide="ignore", invalid="ignore"):
                    mirrored = np.float32(1.0) / (np.float32(1.0) / w + np.float32(_UNDERSIDE_M) / slope)
                return np.where(puddle & (w > 0.0) & (slope > 0.05), mirrored, w)
        return w

    def measured(self, kind: str, raw: NDArray[np.uint16], T_world_camera: Array, time_ns: int) -> NDArray[np.uint16]:
        """Apply a fault of the sensor or its light to a measured raw image (h, w)."""
        rng = np.random.default_rng([self._seed, time_ns])
        scale = self._sensor.depth_scale
        match kind:
            case "sun":
                with np.errstate(divide="ignore"):
                    x, y, _ = self._points(np.float32(scale) / raw.astype(np.float32), T_world_camera)
                lit = (x + 0.3 * y) / _SUN_PERIOD_M % 1.0 < _SUN_SHARE
                return np.where(lit | (rng.random(raw.shape, np.float32) < _SUN_LOSS), np.uint16(0), raw)
            case "dark":
                z = np.maximum(raw.astype(np.float32), 1.0) / np.float32(scale)
                return np.where(rng.random(raw.shape, np.float32) < (_DARK_RANGE_M / z) ** 2, raw, np.uint16(0))
            case "dropouts":
                return np.where(rng.random(raw.shape, np.float32) < _DROPOUTS, np.uint16(0), raw)
            case "blobs":
                holed = raw.copy()
                for _ in range(_BLOBS):
                    centre = int(rng.integers(self._lens.width)), int(rng.integers(self._lens.height))
                    cv2.circle(holed, centre, round(float(rng.uniform(*_BLOB_PX)) * self._px), 0, -1)
                return holed
            case "dirt":
                away = np.hypot(self._u - self._lens.cx, self._v - 0.6 * self._lens.cy)
                near = rng.integers(round(_DIRT_M[0] * scale), round(_DIRT_M[1] * scale), raw.shape, dtype=np.uint16)
                return np.where(away < _DIRT_PX * self._px, near, raw)
        return raw

    def _seen_by(self, w: NDArray[np.float32], fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float32]:
        """Return the image (h, w) that a camera of the same size with other intrinsics [px] takes."""
        lens = self._lens
        u = ((self._u - cx) / fx * lens.fx + lens.cx).astype(np.float32)
        v = ((self._v - cy) / fy * lens.fy + lens.cy).astype(np.float32)
        return resampled(w, u, v)

    def _points(self, w: NDArray[np.float32], T: Array) -> tuple[NDArray[np.float32], ...]:
        """Return x, y and z [m] {world}, each (h, w), of the surfaces of an image of inverse depth [1/m]."""
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(w > 0.0, np.float32(1.0) / w, np.float32(0.0))
        points = (z[..., None] * self._rays) @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        return points[..., 0], points[..., 1], points[..., 2]


def delivery(kind: str, stamp_ns: int, begin_ns: int, frame: int) -> tuple[int, int]:
    """Return the stamp and the arrival time [ns] of an image under a fault.

    Args:
        kind: Of the fault.
        stamp_ns: [ns] stamp without the fault.
        begin_ns: [ns] time at which the fault began.
        frame: Number of the image.
    """
    match kind:
        case "late":
            return stamp_ns, stamp_ns + _LATE_NS
        case "stale":
            return begin_ns, stamp_ns
        case "ahead":
            return stamp_ns + _AHEAD_NS, stamp_ns
        case "backward":
            return max(0, begin_ns - _BACKWARD * (stamp_ns - begin_ns)), stamp_ns
        case "jumping":
            return stamp_ns + (_JUMP_NS if frame % 4 < 2 else -_JUMP_NS), stamp_ns
    return stamp_ns, stamp_ns
