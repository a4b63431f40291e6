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
    from sextant.services.mapper.elevation.elevation_grid import ElevationGrid as ElevationGrid
    from sextant.services.mapper.footholds.layers import FootholdLayers as FootholdLayers
    from sextant.services.perception.registration.projective_icp import Registration as Registration
    from sextant.services.planner.roadmap.roadmap import Roadmap as Roadmap
    from sextant.shared.robot.kinematics import leg_forward as leg_forward
    from sextant.shared.robot.kinematics import leg_inverse as leg_inverse
    from sextant.shared.robot.profile import RobotProfile as RobotProfile
    from sextant.shared.robot.profiles import load_profile as load_profile
    from sextant.shared.scenario.scenario import load_scenario as load_scenario

_HOMES = {
    "Client": "sextant.client",
    "ClientError": "sextant.client",
    "Status": "sextant.client",
    "run_lockstep": "sextant.evaluation.lockstep.lockstep_run",
    "ElevationGrid": "sextant.services.mapper.elevation.elevation_grid",
    "FootholdLayers": "sextant.services.mapper.footholds.layers",
    "Registration": "sextant.services.perception.registration.projective_icp",
    "Roadmap": "sextant.services.planner.roadmap.roadmap",
    "leg_forward": "sextant.shared.robot.kinematics",
    "leg_inverse": "sextant.shared.robot.kinematics",
    "load_profile": "sextant.shared.robot.profiles",
    "RobotProfile": "sextant.shared.robot.profile",
    "load_scenario": "sextant.shared.scenario.scenario",
}
__all__ = tuple(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted((*globals(), *_HOMES))
