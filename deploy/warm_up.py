"""Compiles every inner loop of a simulated robot once, by its services' own rehearsals, so that it is done where a run begins.

python -m sextant.deploy.warm_up
"""

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sextant.deploy.workers import share_out
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.shutdown import end_with
from sextant.shared.scenario.scenario import load_scenario

_SCENARIOS = ("steps", "cobbles", "puddle")  # of blocks, of a height field, and in colour
_Rehearsal = Callable[[RobotProfile, str], None]  # each loads its service itself, for a process that rehearses others need not


def _perception(profile: RobotProfile, _: str) -> None:
    from sextant.services.perception.config import Settings
    from sextant.services.perception.warmup import rehearse

    rehearse(profile, Settings())


def _mapper(profile: RobotProfile, _: str) -> None:
    from sextant.services.mapper.config import Settings
    from sextant.services.mapper.warmup import rehearse

    rehearse(profile, Settings())


def _planner(profile: RobotProfile, _: str) -> None:
    from sextant.services.planner.config import Settings
    from sextant.services.planner.warmup import rehearse

    rehearse(profile, Settings())


def _simulator(profile: RobotProfile, scenario: str) -> None:
    from sextant.services.simulator.config import Settings
    from sextant.services.simulator.warmup import rehearse

    rehearse(profile, Settings(scenario))


_SHARES = ((_planner,), (_perception, _mapper, _simulator))  # either takes about as long as the other, where all is new


def main() -> int:
    """Rehearse for all of them; on two cores, where there are two and much is to be done."""
    parser = argparse.ArgumentParser(prog="python -m sextant.deploy.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    jobs = 1 if _compiled_before() else min(len(_SHARES), len(os.sched_getaffinity(0)))
    for _ in share_out(_rehearse_everywhere, [(share,) for share in _SHARES], jobs, in_order=False):
        pass
    return 0


def _compiled_before() -> bool:
    """Whether Numba keeps anything of the planner's search, which takes longest: what is left to do is little, mostly."""
    from sextant.services.planner.gap_crossing import roadmap_search

    compiled: Any = roadmap_search.grow
    return any(Path(compiled.stats.cache_path).glob("search.*.nbi"))


def rehearse(profile: RobotProfile, scenario: str) -> None:
    """Let all services that have something to compile rehearse, for a robot on a course."""
    for share in _SHARES:
        for rehearsal in share:
            rehearsal(profile, scenario)


def _rehearse_everywhere(share: tuple[_Rehearsal, ...]) -> None:
    for scenario in _SCENARIOS:
        for rehearsal in share:
            rehearsal(load_profile(load_scenario(scenario).robot), scenario)


if __name__ == "__main__":
    sys.exit(main())
