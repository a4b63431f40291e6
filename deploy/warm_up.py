"""Compiles every inner loop once by walking a moment in lockstep, so that no service compiles while it should work.

python -m deploy.warm_up
"""

import argparse
import sys

from deploy.lockstep_run import assemble
from shared.host import end_with
from shared.robot import load_profile
from shared.scenario import load_scenario

_WALK_NS = 4_000_000_000  # [ns] simulated: standing up, and the first steps on a map


def main() -> int:
    """Walk a moment."""
    parser = argparse.ArgumentParser(prog="python -m deploy.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    scenario = load_scenario("steps")
    assemble(scenario, 0, load_profile(scenario.robot)).run(_WALK_NS)
    return 0


if __name__ == "__main__":
    sys.exit(main())
