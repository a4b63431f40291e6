"""Contact of the feet, estimated from the motors' torques only."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.actuator.estimation.contact import ContactEstimate
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import body_inverse, joint_torques, link_torques
from sextant.shared.robot.profile import GRAVITY, RobotProfile
from sextant.shared.robot.profiles import load_profile
from tests.support.families import robot_with

Flags = NDArray[np.bool_]

PROFILE = load_profile("phantomx_mk2")
Q = body_inverse(PROFILE, PROFILE.rest_feet())
TRIPOD = np.arange(6) % 2 == 0
DT = 0.02  # [s]


def torques(push: Array) -> Array:
    """Return motor torques (6, 3) for vertical ground forces (6,) [N]."""
    return joint_torques(PROFILE, Q, push[:, None] * [0.0, 0.0, 1.0])


def settled(estimate: ContactEstimate, push: Array) -> Flags:
    for _ in range(20):
        contact = estimate.update(Q, torques(push), DT)
    return contact


def test_contact_is_initially_false() -> None:
    assert not ContactEstimate(PROFILE).update(Q, np.zeros((6, 3)), DT).any()


def test_legs_under_upward_force_are_in_contact() -> None:
    contact = settled(ContactEstimate(PROFILE), np.where(TRIPOD, 8.0, 0.0))
    np.testing.assert_array_equal(contact, TRIPOD)


def test_hanging_legs_are_not_in_contact() -> None:
    assert not settled(ContactEstimate(PROFILE), np.full(6, -3.0)).any()


@pytest.mark.parametrize("mass", [0.4, 0.75, 1.9, 2.5, 5.0])
def test_feet_that_share_the_weight_of_a_robot_of_any_mass_are_in_contact(mass: float) -> None:
    factor = mass / PROFILE.body.total_mass
    legs = tuple(factor * link for link in PROFILE.body.leg_link_masses)
    light = replace(PROFILE, body=replace(PROFILE.body, mass=factor * PROFILE.body.mass, leg_link_masses=legs))
    estimate = ContactEstimate(light)
    assert settled(estimate, np.full(6, mass * GRAVITY / 6.0)).all()
    assert estimate.firm.all()
    assert not settled(estimate, np.full(6, 0.15 * min(mass, 2.5) * GRAVITY / 6.0)).any()


def test_contact_has_hysteresis() -> None:
    """Check that contact keeps its state between the two thresholds (hysteresis)."""
    pushes = np.linspace(0.0, 4.0, 41)
    estimate = ContactEstimate(PROFILE)
    rising = [bool(settled(estimate, np.full(6, p))[0]) for p in pushes]
    falling = [bool(settled(estimate, np.full(6, p))[0]) for p in pushes[::-1]][::-1]
    assert rising == sorted(rising)
    assert falling == sorted(falling)
    assert rising[-1]
    assert not falling[0]
    assert sum(falling) > sum(rising)


SMALL = robot_with("STS3215")


def stands(profile: RobotProfile, force: Array, friction: float = 0.0, q_rate: float = 0.0) -> Flags:
    """Return which legs prove that they stand under ground forces (6, 3) [N].

    Dry friction is a share of that of the servos, and all femora turn by `q_rate` [rad/s] against their damping.
    """
    estimate, servos = ContactEstimate(profile), profile.servos
    q = body_inverse(profile, profile.rest_feet())
    turn = np.array([0.0, q_rate, 0.0]) * DT
    torque = joint_torques(profile, q, force) + link_torques(profile, q) + servos.damping * turn / DT
    for k in range(40):
        estimate.update(q + k * turn, torque + friction * servos.friction, DT)
    return estimate.stands


@pytest.mark.parametrize("profile", [PROFILE, SMALL], ids=lambda one: one.name)
def test_push_towards_the_body_does_not_hide_that_a_foot_stands(profile: RobotProfile) -> None:
    """Check half of the load of a tripod's leg, with and without a horizontal push and friction."""
    weight = profile.body.total_mass * GRAVITY
    inwards = -profile.T_body_coxa[:, :3, 0]
    for push in (0.0, 0.7):
        force = weight / 6 * (np.array([0.0, 0.0, 1.0]) + push * inwards)
        for friction in (0.0, 0.5):
            assert stands(profile, force, friction).all()


