"""Camera service that uses the clock of the robot's computer."""

import time

from sextant.services.perception.cameras.config import Settings
from sextant.services.perception.cameras.service import CameraService
from sextant.shared.robot.profile import RobotProfile


def live_camera(profile: RobotProfile, settings: Settings) -> CameraService:
    """Create the service of a real camera; a missing camera is only reported."""
    return CameraService(profile, settings, None, time.monotonic_ns)
