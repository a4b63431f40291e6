"""Compile every inner loop of a simulated robot once, before a run begins.

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

_SCENARIOS = ("steps", "cobbles", "puddle")  # with blocks, with a height field, and in colour
_Rehearsal = Callable[[RobotProfile, str], None]  # each imports its service itself, so that other processes need not


def _perception(profile: RobotProfile, _: str) -> None:
    from sextant.services.perception.config import Settings
    from sextant.services.perception.warmup import compile_functions

    compile_functions(profile, Settings())


def _mapper(profile: RobotProfile, _: str) -> None:
    from sextant.services.mapper.config import Settings
    from sextant.services.mapper.warmup import compile_functions

    compile_functions(profile, Settings())


def _planner(profile: RobotProfile, _: str) -> None:
    from sextant.services.planner.config import Settings
    from sextant.services.planner.warmup import compile_functions

    compile_functions(profile, Settings())


def _simulator(profile: RobotProfile, scenario: str) -> None:
    from sextant.services.simulator.config import Settings
    from sextant.services.simulator.warmup import compile_functions

    compile_functions(profile, Settings(scenario))


_SHARES = ((_planner,), (_perception, _mapper, _simulator))  # both take about equally long when nothing is compiled


def main() -> int:
    """Compile for all scenarios; on two cores if much is to be compiled."""
    parser = argparse.ArgumentParser(prog="python -m sextant.deploy.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="id of the parent process; this process ends with it")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    jobs = 1 if _compiled_before() else min(len(_SHARES), len(os.sched_getaffinity(0)))
    for _ in share_out(_rehearse_everywhere, [(share,) for share in _SHARES], jobs, in_order=False):
        pass
    return 0


def _compiled_before() -> bool:
    """Return whether Numba has cached the planner's search, which compiles longest.

    If it has, little is usually left to compile.
    """
    from sextant.services.planner.gap_crossing import roadmap_search

    compiled: Any = roadmap_search.grow
    return any(Path(compiled.stats.cache_path).glob("search.*.nbi"))


def compile_functions(profile: RobotProfile, scenario: str) -> None:
    """Compile all services for a robot on a course."""
    for share in _SHARES:
        for rehearsal in share:
            rehearsal(profile, scenario)


def _rehearse_everywhere(share: tuple[_Rehearsal, ...]) -> None:
    for scenario in _SCENARIOS:
        for rehearsal in share:
            rehearsal(load_profile(load_scenario(scenario).robot), scenario)


if __name__ == "__main__":
    sys.exit(main())
