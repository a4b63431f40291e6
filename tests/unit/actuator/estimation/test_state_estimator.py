"""State estimator: a new {odom} on level ground, and the contacts of a cycle."""

import numpy as np

from sextant.services.actuator.estimation.state_estimator import StateEstimator
from sextant.services.actuator.estimation.touchdown_detector import FemurReading
from sextant.shared.geometry import apply, rotation_z, transform
from sextant.shared.robot.kinematics import body_inverse, joint_torques
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet()
Q_REST = body_inverse(PROFILE, REST)
NONE, ALL = np.zeros(6, dtype=np.bool_), np.ones(6, dtype=np.bool_)
FIRST = np.arange(6) == 0
SECOND = 1_000_000_000


def restarted() -> StateEstimator:
    estimator = StateEstimator(PROFILE)
    estimator.restart(Q_REST)
    return estimator


def test_restart_puts_the_ground_at_zero_under_the_standing_feet() -> None:
    feet = REST + np.where(FIRST[:, None], np.array([0.0, 0.0, 0.04]), 0.0)
    estimator = StateEstimator(PROFILE)
    found = estimator.restart(body_inverse(PROFILE, feet), standing=~FIRST)
    np.testing.assert_allclose(found, feet, atol=1e-9)
    np.testing.assert_allclose(estimator.feet_odom[~FIRST, 2], PROFILE.foot.radius, atol=1e-9)
    assert estimator.odometry.T_odom_body[0, 3] == estimator.odometry.T_odom_body[1, 3] == 0.0


def test_a_hanging_foot_is_lifted_and_earlier_loads_do_not_count() -> None:
    estimator = restarted()
    weight = np.where(FIRST, 0.0, 5.0)[:, None] * [0.0, 0.0, 1.0]
    feet = REST + np.where(FIRST[:, None], np.array([0.0, 0.0, 0.04]), 0.0)
    q = body_inverse(PROFILE, feet)
    estimator.contact.update(Q_REST, np.zeros((6, 3)), 10.0)
    np.testing.assert_allclose(estimator.lifted(q, joint_torques(PROFILE, q, weight)), np.where(FIRST, 0.04, 0.0), atol=1e-6)


def test_legs_without_torque_or_answer_are_assumed_to_stand() -> None:
    estimator = restarted()
    estimator.touchdown.begin_cycle(Q_REST, Q_REST)
    silent = estimator.foot_contact(NONE, NONE, ALL, Q_REST, 0, SECOND)
    assert silent.bears.all(), "no servo has ever answered"
    assert not silent.heard.any()
    for leg in range(6):
        estimator.touchdown.add_reading(leg, FemurReading(0.0, 0.0, 0.0, SECOND, SECOND))
    assert estimator.foot_contact(NONE, FIRST, ALL, Q_REST, 0, SECOND).bears.tolist() == FIRST.tolist()


def test_contacts_are_in_odom() -> None:
    estimator = restarted()
    estimator.touchdown.begin_cycle(Q_REST, Q_REST)
    goals = Q_REST + 0.01
    contact = estimator.foot_contact(NONE, NONE, ~FIRST, goals, 0, SECOND)
    np.testing.assert_allclose(contact.feet, apply(estimator.odometry.T_odom_body, REST), atol=1e-9)
    assert contact.goals is not None
    assert np.abs(contact.goals - contact.feet).max() > 1e-4
    assert contact.known.tolist() == (~FIRST).tolist()


def test_without_an_inertial_sensor_odom_does_not_turn() -> None:
    estimator = restarted()
    before = estimator.odometry.T_odom_body.copy()
    assert estimator.turn(0.02, SECOND, None) is None
    np.testing.assert_array_equal(estimator.odometry.T_odom_body, before)


def test_only_feet_that_move_against_the_others_slip() -> None:
    estimator, ground = restarted(), np.full(6, PROFILE.foot.radius)
    # The body turns over standing feet: no foot slips.
    turned = body_inverse(PROFILE, apply(transform(rotation_z(0.03), np.zeros(3)), REST))
    estimator.update(turned, np.zeros((6, 3)), ALL, ground, 0.02)
    assert estimator.slip_warning == ""
    moved = REST + np.where(FIRST[:, None], np.array([0.0, 0.03, 0.0]), 0.0)
    estimator.update(body_inverse(PROFILE, moved), np.zeros((6, 3)), ALL, ground, 0.02)
    assert estimator.slip_warning == "slipping: left front"
