"""Hand-held camera without odometry.

It tracks its motion from the first two frames on, recovers when lost, and ignores moving bodies.
"""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from sextant.services.perception.registration.acceptance import HAND_HELD, Acceptance
from sextant.services.perception.registration.motion_prior import VelocityPrior
from sextant.services.perception.registration.projective_icp import Registration
from sextant.services.perception.registration.registration_result import RegistrationResult
from tests.support.depth_folders import CAMERA, RATE_HZ, SENSOR, room
from tests.support.raycast import camera_pose, depth_image

PERIOD_NS = round(1e9 / RATE_HZ)
NO_BOXES = np.zeros((0, 6))
Boxes = Callable[[int], np.ndarray]


def at(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return np.asarray(camera_pose(x, y, yaw, z=0.6))


def register_frames(poses: Sequence[np.ndarray], boxes: Boxes) -> list[RegistrationResult]:
    """Register the frames of a hand-held camera without odometry."""
    rng, prior = np.random.default_rng(1000), VelocityPrior(0.15)
    registration = Registration(CAMERA, SENSOR, HAND_HELD, blocks_across=160)
    found: list[RegistrationResult] = []
    for n, T in enumerate(poses):
        expected = prior.predict(1.0 / RATE_HZ) if found else T
        sigma = 0.01 if prior.measured else 0.06
        image = depth_image(T, boxes(n), rng, CAMERA, SENSOR)
        found.append(registration.update(image, n * PERIOD_NS, expected, sigma**2 * np.eye(6)))
        prior.update(n * PERIOD_NS, found[-1].T_world_camera, found[-1].ok, found[-1].degenerate)
    return found


def errors(found: Sequence[RegistrationResult], poses: Sequence[np.ndarray]) -> np.ndarray:
    """Return distances (n,) [m] of the estimated from the true positions."""
    return np.array([np.linalg.norm(r.T_world_camera[:3, 3] - T[:3, 3]) for r, T in zip(found, poses, strict=True)])


@pytest.mark.slow
@pytest.mark.parametrize(
    "move",
    [
        pytest.param(lambda s: at(1.5 * s), id="1.5 m/s ahead"),
        pytest.param(lambda s: at(0.5, 1.2 * s - 0.2), id="1.2 m/s aside"),
        pytest.param(lambda s: at(0.5, yaw=np.radians(80.0) * s - 0.2), id="80 deg/s"),
    ],
)
def test_camera_moving_from_first_frame_is_tracked(move: Callable[[float], np.ndarray]) -> None:
    poses = [move(n / RATE_HZ) for n in range(8)]
    boxes = room()
    found = register_frames(poses, lambda _: boxes)
    assert all(r.ok for r in found)
    assert errors(found, poses).max() < 0.015


@pytest.mark.slow
def test_camera_moved_away_is_lost_and_relocalized_on_return() -> None:
    """Check a jump of 3 m to unseen ground, and a return near the previous place."""
    boxes = room()
    away = range(12, 24)
    poses = [at(0.2 * n / RATE_HZ + 3.0 * (n in away), 0.15 * (n >= 24), 0.1 * (n >= 24)) for n in range(34)]
    found = register_frames(poses, lambda _: boxes)
    assert not any(found[n].ok for n in away)
    rest = found[23].T_world_camera[:3, 3] - found[11].T_world_camera[:3, 3]
    assert np.linalg.norm(rest) < 0.05, "where it is not seen to move it is expected to rest"
    assert all(r.ok for r in found[28:]), "within four pictures"
    assert errors(found, poses)[28:].max() < 0.015


def trolley(n: int) -> np.ndarray:
    y = -0.8 + 0.5 * n / RATE_HZ
    return np.array([[1.2, y, 0.0, 1.6, y + 0.4, 0.5]])


def approaching(n: int) -> np.ndarray:
    x = 1.9 - 0.2 * n / RATE_HZ
    return np.array([[x, -0.3, 0.0, x + 0.4, 0.3, 0.5]])


def walking_legs(n: int) -> np.ndarray:
    s = n / RATE_HZ
    y, swing = -0.9 + s, 0.2 * np.sin(6.0 * s)
    return np.array(
        [[1.1 + swing, y, 0.0, 1.22 + swing, y + 0.12, 0.9], [1.1 - swing, y + 0.15, 0.0, 1.22 - swing, y + 0.27, 0.9]]
    )


@pytest.mark.slow
@pytest.mark.parametrize("body", [trolley, approaching, walking_legs])
@pytest.mark.parametrize("things", [NO_BOXES, room()[:12]], ids=["bare floor", "a few things"])
def test_moving_body_does_not_shift_resting_camera(body: Boxes, things: np.ndarray) -> None:
    poses = [at(0.0)] * 45
    found = register_frames(poses, lambda n: np.vstack([things, body(n)]))
    assert errors(found, poses).max() < 0.006
    yaw = [np.arctan2(r.T_world_camera[1, 2], r.T_world_camera[0, 2]) for r in found]
    assert np.abs(yaw).max() < np.radians(0.5)


@pytest.mark.parametrize("body", [trolley, approaching, walking_legs])
def test_moving_body_does_not_shift_standing_robot(body: Boxes) -> None:
    """Check legs that report a standing robot with some uncertainty."""
    rng, T = np.random.default_rng(1001), at(0.0)
    registration = Registration(CAMERA, SENSOR, Acceptance())
    covariance = np.diag([0.001, 0.001, 0.01, 0.01, 0.01, 0.001]) ** 2
    expected = T
    for n in range(30):
        image = depth_image(T, body(2 * n), rng, CAMERA, SENSOR)
        expected = registration.update(image, 2 * n * PERIOD_NS, expected, covariance).T_world_camera
    assert np.linalg.norm(expected[:3, 3] - T[:3, 3]) < 0.006


@pytest.mark.slow
def test_camera_starting_to_move_among_static_objects_is_tracked() -> None:
    speeds = np.concatenate([np.zeros(10), np.linspace(0.0, 0.5, 20)])
    poses = [at(x) for x in np.cumsum(speeds) / RATE_HZ]
    boxes = room()
    found = register_frames(poses, lambda _: boxes)
    assert all(r.ok for r in found)
    assert errors(found, poses).max() < 0.015
