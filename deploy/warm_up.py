"""Compiles every inner loop of a simulated robot once, by its services' own rehearsals, so that it is done where a run begins.

python -m deploy.warm_up
"""

import argparse
import sys

from deploy.lockstep_run import assemble
from services.mapper import rehearsal as mapper
from services.mapper.config import Settings as MapperSettings
from services.perception import rehearsal as perception
from services.perception.config import Settings as PerceptionSettings
from services.planner import rehearsal as planner
from services.planner.config import Settings as PlannerSettings
from shared.host import end_with
from shared.robot import RobotProfile, load_profile
from shared.scenario import load_scenario

_SCENARIOS = ("steps", "puddle")  # without and with colour
_LOOK_NS = 1_600_000_000  # [ns] simulated: standing up, and the first pictures


def main() -> int:
    """Rehearse, and look at both."""
    parser = argparse.ArgumentParser(prog="python -m deploy.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    for name in _SCENARIOS:
        scenario = load_scenario(name)
        profile = load_profile(scenario.robot)
        rehearse(profile)
        assemble(scenario, 0, profile).run(_LOOK_NS)  # the simulator's part
    return 0


def rehearse(profile: RobotProfile) -> None:
    """Let all services that have something to compile rehearse, for a robot."""
    perception.rehearse(profile, PerceptionSettings())
    mapper.rehearse(profile, MapperSettings())
    planner.rehearse(profile, PlannerSettings())


if __name__ == "__main__":
    sys.exit(main())
