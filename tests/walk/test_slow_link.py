"""A link that delivers too late: the walk reports the link, and not the ground."""

from dataclasses import replace

from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Link


def test_run_over_late_link_reports_link_as_reason() -> None:
    scenario = replace(load_scenario("flat"), goal=Goal(1.0, route=True), link=Link(delay_ms=700.0), time_limit_s=14.0)
    report = run_lockstep(scenario, 1000)
    assert not report.success
    assert "stuck" not in report.reason
    assert "the link between the machines is too slow: " in report.reason
    assert report.reason.endswith(report.too_slow)
    assert report.late_s > 2.0
    pose = report.input_ages_s["planner perception/pose"]
    assert pose.max > 0.7 > pose.limit
    assert pose.late > 0.9
