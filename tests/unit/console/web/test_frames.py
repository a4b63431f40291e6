"""Frames of maps and pictures for a page, decoded as its script decodes them."""

import json
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.console.web.frames import NO_HEIGHT, NO_VALUE, make_frame, map_frame, picture_frame
from sextant.shared.wire.messages import UNKNOWN, Preview, TerrainMap

NX, NY = 7, 5


def terrain(seed: int = 0, colored: bool = False) -> TerrainMap:
    rng = np.random.default_rng(seed)
    unknown = rng.random((NX, NY)) < 0.3
    elevation = np.where(unknown, np.nan, rng.uniform(-0.5, 0.5, (NX, NY))).astype(np.float32)
    score = np.where(unknown, np.nan, rng.uniform(0.0, 4.0, (NX, NY))).astype(np.float32)
    variance = np.where(unknown, np.nan, rng.uniform(0.0, 1e-3, (NX, NY))).astype(np.float32)
    evaluation = np.where(unknown, UNKNOWN, rng.integers(-40, 40, (NX, NY))).astype(np.int8)
    extra = {"color": rng.integers(0, 255, (NX, NY, 3), dtype=np.uint8)} if colored else {}
    return TerrainMap(
        5, 0.01, np.array([0.5, -1.0]), elevation, variance, score, np.zeros((NX, NY), dtype=bool), evaluation, **extra
    )


def read(frame: bytes) -> tuple[dict[str, Any], bytes]:
    """Decode a frame as the page's `Link.take` does."""
    (length,) = struct.unpack_from("<I", frame)
    return json.loads(frame[4 : 4 + length]), frame[4 + length :]


def read_map(frame: bytes) -> tuple[dict[str, Any], NDArray[np.int16], NDArray[np.uint8]]:
    header, body = read(frame)
    cells = header["nx"] * header["ny"]
    heights = np.frombuffer(body, np.int16, cells).reshape(header["nx"], header["ny"])
    return header, heights, np.frombuffer(body, np.uint8, offset=2 * cells)


@given(st.text(max_size=40), st.integers(0, 9))
def test_data_after_header_is_aligned(text: str, length: int) -> None:
    frame = make_frame({"words": text}, np.arange(length, dtype=np.int16))
    header, body = read(frame)
    assert header == {"words": text}
    np.testing.assert_array_equal(np.frombuffer(body, np.int16), np.arange(length))
    assert (len(frame) - 2 * length) % 4 == 0


@given(st.integers(0, 1000))
def test_heights_have_millimetre_resolution_and_unknown_stays_unknown(seed: int) -> None:
    map_ = terrain(seed)
    header, heights, _ = read_map(map_frame(map_, "score"))
    known = np.isfinite(map_.elevation)
    np.testing.assert_array_equal(heights == NO_HEIGHT, ~known)
    np.testing.assert_allclose(heights[known] * 1e-3, map_.elevation[known], atol=1.1e-3)
    assert (header["resolution"], header["origin"], header["stamp_ns"]) == (0.01, [0.5, -1.0], 5)


@pytest.mark.parametrize(("height", "drawn"), [(100.0, 32767), (-100.0, NO_HEIGHT)])
def test_heights_outside_range_are_clipped_or_unknown(height: float, drawn: int) -> None:
    map_ = replace(terrain(), elevation=np.full((NX, NY), height, np.float32))
    assert (read_map(map_frame(map_, "score"))[1] == drawn).all()


def test_layer_header_gives_scale_of_its_bytes() -> None:
    map_ = terrain(1)
    known = np.isfinite(map_.elevation)
    for layer, expected in (("score", map_.score), ("variance", np.sqrt(map_.variance))):
        header, _, values = read_map(map_frame(map_, layer))  # type: ignore[arg-type]
        values = values.reshape(NX, NY)
        assert header["layer"] == layer
        np.testing.assert_array_equal(values == NO_VALUE, ~known)
        most = 254 * header["scale"]["per_byte"]
        read_back = values[known] * header["scale"]["per_byte"]
        np.testing.assert_allclose(read_back, np.minimum(expected[known], most), atol=header["scale"]["per_byte"])
    header, _, values = read_map(map_frame(map_, "evaluation"))
    values = values.reshape(NX, NY).astype(int)
    np.testing.assert_array_equal(values == NO_VALUE, ~known)
    np.testing.assert_array_equal(values[known] - header["scale"]["zero"], np.clip(map_.evaluation[known], -25, 25))


def test_color_layer_is_sent_if_available_otherwise_score() -> None:
    map_ = terrain(2, colored=True)
    header, _, values = read_map(map_frame(map_, "color"))
    assert (header["layer"], "color" in header["layers"]) == ("color", True)
    np.testing.assert_array_equal(values.reshape(NX, NY, 3), map_.color)
    header, _, _ = read_map(map_frame(terrain(2), "color"))
    assert (header["layer"], header["layers"]) == ("score", ["score", "evaluation", "variance"])


def test_picture_frame_has_unchanged_image_bytes() -> None:
    depth, color = np.arange(9, dtype=np.uint8), np.arange(5, dtype=np.uint8)
    header, body = read(picture_frame(Preview(3, depth, color)))
    assert header == {"type": "picture", "stamp_ns": 3, "depth": 9, "color": 5}
    assert body == depth.tobytes() + color.tobytes()
