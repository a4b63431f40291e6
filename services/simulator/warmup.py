"""Warm-up of the simulator: compile its functions before the servo bus opens."""

from sextant.services.simulator.config import Settings
from sextant.services.simulator.service import Simulator
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.warmup import WarmupRunner
from sextant.shared.servo import dynamixel as dxl

_FOR_S = 0.2  # [s] simulated time, long enough for several depth frames


def compile_functions(profile: RobotProfile, settings: Settings) -> None:
    """Compile the functions of the simulator by a short run with a standing robot.

    Raises:
        ConfigError: The scenario cannot be simulated.
    """
    simulator = Simulator(profile, settings)
    WarmupRunner(simulator).tick(_FOR_S)
    simulator.servos.read(0, dxl.PRESENT_POSITION.address, dxl.PRESENT_POSITION.size)
