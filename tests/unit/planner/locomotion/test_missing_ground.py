"""Missing ground: each place is remembered once and refused by all map layers."""

from dataclasses import replace
from typing import Any

import numpy as np

from sextant.services.planner.compiled_terrain import GOOD, NONE
from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.blind_walking import BlindStepPlanner
from sextant.services.planner.locomotion.missing_ground import MissingGround
from sextant.services.planner.terrain import Terrain, flat_terrain
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.wire.messages import HAZARDS, UNKNOWN, ActuatorState
from tests.unit.planner.test_service import PROFILE, Rig

FLAT = flat_terrain(0, np.zeros(2), 0.0)


def actuator_state_with(**changes: Any) -> ActuatorState:
    return replace(Rig().state, **changes)


def ground_not_found_at(at: tuple[float, float], stamp_ns: int = 5) -> ActuatorState:
    """Return a state in which the third leg found no ground at a place {odom}."""
    touch, stamps = np.zeros((6, 3)), np.full(6, -1, dtype=np.int64)
    touch[2], stamps[2] = (*at, -0.05), stamp_ns
    return actuator_state_with(touchdown_point=touch, touchdown_ns=stamps, touchdown_contact=np.zeros(6, dtype=bool))


def test_map_is_unchanged_without_missing_ground() -> None:
    holes = MissingGround()
    holes.update(actuator_state_with(), np.eye(4))
    assert holes.marked(FLAT) is FLAT


def test_missing_ground_is_refused_only_nearby() -> None:
    holes = MissingGround()
    holes.update(ground_not_found_at((0.2, 0.1)), from_xyz_rpy((0.1, 0.0, 0.0), np.zeros(3)))
    marked = holes.marked(FLAT)
    near, far = np.array([[0.3, 0.1], [0.32, 0.12]]), np.array([[0.3, 0.16], [0.2, 0.1]])
    assert (marked.suitability(near) == NONE).all()
    assert (marked.suitability(far) == GOOD).all()
    assert (replace(marked, layer="evaluation").suitability(near) == NONE).all()
    assert [HAZARDS[h] for h in marked.hazards(near)] == ["no ground by touch"] * 2
    assert (FLAT.suitability(near) == GOOD).all(), "the map itself is left alone"
    assert holes.marked(FLAT) is marked


def test_missing_ground_at_the_unseen_start_is_not_replaced_by_the_plane_of_the_feet() -> None:
    blind, seen = BlindStepPlanner(PROFILE, Settings()), FLAT.map
    x = seen.origin[0] + seen.resolution * np.arange(seen.elevation.shape[0])
    unseen = np.hypot(x[:, None], x) < 0.4
    elevation, score = (np.where(unseen, np.float32(np.nan), layer) for layer in (seen.elevation, seen.score))
    evaluation = np.where(unseen, np.int8(UNKNOWN), seen.evaluation)
    holes = MissingGround()
    holes.update(ground_not_found_at((0.2, 0.1)), np.eye(4))
    start = holes.marked(Terrain(replace(seen, elevation=elevation, score=score, evaluation=evaluation)))
    feet = PROFILE.rest_feet(0.1) + np.array([0.0, 0.0, 0.1])
    filled = blind.fill_unseen_start(start, feet, np.zeros(2), 0.0)
    assert filled is not None
    for terrain in (filled, replace(filled, layer="evaluation")):
        missing, other = terrain.suitability(np.array([[0.2, 0.1], [0.2, -0.1]]))
        assert other == GOOD
        assert not missing > NONE


def test_missing_ground_is_stored_once_and_carrying_ground_is_not() -> None:
    holes = MissingGround()
    for _ in range(5):
        holes.update(ground_not_found_at((0.2, 0.1)), np.eye(4))
    assert len(holes.places) == 1
    carries = replace(ground_not_found_at((0.4, 0.1), 9), touchdown_contact=np.ones(6, dtype=bool))
    holes.update(carries, np.eye(4))
    assert len(holes.places) == 1
    holes.update(ground_not_found_at((0.5, 0.1), 12), np.eye(4))
    np.testing.assert_allclose(holes.places, [[0.2, 0.1], [0.5, 0.1]])
    assert holes.marked(FLAT).suitability(np.array([[0.5, 0.1]]))[0] == NONE
