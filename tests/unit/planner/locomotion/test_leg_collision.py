"""Clearance of the legs' links during a step.

The step is free over level ground, lifts a foot over an obstacle, and is refused where no lift helps.
"""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.planner.compiled_terrain import FootholdRules, leg_numbers, rises_clear, stands_clear
from sextant.services.planner.locomotion.leg_collision import (
    LegCollision,
    StepMotion,
    find_clearances,
    links_at,
)
from sextant.services.planner.locomotion.swing_clearance import lowest_path
from sextant.services.planner.terrain import Terrain, flat_terrain, plane_terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import body_inverse, leg_points
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
HEIGHT = PROFILE.stance.body_height
HIGHEST = PROFILE.stance.max_lift
MARGIN, FOOT_MARGIN = 0.01, 0.003
TRIPOD = np.arange(6) % 2 == 0
MIDDLE = LEGS.index("right middle")
LEG = leg_numbers(PROFILE)[MIDDLE]
RULES = FootholdRules(0.06, PROFILE.foot.radius, 0.0, MARGIN, FOOT_MARGIN)
LOW = np.full(6, 0.025)
FLAT = flat_terrain(0, np.zeros(2), 0.0)
Maker = Callable[..., Terrain]


def step(travel: float = 0.1, yaw: float = 0.0, out: float = 0.0, even: bool = True) -> StepMotion:
    """Return a tripod's step over level ground.

    The right middle foot stands further out by `out` [m].
    """
    T_start, T_end = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3)), from_xyz_rpy((travel, 0.0, HEIGHT), (0.0, 0.0, yaw))
    rest = PROFILE.rest_feet(HEIGHT)
    rest[MIDDLE, 1] -= out
    swing = TRIPOD if even else ~TRIPOD
    half = np.array([travel / 2, 0.0, 0.0])
    start = apply(T_start, rest) - half
    return StepMotion(start, np.where(swing[:, None], apply(T_end, rest) + half, start), T_start, T_end, swing)


def required_clearance(way: StepMotion, ground: Terrain) -> Array | LegCollision:
    return find_clearances(way, LOW, MARGIN, FOOT_MARGIN, HIGHEST, PROFILE, ground)


def ridge(make_terrain: Maker, height: float, until: float = 0.08) -> Terrain:
    """Return a ridge inside the path of the right middle foot, under its tibia.

    The foot stands 4.5 cm further out, so its tibia leans over the ridge.
    """
    return make_terrain(lambda x, y: np.where((-y > 0.205) & (-y < 0.23) & (x > 0.02) & (x < until), height, 0.0))


