"""The camera with the clock of the robot's computer."""

import time

from sextant.services.perception.cameras.config import Settings
from sextant.services.perception.cameras.service import CameraService
from sextant.shared.robot.profile import RobotProfile


def live_camera(profile: RobotProfile, settings: Settings) -> CameraService:
    """Make the service of a real camera; a camera that is absent is reported, not raised."""
    return CameraService(profile, settings, None, time.monotonic_ns)
