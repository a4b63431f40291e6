"""Colours as they cross the wire and as they are compared: luma and two chroma differences, six bits each.

YCoCg (Malvar and Sullivan 2003): luma Y = (R + 2 G + B) / 4, orange Co = R - B, green Cg = G - (R + B) / 2. Y runs over 0..255,
Co and Cg over -255..255. A code is Y / 4, Co / 8 + 32, Cg / 8 + 32, rounded; luma code 0 says that there is no colour.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_STEPS = np.array([4.0, 8.0, 8.0])
_NEUTRAL = np.array([0.0, 32.0, 32.0])
_BITS = 63
NO_COLOR = 0  # luma code of a point without colour


def ycocg_from_rgb(rgb: NDArray[Any]) -> NDArray[np.float32]:
    """Y, Co, Cg (..., 3) of R, G, B (..., 3) within 0..255."""
    r, g, b = (np.asarray(rgb[..., k], dtype=np.float32) for k in range(3))
    return np.stack([0.25 * r + 0.5 * g + 0.25 * b, r - b, g - 0.5 * (r + b)], axis=-1)


def rgb_from_ycocg(color: NDArray[Any]) -> NDArray[np.uint8]:
    """R, G, B (..., 3) of Y, Co, Cg (..., 3); what lies outside 0..255 is cut off."""
    y, co, cg = (np.asarray(color[..., k], dtype=np.float32) for k in range(3))
    rest = y - 0.5 * cg
    rgb = np.stack([rest + 0.5 * co, rest + cg, rest - 0.5 * co], axis=-1)
    return np.asarray(np.clip(np.rint(rgb), 0, 255), dtype=np.uint8)


def codes(color: NDArray[Any]) -> NDArray[np.uint8]:
    """Codes (n, 3) of colours Y, Co, Cg (n, 3); a row with NaN has none."""
    known = np.isfinite(color).all(axis=1)
    levels = np.rint(np.where(known[:, None], color, 0.0) / _STEPS + _NEUTRAL)
    out = np.asarray(np.clip(levels, [1, 0, 0], _BITS), dtype=np.uint8)
    out[~known] = NO_COLOR, *_NEUTRAL[1:]
    return out


def from_codes(code: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Colours Y, Co, Cg (n, 3) of codes (n, 3), NaN where there is none."""
    color = np.asarray((code - _NEUTRAL) * _STEPS, dtype=np.float32)
    color[code[:, 0] == NO_COLOR] = np.nan
    return color
