"""A registration of another package: its arguments, and the use of its pose."""

import numpy as np
import pytest

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.camera_correction import CameraCorrection
from sextant.services.perception.registration.frame_registration import FrameRegistration
from sextant.services.perception.registration.plugin_registration import PluginRegistration
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
CAMERA = PROFILE.camera
PRIOR = from_xyz_rpy((1.0, 2.0, 0.3), (0.0, 0.5, 0.2))
COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5])


def frame() -> np.ndarray:
    raw = np.full((CAMERA.intrinsics.height, CAMERA.intrinsics.width), 800, dtype=np.uint16)
    raw[0, :3] = (0, 1, 65535)
    return raw


def test_frame_has_depth_in_metres_and_the_expected_pose():
    method = PluginRegistration(PROFILE, "tests.support.plugins:Shifted")
    method.update(frame(), 7, PRIOR, COVARIANCE)
    (told,) = method._plugin._target.frames
    assert told.stamp_ns == 7
    assert told.depth.dtype == np.float32
    assert told.depth[0, :3].tolist() == [0.0, 0.0, 0.0], "values outside the range of the sensor are no measurement"
    assert told.depth[5, 5] == pytest.approx(800 / CAMERA.sensor.depth_scale)
    assert (told.T_world_camera == PRIOR).all()
    assert (told.covariance == COVARIANCE).all()


def test_pose_of_the_plugin_is_taken():
    found = PluginRegistration(PROFILE, "tests.support.plugins:Shifted").update(frame(), 7, PRIOR, COVARIANCE)
    assert found.ok
    assert found.T_world_camera[0, 3] == pytest.approx(PRIOR[0, 3] + 1e-3)
    assert (found.overlap, len(found.degenerate)) == (0.5, 0)


def test_reason_for_no_pose_keeps_the_expected_one():
    found = PluginRegistration(PROFILE, "tests.support.plugins:Lost").update(frame(), 7, PRIOR, COVARIANCE)
    assert (found.ok, found.reason) == (False, "fog")
    assert (found.T_world_camera == PRIOR).all()


def test_frame_of_another_size_is_refused():
    with pytest.raises(ValueError, match="expected"):
        PluginRegistration(PROFILE, "tests.support.plugins:Lost").update(frame()[:-1], 7, PRIOR, COVARIANCE)


def test_perception_uses_the_plugin_of_the_settings():
    registration = FrameRegistration(
        PROFILE, Settings(registration="tests.support.plugins:Lost"), CameraCorrection(PROFILE.camera)
    )
    assert isinstance(registration._method, PluginRegistration)
