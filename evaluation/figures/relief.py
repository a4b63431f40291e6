"""Height maps in their own colours with hill shading."""

import numpy as np
from numpy.typing import NDArray

_LAMP = np.array([-0.5, 0.5, 1.0])  # toward the light: from the upper left of a picture with x to the right and y up
_AMBIENT = 0.55  # [1] share of ambient light
_EXAGGERATION = 2.0  # of heights, so that steps of a centimetre are visible


def shaded(rgb: NDArray[np.uint8], elevation: NDArray[np.float32], resolution: float) -> NDArray[np.uint8]:
    """Shade cell colours by their slopes.

    Args:
        rgb: (nx, ny, 3) colours of the ground.
        elevation: (nx, ny) [m] heights, NaN where unknown; unknown cells and their neighbours count as level.
        resolution: [m] cell edge.

    Returns:
        (nx, ny, 3) R, G, B.

    Raises:
        ValueError: The shapes differ.
    """
    if rgb.shape != (*elevation.shape, 3):
        raise ValueError(f"colours {(*elevation.shape, 3)} expected, found {rgb.shape}")
    slopes = []
    for axis in range(2):
        rise = np.zeros(elevation.shape)
        if elevation.shape[axis] > 1:
            rise = np.gradient(elevation.astype(np.float64), resolution, axis=axis) * _EXAGGERATION
        slopes.append(np.where(np.isfinite(rise), rise, 0.0))
    lamp = _LAMP / np.linalg.norm(_LAMP)
    cosine = (lamp[2] - lamp[0] * slopes[0] - lamp[1] * slopes[1]) / np.sqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2)
    light = _AMBIENT + (1.0 - _AMBIENT) * np.maximum(cosine, 0.0) / lamp[2]  # level ground keeps its colour
    return np.asarray(np.clip(np.rint(rgb * light[..., None]), 0, 255), dtype=np.uint8)
