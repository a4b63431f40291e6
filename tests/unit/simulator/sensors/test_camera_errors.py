"""Errors of a camera: a distorting lens shows surfaces at other pixels, smoothly."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.simulator.sensors.camera_errors import CameraErrors
from sextant.shared.robot.profiles import load_profile

CAMERA = load_profile("phantomx_mk2").camera
LENS = CAMERA.intrinsics
FLOOR = (0.1, 1.8, 1.2)  # [1/m] inverse depth of a floor: A x + B y + C, by the slopes x and y of a ray


def rays() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the slopes x and y (h, w) of the rays of all pixels."""
    v, u = np.mgrid[: LENS.height, : LENS.width]
    return (u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy


def plane(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the inverse depth [1/m] of the floor along rays; 0 above its horizon."""
    w = FLOOR[0] * x + FLOOR[1] * y + FLOOR[2]
    return np.asarray(np.where(w > 0.3, w, 0.0), dtype=np.float32)


def seen(inverse_depth: NDArray[np.float32], k1: float) -> NDArray[np.float32]:
    """Return an image through a lens that appears to move a ray at r to r (1 + k1 r^2)."""
    return CameraErrors(replace(CAMERA, distortion=k1), 0.0).depth(inverse_depth)


@pytest.mark.parametrize("k1", [-0.03, 0.03])
def test_distorted_floor_stays_smooth(k1: float) -> None:
    x, y = rays()
    measured = seen(plane(x, y), k1)
    # The true ray of each pixel, by fixed-point iteration.
    true_x, true_y = x, y
    for _ in range(20):
        out = 1.0 + k1 * (true_x**2 + true_y**2)
        true_x, true_y = x / out, y / out
    expected = plane(true_x, true_y)
    surface = (measured > 0.0) & (expected > 0.35)
    assert surface.mean() > 0.7
    assert np.abs(measured - plane(x, y))[surface].max() > 0.005, "it is distorted"
    off = np.abs(measured - expected)[surface]
    assert np.mean(off < 2e-4) > 0.98
    assert off.max() < 2e-3, "half a pixel, at the border of the image"


def test_edge_of_a_block_is_not_blurred() -> None:
    near, far = np.float32(1 / 0.8), np.float32(1 / 1.0)
    image = np.where(rays()[0] < 0.2, near, far).astype(np.float32)
    image[:40] = 0.0  # sky
    assert set(np.unique(seen(image, 0.03)).tolist()) == {0.0, float(near), float(far)}


def test_exact_camera_changes_nothing() -> None:
    image = plane(*rays())
    np.testing.assert_array_equal(seen(image, 0.0), image)
