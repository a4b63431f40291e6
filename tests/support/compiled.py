"""What is compiled, or loaded, when services rehearse, on one line; then what a walk after it adds, a line each.

python -m tests.support.compiled steps 5.0     a process of its own: what another test has called is compiled already
"""

import sys

from sextant.deploy.runs.lockstep_run import assemble
from sextant.deploy.warm_up import rehearse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import load_scenario

SERVICES = ("sextant.services.perception", "sextant.services.mapper", "sextant.services.planner", "sextant.services.simulator")


def signatures() -> set[str]:
    """Every signature of every compiled function of the services that rehearse."""
    modules = [module for name, module in sys.modules.items() if name.startswith(SERVICES)]
    functions = {f for module in modules for f in vars(module).values() if hasattr(f, "signatures")}
    return {f"{f.__module__}.{f.__name__}{signature}" for f in functions for signature in f.signatures}


def main() -> None:
    """Rehearse, walk, and tell what was new."""
    scenario, until_s = load_scenario(sys.argv[1]), float(sys.argv[2])
    profile = load_profile(scenario.robot)
    rehearse(profile, sys.argv[1])
    before = signatures()
    print(*sorted({signature.partition("(")[0] for signature in before}))
    assemble(scenario, 1000, profile).run(round(until_s * 1e9))
    print(*sorted(signatures() - before), sep="\n")


if __name__ == "__main__":
    main()
