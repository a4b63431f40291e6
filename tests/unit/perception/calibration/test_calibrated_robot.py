"""Results of calibrations that are good, and of those that must not be used."""

from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from sextant.services.perception.calibration.calibrated_robot import CalibrationError, calibrate
from sextant.services.perception.calibration.imu_mount import ImuTrack
from sextant.services.perception.calibration.kinematic_calibration import Recording
from sextant.services.perception.calibration.survey import Survey
from sextant.shared.geometry import Array, align_rigid, exp_so3, log_so3
from sextant.shared.robot.kinematics import feet_and_shanks
from sextant.shared.robot.profile import GRAVITY, LEGS, Imu
from sextant.shared.robot.profiles import load_profile
from tests.unit.perception.calibration.measurements import PROFILE, Truth, recording


@dataclass
class Done(Survey):
    """A survey that is over."""

    measured: Recording | None
    reached: int = 37
    refusal: str = ""
    reason: str = "all postures measured"

    track: ImuTrack | None = None

    def recording(self) -> Recording | None:
        return self.measured

    def imu(self) -> ImuTrack | None:
        return self.track


def gravity(measured: Recording, R_true_profile: Array) -> ImuTrack:
    """Return readings of an IMU whose mount is turned against the profile, in the postures of a recording on level floor."""
    stamps, force = [], []
    for number in np.unique(measured.posture):
        end_ns = measured.views[int(np.flatnonzero(measured.posture == number)[-1])].stamp_ns
        (q,) = measured.joints.at(np.array([end_ns]))
        R_floor_body = align_rigid(np.array(feet_and_shanks(PROFILE, q.reshape(6, 3))[0]), PROFILE.rest_feet())[:3, :3]
        stamps += range(end_ns - 300_000_000, end_ns, 20_000_000)
        force += 15 * [GRAVITY * R_true_profile.T @ R_floor_body[2]]
    return ImuTrack(np.array(stamps), np.zeros((len(stamps), 3)), np.array(force))


def test_calibrated_camera_and_horns_are_written(tmp_path: Path) -> None:
    camera = replace(PROFILE.camera, mount_xyz=(0.104, -0.006, 0.143), roll_deg=-1.5, pitch_down_deg=32.0, yaw_deg=2.0)
    measured, trims = recording(Truth(replace(PROFILE, camera=camera), trims_deg=3.0))
    found = calibrate(PROFILE, Done(measured))
    assert found.refusals == ()
    assert found.known_legs == list(range(6))
    robot = found.write(tmp_path / "mine.toml", "phantomx_mk2", date(2026, 7, 30))
    assert robot == load_profile(str(tmp_path / "mine.toml"))
    assert robot.camera.roll_deg == pytest.approx(-1.5, abs=0.3)
    assert robot.camera.pitch_down_deg == pytest.approx(32.0, abs=0.6)
    assert robot.camera.yaw_deg == pytest.approx(2.0, abs=0.4)
    assert robot.camera.mount_xyz == pytest.approx(camera.mount_xyz, abs=0.004)
    assert np.degrees(np.abs(robot.trims - trims)).max() < 2.5
    lines = list(found.lines(PROFILE))
    assert any(line.startswith("pitch_down_deg") and "(profile 30.00)" in line for line in lines)
    assert [line.split(":")[0] for line in lines[-6:]] == list(LEGS)


def test_mount_of_a_separate_imu_is_written(tmp_path: Path) -> None:
    robot = replace(PROFILE, imu=Imu("bno085", yaw_deg=90.0))
    measured, _ = recording(Truth(robot))
    found = calibrate(robot, Done(measured, track=gravity(measured, exp_so3(np.radians([2.0, -1.0, 3.0])))))
    written = found.write(tmp_path / "mine.toml", "phantomx_mk2_imu", date(2026, 7, 30)).imu
    expected = exp_so3(np.radians([2.0, -1.0, 3.0])) @ robot.imu.R_body_imu
    assert np.degrees(log_so3(expected.T @ written.R_body_imu)) == pytest.approx(0.0, abs=0.3)
    assert any(line.startswith("imu yaw_deg") and "(profile 90.00)" in line for line in found.lines(robot))


@pytest.mark.parametrize(("readings", "words"), [(False, "it sent no readings"), (True, "came to rest in too few postures")])
def test_mount_of_an_imu_that_is_not_measured_stays(tmp_path: Path, readings: bool, words: str) -> None:
    robot = replace(PROFILE, imu=Imu("bno085", roll_deg=5.0))
    measured, _ = recording(Truth(robot))
    track = gravity(measured, np.eye(3)) if readings else None
    found = calibrate(robot, Done(measured, track=track and replace(track, gyro=track.gyro + 1.0)))
    assert found.refusals == ()
    assert any(line.startswith("imu: its mount stays as it is: ") and words in line for line in found.lines(robot))
    found.write(tmp_path / "mine.toml", "phantomx_mk2_imu", date(2026, 7, 30))
    assert "[imu]" not in (tmp_path / "mine.toml").read_text()


def test_imu_of_a_camera_has_the_mount_of_the_camera() -> None:
    measured, _ = recording(Truth())
    found = calibrate(PROFILE, Done(measured, track=gravity(measured, np.eye(3))))
    assert not any(line.startswith("imu") for line in found.lines(PROFILE))


@pytest.mark.parametrize(
    ("truth", "reached", "words"),
    [
        (Truth(tilt_deg=3.0), 37, "the floor in view is tilted against the floor below the feet"),
        (Truth(uneven_m=0.008), 37, "the feet do not stand on one plane"),
        (Truth(share=0.05), 37, "the motion does not determine"),
        (Truth(), 12, "at least 20 postures expected, 12 reached; the last refusal: out of reach"),
    ],
)
def test_bad_measurement_is_refused_with_its_reason(truth: Truth, reached: int, words: str) -> None:
    found = calibrate(PROFILE, Done(recording(truth)[0], reached, "out of reach"))
    assert any(words in refusal for refusal in found.refusals), found.refusals


def test_useless_images_and_an_early_end_are_errors() -> None:
    measured, _ = recording(Truth(share=0.05))
    blind = replace(measured, views=[replace(view, inverse_depth=view.inverse_depth * np.nan) for view in measured.views])
    with pytest.raises(CalibrationError, match="sees enough floor in 0% of the images, at least 70% expected"):
        calibrate(PROFILE, Done(blind))
    hanging = replace(measured, joints=replace(measured.joints, contact=np.zeros_like(measured.joints.contact)))
    with pytest.raises(CalibrationError, match="at least 4 legs carry load in 0% of the images"):
        calibrate(PROFILE, Done(hanging))
    with pytest.raises(CalibrationError, match="ended early: the actuator is silent"):
        calibrate(PROFILE, Done(None, 3, reason="the actuator is silent"))


def test_leg_whose_horns_stay_is_named_with_the_reason() -> None:
    measured, _ = recording(Truth(trims_deg=1.0))
    contact = measured.joints.contact.copy()
    contact[:, 2] = False
    found = calibrate(PROFILE, Done(replace(measured, joints=replace(measured.joints, contact=contact))))
    assert 2 not in found.known_legs
    assert "right middle: its horns stay as they are: it stood on the floor too rarely; calibrate again" in list(
        found.lines(PROFILE)
    )
    crooked = replace(found, trims_deg=np.where(np.arange(6)[:, None] == 4, 25.0, found.trims_deg))
    assert any(
        "left rear" in line and "one is off by 25 deg, at most 20 deg expected" in line for line in crooked.lines(PROFILE)
    )
