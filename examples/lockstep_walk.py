"""Walk a course in simulation, with all services in this process, and read the report.

python examples/lockstep_walk.py [SCENARIO] [SEED] [OUT]
"""

import sys
from dataclasses import replace
from pathlib import Path

import sextant

name, seed, out = (*sys.argv[1:], *("flat", "0", "")[len(sys.argv) - 1 :])
scenario = sextant.load_scenario(name)  # a name, or the path of a TOML file
scenario = replace(scenario, walk=replace(scenario.walk, body_height=0.12))
report = sextant.run_lockstep(scenario, seed=int(seed), out=Path(out) if out else None)

print(f"{report.scenario}, seed {report.seed}: {'success' if report.success else 'failed'}: {report.reason}")
print(f"{report.distance_m:.2f} m in {report.duration_s:.1f} s, {report.steps} steps, {report.missteps} missteps")
print(f"tilt {report.tilt_deg.p95:.2f} deg (95 %), highest torque {report.torque_nm.max:.2f} N m")
print(
    f"pose error at the end {1000 * report.pose_error_m.final:.1f} mm, map error {1000 * report.map_error_m.rmse:.1f} mm (rmse)"
)
