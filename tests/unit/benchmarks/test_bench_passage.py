"""The bench of the passage planner uses the pillars of the scenarios."""

import numpy as np
import pytest

from benchmarks.peers.passage import LENGTH, SHIFT, TWO, Y
from benchmarks.peers.passage_ompl import each_leg_reaches
from benchmarks.peers.passage_strips import GAP, thesis_blocks
from sextant.shared.robot.kinematics import leg_inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.course import Course, Gap
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.terrain import Pillars


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


def test_compiled_validity_test_of_ompl_agrees_with_inverse_kinematics() -> None:
    profile, rng = load_profile("phantomx_mk2"), np.random.default_rng(0)
    links, T, limits = profile.links, profile.T_coxa_body, profile.joint_limits
    found = []
    for _ in range(60):
        body = np.array([*rng.uniform(-0.1, 0.1, 2), 0.105])
        footholds = np.column_stack([rng.uniform(-0.3, 0.3, (15, 2)), np.zeros(15)])
        q = [leg_inverse((footholds - body) @ T[leg, :3, :3].T + T[leg, :3, 3], links) for leg in range(6)]
        expected = all(((q[leg] >= limits[leg, :, 0]) & (q[leg] <= limits[leg, :, 1])).all(axis=1).any() for leg in range(6))
        found.append(each_leg_reaches(body, footholds, T, (links.coxa, links.femur, links.tibia), limits))
        assert found[-1] == expected
    assert 0 < sum(found) < len(found)  # some bodies stand, some do not
