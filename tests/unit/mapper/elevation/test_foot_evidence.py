"""Evidence of the feet: touchdowns correct the map, standing feet refute it."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.foot_evidence import FootEvidence, feet_show_ground
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode
from tests.support.grid_scans import centres, scan_of
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.10
RADIUS = PROFILE.foot.radius
S = 1_000_000_000
BODY = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
POSE = BodyPose(0, BODY, np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
FRONT = np.arange(6) == 0


def assumed_at(height: float) -> ElevationGrid:
    """Return a map of level ground that no camera has seen."""
    grid = ElevationGrid(200, 0.01)
    grid.seed_plane(np.array([[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]]), np.array([height, 0.0, 0.0]))
    return grid


def grid_at(height: float) -> ElevationGrid:
    """Return a map of level ground."""
    grid = ElevationGrid(200, 0.01)
    points = np.column_stack([centres(grid), np.full(200 * 200, height)])
    for _ in range(3):
        grid.fuse(scan_of(points, np.full(len(points), 8), np.zeros(len(points)), (-0.9, 0.0, height + 0.5)))
    return grid


def legs(**changes: Any) -> ActuatorState:
    return actuator_state(PROFILE, **{"feet": PROFILE.rest_feet(HEIGHT), **changes})


def landed(leg: int, place: Array, stamp_ns: int) -> ActuatorState:
    """Return legs of which one has touched the ground at `place` (3,) [m] {world}, and stands there."""
    one = np.arange(6) == leg
    feet = PROFILE.rest_feet(HEIGHT)
    feet[leg] = place + np.array([0.0, 0.0, RADIUS - HEIGHT])
    touch = np.where(one[:, None], place, 0.0)
    return legs(feet=feet, touchdown_point=touch, touchdown_ns=np.where(one, stamp_ns, -1), touchdown_contact=one)


def evidence() -> FootEvidence:
    return FootEvidence(RADIUS, 0.01)


def test_touchdown_corrects_the_map_once() -> None:
    feet, grid, place = evidence(), grid_at(0.0), np.array([0.2, 0.1, 0.02])
    feet.apply_touchdowns(grid, POSE, landed(0, place, S))
    corrected = float(grid.heights(place[:2]))
    assert 0.005 < corrected <= 0.02
    feet.apply_touchdowns(grid, POSE, landed(0, place, S))
    assert float(grid.heights(place[:2])) == corrected, "the same touchdown is no new evidence"


def test_touchdown_far_from_the_map_is_ignored() -> None:
    grid = grid_at(0.0)
    evidence().apply_touchdowns(grid, POSE, landed(0, np.array([0.2, 0.1, 0.5]), S))
    assert float(grid.heights([0.2, 0.1])) == pytest.approx(0.0, abs=1e-6)


def land(feet: FootEvidence, grid: ElevationGrid, leg: int, places: Array) -> None:
    """Let a foot land on places (n, 3) [m] {world}, one after the other."""
    for k, place in enumerate(places):
        feet.apply_touchdowns(grid, POSE, landed(leg, place, (k + 1) * S))


def test_height_of_a_standing_foot_follows_the_attitude_of_its_pose() -> None:
    """Touchdowns use {odom}, whose tilt in {world} is averaged over steps."""
    feet, grid = FootEvidence(RADIUS, 0.01, leg_difference=0.02), grid_at(0.0)
    tilted = replace(POSE, T_world_body=from_xyz_rpy((0.0, 0.0, HEIGHT), [0.05, 0.0, 0.0]))
    for k, x in enumerate(np.linspace(-0.3, 0.3, 11)):
        feet.apply_touchdowns(grid, tilted, landed(2, np.array([x, -0.1, 0.0]), (k + 1) * S))
    assert feet.leg_heights.differences[2] == pytest.approx(-0.005, abs=0.001)


def places_at(heights: Array) -> Array:
    """Return places (n, 3) [m] {world} 6 cm apart."""
    return np.column_stack([np.linspace(-0.3, 0.3, len(heights)), np.full(len(heights), 0.1), heights])


def test_height_of_one_leg_is_learned_and_kept_out_of_the_map() -> None:
    feet, grid = FootEvidence(RADIUS, 0.01, leg_difference=0.02), grid_at(0.0)
    rng = np.random.default_rng(0)
    places = places_at(-0.008 + rng.normal(0.0, 0.002, 11))
    land(feet, grid, 2, places)
    np.testing.assert_allclose(feet.leg_heights.differences, [0.0, 0.0, -0.008, 0.0, 0.0, 0.0], atol=0.002)
    assert re.match(r"the right middle leg measures the ground [78] mm lower than the camera", feet.leg_heights.describe())
    assert abs(float(grid.heights(places[-1, :2]))) < 0.003
    without = FootEvidence(RADIUS, 0.01, leg_difference=0.0)
    land(without, grid_at(0.0), 2, places)
    assert not without.leg_heights.differences.any()
    assert without.leg_heights.describe() == ""


def test_assumed_ground_shows_no_difference_of_a_leg() -> None:
    """It is the plane of the feet, which the camera has not seen."""
    feet = FootEvidence(RADIUS, 0.01, leg_difference=0.02)
    land(feet, assumed_at(0.0), 2, places_at(np.full(11, -0.008)))
    assert not feet.leg_heights.differences.any()


def test_difference_of_a_leg_is_bounded_and_edges_do_not_count() -> None:
    feet = FootEvidence(RADIUS, 0.01, leg_difference=0.02)
    land(feet, grid_at(0.0), 2, places_at(np.linspace(-0.01, -0.06, 11)))
    assert feet.leg_heights.differences[2] == pytest.approx(-0.02)
    land(feet, grid_at(0.0), 4, places_at(np.full(11, -0.05)))
    assert feet.leg_heights.differences[4] == 0.0
    grid = grid_at(0.0)
    for x in np.arange(-0.35, 0.35, 0.01):
        grid.touch([x, 0.11, 0.04], 0.001, 0.005)
    land(feet, grid, 5, places_at(np.full(11, -0.008)))
    assert feet.leg_heights.differences[5] == 0.0


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


def test_feet_on_the_map_confirm_its_ground_for_a_while() -> None:
    feet, lifted = evidence(), legs(contact=np.zeros(6, dtype=bool))
    assert feet.confirmed_ground(grid_at(0.0), S, POSE, lifted) is None
    assert feet.confirmed_ground(grid_at(0.0), S, POSE, legs()) == pytest.approx(0.0, abs=1e-6)
    assert feet.confirmed_ground(grid_at(0.0), 2 * S, POSE, lifted) == pytest.approx(0.0, abs=1e-6)
    assert feet.confirmed_ground(grid_at(0.0), 4 * S, POSE, lifted) is None
    assert feet.confirmed_ground(grid_at(0.05), 4 * S, POSE, legs()) is None
