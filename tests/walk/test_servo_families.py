"""Robots with servos of each family walk, with the same actuator on the bytes of their buses."""

from dataclasses import replace

import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.shared.scenario.scenario import load_scenario
from tests.support.families import FAMILIES, robot_with

_LOOK_NS = 500_000_000


@pytest.mark.parametrize(
    ("name", "terrain", "distance"),
    [
        ("STS3215", "flat", 0.4),
        ("XL430-W250", "flat", 0.4),
        *(pytest.param(name, "steps", load_scenario("steps").goal.distance, marks=pytest.mark.campaign) for name in FAMILIES),
    ],
)
def test_robot_walks_to_its_goal(name: str, terrain: str, distance: float) -> None:
    scenario = load_scenario(terrain)
    scenario = replace(scenario, goal=replace(scenario.goal, distance=distance))
    run = LockstepRun(scenario, 1000, robot_with(name))
    while not run.attendance.over():
        run.run(run.now_ns() + _LOOK_NS)
    report = run.attendance.judge(1.0, in_a_hurry=True)
    assert report.success, report.reason
    assert report.falls == 0
