"""A camera whose mount differs from the profile is named and corrected while the robot walks."""

from dataclasses import replace

import pytest

from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.mismatch import Mismatch


@pytest.mark.slow
def test_camera_that_looks_3_deg_too_low_is_named_and_corrected() -> None:
    """Without correction the pose is 85 mm off on average, because the map rises by 5 cm in each metre."""
    scenario = replace(load_scenario("steps"), mismatch=Mismatch(camera_angle_deg=3.0, at_bounds=True))
    assert scenario.deviation(1000).camera_rpy_deg[1] == 3.0
    report = run_lockstep(scenario, 1000)
    assert report.success
    assert "lower than its profile says: run `sextant camera calibrate`" in report.camera.finding
    assert report.camera.rpy_deg[1] == pytest.approx(-3.0, abs=3.0 * report.camera.rpy_sigma_deg[1])
    assert report.pose_error_m.rms < 0.06
    assert report.map_error_m.bias < 0.06
