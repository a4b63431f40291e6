"""Walks of robots that differ from their profile."""

from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.shared.scenario.loading import load_scenario


def test_robot_with_usual_deviations_walks_over_steps() -> None:
    """Walk with horns, links, camera and battery that are off; before the legs' heights were learned, time ran out."""
    report = run_lockstep(load_scenario("steps+usual"), 1000)
    assert report.success, report.reason
    assert (report.falls, report.shutdowns) == (0, 0)
    assert report.missteps <= 2
    assert report.min_stability_margin_m > 0.02
    assert len(report.deviation["horns_deg"]) == 6
