"""Ripple and wave gaits in lockstep: slower, with more legs in stance."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal

_TWO_STEPS = """
name = "two-steps"
time_limit_s = 60.0
[goal]
distance = 0.8
[[terrain]]
kind = "plane"
[[terrain]]
kind = "stairs"
xy = [0.5, 0.0]
riser = 0.045
tread = 0.2
count = 2
width = 2.4
landing = 2.0
"""


def test_ripple_gait_climbs_two_stairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = tmp_path / "two-steps.toml"
    course.write_text(_TWO_STEPS, encoding="utf-8")
    words = ["run", str(course), "--lockstep", "--seed", "1001", "--gait", "ripple", "--out", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    table = json.loads(capsys.readouterr().out)
    assert (table["gait"], table["success"], table["falls"], table["shutdowns"]) == ("ripple", True, 0, 0)
    assert table["min_stability_margin_m"] >= 0.03
    assert table["torque_nm"]["rms_worst_joint"] < 0.5


def test_wave_gait_is_slower_and_more_stable_than_tripod() -> None:
    scenario = replace(load_scenario("flat"), goal=Goal(0.15))
    tripod = run_lockstep(scenario, 1000)
    wave = run_lockstep(replace(scenario, walk=replace(scenario.walk, gait="wave")), 1000)
    assert tripod.success, tripod.reason
    assert wave.success, wave.reason
    assert wave.speed_mps < tripod.speed_mps
    assert wave.min_stability_margin_m > tripod.min_stability_margin_m