@given(st.floats(-0.1, 0.1), st.floats(-0.15, 0.15), st.booleans(), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
@settings(max_examples=40)
def test_level_and_sloping_ground_need_no_extra_clearance(
    travel: float, yaw: float, even: bool, along: float, across: float
) -> None:
    way = step(travel, yaw, even=even)
    np.testing.assert_array_equal(required_clearance(way, FLAT), LOW)
    tilt = from_xyz_rpy((0.0, 0.0, 0.0), (np.arctan(across), -np.arctan(along), 0.0))
    slope = np.array([-tilt[0, 2], -tilt[1, 2]]) / tilt[2, 2]
    leaning = StepMotion(apply(tilt, way.start), apply(tilt, way.end), tilt @ way.T_start, tilt @ way.T_end, way.swing)
    np.testing.assert_array_equal(required_clearance(leaning, plane_terrain(0, np.zeros(2), 0.0, slope)), LOW)


def test_foot_is_lifted_higher_if_tibia_would_hit_ridge(make_terrain: Maker) -> None:
    lifts = []
    for height in (0.04, 0.07, 0.08):
        found = required_clearance(step(out=0.045), ridge(make_terrain, height))
        assert not isinstance(found, LegCollision)
        np.testing.assert_array_equal(np.delete(found, MIDDLE), np.delete(LOW, MIDDLE))
        lifts.append(found[MIDDLE])
    assert lifts[0] == LOW[MIDDLE]
    assert lifts[0] < lifts[1] < lifts[2] <= HIGHEST


def test_collision_without_sufficient_lift_names_leg_link_and_place(make_terrain: Maker) -> None:
    high = required_clearance(step(out=0.045), ridge(make_terrain, 0.10))
    where_it_lands = required_clearance(step(out=0.045), ridge(make_terrain, 0.07, until=0.3))
    for found in (high, where_it_lands):
        assert isinstance(found, LegCollision)
        assert found.leg == MIDDLE
        assert found.reason.startswith("right middle leg: its tibia would touch the ground at (0.")


def test_foothold_without_room_for_tibia_is_refused(make_terrain: Maker) -> None:
    way = step(out=0.045)
    feet = way.end[[MIDDLE, MIDDLE]] + [[0.0, 0.0, 0.0], [-0.13, 0.0, 0.0]]
    ground = make_terrain(lambda x, y: np.where((-y > 0.205) & (-y < 0.23) & (x > 0.1), 0.07, 0.0))
    elevation, _, grid, _ = ground.ground
    coxa = way.T_end @ PROFILE.T_body_coxa[MIDDLE]
    assert [stands_clear(elevation, grid, LEG, RULES, coxa, *foot) for foot in feet.tolist()] == [False, True]


def test_step_that_pushes_stance_leg_into_block_is_refused(make_terrain: Maker) -> None:
    """Check a standing foot whose femur moves with the body."""
    way = step(even=False)
    block = make_terrain(lambda x, y: np.where((x > 0.165) & (x < 0.2) & (y > 0.09) & (y < 0.12), 0.125, 0.0))
    found = required_clearance(way, block)
    assert isinstance(found, LegCollision)
    assert found.reason.startswith("left front leg: its femur would touch")
    assert not way.swing[found.leg]


def test_foot_of_folded_leg_needs_room_outwards_when_rising(make_terrain: Maker) -> None:
    body = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
    out = PROFILE.links.coxa + np.array([0.01, 0.03, 0.07])  # [m] distances of the feet from the right middle leg's coxa
    feet = apply(body @ PROFILE.T_body_coxa[MIDDLE], np.column_stack([out, np.zeros(3), np.zeros(3)]))
    feet[:, 2] = PROFILE.foot.radius
    bodies = np.stack([body @ from_xyz_rpy((x, 0.0, 0.0), np.zeros(3)) for x in (-0.1, 0.0, 0.1)])  # the body passes the feet
    coxas = bodies @ PROFILE.T_body_coxa[MIDDLE]
    edge = abs(feet[0, 1]) + 0.025  # of a block further out than the first two feet; the third foot stands on it

    def room(height: float) -> list[bool]:
        block = make_terrain(lambda x, y: np.where(-y > edge, height, 0.0))
        on = feet + [0.0, 0.0, 1.0] * np.where(-feet[:, 1:2] > edge, np.nan_to_num(height), 0.0)
        elevation, _, grid, _ = block.ground
        return [all(rises_clear(elevation, grid, LEG, RULES, coxa, *foot) for coxa in coxas) for foot in on.tolist()]

    assert room(0.0) == [True, True, True]
    assert room(0.05) == [False, False, True]
    assert room(np.nan) == [True, True, True], "unseen ground obstructs no leg"
    assert room(-0.02) == [True, True, True]


def test_unseen_ground_and_existing_contact_do_not_block_step(make_terrain: Maker) -> None:
    wall = ridge(make_terrain, 0.10)
    wall.map.elevation[wall.map.elevation > 0.0] = np.nan
    np.testing.assert_array_equal(required_clearance(step(out=0.045), wall), LOW)
    sunk = make_terrain(lambda x, y: np.full_like(x, 0.05))  # the map has the robot stand knee-deep in the ground
    assert not isinstance(required_clearance(step(), sunk), LegCollision)


def folded(make_terrain: Maker, block: float) -> tuple[StepMotion, Terrain]:
    """Return a step of the left front foot, 6.7 cm from its coxa, next to a block.

    The block, of a given height [m], begins 3.5 cm to the side of the foot.
    """
    way = step()
    near = np.array([0.135, 0.119, PROFILE.foot.radius])
    start, end = way.start.copy(), way.end.copy()
    start[0], end[0] = near, near + np.array([0.137, 0.019, 0.0])
    ground = make_terrain(lambda x, y: np.where((y > 0.155) & (y < 0.3) & (x > 0.14), block, 0.0))
    return StepMotion(start, end, way.T_start, way.T_end, way.swing), ground


def test_step_that_pushes_foot_of_folded_leg_into_block_is_refused(make_terrain: Maker) -> None:
    """Check a foot lifted next to a block, as on rubble with seed 46.

    It came too near its coxa, and the leg pushed the body away.
    """
    way, level = folded(make_terrain, 0.0)
    np.testing.assert_array_equal(required_clearance(way, level), LOW)
    found = required_clearance(*folded(make_terrain, 0.034))
    assert isinstance(found, LegCollision)
    assert found.leg == 0
    assert found.reason.startswith("left front leg: its foot would be pushed against the ground at (0.1")
    way, block = folded(make_terrain, 0.034)
    lifted = find_clearances(way, LOW, MARGIN, -np.inf, HIGHEST, PROFILE, block)
    np.testing.assert_array_equal(lifted, LOW)


def test_link_samples_match_forward_kinematics() -> None:
    rng = np.random.default_rng(3)
    q = body_inverse(PROFILE, PROFILE.rest_feet() + rng.uniform(-0.02, 0.02, (20, 6, 3)))
    _, hip, knee, foot = np.moveaxis(leg_points(PROFILE, q), -2, 0)
    samples = links_at(q, PROFILE.links) @ PROFILE.T_body_coxa[:, :3, :3].mT + PROFILE.T_body_coxa[:, None, :3, 3]
    np.testing.assert_allclose(samples[..., 2, :], knee, atol=1e-12)
    np.testing.assert_allclose(samples[..., 0, :], hip + 0.4 * (knee - hip), atol=1e-12)
    np.testing.assert_allclose(samples[..., -1, :], knee + 0.85 * (foot - knee), atol=1e-12)


@pytest.mark.parametrize("rise", [-0.04, 0.0, 0.04])
def test_lowest_path_connects_start_and_end(rise: float) -> None:
    start, end = np.zeros((1, 3)), np.array([[0.1, 0.0, rise]])
    shape = lowest_path(start, end, np.array([0.05]))
    np.testing.assert_array_equal(shape[[0, -1]], [start, end])
    assert shape[..., 2].max() == pytest.approx(max(rise, 0.0) + 0.8 * 0.05)
