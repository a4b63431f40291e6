"""Ground without footholds: the robot stops before it.

It reports the leg without a foothold, and the reason.
"""

from pathlib import Path

import pytest

from sextant.evaluation.report import as_table, check
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import Mode
from tests.support.walks import course, walk

HEAD = """
name = "refused"
time_limit_s = 60.0
[goal]
distance = 2.0
"""
COURSES = {
    "a wall across": (
        """
[[terrain]]
kind = "plane"
[[terrain]]
kind = "box"
xy = [0.95, 0.0]
size = [0.3, 3.0]
top = 0.3
""",
        0.8,
    ),
    "ground that ends": (
        """
[[terrain]]
kind = "box"
xy = [0.0, 0.0]
size = [1.6, 4.0]
top = 0.0
""",
        0.8,
    ),
}


@pytest.mark.rare
@pytest.mark.parametrize("what", COURSES)
def test_robot_stops_before_ground_without_footholds_and_names_leg(what: str, tmp_path: Path) -> None:
    terrain, edge = COURSES[what]
    found = walk(course(tmp_path, HEAD + terrain), 1001)
    report = found.report
    assert not report.success
    assert (report.falls, report.shutdowns) == (0, 0)
    assert report.min_stability_margin_m > 0
    assert 0.3 < report.distance_m < edge - 0.1
    state = found.states()[-1]
    assert state.mode is Mode.HOLD
    blocked = [status for status in found.statuses() if status.state == "blocked"]
    assert blocked
    for status in blocked:
        assert status.reason.startswith(f"{LEGS[status.blocked_leg]} leg: no foothold within")
        assert any(why in status.reason for why in ("not seen", "too steep or too near an edge"))
    assert "blocked" in report.reason
    assert blocked[-1].reason in report.reason
    assert not check(as_table(report))
    assert found.feet()[..., 0].max() < edge, "no foot touched it"
