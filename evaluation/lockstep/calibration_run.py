"""Rehearsal of a calibration in lockstep: a simulated robot that differs from its profile measures itself."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.perception.calibration.calibrated_robot import CalibratedRobot, calibrate
from sextant.services.perception.calibration.survey import Survey
from sextant.services.simulator.real_robot import real_profile
from sextant.services.simulator.service import Simulator
from sextant.shared.geometry import Array, log_so3
from sextant.shared.robot.profile import Camera, Imu
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Scenario

_LIMIT_NS = 600_000_000_000  # simulated time
_LOOK_NS = 250_000_000  # simulated time between two reports of the progress


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsal:
    """Result of a rehearsal, and the truth, which the robot does not know."""

    robot: CalibratedRobot
    true_camera: Camera
    R_before_body: Array  # (3, 3) vectors {body} as the profile before shows those that the IMU measures
    up_before: Array  # (3,) what it shows as up on a level body, with the errors of the accelerometer
    before: Imu

    @property
    def errors(self) -> dict[str, float]:
        """Errors of the camera's numbers, with the names and units of `CalibratedRobot.camera_sigma`, and of a measured IMU."""
        found, true = self.robot.camera, self.true_camera
        turn = np.degrees(log_so3(true.T_body_camera[:3, :3].T @ found.T_body_camera[:3, :3]))
        place: Array = np.subtract(found.mount_xyz, true.mount_xyz)
        return {
            "pitch_down_deg": float(turn[0]),
            "yaw_deg": float(turn[1]),
            "roll_deg": float(turn[2]),
            **dict(zip("xyz", place.tolist(), strict=True)),
            "depth_error": found.depth_error - true.depth_error,
            "time_offset_s": found.time_offset_s - true.time_offset_s,
            **(self._errors_of_imu() if self.robot.imu_sigma else {}),
        }

    def _errors_of_imu(self) -> dict[str, float]:
        """Return the errors [deg] of roll and pitch, as gravity shows them, and of the heading of the mount."""
        R_after_before = self.robot.imu.R_body_imu @ self.before.R_body_imu.T
        x, y, z = R_after_before @ self.up_before
        yaw = log_so3(R_after_before @ self.R_before_body)[2]
        angles = (np.arctan2(-y, z), np.arctan2(x, z), yaw)
        return {f"imu_{name}": float(np.degrees(angle)) for name, angle in zip(self.robot.imu_sigma, angles, strict=True)}


def rehearse(scenario: Scenario, seed: int, tell: Callable[[str], None] = lambda _words: None) -> Rehearsal:
    """Calibrate the simulated robot of a scenario.

    Args:
        scenario: The robot, its deviations and the ground.
        seed: Random seed of the deviations and of the run.
        tell: Receives the progress.
    """
    profile = load_profile(scenario.robot)
    survey = Survey(profile)
    run = LockstepRun(scenario, seed, profile, around={"operator": lambda _operator: survey})
    told = ""
    while not survey.finished and run.now_ns() < _LIMIT_NS:
        run.run(run.now_ns() + _LOOK_NS)
        if survey.status() != told:
            told = survey.status()
            tell(told)
    real = load_profile(scenario.real_robot) if scenario.real_robot else profile
    camera = real_profile(real, scenario.deviation(seed)).camera
    simulator = run.service("simulator")
    assert isinstance(simulator, Simulator)
    return Rehearsal(calibrate(profile, survey), camera, simulator.R_shown_body, simulator.imu_of_level_body(), profile.imu)
