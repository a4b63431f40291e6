"""Which legs swing, and where they would like to land."""

from itertools import pairwise

import numpy as np
import pytest

from services.planner.gait import active_sextant, directions, nominal_touchdowns, swinging_tripod
from shared.geometry import Array, apply, from_xyz_rpy, inverse
from shared.robot import LEGS, load_profile

REST = load_profile("phantomx_mk2").rest_feet()
EVEN = np.arange(6) % 2 == 0
HEADINGS = np.radians(np.arange(0, 360, 15))


def unit(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("leg", range(6))
def test_a_leg_owns_the_direction_it_points_in(leg: int) -> None:
    towards = REST[leg, :2] / np.linalg.norm(REST[leg, :2])
    assert active_sextant(towards, REST) == leg


def test_the_active_leg_is_the_one_with_the_least_angle_to_the_motion() -> None:
    bearings = np.arctan2(REST[:, 1], REST[:, 0])
    for heading in np.linspace(-np.pi, np.pi, 73):
        apart = np.abs((bearings - heading + np.pi) % (2 * np.pi) - np.pi)
        assert apart[active_sextant(unit(heading), REST)] == pytest.approx(apart.min())


def test_sideways_the_middle_legs_lead() -> None:
    assert LEGS[active_sextant(np.array([0.0, 1.0]), REST)] == "left middle"
    assert LEGS[active_sextant(np.array([0.0, -1.0]), REST)] == "right middle"


@pytest.mark.parametrize("heading", HEADINGS)
def test_from_rest_the_tripod_of_the_active_leg_begins(heading: float) -> None:
    along = directions(unit(heading), 0.0, REST)
    swing = swinging_tripod(along, REST, REST)
    assert swing.sum() == 3
    assert swing[active_sextant(unit(heading), REST)]


@pytest.mark.parametrize(
    ("velocity", "yaw_rate"),
    [*(((np.cos(h), np.sin(h)), 0.0) for h in HEADINGS), ((0, 0), 1.0), ((0, 0), -1.0), ((0.1, 0.0), 0.3), ((0.0, -0.1), 0.5)],
)
def test_tripods_alternate_however_the_robot_moves(velocity: tuple[float, float], yaw_rate: float) -> None:
    """A walk on unobstructed ground: straight in any direction, on the spot, along an arc."""
    stride = 0.06
    along = directions(np.array(velocity), yaw_rate, REST)
    size = stride / np.linalg.norm(np.array(velocity) + yaw_rate * REST[:, :2] @ [[0, 1], [-1, 0]], axis=1).max()
    travel, turn = size * np.array(velocity), size * yaw_rate
    body, feet, sets = np.eye(4), REST.copy(), []
    for _ in range(8):
        swing = swinging_tripod(along, apply(inverse(body), feet), REST)
        body = body @ from_xyz_rpy((*travel, 0.0), (0.0, 0.0, turn))
        feet[swing, :2] = nominal_touchdowns(REST, body, travel)[swing]
        sets.append(swing)
    for before, after in pairwise(sets):
        np.testing.assert_array_equal(after, ~before)


@pytest.mark.parametrize("heading", HEADINGS[::3])
def test_the_tripod_that_is_behind_swings_whoever_is_active(heading: float) -> None:
    along = directions(unit(heading), 0.0, REST)
    for behind in (EVEN, ~EVEN):
        feet = REST - np.where(behind[:, None], 0.02, 0.0) * [np.cos(heading), np.sin(heading), 0.0]
        np.testing.assert_array_equal(swinging_tripod(along, feet, REST), behind)


def test_directions_are_those_of_a_rigid_body() -> None:
    velocity, yaw_rate = np.array([0.05, -0.02]), 0.4
    dt = 1e-6
    moved = from_xyz_rpy((*velocity * dt, 0.0), (0.0, 0.0, yaw_rate * dt))
    speeds = (apply(moved, REST) - REST)[:, :2] / dt
    along = directions(velocity, yaw_rate, REST)
    np.testing.assert_allclose(along, speeds / np.linalg.norm(speeds, axis=1).max(), atol=1e-5)
    assert np.linalg.norm(along, axis=1).max() == pytest.approx(1.0)


def test_no_motion_has_no_direction() -> None:
    np.testing.assert_array_equal(directions(np.zeros(2), 0.0, REST), 0.0)
    assert swinging_tripod(np.zeros((6, 2)), REST, REST).sum() == 3


def test_feet_land_so_that_the_body_passes_over_their_middle() -> None:
    """Half a stride ahead at touchdown, half a stride behind at lift-off: seen from the body, symmetric about rest."""
    travel = np.array([0.05, 0.02])
    T_end = from_xyz_rpy((0.3, -0.1, 0.1), (0.0, 0.0, 0.7))
    T_after = T_end @ from_xyz_rpy((*travel, 0.0), np.zeros(3))
    touchdown = nominal_touchdowns(REST, T_end, travel)
    feet = np.column_stack([touchdown, np.zeros(6)])
    first, last = (apply(inverse(T), feet)[:, :2] - REST[:, :2] for T in (T_end, T_after))
    np.testing.assert_allclose(first, -last, atol=1e-12)
    np.testing.assert_allclose(first, np.tile(travel / 2, (6, 1)), atol=1e-12)
