"""Colour codes: luma and two chroma differences, six bits each.

They are used in messages and to compare colours.

YCoCg (Malvar and Sullivan 2003): luma Y = (R + 2 G + B) / 4, orange Co = R - B, green Cg = G - (R + B) / 2. The range of Y is
0..255, that of Co and Cg is -255..255. A code is Y / 4, Co / 8 + 32, Cg / 8 + 32, rounded. Luma code 0 means no colour.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_STEPS = np.array([4.0, 8.0, 8.0])
_NEUTRAL = np.array([0.0, 32.0, 32.0])
_BITS = 63
NO_COLOR = 0  # luma code of a point without colour


def ycocg_from_rgb(rgb: NDArray[Any]) -> NDArray[np.float32]:
    """Convert R, G, B (..., 3) within 0..255 to Y, Co, Cg (..., 3)."""
    r, g, b = (np.asarray(rgb[..., k], dtype=np.float32) for k in range(3))
    return np.stack([0.25 * r + 0.5 * g + 0.25 * b, r - b, g - 0.5 * (r + b)], axis=-1)


def rgb_from_ycocg(color: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert Y, Co, Cg (..., 3) to R, G, B (..., 3), clipped to 0..255."""
    y, co, cg = (np.asarray(color[..., k], dtype=np.float32) for k in range(3))
    rest = y - 0.5 * cg
    rgb = np.stack([rest + 0.5 * co, rest + cg, rest - 0.5 * co], axis=-1)
    return np.asarray(np.clip(np.rint(rgb), 0, 255), dtype=np.uint8)


def codes(color: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the codes (n, 3) of colours Y, Co, Cg (n, 3).

    A row with NaN becomes `NO_COLOR`.
    """
    known = np.isfinite(color).all(axis=1)
    levels = np.rint(np.where(known[:, None], color, 0.0) / _STEPS + _NEUTRAL)
    out = np.asarray(np.clip(levels, [1, 0, 0], _BITS), dtype=np.uint8)
    out[~known] = NO_COLOR, *_NEUTRAL[1:]
    return out


def from_codes(code: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the colours Y, Co, Cg (n, 3) of codes (n, 3); NaN without a colour."""
    color = np.asarray((code - _NEUTRAL) * _STEPS, dtype=np.float32)
    color[code[:, 0] == NO_COLOR] = np.nan
    return color
