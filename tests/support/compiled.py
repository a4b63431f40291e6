"""Compiled and loaded functions: during the warm-up, then during a walk.

The first line of the output lists the functions of the warm-up. Each further line is one that the walk adds.

python -m tests.support.compiled steps 5.0     needs a separate process: other tests have compiled functions already
"""

import sys

from sextant.deploy.launch.warm_up import compile_functions
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario

WARMED_UP = (
    "sextant.services.perception",
    "sextant.services.mapper",
    "sextant.services.planner",
    "sextant.services.simulator",
    "sextant.shared.rendering",
)


def signatures() -> set[str]:
    """Return every signature of the compiled functions that warm up."""
    modules = [module for name, module in sys.modules.items() if name.startswith(WARMED_UP)]
    functions = {f for module in modules for f in vars(module).values() if hasattr(f, "signatures")}
    return {f"{f.__module__}.{f.__name__}{signature}" for f in functions for signature in f.signatures}


def main() -> None:
    """Warm up, walk, and print the new signatures."""
    scenario, until_s = load_scenario(sys.argv[1]), float(sys.argv[2])
    profile = load_profile(scenario.robot)
    compile_functions(profile, sys.argv[1])
    before = signatures()
    print(*sorted({signature.partition("(")[0] for signature in before}))
    LockstepRun(scenario, 1000, profile).run(round(until_s * 1e9))
    print(*sorted(signatures() - before), sep="\n")


if __name__ == "__main__":
    main()
