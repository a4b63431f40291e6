"""The operator of a fault run as a separate process, so that it can be killed.

python -m benchmarks.faults.scripted_console
"""

from dataclasses import dataclass

from benchmarks.faults.fault_run import SCENARIO
from sextant.evaluation.observers.operator import Operator
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime import process


@dataclass(frozen=True, slots=True)
class Settings:
    """No settings."""


def operator(profile: RobotProfile, settings: Settings) -> Operator:
    """Return an operator that walks the robot over level ground."""
    return Operator(profile, SCENARIO)


if __name__ == "__main__":
    process.main("operator", Settings, operator)
