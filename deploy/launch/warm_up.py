"""Compile the inner loops of a simulated robot once, before a run begins.

python -m sextant.deploy.launch.warm_up
"""

import argparse
import sys
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime import compile_progress, warm_up_mark
from sextant.shared.runtime.operating_system import usable_cores
from sextant.shared.runtime.shutdown import end_with
from sextant.shared.runtime.workers import share_out
from sextant.shared.scenario.loading import load_scenario

_SCENARIOS = ("steps", "cobbles", "puddle")  # with blocks, with a height field, and in colour
_SERVICES = ("planner", "mapper", "perception", "simulator")  # from the one that compiles longest


def main() -> int:
    """Compile the services; in a process for each if much is to be compiled."""
    parser = argparse.ArgumentParser(prog="python -m sextant.deploy.launch.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="id of the parent process; this process ends with it")
    parser.add_argument("--progress", action="store_true", help="print how many functions are compiled")
    parser.add_argument("--least", action="store_true", help="only what every walk needs: no gap crossings and no colour")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    services = ("planner.locomotion", *_SERVICES[1:]) if arguments.least else _SERVICES
    scenarios = _SCENARIOS[:1] if arguments.least else _SCENARIOS
    jobs = 1 if has_compiled() or usable_cores() == 1 else len(services)
    tasks = [(service, scenarios, arguments.progress) for service in services]
    for _ in share_out(_compile_service, tasks, jobs, in_order=False):
        pass
    warm_up_mark.write()
    return 0


def has_compiled() -> bool:
    """Return whether Numba has cached the mapper's longest function; if it has, little is usually left to compile."""
    from sextant.services.mapper.elevation import fusion

    longest: Any = fusion._measure
    return any(Path(longest.stats.cache_path).glob("fusion._measure-*.nbi"))


def compile_functions(profile: RobotProfile, scenario: str) -> None:
    """Compile all services for a robot on a course."""
    for service in _SERVICES:
        _compile(service, profile, scenario)


def _compile(service: str, profile: RobotProfile, scenario: str) -> None:
    """Compile the functions of a service or a part of it, which is imported here, so that other processes need not."""
    settings = import_module(f"sextant.services.{service.partition('.')[0]}.config").Settings
    warmup = import_module(f"sextant.services.{service}.warmup")
    warmup.compile_functions(profile, settings(scenario) if service == "simulator" else settings())


def _compile_service(service: str, scenarios: tuple[str, ...], progress: bool) -> None:
    """Compile a service for some scenarios."""
    import_module(f"sextant.services.{service}.warmup")  # now all functions are known
    with compile_progress.reported() if progress else nullcontext():
        for scenario in scenarios:
            _compile(service, load_profile(load_scenario(scenario).robot), scenario)


if __name__ == "__main__":
    sys.exit(main())
