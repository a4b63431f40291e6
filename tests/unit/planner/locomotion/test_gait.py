"""Gaits: which legs swing, and their nominal touchdowns."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.planner.locomotion.gait import (
    GAITS,
    Gait,
    active_sextant,
    directions,
    extrapolate_pose,
    nominal_touchdowns,
    swing_order,
)
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile

REST = load_profile("phantomx_mk2").rest_feet()
EVEN = np.arange(6) % 2 == 0
TRIPOD = GAITS["tripod"]
MOTIONS = [
    *(((np.cos(h), np.sin(h)), 0.0) for h in np.radians(np.arange(0, 360, 15))),
    ((0, 0), 1.0),
    ((0, 0), -1.0),
    ((0.1, 0.0), 0.3),
    ((0.0, -0.1), 0.5),
]
HEADINGS = np.radians(np.arange(0, 360, 15))


def swinging(gait: Gait, along: Array, feet: Array) -> NDArray[np.bool_]:
    return swing_order(gait, along, feet, REST)[0]


def unit(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("leg", range(6))
def test_leg_is_active_in_its_own_direction(leg: int) -> None:
    towards = REST[leg, :2] / np.linalg.norm(REST[leg, :2])
    assert active_sextant(towards, REST) == leg


def test_active_leg_has_least_angle_to_motion() -> None:
    bearings = np.arctan2(REST[:, 1], REST[:, 0])
    for heading in np.linspace(-np.pi, np.pi, 73):
        apart = np.abs((bearings - heading + np.pi) % (2 * np.pi) - np.pi)
        assert apart[active_sextant(unit(heading), REST)] == pytest.approx(apart.min())


def test_middle_legs_are_active_in_sideways_motion() -> None:
    assert LEGS[active_sextant(np.array([0.0, 1.0]), REST)] == "left middle"
    assert LEGS[active_sextant(np.array([0.0, -1.0]), REST)] == "right middle"


@pytest.mark.parametrize("heading", HEADINGS)
def test_first_tripod_from_rest_contains_active_leg(heading: float) -> None:
    along = directions(unit(heading), 0.0, REST)
    swing = swinging(TRIPOD, along, REST)
    assert swing.sum() == 3
    assert swing[active_sextant(unit(heading), REST)]


def simulate_walk(gait: Gait, velocity: tuple[float, float], yaw_rate: float, steps: int) -> list[NDArray[np.bool_]]:
    """Return the swing legs of each step of a walk on unobstructed ground.

    The walk goes straight, turns on the spot or follows an arc.
    """
    stride = 0.06 / gait.stances
    along = directions(np.array(velocity), yaw_rate, REST)
    size = stride / np.linalg.norm(np.array(velocity) + yaw_rate * REST[:, :2] @ [[0, 1], [-1, 0]], axis=1).max()
    travel, turn = size * np.array(velocity), size * yaw_rate
    body, feet, sets = np.eye(4), REST.copy(), []
    for _ in range(steps):
        swing = swinging(gait, along, apply(inverse(body), feet))
        body = extrapolate_pose(body, travel, turn, 1.0)
        feet[swing, :2] = nominal_touchdowns(REST, extrapolate_pose(body, travel, turn, gait.stances / 2))[swing]
        sets.append(swing)
    return sets


@pytest.mark.parametrize(("velocity", "yaw_rate"), MOTIONS)
def test_tripods_alternate_in_any_motion(velocity: tuple[float, float], yaw_rate: float) -> None:
    for before, after in pairwise(simulate_walk(TRIPOD, velocity, yaw_rate, 8)):
        np.testing.assert_array_equal(after, ~before)


@pytest.mark.parametrize("gait", GAITS.values(), ids=GAITS)
@pytest.mark.parametrize(("velocity", "yaw_rate"), MOTIONS[::3])
def test_each_leg_swings_once_per_cycle_with_gait_duty_factor(
    gait: Gait, velocity: tuple[float, float], yaw_rate: float
) -> None:
    n = len(gait.groups)
    sets = np.array(simulate_walk(gait, velocity, yaw_rate, 4 * n))
    for begin in range(3 * n + 1):
        np.testing.assert_array_equal(sets[begin : begin + n].sum(axis=0), 1)
    np.testing.assert_allclose((~sets).mean(axis=0), gait.duty)


def test_gait_duty_factors() -> None:
    assert {name: gait.duty for name, gait in GAITS.items()} == pytest.approx({"tripod": 1 / 2, "ripple": 2 / 3, "wave": 5 / 6})


@given(st.sampled_from(sorted(GAITS)), st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6), st.sampled_from(MOTIONS))
def test_swing_order_has_each_group_once_rearmost_first(
    name: str, behind: list[float], motion: tuple[tuple[float, float], float]
) -> None:
    gait, along = GAITS[name], directions(np.array(motion[0]), motion[1], REST)  # type: ignore[index]
    feet = REST.copy()
    feet[:, :2] += np.array(behind)[:, None] * along
    order = swing_order(gait, along, feet, REST)
    np.testing.assert_array_equal(np.sum(order, axis=0), 1)
    assert {tuple(np.flatnonzero(swing).tolist()) for swing in order} == {tuple(sorted(legs)) for legs in gait.groups}
    ahead, moved = ((feet - REST)[:, :2] * along).sum(axis=1), np.maximum((along**2).sum(axis=1), 0.01)
    lead = [ahead[swing].sum() / moved[swing].sum() for swing in order]
    assert all(before < after + 0.005 for before, after in pairwise(lead))


@pytest.mark.parametrize("name", GAITS)
def test_gait_change_does_not_swing_foremost_leg_first(name: str) -> None:
    """Check that a leg that has just swung is not first in another gait."""
    along = directions(unit(0.0), 0.0, REST)
    just = np.arange(6) == 0
    feet = REST + np.where(just[:, None], [0.03, 0.0, 0.0], [-0.01, 0.0, 0.0])
    if name != "ripple":  # in the ripple gait the partner leg may be further behind
        assert not swinging(GAITS[name], along, feet)[0]  # type: ignore[index]


@pytest.mark.parametrize("heading", HEADINGS[::3])
def test_rear_tripod_swings_regardless_of_active_leg(heading: float) -> None:
    along = directions(unit(heading), 0.0, REST)
    for behind in (EVEN, ~EVEN):
        feet = REST - np.where(behind[:, None], 0.02, 0.0) * [np.cos(heading), np.sin(heading), 0.0]
        np.testing.assert_array_equal(swinging(TRIPOD, along, feet), behind)


def test_foot_directions_match_rigid_body_motion() -> None:
    velocity, yaw_rate = np.array([0.05, -0.02]), 0.4
    dt = 1e-6
    moved = from_xyz_rpy((*velocity * dt, 0.0), (0.0, 0.0, yaw_rate * dt))
    speeds = (apply(moved, REST) - REST)[:, :2] / dt
    along = directions(velocity, yaw_rate, REST)
    np.testing.assert_allclose(along, speeds / np.linalg.norm(speeds, axis=1).max(), atol=1e-5)
    assert np.linalg.norm(along, axis=1).max() == pytest.approx(1.0)


def test_zero_motion_has_zero_directions() -> None:
    np.testing.assert_array_equal(directions(np.zeros(2), 0.0, REST), 0.0)
    assert swinging(TRIPOD, np.zeros((6, 2)), REST).sum() == 3


@pytest.mark.parametrize("gait", GAITS.values(), ids=GAITS)
def test_nominal_touchdown_is_symmetric_about_rest_over_stance(gait: Gait) -> None:
    """Check that feet land half a stance ahead of rest and lift half a stance behind.

    Seen from the body, both places are symmetric about rest.
    """
    travel = np.array([0.05, 0.02]) / gait.stances
    T_end = from_xyz_rpy((0.3, -0.1, 0.1), (0.0, 0.0, 0.7))
    T_after = extrapolate_pose(T_end, travel, 0.0, gait.stances)
    touchdown = nominal_touchdowns(REST, extrapolate_pose(T_end, travel, 0.0, gait.stances / 2))
    feet = np.column_stack([touchdown, np.zeros(6)])
    first, last = (apply(inverse(T), feet)[:, :2] - REST[:, :2] for T in (T_end, T_after))
    np.testing.assert_allclose(first, -last, atol=1e-12)
    np.testing.assert_allclose(first, np.tile([0.025, 0.01], (6, 1)), atol=1e-12)


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.3, 0.3), st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_extrapolated_steps_are_additive(x: float, y: float, turn: float, a: float, b: float) -> None:
    """Check that a + b steps turn and travel as far as a steps and then b steps."""
    T, travel = from_xyz_rpy((0.3, -0.1, 0.1), (0.0, 0.0, 0.7)), np.array([x, y])
    both = extrapolate_pose(extrapolate_pose(T, travel, turn, a), travel, turn, b)
    once = extrapolate_pose(T, travel, turn, a + b)
    np.testing.assert_allclose(both[:2, :2], once[:2, :2], atol=1e-9)
    # Each part of an arc is walked along its chord.
    np.testing.assert_allclose(both[:3, 3], once[:3, 3], atol=1e-9 + 0.2 * turn**2 * np.hypot(x, y) * (a + b))
