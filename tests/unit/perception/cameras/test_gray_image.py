"""The grey image of a colour image."""

import numpy as np
import pytest

from sextant.services.perception.cameras.gray_image import gray_image
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.wire.messages import MAX_GRAY, DepthImage

LENS = Intrinsics(640, 480, 585.0, 585.0, 319.5, 239.5)


def test_pixels_are_means_of_squares() -> None:
    rgb = np.zeros((480, 640, 3), np.uint8)
    rgb[2:4, 6:8] = 200
    rgb[2, 6] = 0
    gray = gray_image(rgb, LENS)
    assert gray.shape == (240, 320)
    assert gray[1, 3] == 150
    assert gray.sum() == 150


@pytest.mark.parametrize("rgb", [None, np.zeros((240, 320, 3), np.uint8), np.zeros((480, 640, 1), np.uint8)])
def test_without_an_image_of_the_lens_there_is_none(rgb: np.ndarray | None) -> None:  # type: ignore[type-arg]
    assert gray_image(rgb, LENS).shape == (0, 0)


@pytest.mark.parametrize("size", [(64, 48), (320, 240), (640, 480), (848, 480), (1280, 720), (4096, 16), (1501, 1396)])
def test_every_lens_has_a_grey_image_that_fits_into_a_message(size: tuple[int, int]) -> None:
    width, height = size
    lens = Intrinsics(width, height, 600.0, 600.0, (width - 1) / 2, (height - 1) / 2)
    gray = gray_image(np.full((height, width, 3), 7, np.uint8), lens)
    assert gray.shape == (lens.gray.height, lens.gray.width)
    assert max(gray.shape) <= MAX_GRAY
    DepthImage(0, np.zeros((height, width), np.uint16), gray)


def test_grey_lens_sees_the_same_directions() -> None:
    gray = LENS.gray
    for u in (0, 10, 319):  # a grey pixel is centred between the two pixels that it covers
        assert (u - gray.cx) / gray.fx == pytest.approx((2 * u + 0.5 - LENS.cx) / LENS.fx)


def test_a_grey_image_that_is_too_large_is_refused() -> None:
    with pytest.raises(ValueError, match="gray"):
        DepthImage(0, np.zeros((4, 4), np.uint16), np.zeros((1, MAX_GRAY + 1), np.uint8))
