"""Compiles every inner loop once by walking a moment in lockstep, so that no service compiles while it should work.

python -m deploy.warm_up
"""

import argparse
import sys

import numpy as np

from deploy.lockstep_run import assemble
from deploy.passage_warm_up import plan_passage
from services.mapper.cloud import Strip
from services.mapper.elevation import ElevationGrid
from services.mapper.survey import Survey
from shared.geometry import from_xyz_rpy
from shared.host import end_with
from shared.robot import RobotProfile, load_profile
from shared.scenario import load_scenario

_WALK_NS = 4_000_000_000  # [ns] simulated: standing up, and the first steps on a map
_LOOK_NS = 1_600_000_000  # [ns] simulated: standing up, and the first map in colour


def main() -> int:
    """Walk a moment."""
    parser = argparse.ArgumentParser(prog="python -m deploy.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    scenario = load_scenario("steps")
    profile = load_profile(scenario.robot)
    assemble(scenario, 0, profile).run(_WALK_NS)
    _survey(profile)
    plan_passage(scenario.robot)
    colored = load_scenario("puddle")
    assemble(colored, 0, load_profile(colored.robot)).run(_LOOK_NS)
    return 0


def _survey(profile: RobotProfile) -> None:
    """Survey a passage, which a walk does only when it is asked to."""
    known = ElevationGrid().snapshot()
    survey = Survey(profile, Strip((0.0, 0.0), 0.0, 1.0, 0.5), known, reach=1.5)
    i, j = np.meshgrid(np.arange(0.505, 0.7, 0.01), np.arange(-0.195, 0.2, 0.01), indexing="ij")
    survey.add(np.column_stack([i.ravel(), j.ravel(), np.zeros(i.size)]), np.full(i.size, 8, dtype=np.uint8))
    height, grid = profile.stance.body_height, survey.grid(known)
    survey.evaluation(grid, height, 0.0)
    survey.outlook(grid, from_xyz_rpy((0.0, 0.0, height), (0.0, 0.0, 0.0)), profile.rest_feet(height))


if __name__ == "__main__":
    sys.exit(main())
