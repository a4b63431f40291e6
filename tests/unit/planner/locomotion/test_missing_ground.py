"""Missing ground: each place is remembered once and refused by all map layers."""

from dataclasses import replace
from typing import Any

import numpy as np

from sextant.services.planner.locomotion.missing_ground import MissingGround
from sextant.services.planner.terrain import GOOD, NONE, flat_terrain
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.wire.messages import HAZARDS, ActuatorState
from tests.unit.planner.test_service import Rig

FLAT = flat_terrain(0, np.zeros(2), 0.0)


def heard(**changes: Any) -> ActuatorState:
    return replace(Rig().state, **changes)


def lost(at: tuple[float, float], stamp_ns: int = 5) -> ActuatorState:
    """Return a state in which the third leg found no ground at a place {odom}."""
    touch, stamps = np.zeros((6, 3)), np.full(6, -1, dtype=np.int64)
    touch[2], stamps[2] = (*at, -0.05), stamp_ns
    return heard(touch=touch, touch_ns=stamps, touch_carries=np.zeros(6, dtype=bool))


def test_without_findings_the_map_stays_what_it_is() -> None:
    holes = MissingGround()
    holes.update(heard(), np.eye(4))
    assert holes.marked(FLAT) is FLAT


def test_a_hole_is_refused_with_what_is_near_and_nothing_else() -> None:
    holes = MissingGround()
    holes.update(lost((0.2, 0.1)), from_xyz_rpy((0.1, 0.0, 0.0), np.zeros(3)))
    marked = holes.marked(FLAT)
    near, far = np.array([[0.3, 0.1], [0.32, 0.12]]), np.array([[0.3, 0.16], [0.2, 0.1]])
    assert (marked.suitability(near) == NONE).all()
    assert (marked.suitability(far) == GOOD).all()
    assert (replace(marked, layer="evaluation").suitability(near) == NONE).all()
    assert [HAZARDS[h] for h in marked.hazards(near)] == ["no ground by touch"] * 2
    assert (FLAT.suitability(near) == GOOD).all(), "the map itself is left alone"
    assert holes.marked(FLAT) is marked


def test_a_finding_counts_once_and_ground_that_was_found_is_no_hole() -> None:
    holes = MissingGround()
    for _ in range(5):
        holes.update(lost((0.2, 0.1)), np.eye(4))
    assert len(holes.places) == 1
    carries = replace(lost((0.4, 0.1), 9), touch_carries=np.ones(6, dtype=bool))
    holes.update(carries, np.eye(4))
    assert len(holes.places) == 1
    holes.update(lost((0.5, 0.1), 12), np.eye(4))
    np.testing.assert_allclose(holes.places, [[0.2, 0.1], [0.5, 0.1]])
    assert holes.marked(FLAT).suitability(np.array([[0.5, 0.1]]))[0] == NONE
