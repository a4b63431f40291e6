"""Result of a calibration: camera, horns and IMU of one robot, with their uncertainty, or why there is none."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np

from sextant.services.perception.calibration import imu_mount, kinematic_calibration
from sextant.services.perception.calibration.kinematic_calibration import Estimate, Recording
from sextant.services.perception.calibration.survey import Survey
from sextant.shared.errors import SextantError
from sextant.shared.geometry import Array, exp_so3, rpy_from_rotation
from sextant.shared.robot import profile_file
from sextant.shared.robot.profile import JOINTS, LEGS, MAX_TRIM_DEG, Calibration, Camera, Imu, RobotProfile

_MIN_POSTURES = 20
_MIN_BLOCKS = 20  # blocks of pixels that show the floor in a useful image
_MIN_SEEN, _MIN_STANDING = 0.7, 0.3  # shares of the images that show enough floor, and in which enough legs stand
_MAX_FLOOR = 0.004  # [1/m] standard deviation of the inverse depth of the floor
_MAX_SURPRISE = 3.0  # [sigma] by which the floor may contradict a flat one
_MAX_ANGLE_DEG, _MAX_PLACE_M, _MAX_SCALE, _MAX_DELAY_S = 0.7, 0.006, 0.015, 0.006  # standard deviations of the camera's numbers
_MAX_TRIM_SIGMA_DEG = 1.0  # of a leg's horns
_MAX_IMU_SIGMA_DEG = 0.7  # of each angle of the IMU


class CalibrationError(SextantError):
    """A survey that allows no calibration; the text says why."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedRobot:
    """Camera, horns and IMU of one robot."""

    camera: Camera
    camera_sigma: dict[str, float]  # standard deviations: [deg] of the angles, x, y, z [m], depth_error [1], time_offset_s [s]
    trims_deg: Array  # (6, 3) [deg] of all horns
    trims_sigma_deg: Array  # (6, 3) [deg]
    imu: Imu  # that of the profile, if the motion did not determine its mount
    imu_sigma: dict[str, float]  # standard deviations [deg] of the angles; empty without a measurement
    imu_words: str  # why the mount of a separate IMU is not measured, or an empty string
    estimate: Estimate
    refusals: tuple[str, ...]  # why the result must not be used; empty for a good one

    @property
    def known_legs(self) -> list[int]:
        """Return the legs whose horns are known well enough."""
        fits = np.abs(self.trims_deg) <= MAX_TRIM_DEG
        return [int(leg) for leg in np.flatnonzero((fits & (self.trims_sigma_deg < _MAX_TRIM_SIGMA_DEG)).all(axis=1))]

    def write(self, path: Path, base: str, day: date) -> RobotProfile:
        """Write camera, known horns and a measured IMU into the robot's own file.

        Args:
            path: The file; created if it does not exist.
            base: Profile that a new file extends.
            day: Date of the calibration.

        Returns:
            The robot as loaded from the new file.

        Raises:
            ConfigError: The file cannot be written, or not without damage to its content.
        """
        camera, lens = self.camera, self.camera.intrinsics
        tables: dict[str, profile_file.Values] = {
            "camera": {
                "mount_xyz": camera.mount_xyz,
                "roll_deg": camera.roll_deg,
                "pitch_down_deg": camera.pitch_down_deg,
                "yaw_deg": camera.yaw_deg,
                "time_offset_s": camera.time_offset_s,
                "depth_error": camera.depth_error,
                "distortion": camera.distortion,
            },
            "camera.intrinsics": {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy},
        }
        if self.imu_sigma:
            imu = self.imu
            tables["imu"] = {"roll_deg": imu.roll_deg, "pitch_deg": imu.pitch_deg, "yaw_deg": imu.yaw_deg}
        trims = self.trims_deg.round(2).tolist()
        legs = tuple(Calibration(LEGS[leg], day, (c, f, t)) for leg, (c, f, t) in enumerate(trims) if leg in self.known_legs)
        return profile_file.change(path, base, tables, legs)

    def lines(self, before: RobotProfile) -> Iterator[str]:
        """Yield the result as lines of text, with the values of the profile before; +- is a 95 % interval."""
        new, old, sigma = self.camera, before.camera, self.camera_sigma
        for name, value, was in (
            ("roll_deg", new.roll_deg, old.roll_deg),
            ("pitch_down_deg", new.pitch_down_deg, old.pitch_down_deg),
            ("yaw_deg", new.yaw_deg, old.yaw_deg),
        ):
            yield f"{name:15s} {value:8.2f} +- {2 * sigma[name]:.2f} deg    (profile {was:.2f})"
        for axis, value, was in zip("xyz", new.mount_xyz, old.mount_xyz, strict=True):
            yield f"{'mount ' + axis:15s} {1e3 * value:8.1f} +- {2e3 * sigma[axis]:.1f} mm     (profile {1e3 * was:.1f})"
        yield (
            f"{'depth_error':15s} {100 * new.depth_error:8.2f} +- {200 * sigma['depth_error']:.2f} %      "
            f"(profile {100 * old.depth_error:.2f})"
        )
        yield (
            f"{'time_offset_s':15s} {1e3 * new.time_offset_s:8.1f} +- {2e3 * sigma['time_offset_s']:.1f} ms     "
            f"(profile {1e3 * old.time_offset_s:.1f})"
        )
        if self.imu_words:
            yield f"imu: its mount stays as it is: {self.imu_words}"
        for name in self.imu_sigma:
            value, was = getattr(self.imu, name), getattr(before.imu, name)
            yield f"{'imu ' + name:15s} {value:8.2f} +- {2 * self.imu_sigma[name]:.2f} deg    (profile {was:.2f})"
        known = self.known_legs
        for leg, name in enumerate(LEGS):
            if leg not in known:
                yield f"{name}: its horns stay as they are: {self._unknown_reason(leg)}"
                continue
            pairs = zip(JOINTS, self.trims_deg[leg], self.trims_sigma_deg[leg], strict=True)
            yield f"{name}: horns off by " + ", ".join(f"{j} {trim:.1f} +- {2 * s:.1f}" for j, trim, s in pairs) + " deg"

    def _unknown_reason(self, leg: int) -> str:
        """Return why the horns of a leg are not written."""
        off = float(np.abs(self.trims_deg[leg]).max())
        if off > MAX_TRIM_DEG:
            return f"one is off by {off:.0f} deg, at most {MAX_TRIM_DEG:g} deg expected; mount it again, and calibrate again"
        return "it stood on the floor too rarely; calibrate again"


