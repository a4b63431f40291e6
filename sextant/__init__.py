"""Public API of Sextant, software for a six-legged robot that walks on rough terrain.

    >>> import sextant
    >>> sextant.load_profile("phantomx_mk2").name
    'phantomx_mk2'

Each name is imported on first use. A program therefore needs only the dependencies of the names that it uses.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sextant.client import Client as Client
    from sextant.client import ClientError as ClientError
    from sextant.client import Status as Status
    from sextant.evaluation.lockstep.lockstep_run import run_lockstep as run_lockstep
    from sextant.evaluation.map_plan.map_walk import plan_on_map as plan_on_map
    from sextant.evaluation.replay.tum_recording import record_tum as record_tum
    from sextant.evaluation.trials.trials import run_trials as run_trials
    from sextant.services.mapper.elevation.elevation_grid import ElevationGrid as ElevationGrid
    from sextant.services.mapper.elevation.validated_scan import ValidatedScan as ValidatedScan
    from sextant.services.mapper.footholds.layers import FootholdLayers as FootholdLayers
    from sextant.services.perception.reduction.scan_reduction import reduce_scan as reduce_scan
    from sextant.services.perception.registration.projective_icp import Registration as Registration
    from sextant.services.perception.tum import read_recording as read_recording
    from sextant.services.planner.locomotion.step_planner import PlannedStep as PlannedStep
    from sextant.services.planner.locomotion.step_planner import StepPlanner as StepPlanner
    from sextant.services.planner.locomotion.step_planner import StepStart as StepStart
    from sextant.services.planner.roadmap.roadmap import Roadmap as Roadmap
    from sextant.services.planner.terrain import Terrain as Terrain
    from sextant.shared.plugins.loading import Plugins as Plugins
    from sextant.shared.recording.grid_map import read_grid_map as read_grid_map
    from sextant.shared.robot.kinematics import leg_forward as leg_forward
    from sextant.shared.robot.kinematics import leg_inverse as leg_inverse
    from sextant.shared.robot.profile import RobotProfile as RobotProfile
    from sextant.shared.robot.profiles import load_profile as load_profile
    from sextant.shared.scenario.loading import load_scenario as load_scenario
    from sextant.shared.wire.access import AccessError as AccessError
    from sextant.shared.wire.messages import TerrainMap as TerrainMap
    from sextant.shared.wire.messages import VelocityCommand as VelocityCommand

_HOMES = {
    "AccessError": "sextant.shared.wire.access",
    "Client": "sextant.client",
    "ClientError": "sextant.client",
    "Status": "sextant.client",
    "run_lockstep": "sextant.evaluation.lockstep.lockstep_run",
    "plan_on_map": "sextant.evaluation.map_plan.map_walk",
    "record_tum": "sextant.evaluation.replay.tum_recording",
    "run_trials": "sextant.evaluation.trials.trials",
    "ElevationGrid": "sextant.services.mapper.elevation.elevation_grid",
    "ValidatedScan": "sextant.services.mapper.elevation.validated_scan",
    "FootholdLayers": "sextant.services.mapper.footholds.layers",
    "reduce_scan": "sextant.services.perception.reduction.scan_reduction",
    "Registration": "sextant.services.perception.registration.projective_icp",
    "read_recording": "sextant.services.perception.tum",
    "PlannedStep": "sextant.services.planner.locomotion.step_planner",
    "StepPlanner": "sextant.services.planner.locomotion.step_planner",
    "StepStart": "sextant.services.planner.locomotion.step_planner",
    "Roadmap": "sextant.services.planner.roadmap.roadmap",
    "Terrain": "sextant.services.planner.terrain",
    "Plugins": "sextant.shared.plugins.loading",
    "read_grid_map": "sextant.shared.recording.grid_map",
    "leg_forward": "sextant.shared.robot.kinematics",
    "leg_inverse": "sextant.shared.robot.kinematics",
    "RobotProfile": "sextant.shared.robot.profile",
    "load_profile": "sextant.shared.robot.profiles",
    "load_scenario": "sextant.shared.scenario.loading",
    "TerrainMap": "sextant.shared.wire.messages",
    "VelocityCommand": "sextant.shared.wire.messages",
}
__all__ = tuple(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted((*globals(), *_HOMES))
