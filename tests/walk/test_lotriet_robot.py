"""The robot of the second thesis on its tests: RX-64 servos, the same actuator.

Its figures equal the published ones, or are better.
"""

from dataclasses import replace

import pytest

from sextant.evaluation.figures.thesis_figures import TESTS, Measured
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario

_LOOK_NS = 500_000_000


@pytest.mark.parametrize(
    ("name", "distance"),
    [
        ("lotriet_flat", 0.6),
        *(pytest.param(name, load_scenario(name).goal.distance, marks=pytest.mark.rare) for name in TESTS),
    ],
)
def test_rx64_robot_matches_or_exceeds_thesis_results(name: str, distance: float) -> None:
    scenario = load_scenario(name)
    scenario = replace(scenario, goal=replace(scenario.goal, distance=distance))
    run = LockstepRun(scenario, 1000, load_profile(scenario.robot))
    while not run.attendance.over():
        run.run(run.now_ns() + _LOOK_NS)
    report = run.attendance.judge(1.0, in_a_hurry=True)
    assert report.success, report.reason
    assert report.torque_nm.rms_worst_joint < load_profile(scenario.robot).servo.stall_torque / 3.0
    assert report.min_stability_margin_m >= 0.04  # no foot in the air counted as standing
    measured, published = Measured.of(run.attendance.scorer.trace), TESTS[name]
    assert abs(measured.height_error_m) < abs(published.height_error_m or 0.0)
    assert measured.off_command_deg < (published.tilt_deg or 0.0)
    if published.oscillation_m is not None:
        assert measured.oscillation_m < published.oscillation_m
        assert measured.stride_m == pytest.approx(published.stride_m, abs=0.01)
        assert measured.step_height_m == pytest.approx(published.step_height_m, abs=0.015)