def calibrate(profile: RobotProfile, survey: Survey) -> CalibratedRobot:
    """Return the robot that a survey has measured.

    Args:
        profile: The profile with which it was measured.
        survey: The finished survey.

    Raises:
        CalibrationError: The survey ended before all postures, or too few of its images are useful.
    """
    recording = survey.recording()
    if recording is None:
        raise CalibrationError(f"the motion ended early: {survey.reason}")
    if problems := list(_view_problems(recording)):
        raise CalibrationError("; ".join(problems))
    estimate = kinematic_calibration.estimate(profile, recording)
    angles, camera = np.degrees(estimate.sigma("rotation")), _camera(profile.camera, estimate)
    sigma = {
        # Turns about the camera's x axis are pitch, about its y axis yaw, about its line of sight roll.
        "pitch_down_deg": float(angles[0]),
        "yaw_deg": float(angles[1]),
        "roll_deg": float(angles[2]),
        **dict(zip("xyz", estimate.sigma("place").tolist(), strict=True)),
        "depth_error": float(estimate.sigma("scale")[0]),
        "time_offset_s": float(estimate.sigma("delay")[0]),
    }
    imu, imu_sigma, imu_words = _imu(profile.imu, survey.imu(), estimate)
    legs = estimate.with_exact_links()  # a profile has one length for all legs: the horns make up for the differences
    return CalibratedRobot(
        camera=camera,
        camera_sigma=sigma,
        trims_deg=np.degrees(profile.trims + legs.of("trims").reshape(6, 3)),
        trims_sigma_deg=np.degrees(estimate.sigma("trims").reshape(6, 3)),
        imu=imu,
        imu_sigma=imu_sigma,
        imu_words=imu_words,
        estimate=estimate,
        refusals=tuple(_refusals(survey, estimate, sigma)),
    )


def _camera(camera: Camera, estimate: Estimate) -> Camera:
    R_mount_camera = camera.T_body_mount[:3, :3].T @ camera.T_body_camera[:3, :3]
    R_body_camera = camera.T_body_camera[:3, :3] @ exp_so3(estimate.of("rotation"))
    roll, pitch, yaw = np.degrees(rpy_from_rotation(R_body_camera @ R_mount_camera.T)).round(3).tolist()
    x, y, z = (np.array(camera.mount_xyz) + estimate.of("place")).round(5).tolist()
    lens, focal, (du, dv) = camera.intrinsics, 1.0 + float(estimate.of("focal")[0]), estimate.of("centre")
    depth_error = (1.0 + camera.depth_error) * (1.0 + float(estimate.of("scale")[0])) - 1.0
    return replace(
        camera,
        mount_xyz=(x, y, z),
        roll_deg=roll,
        pitch_down_deg=pitch,
        yaw_deg=yaw,
        time_offset_s=round(camera.time_offset_s + float(estimate.of("delay")[0]), 5),
        depth_error=round(depth_error, 5),
        distortion=round(camera.distortion + float(estimate.of("distortion")[0]), 5),
        intrinsics=replace(
            lens,
            fx=round(lens.fx * focal, 3),
            fy=round(lens.fy * focal, 3),
            cx=round(lens.cx + float(du), 3),
            cy=round(lens.cy + float(dv), 3),
        ),
    )


