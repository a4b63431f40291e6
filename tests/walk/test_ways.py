"""Starts on other ground than a level floor, and long ways."""

import pytest

from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.evaluation.trials.campaign_table import WAYS
from sextant.shared.scenario.loading import load_scenario

LENGTHS = {"far_goal": 14.0, "loop": 30.0}  # [m] of the way


@pytest.mark.rare
@pytest.mark.parametrize("name", WAYS)
def test_robot_reaches_the_goal(name: str) -> None:
    report = run_lockstep(load_scenario(name), 1001)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns, report.collisions) == (0, 0, 0)
    assert report.distance_m > LENGTHS.get(name, 1.5)
    assert report.pose_error_m.final < 0.06 + 0.01 * report.distance_m
