"""Rectified images are those of a pinhole camera."""

from dataclasses import replace

import numpy as np

from sextant.services.perception.rectification import Rectifier
from sextant.services.simulator.sensors.camera_errors import CameraErrors
from sextant.shared.robot.profiles import load_profile

CAMERA = load_profile("phantomx_mk2").camera


def test_rectified_image_of_a_distorted_plane_is_affine_again() -> None:
    lens = CAMERA.intrinsics
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    plane = (0.5 + 2e-4 * u + 1e-3 * v).astype(np.float32)  # [1/m] inverse depth
    seen = CameraErrors(replace(CAMERA, distortion=0.1, depth_error=0.0), 0.0).depth(plane)
    per_m = 20_000.0  # so fine that rounding does not show
    raw = np.where(seen > 0.0, np.rint(per_m / np.maximum(seen, 0.4)), 0.0).astype(np.uint16)
    found = Rectifier(lens, 0.1).depth(raw)
    inside = found > 0
    assert inside.mean() > 0.9
    error = np.abs(per_m / found[inside] - plane[inside])
    assert np.abs(per_m / raw[raw > 0] - plane[raw > 0]).max() > 5e-3
    assert np.mean(error < 1e-4) > 0.98  # the nearest pixel is off by up to 5e-4
    assert error.max() < 2.5e-3  # at the border


def test_without_distortion_and_for_another_size_the_image_stays() -> None:
    raw = np.ones((CAMERA.intrinsics.height, CAMERA.intrinsics.width), dtype=np.uint16)
    assert Rectifier(CAMERA.intrinsics, 0.0).depth(raw) is raw
    small = raw[:10, :10]
    assert Rectifier(CAMERA.intrinsics, 0.1).depth(small) is small


def test_rectified_camera_measures_true_depth() -> None:
    camera = replace(CAMERA, depth_error=0.02, distortion=0.01)
    raw = 1.5 * (1.0 + camera.depth_error) * camera.sensor.depth_scale
    assert raw / camera.rectified.sensor.depth_scale == 1.5
    assert (camera.rectified.depth_error, camera.rectified.distortion) == (0.0, 0.0)
    assert CAMERA.rectified == CAMERA
