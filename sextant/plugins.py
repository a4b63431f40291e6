"""Public API of plug-ins: algorithms of your own in place of Sextant's.

`sextant run steps --foothold package.module:function` replaces the score of footholds. `--planner` replaces the planner of
steps, `--registration` the registration of depth frames. `examples/plugin` is a package with one of each.
"""

from sextant.shared.plugins.foothold_rule import ElevationMap, FootholdRule
from sextant.shared.plugins.registration import Frame, NoPose, Pose, Registration
from sextant.shared.plugins.step_planner import NoStep, Step, StepPlanner, StepRequest
from sextant.shared.robot.kinematics import reaches
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import TerrainMap

__all__ = [
    "ElevationMap",
    "FootholdRule",
    "Frame",
    "NoPose",
    "NoStep",
    "Pose",
    "Registration",
    "RobotProfile",
    "Step",
    "StepPlanner",
    "StepRequest",
    "TerrainMap",
    "reaches",
]