@pytest.mark.parametrize("profile", [PROFILE, SMALL], ids=lambda one: one.name)
def test_leg_in_the_air_does_not_prove_that_it_stands(profile: RobotProfile) -> None:
    nothing = np.zeros((6, 3))
    for friction in (-1.0, 0.0, 1.0):
        assert not stands(profile, nothing, friction).any()
    assert not stands(profile, nothing, q_rate=-0.2).any(), "damping is none of the ground's push"
    still = ContactEstimate(profile)
    assert not still.stands.any()


def test_single_outlier_does_not_end_contact() -> None:
    estimate = ContactEstimate(PROFILE)
    settled(estimate, np.full(6, 5.0))
    assert estimate.update(Q, torques(np.zeros(6)), DT).all()


def test_contact_filter_is_independent_of_update_rate() -> None:
    seldom, often, push = ContactEstimate(PROFILE), ContactEstimate(PROFILE), torques(np.full(6, 1.9))
    seldom_in = [seldom.update(Q, push, 4 * DT)[0] for _ in range(6)]
    often_in = [often.update(Q, push, DT)[0] for _ in range(24)]
    assert seldom_in == often_in[3::4]
    assert not often_in[0]
    assert often_in[-1]
    assert ContactEstimate(PROFILE).update(Q, push, float("inf")).all()


def test_contact_of_each_leg_uses_only_its_own_torques() -> None:
    for leg in range(6):
        push = np.zeros(6)
        push[leg] = 6.0
        np.testing.assert_array_equal(np.flatnonzero(settled(ContactEstimate(PROFILE), push)), [leg])


@pytest.mark.parametrize("stretched", [np.zeros((6, 3)), np.full((6, 3), [0.0, 1.5, 0.0])])
def test_contact_is_finite_at_singular_leg_pose(stretched: Array) -> None:
    """Check that the estimate stays finite where the Jacobian is singular."""
    estimate = ContactEstimate(PROFILE)
    assert estimate.update(stretched, np.full((6, 3), 1.5), DT).dtype == bool
    assert not settled(estimate, np.full(6, -5.0)).any()


def test_returned_contact_array_is_not_modified_later() -> None:
    estimate = ContactEstimate(PROFILE)
    first = settled(estimate, np.full(6, 6.0))
    settled(estimate, np.zeros(6))
    assert first.all()


def test_firm_contact_requires_more_force_than_contact() -> None:
    estimate = ContactEstimate(PROFILE)
    assert settled(estimate, np.full(6, 2.0)).all()
    assert not estimate.firm.any()
    settled(estimate, np.where(TRIPOD, 4.0, 0.0))
    np.testing.assert_array_equal(estimate.firm, TRIPOD)


SPANNING = [[0, 2, 4], [1, 3, 5], [0, 1, 3, 4], [1, 2, 4, 5], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4, 5]]
TILT = st.floats(-0.15, 0.15)


def estimate_from_forces(push: Array) -> ContactEstimate:
    """Return an estimate after one update under vertical forces (6,) [N]."""
    estimate = ContactEstimate(PROFILE)
    estimate.update(Q, torques(push), np.inf)
    return estimate


@given(st.sampled_from(SPANNING), TILT, TILT, st.lists(st.floats(-10.0, 2.9), min_size=6, max_size=6), st.floats(0.007, 0.08))
def test_feet_above_support_plane_are_lifted_despite_friction(
    down: list[int], roll: float, pitch: float, feigned: list[float], height: float
) -> None:
    stands = np.isin(np.arange(6), down)
    level = PROFILE.rest_feet() + np.where(stands, 0.0, height)[:, None] * [0.0, 0.0, 1.0]
    feet = apply(from_xyz_rpy((0.0, 0.0, 0.0), (roll, pitch, 0.0)), level)
    push = np.where(stands, 25.0 / len(down), feigned)
    lifted = estimate_from_forces(push).lifted(feet)
    np.testing.assert_array_equal(lifted == 0.0, stands)
    np.testing.assert_allclose(lifted * np.cos(roll) * np.cos(pitch), np.where(stands, 0.0, height), atol=1e-9)


