"""Binary frames for pages: a JSON header and arrays that the GPU uses directly.

    uint32 little-endian length of header and padding | header | spaces as padding to 4 bytes | heights, int16 | values, uint8

Heights are in millimetres {world}; -32768 is unknown. The values of a layer are one byte per cell, with the scale of the
header; the layer "color" has three bytes per cell, R, G, B.
"""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.console.web.requests import Layer
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE, UNKNOWN, Preview, TerrainMap

NO_HEIGHT = -32768
_MAX_HEIGHT_MM = np.float32(32767.0)  # [mm] upper limit of heights
NO_VALUE = 255  # unknown value of a layer
_ALIGNMENT = 4
SCORE_STEPS = 100.0  # byte values per unit of the score; a cell with a score up to 1 is a foothold
MAX_SIGMA_M = 0.02  # [m] standard deviation of a height at the end of the colour scale
MAX_EVALUATION_CELLS = 25  # [cells] absolute value of the evaluation function at both ends of the colour scale


def map_frame(terrain: TerrainMap, layer: Layer) -> bytes:
    """Return the frame of a map with one layer.

    It has three bytes per cell, five for the layer "color".

    Args:
        terrain: The map.
        layer: Layer that colours the map; the score replaces "color" if the map has no colour.
    """
    chosen: Layer = "score" if layer == "color" and terrain.color.size == 0 else layer
    values, scale = _values(terrain, chosen)
    header = {
        "type": "map",
        "stamp_ns": terrain.stamp_ns,
        "resolution": terrain.resolution,
        "origin": [round(float(v), 4) for v in terrain.origin],
        "nx": terrain.elevation.shape[0],
        "ny": terrain.elevation.shape[1],
        "layer": chosen,
        "scale": scale,
        "layers": ["score", "evaluation", "variance", *(["color"] if terrain.color.size else [])],
    }
    return make_frame(header, _heights(terrain), values)


def picture_frame(picture: Preview) -> bytes:
    """Return the frame of a camera picture: depth as JPEG, followed by colour as JPEG."""
    header = {
        "type": "picture",
        "stamp_ns": picture.stamp_ns,
        "depth": len(picture.depth_jpeg),
        "color": len(picture.color_jpeg),
    }
    return make_frame(header, picture.depth_jpeg, picture.color_jpeg)


def make_frame(header: dict[str, Any], *arrays: NDArray[Any]) -> bytes:
    """Return the frame of a header and arrays: the layout of this module, with any arrays."""
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    gap = -(4 + len(text)) % _ALIGNMENT
    return b"".join((struct.pack("<I", len(text) + gap), text, b" " * gap, *(array.tobytes() for array in arrays)))


def _heights(terrain: TerrainMap) -> NDArray[np.int16]:
    mm = terrain.elevation * np.float32(1000.0)
    np.fmax(mm, np.float32(NO_HEIGHT), out=mm)  # fmax replaces NaN by NO_HEIGHT
    np.fmin(mm, _MAX_HEIGHT_MM, out=mm)
    return mm.astype(np.int16)


def _values(terrain: TerrainMap, layer: Layer) -> tuple[NDArray[np.uint8], dict[str, float]]:
    """Return the bytes of a layer and its scale for the header.

    The layer "color" has three bytes per cell, the others one.
    """
    match layer:
        case "color":
            return np.ascontiguousarray(terrain.color), {}
        case "score":
            scale = {"per_byte": 1.0 / SCORE_STEPS, "limit": MAX_FOOTHOLD_SCORE}
            return _bytes(terrain.score * np.float32(SCORE_STEPS)), scale
        case "variance":
            deviation = np.sqrt(np.maximum(terrain.variance, np.float32(0.0)))
            return _bytes(deviation * np.float32(254.0 / MAX_SIGMA_M)), {
                "per_byte": MAX_SIGMA_M / 254.0,
                "limit": MAX_SIGMA_M,
            }
    near = np.clip(terrain.evaluation, -MAX_EVALUATION_CELLS, MAX_EVALUATION_CELLS).astype(np.int16) + MAX_EVALUATION_CELLS
    values = np.where(terrain.evaluation == UNKNOWN, NO_VALUE, near).astype(np.uint8)
    return values, {"per_byte": 1.0, "zero": float(MAX_EVALUATION_CELLS), "limit": -1.0}


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return values >= 0 as bytes clipped to 254; NaN becomes NO_VALUE."""
    known = np.fmax(values, np.float32(-1.0))  # fmax replaces NaN by -1, which is NO_VALUE as a byte
    np.fmin(known, np.float32(254.0), out=known)
    return known.astype(np.int16).astype(np.uint8)
