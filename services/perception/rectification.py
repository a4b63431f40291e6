"""Rectification of depth and colour images: without the distortion of the lens."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.resampling import resampled
from sextant.shared.robot.camera import Intrinsics


class Rectifier:
    """Maps the images of one camera to those of a pinhole camera with the same intrinsics."""

    def __init__(self, lens: Intrinsics, distortion: float):
        """Compute the pixels to read.

        Args:
            lens: Intrinsics of both cameras.
            distortion: Radial distortion k1 of Brown's model; with zero, images stay as they are.
        """
        self._shape = (lens.height, lens.width)
        self._pixels: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if distortion:
            v, u = np.mgrid[: lens.height, : lens.width]
            x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
            stretch = 1.0 + distortion * (x * x + y * y)
            seen_u, seen_v = lens.cx + lens.fx * stretch * x, lens.cy + lens.fy * stretch * y
            self._pixels = seen_u.astype(np.float32), seen_v.astype(np.float32)

    def depth(self, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return a rectified depth image (h, w); 0 where the camera sees nothing. An image of another size stays as it is."""
        if self._pixels is None or image.shape != self._shape:
            return image
        return resampled(image, *self._pixels)

    def picture(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a rectified grey or colour image (h, w, ...); 0 where the camera sees nothing. Another size stays as it is."""
        if self._pixels is None or image.shape[:2] != self._shape:
            return image
        return np.asarray(cv2.remap(image, *self._pixels, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))