def _imu(imu: Imu, track: imu_mount.ImuTrack | None, estimate: Estimate) -> tuple[Imu, dict[str, float], str]:
    """Return the IMU with its measured mount, the standard deviations [deg] of its angles, and why there is no measurement.

    The mount of a camera's IMU is that of the camera.
    """
    if not imu.is_separate:
        return imu, {}, ""
    if track is None:
        return imu, {}, "it sent no readings; see the status of the process `imu`"
    mount = imu_mount.estimate(track, estimate.poses)
    if mount is None:
        return imu, {}, "the body came to rest in too few postures, or the IMU was silent; calibrate again"
    sigma = np.degrees(mount.sigma)
    if sigma.max() > _MAX_IMU_SIGMA_DEG:
        return imu, {}, f"it is known to +- {2 * sigma.max():.1f} deg, +- {2 * _MAX_IMU_SIGMA_DEG} expected; calibrate again"
    R_body_imu = exp_so3(mount.turn) @ imu.R_body_imu
    roll, pitch, yaw = np.degrees(rpy_from_rotation(R_body_imu)).round(3).tolist()
    # The turns are about the axes of the body: those of the sensor differ from them if it is mounted turned.
    of_sensor = np.sqrt(np.diag(R_body_imu.T @ np.diag(sigma**2) @ R_body_imu)).tolist()
    return (
        replace(imu, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw),
        dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), of_sensor, strict=True)),
        "",
    )


def _view_problems(recording: Recording) -> Iterator[str]:
    """Yield why the images of a recording are of no use."""
    blocks = np.array([np.isfinite(view.inverse_depth).sum() for view in recording.views])
    share = float((blocks >= _MIN_BLOCKS).mean())
    if share < _MIN_SEEN:
        yield (
            f"the camera sees enough floor in {share:.0%} of the images, at least {_MIN_SEEN:.0%} expected: "
            "clear the floor ahead of the robot for 1.5 m"
        )
    standing = kinematic_calibration.standing_share(recording)
    if standing < _MIN_STANDING:
        yield (
            f"at least {kinematic_calibration.MIN_LEGS} legs carry load in {standing:.0%} of the images, "
            f"at least {_MIN_STANDING:.0%} expected: place the robot on a flat, hard floor"
        )


def _refusals(survey: Survey, estimate: Estimate, sigma: dict[str, float]) -> Iterator[str]:
    """Yield what is wrong with a measurement."""
    if survey.reached < _MIN_POSTURES:
        why = survey.refusal or survey.reason
        yield f"at least {_MIN_POSTURES} postures expected, {survey.reached} reached; the last refusal: {why}"
    slope, surprise = np.degrees(estimate.of("slope")), estimate.surprise("slope")
    if surprise.max() > _MAX_SURPRISE:
        yield (
            f"the floor in view is tilted against the floor below the feet, by about {np.abs(slope).max():.1f} deg or more: "
            "place the robot on a flat floor"
        )
    heights, surprise = 1e3 * estimate.of("feet")[2::3], estimate.surprise("feet")[2::3]
    if surprise.max() > _MAX_SURPRISE:
        yield (
            f"the feet do not stand on one plane, their heights differ by {np.ptp(heights):.1f} mm or more: "
            "place the robot on a flat, hard floor"
        )
    if estimate.sigma_w > _MAX_FLOOR:
        yield (
            f"the floor in view is not flat: its inverse depth varies by {estimate.sigma_w:.4f} 1/m, at most {_MAX_FLOOR} "
            "expected: clear the floor ahead of the robot"
        )
    limits = {"roll_deg": _MAX_ANGLE_DEG, "pitch_down_deg": _MAX_ANGLE_DEG, "yaw_deg": _MAX_ANGLE_DEG}
    limits |= {"x": _MAX_PLACE_M, "y": _MAX_PLACE_M, "z": _MAX_PLACE_M}
    limits |= {"depth_error": _MAX_SCALE, "time_offset_s": _MAX_DELAY_S}
    loose = [
        f"{name} (+- {2 * sigma[name]:.2g}, at most {2 * limit:.2g} expected)"
        for name, limit in limits.items()
        if sigma[name] > limit
    ]
    if loose:
        yield f"the motion does not determine {', '.join(loose)}"
