"""The operator of a fault's walk as a process of its own, so that it can be killed: python -m deploy.faults.console."""

from dataclasses import dataclass

from deploy.faults.watched import SCENARIO
from deploy.runs.operator import Operator
from shared import process
from shared.robot import RobotProfile


@dataclass(frozen=True, slots=True)
class Settings:
    """None."""


def operator(profile: RobotProfile, settings: Settings) -> Operator:
    """One who walks the robot over level ground."""
    return Operator(profile, SCENARIO)


if __name__ == "__main__":
    process.main("operator", Settings, operator)
