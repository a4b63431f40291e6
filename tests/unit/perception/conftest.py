"""Synthetic world for perception: a floor with boxes and a walking depth camera.

The camera has the properties of a PrimeSense.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.shared.robot.camera import DepthSensor, Intrinsics
from tests.support.raycast import INTRINSICS, SENSOR, camera_pose, depth_image


def walk(steps: int, step: float):
    """Return camera poses (n, 4, 4) of a walk along x.

    The poses include the bob, roll, pitch and yaw of a gait.
    """
    s = step * np.arange(steps)
    phase = 2 * np.pi * s / 0.1  # one gait cycle per 10 cm
    return np.stack(
        [
            camera_pose(
                s[i],
                0.005 * np.sin(phase[i] / 2),
                yaw=np.radians(1.0) * np.sin(phase[i] / 3),
                z=0.25 + 0.004 * np.sin(phase[i]),
                pitch=np.radians(30 + 0.7 * np.sin(phase[i] + 1)),
                roll=np.radians(1.0) * np.sin(phase[i] / 2 + 2),
            )
            for i in range(steps)
        ]
    )


def steps_world():
    """Return two stairs of 3 cm across the way, with blocks between them."""
    rng = np.random.default_rng(5)
    boxes = [[1.2, -2, 0, 6, 2, 0.03], [1.6, -2, 0, 6, 2, 0.06]]
    for x in np.arange(0.5, 4.5, 0.3):
        base = 0.03 * (x > 1.2) + 0.03 * (x > 1.6)
        for _ in range(2):
            cx, cy = x + rng.uniform(-0.1, 0.1), rng.uniform(-0.5, 0.5)
            boxes.append([cx, cy, 0, cx + 0.15, cy + 0.2, base + rng.uniform(0.01, 0.04)])
    return np.array(boxes)


def boxes_world():
    """Return a floor with a low box every 0.45 m."""
    rng = np.random.default_rng(6)
    centres = np.column_stack([np.arange(0.6, 5.0, 0.45), rng.uniform(-0.4, 0.4, 10)])
    heights = rng.uniform(0.02, 0.06, 10)
    return np.array([[x, y, 0.0, x + 0.12, y + 0.12, h] for (x, y), h in zip(centres, heights, strict=True)])


def pillars_world():
    """Return close posts of various heights: every direction is constrained."""
    rng = np.random.default_rng(7)
    corners = rng.uniform([0.5, -0.8], [3.0, 0.8], (40, 2))
    return np.column_stack([corners, np.zeros(40), corners + 0.08, rng.uniform(0.03, 0.2, 40)])


@dataclass(frozen=True)
class World:
    """The contents of this file, provided by a fixture."""

    intrinsics: Intrinsics
    sensor: DepthSensor
    depth_image: Callable[..., NDArray[np.uint16]]
    camera_pose: Callable[..., NDArray[np.float64]]
    walk: Callable[[int, float], NDArray[np.float64]]
    scenes: dict[str, NDArray[np.float64]]


@pytest.fixture(scope="session")
def world() -> World:
    return World(
        INTRINSICS,
        SENSOR,
        depth_image,
        camera_pose,
        walk,
        {"flat": np.zeros((0, 6)), "boxes": boxes_world(), "steps": steps_world(), "pillars": pillars_world()},
    )
