"""Binary frames for pages: a header in JSON, and behind it what a graphics card takes as it is. Pure.

    uint32 little-endian header length | header | padding to 4 bytes | heights, int16 | colours, uint8

Heights are millimetres {world}; unknown is -32768. `values` are one byte a cell, what they mean the header says;
`rgb` are three.
"""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.console.web.requests import Layer
from sextant.shared.wire.messages import UNKNOWN, Preview, TerrainMap

NO_HEIGHT = -32768
_HIGHEST = np.float32(32767.0)  # [mm]; what is higher is drawn there, what is as deep is unknown
NO_VALUE = 255  # of a layer: unknown
_ALIGNMENT = 4
_SCORE_STEPS = 100.0  # values of a byte per unit of the score, which is a foothold up to 1
_WORST_VARIANCE = 0.02  # [m] standard deviation drawn as the worst
_FAR_VALUE = 25  # [cells] of the evaluation function on either side that are told apart


def map_frame(terrain: TerrainMap, layer: Layer) -> bytes:
    """A map with one of its layers; about three bytes a cell, five in colour.

    Args:
        terrain: The map.
        layer: To colour it by; the score, where it has no colour.
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
    return framed(header, _heights(terrain), values)


def picture_frame(picture: Preview) -> bytes:
    """What the camera sees: its depth as JPEG, and behind it its colour."""
    header = {
        "type": "picture",
        "stamp_ns": picture.stamp_ns,
        "depth": len(picture.depth_jpeg),
        "color": len(picture.color_jpeg),
    }
    return framed(header, picture.depth_jpeg, picture.color_jpeg)


def framed(header: dict[str, Any], *arrays: NDArray[Any]) -> bytes:
    """A header and what goes behind it."""
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    gap = -(4 + len(text)) % _ALIGNMENT
    return b"".join((struct.pack("<I", len(text) + gap), text, b" " * gap, *(array.tobytes() for array in arrays)))


def _heights(terrain: TerrainMap) -> NDArray[np.int16]:
    mm = terrain.elevation * np.float32(1000.0)
    np.fmax(mm, np.float32(NO_HEIGHT), out=mm)  # the other one of a NaN
    np.fmin(mm, _HIGHEST, out=mm)
    return mm.astype(np.int16)


def _values(terrain: TerrainMap, layer: Layer) -> tuple[NDArray[np.uint8], dict[str, float]]:
    """A byte a cell, or three, and how to read it."""
    match layer:
        case "color":
            return np.ascontiguousarray(terrain.color), {}
        case "score":
            return _bytes(terrain.score * np.float32(_SCORE_STEPS)), {"per_byte": 1.0 / _SCORE_STEPS, "limit": 1.0}
        case "variance":
            deviation = np.sqrt(np.maximum(terrain.variance, np.float32(0.0)))
            return _bytes(deviation * np.float32(254.0 / _WORST_VARIANCE)), {
                "per_byte": _WORST_VARIANCE / 254.0,
                "limit": _WORST_VARIANCE,
            }
    near = np.clip(terrain.evaluation, -_FAR_VALUE, _FAR_VALUE).astype(np.int16) + _FAR_VALUE
    values = np.where(terrain.evaluation == UNKNOWN, NO_VALUE, near).astype(np.uint8)
    return values, {"per_byte": 1.0, "zero": float(_FAR_VALUE), "limit": -1.0}


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Numbers from 0 up as bytes up to 254; what is no number is unknown."""
    known = np.fmax(values, np.float32(-1.0))  # the other one of a NaN; as a byte it is NO_VALUE
    np.fmin(known, np.float32(254.0), out=known)
    return known.astype(np.int16).astype(np.uint8)
