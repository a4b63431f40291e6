"""Depth images seen through another lens."""

from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

D = TypeVar("D", np.uint16, np.float32)
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_ON_SURFACE = np.float32(0.04)  # [1] largest relative change of the depth of a surface among the neighbours of a pixel


def resampled(depth: NDArray[D], u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[D]:
    """Return a depth image (h, w) of what another one shows at the pixels u and v, each (h, w); 0 outside of it.

    Surfaces are interpolated: steps of a pixel would move with the camera, and look like the shape of a floor. At edges, and
    next to pixels without a depth, each pixel is the nearest one. The image may also be one of inverse depth.
    """
    change = cv2.dilate(depth, _NEIGHBOURS) - cv2.erode(depth, _NEIGHBOURS)
    is_edge = cv2.remap((change > _ON_SURFACE * depth).astype(np.uint8), u, v, cv2.INTER_NEAREST)
    nearest = cv2.remap(depth, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    between = cv2.remap(depth, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found: NDArray[Any] = np.where(is_edge.astype(np.bool_) | (nearest == 0), nearest, between)
    return found
