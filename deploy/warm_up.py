"""Compiles every inner loop of a simulated robot once, by its services' own rehearsals, so that it is done where a run begins.

python -m deploy.warm_up
"""

import argparse
import sys

from services.mapper import rehearsal as mapper
from services.mapper.config import Settings as MapperSettings
from services.perception import rehearsal as perception
from services.perception.config import Settings as PerceptionSettings
from services.planner import rehearsal as planner
from services.planner.config import Settings as PlannerSettings
from services.simulator import rehearsal as simulator
from services.simulator.config import Settings as SimulatorSettings
from shared.ending import end_with
from shared.profiles import load_profile
from shared.robot import RobotProfile
from shared.scenario import load_scenario

_SCENARIOS = ("steps", "cobbles", "puddle")  # of blocks, of a height field, and in colour


def main() -> int:
    """Rehearse for all of them."""
    parser = argparse.ArgumentParser(prog="python -m deploy.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    for name in _SCENARIOS:
        rehearse(load_profile(load_scenario(name).robot), name)
    return 0


def rehearse(profile: RobotProfile, scenario: str) -> None:
    """Let all services that have something to compile rehearse, for a robot on a course."""
    perception.rehearse(profile, PerceptionSettings())
    mapper.rehearse(profile, MapperSettings())
    planner.rehearse(profile, PlannerSettings())
    simulator.rehearse(profile, SimulatorSettings(scenario))


if __name__ == "__main__":
    sys.exit(main())
