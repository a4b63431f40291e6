"""Evidence of the feet: touchdowns correct the map, standing feet refute it."""

from typing import Any

import numpy as np
import pytest

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.foot_evidence import FootEvidence, feet_show_ground
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.10
RADIUS = PROFILE.foot.radius
S = 1_000_000_000
BODY = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
POSE = BodyPose(0, BODY, np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
FRONT = np.arange(6) == 0


def grid_at(height: float) -> ElevationGrid:
    """Return a map of level ground."""
    grid = ElevationGrid(200, 0.01)
    grid.seed_plane(np.array([[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]]), np.array([height, 0.0, 0.0]))
    return grid


def legs(**changes: Any) -> ActuatorState:
    return actuator_state(PROFILE, feet=PROFILE.rest_feet(HEIGHT), **changes)


def evidence() -> FootEvidence:
    return FootEvidence(RADIUS, 0.01)


def touched(place: Array) -> ActuatorState:
    touch = np.zeros((6, 3))
    touch[0] = place
    return legs(touchdown_point=touch, touchdown_ns=np.where(FRONT, S, -1), touchdown_contact=FRONT)


def test_touchdown_corrects_the_map_once() -> None:
    feet, grid, place = evidence(), grid_at(0.0), np.array([0.2, 0.1, 0.02])
    feet.apply_touchdowns(grid, POSE, touched(place))
    corrected = float(grid.heights(place[:2]))
    assert 0.005 < corrected <= 0.02
    feet.apply_touchdowns(grid, POSE, touched(place))
    assert float(grid.heights(place[:2])) == corrected, "the same touchdown is no new evidence"


def test_touchdown_far_from_the_map_is_ignored() -> None:
    grid = grid_at(0.0)
    evidence().apply_touchdowns(grid, POSE, touched(np.array([0.2, 0.1, 0.5])))
    assert float(grid.heights([0.2, 0.1])) == pytest.approx(0.0, abs=1e-6)


def test_standing_feet_refute_the_map_after_a_while() -> None:
    feet, grid = evidence(), grid_at(-0.25)
    assert [feet.is_refuted(grid, k * S // 2, POSE, legs()) for k in range(4)] == [False, False, True, True]
    feet.forget()
    assert not feet.is_refuted(grid, 2 * S, POSE, legs())


@pytest.mark.parametrize(
    "changes", [{"swing": FRONT}, {"mode": Mode.OFF}, {"contact": np.arange(6) < 2}], ids=["swinging", "torque off", "carried"]
)
def test_legs_that_do_not_stand_refute_nothing(changes: dict[str, Any]) -> None:
    feet, grid = evidence(), grid_at(-0.25)
    assert not any(feet.is_refuted(grid, k * S, POSE, legs(**changes)) for k in range(4))


def test_agreeing_feet_in_between_start_the_wait_again() -> None:
    feet, wrong, right = evidence(), grid_at(-0.25), grid_at(0.0)
    assert not feet.is_refuted(wrong, 0, POSE, legs())
    assert not feet.is_refuted(right, S, POSE, legs())
    assert not feet.is_refuted(wrong, 2 * S, POSE, legs())


@pytest.mark.parametrize(
    ("changes", "shown"),
    [
        ({}, True),
        ({"contact": np.arange(6) < 4}, False),
        ({"contact": np.arange(6) < 4, "step": 3}, True),
        ({"mode": Mode.OFF}, False),
    ],
)
def test_ground_is_shown_by_enough_loaded_feet(changes: dict[str, Any], shown: bool) -> None:
    assert feet_show_ground(legs(**changes)) is shown
