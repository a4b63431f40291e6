"""Body trajectory: smooth paths through goals, rest, and a frame that follows the measured pose."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.actuator.locomotion.body_trajectory import BodyTrajectory, hermite, pose, wrapped, xyz_rpy_from
from sextant.shared.geometry import Array, from_xyz_rpy, inverse

START = from_xyz_rpy((0.1, -0.2, 0.1), (0.02, -0.03, 0.4))
GOAL = from_xyz_rpy((0.16, -0.18, 0.11), (0.0, 0.01, 0.5))
IDENTITY = np.eye(4)
DURATION = 0.8


def moved(body: BodyTrajectory, goal: Array, stop: bool = False, steps: int = 40) -> Array:
    """Move to a goal; return all places (n, 6) including the first."""
    body.begin(0.0, DURATION)
    places = [body.xyz_rpy]
    for now_s in np.linspace(0.0, DURATION, steps + 1)[1:]:
        body.advance(float(now_s), body.goal(IDENTITY, goal), stop)
        places.append(body.xyz_rpy)
    return np.array(places)


@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_coordinates_and_pose_are_inverse(place: list[float]) -> None:
    np.testing.assert_allclose(xyz_rpy_from(pose(np.array(place))), place, atol=1e-9)


@given(st.floats(-20.0, 20.0))
def test_wrapped_angles_are_the_same_within_half_a_turn(angle: float) -> None:
    found = float(wrapped(np.array(angle)))
    assert abs(found) <= math.pi + 1e-9
    assert math.remainder(found - angle, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_cubic_has_the_given_ends() -> None:
    p0, v0, p1, v1 = np.random.default_rng(0).normal(size=(4, 6))
    for t, place, speed in ((0.0, p0, v0), (DURATION, p1, v1)):
        found = hermite(p0, v0, p1, v1, DURATION, t)
        np.testing.assert_allclose(found[0], place, atol=1e-12)
        np.testing.assert_allclose(found[1], speed, atol=1e-12)


def test_body_reaches_its_goal_and_passes_it_without_a_jerk() -> None:
    body = BodyTrajectory(START)
    first = moved(body, GOAL)
    np.testing.assert_allclose(body.T_odom_body, GOAL, atol=1e-9)
    second = moved(body, GOAL @ from_xyz_rpy((0.06, 0.0, 0.0), np.zeros(3)))
    speeds = np.diff(np.concatenate([first, second[1:]]), axis=0) / (DURATION / 40)
    assert np.abs(np.diff(speeds, axis=0)).max() < 0.03


def test_body_rests_at_the_goal_of_a_stop() -> None:
    body = BodyTrajectory(START)
    places = moved(body, GOAL, stop=True)
    assert np.abs(places[-1] - places[-2]).max() < 1e-3
    before = body.xyz_rpy
    body.brake(0.02, 0.1)
    np.testing.assert_allclose(body.xyz_rpy, before, atol=1e-9)


def test_braking_without_a_goal_coasts_by_speed_times_time_constant() -> None:
    body = BodyTrajectory(START)
    moved(body, GOAL)
    before, speed = body.xyz_rpy, (xyz_rpy_from(GOAL) - xyz_rpy_from(START)) / DURATION
    for _ in range(1000):
        body.brake(0.001, 0.1)
    np.testing.assert_allclose(body.xyz_rpy - before, 0.1 * speed, atol=0.01 * 0.1)


def test_yaw_goals_take_the_short_way() -> None:
    body = BodyTrajectory(from_xyz_rpy((0.0, 0.0, 0.1), (0.0, 0.0, 3.1)))
    goal = body.goal(IDENTITY, from_xyz_rpy((0.0, 0.0, 0.1), (0.0, 0.0, -3.1)))
    assert goal[5] - 3.1 == pytest.approx(math.tau - 6.2)


def test_frame_follows_the_measured_pose_in_the_plane_only() -> None:
    body, measured = BodyTrajectory(START), START.copy()
    measured[:3, 3] += [0.02, -0.01, 0.03]
    for _ in range(400):
        body.follow(0.02, measured)
    np.testing.assert_allclose(body.T_odom_body[:2, 3], measured[:2, 3], atol=1e-4)
    assert body.T_odom_body[2, 3] == pytest.approx(START[2, 3])
    np.testing.assert_allclose(body.level_error(measured), [-0.03, 0.0, 0.0], atol=1e-6)
    turned = measured @ from_xyz_rpy(np.zeros(3), (0.01, -0.02, 0.0))
    _, roll, pitch = body.level_error(turned)
    in_cmd = xyz_rpy_from(inverse(body.T_odom_cmd) @ turned)
    np.testing.assert_allclose([roll, pitch], (body.xyz_rpy - in_cmd)[3:5], atol=1e-9)
    np.testing.assert_allclose(body.to_odom(body.to_cmd(np.eye(3))), np.eye(3), atol=1e-12)


def test_rest_poses_lead_from_the_earliest_rest_to_the_goal_and_not_beyond() -> None:
    body = BodyTrajectory(START)
    moved(body, GOAL)
    body.begin(0.0, DURATION)
    far = GOAL @ from_xyz_rpy((0.2, 0.0, 0.0), np.zeros(3))
    poses = list(body.rest_poses(body.goal(IDENTITY, far), 0.2, 1.0))
    np.testing.assert_allclose(poses[-1], far, atol=1e-9)
    away = [float(np.linalg.norm(T[:3, 3] - GOAL[:3, 3])) for T in poses]
    assert away == sorted(away)
    assert 0.0 < away[0] < 0.01, "the earliest rest lies ahead by a third of the speed times the braking time"
    near = list(body.rest_poses(body.xyz_rpy + 1e-4 * (xyz_rpy_from(GOAL) - xyz_rpy_from(START)), 0.2, 1.0))
    np.testing.assert_allclose(near[0], near[-1], atol=1e-12)


def test_a_paused_body_has_no_speed() -> None:
    body = BodyTrajectory(START)
    moved(body, GOAL)
    body.pause()
    before = body.xyz_rpy
    body.brake(0.02, 0.1)
    np.testing.assert_array_equal(body.xyz_rpy, before)
