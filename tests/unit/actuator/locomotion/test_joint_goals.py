"""Joint goals: feet reach their targets, limits hold, and readings are extrapolated by the command."""

import numpy as np

from sextant.services.actuator.locomotion.joint_goals import JointGoals
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE
from sextant.services.actuator.locomotion.step_executor import Targets
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_forward, body_inverse
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet()
Q_REST = body_inverse(PROFILE, REST)
DT = 0.02
NONE = np.zeros(6, dtype=np.bool_)
FIRST = np.arange(6) == 0


def unloaded(feet: Array) -> Targets:
    return Targets(feet, np.zeros(6), np.eye(3))


def follow(joints: JointGoals, targets: Targets, goals: Array, cycles: int = 100) -> Array:
    for _ in range(cycles):
        goals = joints.follow(targets, goals, NONE, DT)
    return goals


def test_wanted_angles_put_the_feet_on_their_targets() -> None:
    joints, feet = JointGoals(PROFILE, Q_REST), REST + np.array([0.02, 0.01, 0.01])
    follow(joints, unloaded(feet), Q_REST)
    np.testing.assert_allclose(body_forward(PROFILE, joints.wanted), feet, atol=1e-9)


def test_goals_of_loaded_legs_exceed_the_wanted_angles_against_their_sag() -> None:
    joints = JointGoals(PROFILE, Q_REST)
    goals = follow(joints, Targets(REST, np.ones(6), np.eye(3)), Q_REST)
    np.testing.assert_allclose(joints.wanted, Q_REST, atol=1e-9)
    assert (body_forward(PROFILE, goals)[:, 2] < REST[:, 2] - 0.0005).all()


def test_a_moving_joint_leads_and_a_new_motion_begins_without_speed() -> None:
    joints, targets = JointGoals(PROFILE, Q_REST), unloaded(REST)
    follow(joints, targets, Q_REST, cycles=2)
    moved = unloaded(REST + np.array([0.0, 0.001, 0.0]))
    leads = joints.follow(moved, Q_REST, NONE, DT) - joints.wanted
    assert np.abs(leads).max() > 1e-3
    joints.begin_motion()
    settled = joints.follow(unloaded(REST), Q_REST, NONE, DT) - joints.wanted
    assert np.abs(settled).max() < np.abs(leads).max()


def test_a_leg_that_holds_keeps_its_goals_and_wanted_angles() -> None:
    joints = JointGoals(PROFILE, Q_REST)
    goals = joints.follow(unloaded(REST + np.array([0.0, 0.0, 0.005])), Q_REST, FIRST, DT)
    np.testing.assert_array_equal(goals[0], Q_REST[0])
    np.testing.assert_array_equal(joints.wanted[0], Q_REST[0])
    assert (np.abs(goals[1:] - Q_REST[1:]).max(axis=1) > 0.0).all()


def test_only_a_limited_leg_is_slow() -> None:
    joints = JointGoals(PROFILE, Q_REST)
    joints.begin_motion()
    for joint in range(3):
        joints.limits.limit_joint(0, joint)
    goals = joints.follow(unloaded(REST + np.array([0.0, 0.0, 0.04])), Q_REST, NONE, DT)
    assert np.abs(goals[0] - Q_REST[0]).max() <= GENTLE * DT + 1e-9
    assert (np.abs(goals[1:] - Q_REST[1:]).max(axis=1) > GENTLE * DT).all()


def test_targets_out_of_reach_are_reported_and_finite() -> None:
    joints = JointGoals(PROFILE, Q_REST)
    far = REST.copy()
    far[2] = np.nan
    goals = joints.follow(unloaded(far), Q_REST, NONE, DT)
    assert np.isfinite(goals).all()
    np.testing.assert_array_equal(goals[2], Q_REST[2])
    assert "out of reach" in joints.warning


def test_readings_are_extrapolated_by_the_motion_commanded_since() -> None:
    joints = JointGoals(PROFILE, Q_REST)
    targets = unloaded(REST + np.array([0.0, 0.0, 0.02]))
    goals = follow(joints, targets, Q_REST, cycles=5)
    np.testing.assert_allclose(joints.measured(Q_REST, NONE), joints.wanted)
    np.testing.assert_array_equal(joints.measured(Q_REST, FIRST)[0], Q_REST[0])  # without torque it does not follow
    for joint in range(3):
        joints.mark_read(1, joint)
    np.testing.assert_array_equal(joints.measured(goals, NONE)[1], goals[1])


def test_held_and_adopted_goals_are_the_wanted_angles() -> None:
    joints, other = JointGoals(PROFILE, Q_REST), Q_REST + 0.1
    follow(joints, unloaded(REST + np.array([0.0, 0.0, 0.02])), Q_REST, cycles=5)
    joints.adopt(FIRST, other)
    np.testing.assert_array_equal(joints.wanted[0], other[0])
    np.testing.assert_array_equal(joints.measured(other, NONE)[0], other[0])
    joints.hold(other)
    np.testing.assert_array_equal(joints.wanted, other)
    np.testing.assert_array_equal(joints.measured(Q_REST, NONE), Q_REST)
