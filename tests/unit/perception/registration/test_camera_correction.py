"""Laws of the camera's correction: poses of the body stay, and the ground moves as stated."""

import numpy as np
import pytest

from sextant.services.perception.registration.camera_correction import CameraCorrection
from sextant.services.perception.registration.registration_result import first_result
from sextant.shared.geometry import from_xyz_rpy, inverse, is_rigid
from sextant.shared.robot.profiles import load_profile

CAMERA = load_profile("phantomx_mk2").camera
BODY = from_xyz_rpy([0.8, -0.3, 0.2], [0.02, -0.03, 0.4])
TILT = np.radians([0.4, -0.9])


def test_without_a_correction_world_and_track_are_the_same() -> None:
    correction = CameraCorrection(CAMERA)
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6
    T, S = correction.in_track(BODY, covariance)
    np.testing.assert_array_equal(T, BODY)
    np.testing.assert_array_equal(S, covariance)
    found = correction.in_world(first_result(1, BODY, covariance))
    np.testing.assert_array_equal(found.T_world_camera, BODY)
    np.testing.assert_array_equal(found.covariance, covariance)
    assert not correction.ground_change.any()


def test_world_and_track_are_inverse_to_each_other() -> None:
    correction = CameraCorrection(CAMERA)
    correction.change(TILT, 0.004, BODY)
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6
    T, S = correction.in_track(BODY, covariance)
    found = correction.in_world(first_result(1, T, S))
    assert found.T_world_camera == pytest.approx(BODY, abs=1e-12)
    assert found.covariance == pytest.approx(covariance, abs=1e-15)


def test_body_stays_where_it_is() -> None:
    """The same image at the same place of {track} gives the same pose of the body after a correction."""
    correction = CameraCorrection(CAMERA)
    T_track_camera, _ = correction.in_track(BODY @ correction.T_body_camera, np.eye(6))
    for k in range(1, 4):
        correction.change(k * TILT, 0.002 * k, BODY)
        found = correction.in_world(first_result(1, T_track_camera, np.eye(6)))
        assert found.T_world_camera @ inverse(correction.T_body_camera) == pytest.approx(BODY, abs=1e-12)


def test_ground_changes_as_stated() -> None:
    """A point of the ground in {track} gets the height that the stated change gives it."""
    correction = CameraCorrection(CAMERA)
    correction.change(TILT, 0.004, BODY)
    a, b, c = correction.ground_change
    for point in ([0.8, -0.3, 0.0], [1.3, -0.1, 0.05], [0.5, -0.6, -0.1]):
        T = np.eye(4)
        T[:3, 3] = point
        x, y, z = correction.in_world(first_result(1, T, np.eye(6))).T_world_camera[:3, 3]
        assert point[2] + a * x + b * y + c == pytest.approx(z, abs=1e-3)


def test_many_corrections_of_a_pose_that_is_not_exactly_rigid_stay_rigid() -> None:
    correction = CameraCorrection(CAMERA)
    T = BODY.copy()
    T[:3, :3] *= 1.0 + 1e-9
    for k in range(300):
        correction.change(np.sin(k) * TILT, 0.0, T)
        T_track, _ = correction.in_track(T @ correction.T_body_camera, np.eye(6))
        T = correction.in_world(first_result(1, T_track, np.eye(6))).T_world_camera @ inverse(correction.T_body_camera)
    assert is_rigid(T, 1e-6)
    np.testing.assert_allclose(T, BODY, atol=1e-6)
