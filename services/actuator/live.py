"""The actuator with the clocks of the robot's computer."""

from sextant.services.actuator.config import Settings
from sextant.services.actuator.service import Actuator
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.clock import SuspendedTime, now_ns


def live_actuator(profile: RobotProfile, settings: Settings) -> Actuator:
    """Return the actuator of a real robot or of a live simulation.

    Raises:
        BusSetupError: Servos are missing or wrong; the message names all of them.
        BusDisconnectedError: The port cannot be opened.
    """
    return Actuator(profile, settings, None, now_ns, suspended_ns=SuspendedTime())
