"""`sextant camera`: calibrate the camera, the legs and the IMU of a robot."""

import shlex
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, INTERRUPTED, SUCCESS, InputError, complain, say
from sextant.deploy.commands.order import client_name
from sextant.deploy.terminal.arguments import Group, option

if TYPE_CHECKING:
    from sextant.evaluation.lockstep.calibration_run import Rehearsal
    from sextant.services.perception.calibration.calibrated_robot import CalibratedRobot
    from sextant.shared.robot.profile import RobotProfile

camera = Group("camera", "Calibrate the depth camera, and legs and IMU with it.")


@camera.command("calibrate")
@options.robot
@options.connection
@option("--out", "TOML file to write (default: that of --robot, or my_NAME.toml for a profile)", "FILE")
@option("--rehearse", "scenario by name or TOML file, e.g. flat+harsh: calibrate its simulated robot instead", "SCENARIO")
@options.seed
def calibrate(robot: str, connection: options.Connection, out: str | None, rehearse: str | None, seed: int) -> int:
    """Measure the camera (mount, depth error, delay), the horns and the mount of an IMU: the body moves over a flat floor."""
    from sextant.services.perception.calibration.calibration_client import CalibrationClient
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.servo.servo_model import Feedback
    from sextant.shared.wire import topics

    path, base, _ = options.own_file(robot, out)
    profile = load_profile(robot)  # the one with which the services run
    if Feedback.POSITION not in profile.servo_model.feedback:
        raise InputError(
            f"a robot with measured joint angles expected, found {profile.name}: its servos report none, so their sag would "
            "count as an error of the camera; measure the mount with a ruler, and state it in the table [camera] of its profile"
        )
    if rehearse is not None:
        found = _rehearsed(rehearse, robot, seed)
        status = _finish(found.robot, profile, path, base)
        errors = ", ".join(f"{name} {error:.4g}" for name, error in found.errors.items())
        say(f"errors of this result, which only the simulator knows [deg, m, 1, s]: {errors}")
        return status
    from sextant.deploy.live.client_run import run_client

    endpoints = connection.endpoints()
    if endpoints.keys is not None and (refused := endpoints.keys.refusal([topics.MODE, topics.POSTURE])):
        raise InputError(refused)
    client = CalibrationClient(profile, client_name())
    if run_client(client, endpoints, say) is not None:
        complain("stopped by the operator; nothing was measured")
        return INTERRUPTED
    return _finish(client.result(), profile, path, base)


def _rehearsed(name: str, robot: str, seed: int) -> "Rehearsal":
    """Calibrate a simulated robot with the profile of --robot; the real one is that of the scenario, or the profile's base."""
    from dataclasses import replace

    from sextant.evaluation.lockstep.calibration_run import rehearse
    from sextant.shared.robot.profiles import base_profile
    from sextant.shared.scenario.loading import load_scenario

    scenario = load_scenario(name)
    return rehearse(replace(scenario, robot=robot, real_robot=scenario.real_robot or base_profile(robot)), seed, say)


def _finish(found: "CalibratedRobot", profile: "RobotProfile", path: Path, base: str) -> int:
    """Print a result, and write it to the robot's file unless it is refused."""
    for line in found.lines(profile):
        say(line)
    if found.refusals:
        complain(f"not written: {'; '.join(found.refusals)}")
        return FAILED
    found.write(path, base, date.today())
    say(f"{path}: written; restart the robot's services with --robot {shlex.quote(str(path))}")
    return SUCCESS
