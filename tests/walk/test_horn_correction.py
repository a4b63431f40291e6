"""Horns that differ from the profile are corrected while the robot walks, if a parameter says so; those of the profile stay."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.mismatch import Mismatch

CORRECTS = {"actuator": {"correct_horns": True}}


@pytest.mark.slow
def test_horns_that_are_up_to_4_deg_off_are_corrected_towards_the_true_ones() -> None:
    scenario = replace(load_scenario("steps"), mismatch=Mismatch(horn_deg=4.0), params=CORRECTS)
    true = scenario.deviation(1000).horns_deg.ravel()
    report = run_lockstep(scenario, 1000)
    assert report.success
    corrected, estimate = np.array(report.horns.corrected_deg), np.array(report.horns.estimate_deg)
    assert np.linalg.norm(true - corrected) < 0.9 * np.linalg.norm(true)
    assert np.abs(corrected).max() <= 4.0 + 1e-9
    assert (np.abs(true - estimate) < 3.0 * np.array(report.horns.sigma_deg)).all()


@pytest.mark.slow
def test_horns_of_a_robot_that_matches_its_profile_stay() -> None:
    report = run_lockstep(replace(load_scenario("steps"), params=CORRECTS), 1000)
    assert report.success
    assert len(report.horns.estimate_deg) == 18
    assert report.horns.corrected_deg == (0.0,) * 18
