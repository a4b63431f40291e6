"""Small images of the camera's view for display."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.camera import DepthSensor
from sextant.shared.wire.messages import Preview

_WIDTH_PX = 320  # [px]
_QUALITY = 80  # JPEG quality


def preview(stamp_ns: int, depth: NDArray[np.uint16], sensor: DepthSensor, rgb: NDArray[np.uint8] | None) -> Preview:
    """Render a depth frame and an optional colour frame as JPEG images.

    Near is red, far is blue, unknown is black.

    Args:
        stamp_ns: Of the depth frame.
        depth: (h, w) raw units of the sensor, not empty.
        sensor: Scale and range of the camera.
        rgb: (h, w, 3), or None.
    """
    every = math.ceil(max(depth.shape) / _WIDTH_PX)
    small = depth[::every, ::every]
    near, far = sensor.min_range, sensor.max_range
    away = np.clip((small / np.float32(sensor.depth_scale) - near) / (far - near), 0.0, 1.0)
    colored = np.asarray(cv2.applyColorMap((255.0 * (1.0 - away)).astype(np.uint8), cv2.COLORMAP_TURBO), dtype=np.uint8)
    colored[small == 0] = 0
    shown = _NOTHING if rgb is None or not rgb.size else _jpeg(_shrunk(rgb)[..., ::-1])
    return Preview(stamp_ns, _jpeg(colored), shown)


_NOTHING = np.zeros(0, dtype=np.uint8)


def _shrunk(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = max(1, min(round(rgb.shape[0] * _WIDTH_PX / rgb.shape[1]), _WIDTH_PX))
    return np.asarray(cv2.resize(rgb, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _jpeg(bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return np.asarray(data, dtype=np.uint8).ravel()
