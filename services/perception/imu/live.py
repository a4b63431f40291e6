"""IMU service that uses the clock of the robot's computer."""

import time

from sextant.services.perception.imu.config import Settings
from sextant.services.perception.imu.service import ImuService
from sextant.shared.robot.profile import RobotProfile


def live_imu(profile: RobotProfile, settings: Settings) -> ImuService:
    """Create the service of a real IMU; a missing IMU is only reported."""
    return ImuService(profile, settings, None, time.monotonic_ns)
