"""The bench of the passage planner uses the pillars of the scenarios."""

import pytest

from benchmarks.peers.passage import LENGTH, SHIFT, TWO, Y
from benchmarks.peers.passage_strips import GAP, thesis_blocks
from sextant.shared.scenario.scenario import Course, Gap, Pillars, load_scenario


@pytest.mark.parametrize("number", [1, 2, 3])
def test_benchmark_pillars_match_scenario(number: int) -> None:
    scenario = load_scenario(f"passage{number}")
    (course,) = (part for part in scenario.terrain if isinstance(part, Course))
    before, gap, _ = course.stretches
    assert isinstance(gap, Gap)
    assert gap.length == pytest.approx(GAP)
    edge = course.x + before.length  # type: ignore[union-attr]
    wanted = {
        (round(x - edge, 4), round(y, 4), part.length or part.size, part.size)
        for part in scenario.terrain
        if isinstance(part, Pillars)
        for x, y in part.xy
    }
    blocks = thesis_blocks(number, GAP, Y, LENGTH, SHIFT, TWO)
    assert {(round(b.x, 4), round(b.y, 4), b.length, b.width) for b in blocks} == wanted
