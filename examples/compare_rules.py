"""Compare two foothold rules over the same seeds: Sextant's score, and one that accepts any known ground.

python examples/compare_rules.py [SCENARIO] [SEEDS] [OUT]
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import sextant
from sextant.plugins import ElevationMap


def anywhere(ground: ElevationMap):
    """Score every known cell as a foothold."""
    return np.where(np.isnan(ground.elevation), np.nan, 0.0)


def main(name: str = "steps", seeds: str = "5", out: str = "runs/compare_rules") -> None:
    """Walk with both rules, and print their success rates."""
    scenario = sextant.load_scenario(name)
    rules = {"Sextant's score": "", "anywhere": f"{Path(__file__).stem}:anywhere"}  # of a module, or an entry point
    for label, rule in rules.items():
        course = replace(scenario, plugins=sextant.Plugins(foothold=rule))
        found = sextant.run_trials(
            course, range(1000, 1000 + int(seeds)), jobs=1, out=Path(out) / (rule.partition(":")[2] or "score")
        )
        rate = found.success
        print(
            f"{label}: {rate.successes} of {rate.n} ({100 * rate.low:.0f} to {100 * rate.high:.0f} %), "
            f"{found.all_missteps} missteps in {found.all_steps} steps"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
