"""The simulator lets its robot stand for a moment, so that all it calls is compiled before somebody asks its servos."""

from sextant.services.simulator.config import Settings
from sextant.services.simulator.service import Simulator
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.warmup import Rehearsal
from sextant.shared.servo import dynamixel as dxl

_FOR_S = 0.2  # [s] simulated, in which several pictures are taken


def rehearse(profile: RobotProfile, settings: Settings) -> None:
    """Compile all that the simulator calls, on the course that it is to simulate.

    Raises:
        ConfigError: That course cannot be simulated.
    """
    simulator = Simulator(profile, settings)
    Rehearsal(simulator).tick(_FOR_S)
    simulator.servos.read(0, dxl.PRESENT_POSITION.address, dxl.PRESENT_POSITION.size)
