"""Previews: small pictures of any size and depth that fit into a message."""

import cv2
import numpy as np
import pytest

from sextant.services.perception.preview import preview
from sextant.shared.robot.camera import DepthSensor
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import MAX_PREVIEW

SENSOR = DepthSensor()


@pytest.mark.parametrize("size", [(480, 640), (1, 1), (1, 640), (640, 1), (720, 1280), (3, 5)])
@pytest.mark.parametrize("colored", [True, False])
def test_frame_of_any_size_gives_preview(size: tuple[int, int], colored: bool) -> None:
    rng = np.random.default_rng(0)
    depth = rng.integers(0, 65536, size, dtype=np.uint16)
    rgb = rng.integers(0, 256, (*size, 3), dtype=np.uint8) if colored else None
    made = preview(7, depth, SENSOR, rgb)
    assert made.stamp_ns == 7
    assert 0 < made.depth_jpeg.size <= MAX_PREVIEW, "noise is the worst there is"
    assert cv2.imdecode(made.depth_jpeg, cv2.IMREAD_COLOR) is not None
    assert (made.color_jpeg.size > 0) is colored
    assert made.color_jpeg.size <= MAX_PREVIEW


def test_empty_color_image_gives_no_color_preview() -> None:
    made = preview(0, np.ones((4, 4), dtype=np.uint16), SENSOR, np.zeros((0, 0, 3), dtype=np.uint8))
    assert made.color_jpeg.size == 0


@pytest.mark.parametrize("shape", [(424, 512), (639, 639), (480, 639), (1440, 1440), (1, 4096)])
def test_preview_of_any_image_fits_message_size(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    depth = np.where(rng.random(shape) < 0.6, 0, rng.integers(300, 4000, shape)).astype(np.uint16)
    shown = preview(1, depth, DepthSensor(), rng.integers(0, 256, (*shape, 3)).astype(np.uint8))
    assert len(codec.encode(shown)) <= topics.PREVIEW.max_bytes
