"""Plan one step on a map: three feet move forward, around a ditch that lies where they would land.

python examples/plan_step.py [PROFILE]
"""

import sys

import numpy as np

import sextant

profile = sextant.load_profile(sys.argv[1] if len(sys.argv) > 1 else "phantomx_mk2")
T_world_body = np.eye(4)
T_world_body[2, 3] = profile.stance.body_height
feet = profile.rest_feet() + T_world_body[:3, 3]

# 1. A map of level ground, with a ditch across where the left front foot would land.
resolution, origin = 0.01, np.array([-1.0, -1.0])
heights = np.zeros((200, 200), np.float32)
ditch = round((feet[0, 0] + 0.03 - origin[0]) / resolution)
heights[ditch : ditch + 4] = -0.1
variance = np.full_like(heights, 1e-6)
layers = sextant.FootholdLayers(heights.shape, resolution).update(heights, variance, np.zeros(2, np.int64))
known = np.zeros(heights.shape, bool)
ground = sextant.TerrainMap(0, resolution, origin, heights, variance, layers.score, known, layers.evaluation)

# 2. Plan the step of a tripod.
command = sextant.VelocityCommand(0, np.array([0.08, 0.0]), 0.0, profile.stance.body_height, 0.03)
tripod = np.array([True, False, True, False, True, False])
planner = sextant.StepPlanner(profile)
step = planner.plan(sextant.StepStart(T_world_body, feet, tripod, command), sextant.Terrain(ground))

# 3. Show it.
if not isinstance(step, sextant.PlannedStep):
    sys.exit(f"no step: {step.reason}")
print(f"the body moves {1000 * step.body_goal[0, 3]:.0f} mm in {step.duration:.2f} s; {step.moved} footholds are moved")
for k in np.flatnonzero(step.swing):
    print(f"{profile.legs[k].name:>12}: x {step.nominal[k, 0]:.3f} m wanted, {step.touchdown[k, 0]:.3f} m chosen")