@given(st.floats(0.02, 0.1), st.integers(0, 5))
def test_pushing_foot_on_a_block_is_not_lifted(height: float, leg: int) -> None:
    feet = PROFILE.rest_feet()
    feet[leg, 2] += height
    assert not estimate_from_forces(np.full(6, 4.0)).lifted(feet).any()
    push = np.full(6, 5.0)
    push[leg] = 2.0
    np.testing.assert_allclose(estimate_from_forces(push).lifted(feet), np.where(np.arange(6) == leg, height, 0.0), atol=1e-9)


def test_lifted_falls_back_to_loaded_feet_without_support_triangle() -> None:
    feet = PROFILE.rest_feet()
    beside = np.isin(np.arange(6), [1, 2, 3])  # legs on the right side
    feet[4:, 2] += 0.02
    np.testing.assert_allclose(
        estimate_from_forces(np.where(beside, 8.0, 0.0)).lifted(feet), [0.0, 0.0, 0.0, 0.0, 0.02, 0.02], atol=1e-9
    )
    assert not estimate_from_forces(np.where(np.arange(6) < 2, 8.0, 0.0)).lifted(feet).any()
    assert not estimate_from_forces(np.full(6, 5.0)).lifted(np.zeros((6, 3))).any(), "feet in one place define no plane"


@pytest.mark.parametrize(("out_m", "bears"), [(0.004, True), (0.006, False)])
def test_support_triangle_tolerates_centre_5_mm_outside(out_m: float, bears: bool) -> None:
    """Check the tolerance, a share of the weight: one foot would pull 4 or 6 % of it."""
    feet = np.array([[0.1 + out_m, 0.0, 0.05], [out_m, 0.1, 0.0], [out_m, -0.1, 0.0], *[[-0.1, 0.0, 0.02]] * 3])
    lifted = estimate_from_forces(np.where(np.arange(6) < 3, 8.0, 0.0)).lifted(feet)
    plane = (-0.1 - out_m) / 0.1 * 0.05
    mean = 0.05 / 3
    np.testing.assert_allclose(lifted, [0.0] * 3 + [0.02 - plane if bears else 0.0 if 0.02 - mean < 0.006 else 0.02 - mean] * 3)


@pytest.mark.parametrize(("half_m", "tells"), [(0.018, True), (0.016, False)])
def test_support_plane_requires_triangle_of_10_cm2(half_m: float, tells: bool) -> None:
    """Check the limit: a triangle of ten square centimetres."""
    feet = np.array([[0.04, 0.0, 0.03], [-0.02, half_m, 0.0], [-0.02, -half_m, 0.0], *[[-0.1, 0.0, 0.03]] * 3])
    lifted = estimate_from_forces(np.where(np.arange(6) < 3, 8.0, 0.0)).lifted(feet)
    np.testing.assert_allclose(lifted, [0.0] * 3 + [0.03 - (-0.08 / 0.06 * 0.03) if tells else 0.03 - 0.01] * 3)


def test_widest_support_triangle_is_chosen_among_equal_loads() -> None:
    """Check that millimetres of unevenness of the feet add up to a small error.

    The mean error stays below 0.45 mm; with the feet closest to the body it would be 0.5 mm.
    """
    random, stands = np.random.default_rng(0), np.arange(6) < 5
    off = list[float]()
    for _ in range(300):
        uneven = np.where(stands, random.uniform(-0.001, 0.001, 6), 0.02)
        lifted = estimate_from_forces(np.where(stands, 2.5, 0.0)).lifted(
            PROFILE.rest_feet() + uneven[:, None] * [0.0, 0.0, 1.0]
        )
        off.append(np.abs(lifted - np.where(stands, 0.0, 0.02)).max())
    assert np.mean(off) < 0.00045
