"""Recorded depth sequences of synthetic scenes, in the TUM RGB-D layout."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception import tum
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from tests.support.raycast import depth_image

RATE_HZ = 30.0
CAMERA = Intrinsics(320, 240, 290.0, 290.0, 159.5, 119.5)
SENSOR = DepthSensor(rate_hz=RATE_HZ, min_range=0.3, max_range=4.0)
Boxes = NDArray[np.float64] | Callable[[int], NDArray[np.float64]]


def write_folder(
    folder: Path,
    poses: Sequence[NDArray[np.float64]],
    boxes: Boxes,
    *,
    seed: int = 1000,
    truth: bool = True,
    depth_scale: float = 1000.0,
    min_range: float = 0.5,
) -> Path:
    """Write the depth images that a camera takes of a floor with boxes.

    Args:
        folder: Folder to create.
        poses: (4, 4) T_world_camera of each picture.
        boxes: (n, 6) [m] lower and upper corners, the same for all pictures or one set for each picture.
        seed: Seed of the noise.
        truth: Whether groundtruth.txt is written.
        depth_scale: Value in camera.toml; the images are in millimetres.
        min_range: [m] Value in camera.toml.
    """
    rng = np.random.default_rng(seed)
    camera = tum.Camera(CAMERA, depth_scale, RATE_HZ, np.array([0.0, 0.0, -1.0]), min_range=min_range)
    with tum.RecordingWriter(folder, camera) as writer:
        for n, T in enumerate(poses):
            seen = boxes(n) if callable(boxes) else boxes
            writer.add(round(n * 1e9 / RATE_HZ), depth_image(T, seen, rng, CAMERA, SENSOR), T if truth else None)
    return folder


def room() -> NDArray[np.float64]:
    """Boxes of different sizes at random places on a floor.

    Every direction is observable from every camera pose.
    """
    rng = np.random.default_rng(11)
    corners = rng.uniform([0.6, -1.5], [6.0, 1.5], (70, 2))
    sizes = rng.uniform(0.08, 0.2, (70, 2))
    return np.column_stack([corners, np.zeros(70), corners + sizes, rng.uniform(0.04, 0.25, 70)])
