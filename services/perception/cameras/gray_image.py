"""Small grey image of a colour image, in which the ground's texture is tracked."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.camera import Intrinsics

NO_GRAY: NDArray[np.uint8] = np.zeros((0, 0), dtype=np.uint8)


def gray_image(rgb: NDArray[np.uint8] | None, lens: Intrinsics) -> NDArray[np.uint8]:
    """Return the brightness of a colour image (h, w, 3), with the size of `lens.gray`.

    The result is empty without an image, or for one of another size than that of the lens.
    """
    if rgb is None or rgb.shape != (lens.height, lens.width, 3):
        return NO_GRAY
    k, small = lens.gray_factor, lens.gray
    whole = cv2.cvtColor(np.ascontiguousarray(rgb[: k * small.height, : k * small.width]), cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(whole, (small.width, small.height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
