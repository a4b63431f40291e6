"""Systematic errors of a depth camera of which its profile knows nothing: lens distortion, depth scale and bias."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.resampling import resampled
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.robot.profile import Camera


class CameraErrors:
    """Applies the errors of one camera to its images."""

    def __init__(self, camera: Camera, depth_bias: float):
        """Compute the map of the distortion.

        Args:
            camera: The true camera.
            depth_bias: [1/m] error of the inverse depth.
        """
        self._scale, self._bias = np.float32(1.0 / (1.0 + camera.depth_error)), np.float32(depth_bias)
        self._is_exact = camera.depth_error == 0.0 and depth_bias == 0.0
        self._seen_at = _undistorted_pixels(camera.intrinsics, camera.distortion) if camera.distortion else None
        self._gray_seen_at = _undistorted_pixels(camera.intrinsics.gray, camera.distortion) if camera.distortion else None

    def depth(self, inverse_depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the inverse depth (h, w) [1/m] that the camera measures; 0 without a surface."""
        w = inverse_depth if self._seen_at is None else resampled(inverse_depth, *self._seen_at)
        if self._is_exact:
            return w
        return np.where(w > 0.0, np.maximum(w * self._scale - self._bias, np.float32(0.0)), np.float32(0.0))

    def color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the colour image (h, w, 3) that the camera takes."""
        if self._seen_at is None:
            return rgb
        return np.asarray(cv2.remap(rgb, *self._seen_at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))

    def gray(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the grey image that the camera takes."""
        if self._gray_seen_at is None:
            return image
        return np.asarray(cv2.remap(image, *self._gray_seen_at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _undistorted_pixels(lens: Intrinsics, k1: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the pixels u and v, each (h, w), at which a camera without distortion sees what each pixel sees.

    The distortion is radial: a ray at the distance r from the optical axis appears at r (1 + k1 r^2), Brown's first term.
    """
    v, u = np.mgrid[: lens.height, : lens.width]
    K = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    rays = cv2.undistortPoints(pixels, K, np.array([k1, 0.0, 0.0, 0.0])).reshape(lens.height, lens.width, 2)
    return (rays[..., 0] * lens.fx + lens.cx).astype(np.float32), (rays[..., 1] * lens.fy + lens.cy).astype(np.float32)
