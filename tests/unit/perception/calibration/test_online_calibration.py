"""Laws of the self-correction: slow, bounded, only what is known, and told to the operator."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.perception.calibration.motion_calibration import HEIGHT, SCALE
from sextant.services.perception.calibration.online_calibration import OnlineCalibration
from sextant.services.perception.registration.error_twist import apply_twist, covariance_at
from sextant.services.perception.registration.motion_prior import Motion
from sextant.services.perception.registration.registration_result import first_result
from sextant.shared.geometry import Array, exp_so3, transform
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
PRIOR = np.diag([0.002, 0.002, 0.01, 0.01, 0.01, 0.002]) ** 2
SHARP = np.diag([1e-4, 1e-4, 1e-4, 3e-4, 3e-4, 3e-4]) ** 2  # covariance of a pose by images that show everything


class Walk:
    """A robot that walks ahead in steps of 1 cm, and whose camera is turned by (3,) [rad] against its profile."""

    def __init__(self, rotation: tuple[float, float, float], corrects: bool = True, scale: float = 0.0) -> None:
        self.calibration = OnlineCalibration(PROFILE, corrects)
        self._error, self.scale = np.array(rotation), scale
        self.T = np.eye(4)
        self._frame = 0
        self.trace: list[Array] = []  # (10,) corrected errors after each frame

    def run(self, frames: int, reliable: bool = True, ok: bool = True, restarts: int = 0) -> None:
        step = np.array([0.01, 0.0, 0.0])
        for _ in range(frames):
            self._frame += 1
            correction = self.calibration.correction
            remaining = self._error - [*correction.tilt, 0.0]
            shown = exp_so3(remaining) @ step * (1.0 + self.scale)
            prior = self.T @ transform(np.eye(3), step)
            twist = np.concatenate([self.T[:3, :3] @ (shown - step), np.zeros(3)])
            self.T = apply_twist(prior, twist)
            T_camera = self.T @ correction.T_body_camera
            covariance = covariance_at(SHARP, T_camera[:3, 3] - self.T[:3, 3])
            found = first_result(66_000_000 * self._frame, T_camera, covariance)
            found = replace(found, ok=ok, reason="" if ok else "no match")
            motion = Motion(transform(np.eye(3), self._frame * step), 0.01 * self._frame, 0.0, reliable)
            self.calibration.add(found, prior, PRIOR, self.T, motion, restarts)
            self.trace.append(self.calibration.corrected)


def test_camera_that_looks_too_low_is_corrected_slowly_and_named() -> None:
    """The profile is turned up against the true mount: about y, downward is positive."""
    walk = Walk((0.0, -0.05, 0.0))
    walk.run(200)
    changes = np.abs(np.diff([corrected[1] for corrected in walk.trace]))
    assert walk.calibration.corrected[1] == pytest.approx(-0.05, abs=0.007)
    assert changes.max() <= np.radians(0.3) + 1e-12
    assert walk.calibration.finding.startswith("the camera looks 2.")
    assert "lower than its profile says: run `sextant camera calibrate`" in walk.calibration.finding


def test_body_pose_is_continuous_while_the_camera_is_corrected() -> None:
    walk = Walk((0.0, -0.05, 0.0))
    before = walk.T
    for _ in range(100):
        walk.run(1)
        assert np.linalg.norm(walk.T[:3, 3] - before[:3, 3]) < 0.011
        before = walk.T


@pytest.mark.parametrize(
    ("rotation", "scale", "words"),
    [
        ((0.0, 0.07, 0.0), 0.0, " higher "),
        ((0.0, 0.0, 0.08), 0.0, " farther right "),
        ((0.0, 0.0, -0.08), 0.0, " farther left "),
        ((0.0, 0.0, 0.0), 0.05, " longer "),
        ((0.0, 0.0, 0.0), -0.05, " shorter "),
    ],
)
def test_error_is_named_by_its_direction(rotation: tuple[float, float, float], scale: float, words: str) -> None:
    walk = Walk(rotation, corrects=False, scale=scale)
    walk.run(200)
    assert words in walk.calibration.finding
    assert not walk.calibration.corrected.any(), "it is only named"


def test_yaw_and_depth_error_are_not_corrected() -> None:
    walk = Walk((0.0, 0.0, 0.08), scale=0.05)
    walk.run(200)
    assert not walk.calibration.corrected.any()
    assert walk.calibration.values[2] > 0.03


def test_exact_camera_is_neither_corrected_nor_named() -> None:
    walk = Walk((0.0, 0.0, 0.0))
    walk.run(300)
    assert not walk.calibration.corrected.any()
    assert walk.calibration.finding == ""


@pytest.mark.parametrize("scale", [0.09, -0.09])
def test_error_that_only_one_stretch_shows_is_not_named(scale: float) -> None:
    walk = Walk((0.0, 0.0, 0.0), scale=scale)
    walk.run(12)
    calibration = walk.calibration
    assert abs(calibration.values[SCALE]) > 2.0 * calibration.sigma[SCALE], "it would be named if one stretch were enough"
    walk.scale = 0.0
    for _ in range(50):
        assert calibration.finding == ""
        walk.run(1)


def test_correction_is_bounded() -> None:
    walk = Walk((0.0, 0.3, 0.0))  # 17 deg: someone has turned the camera
    walk.run(600)
    assert abs(walk.calibration.corrected[1]) <= np.radians(6.0)


@pytest.mark.parametrize("how", [{"reliable": False}, {"ok": False}])
def test_frames_without_registration_or_legs_teach_nothing(how: dict[str, bool]) -> None:
    walk = Walk((0.0, 0.05, 0.0))
    walk.run(200, **how)
    assert not walk.calibration.values.any()
    assert walk.calibration.news(1) is None


def test_stretch_does_not_reach_across_a_restart_of_odometry() -> None:
    walk = Walk((0.0, 0.05, 0.0))
    for restarts in range(30):
        walk.run(8, restarts=restarts)
    assert not walk.calibration.values.any()


def test_feet_that_stand_lower_than_the_map_lower_the_camera() -> None:
    walk = Walk((0.0, 0.0, 0.0))
    for _ in range(200):
        walk.calibration.compare(np.full(6, walk.calibration.correction.height - 0.008))
        walk.run(1)
    assert walk.calibration.values[HEIGHT] == pytest.approx(0.006, abs=0.003)
    assert walk.calibration.correction.T_body_camera[2, 3] < PROFILE.camera.T_body_camera[2, 3] - 0.003


def test_news_are_told_once() -> None:
    walk = Walk((0.0, -0.05, 0.0))
    assert walk.calibration.news(0) is None
    walk.run(30)
    errors = walk.calibration.news(7)
    assert errors is not None
    assert errors.stamp_ns == 7
    assert errors.estimate[1] < 0.0 < errors.sigma[1]
    assert walk.calibration.news(8) is None
