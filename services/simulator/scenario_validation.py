"""Checks of a scenario that need its terrain or its robot, without simulating it."""

import numpy as np

from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.servo_bus.bus_faults import row_of
from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Scenario


def check_scenario(scenario: Scenario, seed: int, robot: str) -> None:
    """Check that the simulator can be built: the terrain of a seed, and the servos of the faults.

    `robot` is a profile by name, or the path of a TOML file.

    Raises:
        ConfigError: The terrain cannot be built, or a fault names a servo or a bit that the robot does not have.
    """
    build_terrain(scenario, np.random.default_rng([seed, 0]))
    profile = load_profile(robot)
    try:
        for fault in scenario.bus_faults:
            row_of(fault, profile.servo_models)
    except ValueError as error:
        raise ConfigError(f"scenario {scenario.name}", [str(error)]) from None
