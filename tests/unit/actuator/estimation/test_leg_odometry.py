"""Leg odometry: known body motions over standing feet are recovered."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.actuator.estimation.leg_odometry import LegOdometry
from sextant.shared.geometry import Array, apply, exp_so3, from_xyz_rpy, inverse, skew, transform
from sextant.shared.robot.body import Foot
from sextant.shared.robot.kinematics import body_inverse, leg_points
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile

Flags = NDArray[np.bool_]

PROFILE = load_profile("phantomx_mk2")
WILD = settings(max_examples=30)
POINTED = replace(PROFILE, foot=Foot(1e-12))  # feet that do not roll
ALL = np.ones(6, dtype=bool)
TRIPOD = np.arange(6) % 2 == 0
START = from_xyz_rpy((0.0, 0.0, PROFILE.stance.body_height), np.zeros(3))

moves = st.tuples(st.floats(-0.03, 0.03), st.floats(-0.03, 0.03), st.floats(-0.15, 0.15))


def way(x: float, y: float, yaw: float, n: int = 20) -> list[Array]:
    """Return n + 1 poses from the start to x, y and yaw, at equal intervals."""
    height = PROFILE.stance.body_height
    return [from_xyz_rpy((s * x, s * y, height), (0.0, 0.0, s * yaw)) for s in np.linspace(0.0, 1.0, n + 1)]


def standing_joints(profile: RobotProfile, T: Array, feet_odom: Array) -> Array:
    return body_inverse(profile, apply(inverse(T), feet_odom))


@WILD
@given(moves, st.sampled_from([ALL, TRIPOD, ~TRIPOD]))
def test_body_motion_over_stance_feet_is_recovered(move: tuple[float, float, float], standing: Flags) -> None:
    feet = apply(START, POINTED.rest_feet())
    odometry = LegOdometry(POINTED, standing_joints(POINTED, START, feet), START)
    for T in way(*move):
        found = odometry.update(standing_joints(POINTED, T, feet), standing, feet[:, 2])
        np.testing.assert_allclose(found, T, atol=1e-9)
    assert odometry.reliable
    assert odometry.travelled == pytest.approx(np.hypot(*move[:2]), abs=1e-8)
    assert odometry.turned == pytest.approx(abs(move[2]), abs=1e-8)


def test_swing_legs_do_not_affect_odometry() -> None:
    feet = apply(START, POINTED.rest_feet())
    odometry = LegOdometry(POINTED, standing_joints(POINTED, START, feet), START)
    odometry.update(standing_joints(POINTED, START, feet), TRIPOD, feet[:, 2])
    moved = feet + np.where(TRIPOD[:, None], 0.0, [0.03, 0.01, 0.02])
    found = odometry.update(standing_joints(POINTED, START, moved), TRIPOD, feet[:, 2])
    np.testing.assert_allclose(found, START, atol=1e-9)


def test_odometry_over_alternating_tripods_accumulates_exactly() -> None:
    feet = apply(START, POINTED.rest_feet())
    odometry = LegOdometry(POINTED, standing_joints(POINTED, START, feet), START)
    T = START
    for step in range(6):
        standing = TRIPOD if step % 2 else ~TRIPOD
        for k in range(1, 11):
            T = from_xyz_rpy((0.04 * (step + k / 10), 0.0, START[2, 3]), (0.0, 0.0, 0.02 * (step + k / 10)))
            lifted = np.where(standing[:, None], feet, apply(T, POINTED.rest_feet()) + np.array([0.02, 0.0, 0.03]))
            odometry.update(standing_joints(POINTED, T, lifted), standing, feet[:, 2])
        landed = apply(T, POINTED.rest_feet()) + np.array([0.02, 0.0, 0.0])
        feet = np.where(standing[:, None], feet, landed)
        odometry.update(standing_joints(POINTED, T, feet), ALL, feet[:, 2])
    np.testing.assert_allclose(odometry.T_odom_body, T, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_odometry_holds_and_is_unreliable_below_three_stance_legs(count: int) -> None:
    feet = apply(START, POINTED.rest_feet())
    odometry = LegOdometry(POINTED, standing_joints(POINTED, START, feet), START)
    few = np.arange(6) < count
    elsewhere = from_xyz_rpy((0.01, 0.0, START[2, 3]), np.zeros(3))
    found = odometry.update(standing_joints(POINTED, elsewhere, feet), few, feet[:, 2])
    np.testing.assert_array_equal(found, START)
    assert not odometry.reliable
    assert odometry.travelled == 0.0
    odometry.update(standing_joints(POINTED, elsewhere, feet), ALL, feet[:, 2])  # the other legs touch down
    before = odometry.update(standing_joints(POINTED, elsewhere, feet), ALL, feet[:, 2])
    beyond = from_xyz_rpy((0.01, 0.02, START[2, 3]), np.zeros(3))
    after = odometry.update(standing_joints(POINTED, beyond, feet), ALL, feet[:, 2])
    assert odometry.reliable
    np.testing.assert_allclose(after[:3, 3] - before[:3, 3], [0.0, 0.02, 0.0], atol=1e-4)


def rolling(profile: RobotProfile, poses: list[Array], feet: Array) -> list[Array]:
    """Return joint angles of a robot whose spherical feet roll without slipping.

    The computation is independent of the code under test. The shank's angular velocity in {odom} follows from the change of
    its direction. The contact point is at rest, so the foot's centre moves with omega x r upwards, integrated in fine steps.
    """
    centres, out = feet.copy(), []
    shank = _shanks(profile, poses[0], standing_joints(profile, poses[0], centres))
    up = np.array([0.0, 0.0, profile.foot.radius])
    for T in poses:
        moved = centres
        for _ in range(4):  # the joints depend on the rolled centres, and vice versa
            now = _shanks(profile, T, standing_joints(profile, T, moved))
            omega = [skew(a) @ b for a, b in zip(shank, now, strict=True)]
            moved = centres + np.stack([skew(w) @ up for w in omega])
        shank, centres = now, moved
        out.append(standing_joints(profile, T, centres))
    return out


def _shanks(profile: RobotProfile, T: Array, q: Array) -> Array:
    points = leg_points(profile, q)
    up = (points[:, 2] - points[:, 3]) @ T[:3, :3].T
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


@settings(max_examples=6)
@given(moves)
def test_odometry_compensates_rolling_feet(move: tuple[float, float, float]) -> None:
    poses = way(*move)
    feet = apply(START, PROFILE.rest_feet())
    joints = rolling(PROFILE, poses, feet)
    odometry = LegOdometry(PROFILE, joints[0], START)
    for q in joints:
        found = odometry.update(q, ALL, feet[:, 2])
    size = np.hypot(*move[:2]) + 0.2 * abs(move[2])
    np.testing.assert_allclose(found[:3, 3], poses[-1][:3, 3], atol=1e-4 + 0.01 * size)


def test_uncompensated_rolling_underestimates_travel() -> None:
    """Check the sign: the body travels further than the joints of rolling feet show."""
    poses = way(0.05, 0.0, 0.0, n=40)
    feet = apply(START, PROFILE.rest_feet())
    joints = rolling(PROFILE, poses, feet)
    with_it, without = LegOdometry(PROFILE, joints[0], START), LegOdometry(POINTED, joints[0], START)
    for q in joints:
        with_it.update(q, ALL, feet[:, 2])
        without.update(q, ALL, feet[:, 2])
    assert without.T_odom_body[0, 3] < 0.98 * 0.05
    assert with_it.T_odom_body[0, 3] == pytest.approx(0.05, rel=0.005)


def test_body_height_follows_foothold_heights() -> None:
    feet = apply(START, POINTED.rest_feet())
    odometry = LegOdometry(POINTED, standing_joints(POINTED, START, feet), START)
    found = odometry.update(standing_joints(POINTED, START, feet), ALL, feet[:, 2] + 0.03)
    np.testing.assert_allclose(found[:3, 3], START[:3, 3] + [0.0, 0.0, 0.03], atol=1e-9)


def test_pose_stays_a_rigid_transform() -> None:
    rng = np.random.default_rng(3)
    feet = apply(START, PROFILE.rest_feet())
    odometry = LegOdometry(PROFILE, standing_joints(PROFILE, START, feet), START)
    for _ in range(50):
        T = START @ from_xyz_rpy(rng.uniform(-0.01, 0.01, 3), np.zeros(3))
        T[:3, :3] = exp_so3(rng.uniform(-0.05, 0.05, 3))
        R = odometry.update(standing_joints(PROFILE, T, feet), ALL, feet[:, 2])[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_slip_is_attributed_to_the_slipping_foot() -> None:
    T = START
    feet = apply(T, PROFILE.rest_feet())
    odometry = LegOdometry(PROFILE, standing_joints(PROFILE, T, feet), T)
    ground = feet[:, 2]
    odometry.update(standing_joints(PROFILE, T, feet), np.ones(6, dtype=bool), ground)
    assert odometry.slip.max() < 1e-6
    feet[2, 0] += 0.03
    odometry.update(standing_joints(PROFILE, T, feet), np.ones(6, dtype=bool), ground)
    assert odometry.slip.argmax() == 2
    assert odometry.slip[2] > 0.012
    assert np.delete(odometry.slip, 2).max() < 0.01


def test_turn_of_odom_frame_adds_no_travel_and_no_slip() -> None:
    T, feet = START, apply(START, PROFILE.rest_feet())
    odometry = LegOdometry(PROFILE, standing_joints(PROFILE, T, feet), T)
    R = exp_so3(np.array([0.05, -0.08, 0.0]))
    turn = transform(R, T[:3, 3] - R @ T[:3, 3])
    odometry.turn(turn)
    feet = apply(turn, feet)
    found = odometry.update(standing_joints(PROFILE, turn @ T, feet), ALL, feet[:, 2])
    np.testing.assert_allclose(found, turn @ T, atol=1e-9)
    assert odometry.slip.max() < 1e-9
    assert odometry.travelled < 1e-9
