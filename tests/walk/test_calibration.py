"""Calibration of simulated robots that differ from their profile."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks import cli as benchmarks
from sextant.deploy.cli import main
from sextant.services.perception.calibration import survey
from sextant.shared.geometry import log_so3, rotation_from_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario


def test_command_calibrates_a_simulated_robot_into_its_own_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(survey, "POSTURES", 24)
    own = tmp_path / "mine.toml"
    robot = ["--robot", "phantomx_mk2_imu"]
    assert main(["camera", "calibrate", "--rehearse", "flat+usual", *robot, "--seed", "1000", "--out", str(own)]) == 0
    told = capsys.readouterr().out
    assert "all postures measured" in told
    assert f"{own}: written" in told
    found, base = load_profile(str(own)), load_profile("phantomx_mk2")
    deviation = load_scenario("flat+usual").deviation(1000)
    assert found.camera.time_offset_s == pytest.approx(deviation.stamp_offset_s, abs=0.004)
    assert found.camera.yaw_deg == pytest.approx(deviation.camera_rpy_deg[2], abs=0.6)
    assert found.camera.roll_deg == pytest.approx(deviation.camera_rpy_deg[0], abs=0.6)
    assert found.camera.mount_xyz == pytest.approx(base.camera.mount_xyz + deviation.camera_xyz, abs=0.008)
    assert len(found.calibration) >= 4
    error = found.imu.R_body_imu.T @ rotation_from_rpy(np.radians(deviation.imu_rpy_deg))
    assert np.degrees(log_so3(error)) == pytest.approx(0.0, abs=1.5)  # within 2.5 sigma of the accelerometer's error
    (line,) = [line for line in told.splitlines() if line.startswith("errors of this result")]
    of_gravity = dict(re.findall(r"(imu_\w+) (\S+?)(?:,|$)", line))
    assert sorted(of_gravity) == ["imu_pitch_deg", "imu_roll_deg", "imu_yaw_deg"]
    assert max(abs(float(value)) for value in of_gravity.values()) < 0.5

    monkeypatch.chdir(tmp_path)
    seeds = ["--seeds", "1001:1002", "--out", "bench"]
    assert benchmarks.main(["calibration", "--scenario", "stairs", *seeds]) == 0  # stairs ahead: refused, and the reason named
    (row,) = json.loads(Path("bench/calibration.json").read_text())["rows"]
    assert "floor" in row["refusal"]
