"""Ground forces from statics, and goals that compensate the servos' compliance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.feedforward import (
    GRAVITY,
    centre_of_mass,
    foot_forces,
    lag_feed_forward,
    leg_shapes,
    outward_forces,
    sag_feed_forward,
)
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot import stability
from sextant.shared.robot.kinematics import body_forward, body_inverse, joint_torques, leg_points, link_torques
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile

Flags = NDArray[np.bool_]

PROFILE = load_profile("phantomx_mk2")
WEIGHT = PROFILE.body.total_mass * GRAVITY
REST = PROFILE.rest_feet()
SHARES = st.lists(st.sampled_from([1.0, 0.7, 0.2]), min_size=6, max_size=6)
TRIPODS = (np.arange(6) % 2 == 0, np.arange(6) % 2 == 1)


def random_feet_and_centre(seed: int) -> tuple[Array, Array]:
    """Return feet (6, 3) [m] near rest, and a centre of mass (3,) [m] near the body's."""
    rng = np.random.default_rng(seed)
    return REST + rng.uniform(-0.02, 0.02, (6, 3)), np.array([*rng.uniform(-0.01, 0.01, 2), 0.0])


def vertical_forces(feet: Array, share: Array, centre: Array) -> Array:
    """Return vertical forces (6,) [N] on feet (6, 3) [m] of a level body with a centre of mass (3,) [m]."""
    return np.array(foot_forces(offsets(feet, centre), share.tolist(), WEIGHT))


def outward(feet: Array, vertical: Array, centre: Array) -> Array:
    """Return the horizontal forces (6, 2) [N] of these feet."""
    return np.array(outward_forces(offsets(feet, centre), vertical.tolist()))


def offsets(feet: Array, centre: Array) -> list[tuple[float, float]]:
    return [(x, y) for x, y in (feet[:, :2] - centre[:2]).tolist()]


def com(q: Array, profile: RobotProfile = PROFILE) -> Array:
    """Return the centre of mass (3,) [m] {body}."""
    return np.array(centre_of_mass(profile, leg_shapes(profile, q)))


def balance(feet: Array, forces: Array, centre: Array) -> Array:
    """Return the sum of vertical forces [N] and their moments about x and y [N m]."""
    arms = feet[:, :2] - centre[:2]
    return np.array([forces.sum(), (forces * arms[:, 0]).sum(), (forces * arms[:, 1]).sum()])


@given(st.integers(0, 2**32 - 1), SHARES)
def test_forces_balance_weight_and_moments(seed: int, share: list[float]) -> None:
    feet, centre = random_feet_and_centre(seed)
    forces = vertical_forces(feet, np.array(share), centre)
    assert (forces >= 0).all()
    np.testing.assert_allclose(balance(feet, forces, centre), [WEIGHT, 0.0, 0.0], atol=1e-2)


@pytest.mark.parametrize("standing", TRIPODS)
def test_tripod_carries_full_weight_and_swing_legs_none(standing: Flags) -> None:
    forces = vertical_forces(REST, standing.astype(float), np.zeros(3))
    np.testing.assert_array_equal(forces[~standing], 0.0)
    np.testing.assert_allclose(balance(REST, forces, np.zeros(3)), [WEIGHT, 0.0, 0.0], atol=1e-2)


@given(st.integers(0, 2**32 - 1), SHARES)
def test_outward_forces_have_no_net_force_or_moment(seed: int, share: list[float]) -> None:
    feet, centre = random_feet_and_centre(seed)
    vertical = vertical_forces(feet, np.array(share), centre)
    forces = outward(feet, vertical, centre)
    arms = feet[:, :2] - centre[:2]
    np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-2)
    np.testing.assert_allclose(arms[:, 0] @ forces[:, 1] - arms[:, 1] @ forces[:, 0], 0.0, atol=1e-9)
    assert (np.linalg.norm(forces, axis=1) <= 0.3 * vertical + 1e-12).all()  # well below the friction limit


@pytest.mark.parametrize("standing", TRIPODS)
@pytest.mark.parametrize("name", ["phantomx_mk2", "lotriet_rx64"])
def test_outward_forces_reduce_femur_torque_of_a_tripod(name: str, standing: Flags) -> None:
    profile = load_profile(name)
    feet = profile.rest_feet()
    q = body_inverse(profile, feet)
    centre, forces = com(q, profile), np.zeros((6, 3))
    forces[:, 2] = foot_forces(offsets(feet, centre), standing.astype(float).tolist(), profile.body.total_mass * GRAVITY)
    without = np.abs(joint_torques(profile, q, forces))
    forces[:, :2] = outward(feet, forces[:, 2], centre)
    pushing = np.abs(joint_torques(profile, q, forces))
    assert (pushing[standing, 1] < 0.95 * without[standing, 1]).all()
    assert (pushing.max(axis=1) <= without.max(axis=1)).all()  # and no other joint bears more


def test_foot_force_falls_with_load_share() -> None:
    share = np.ones(6)
    forces = []
    for share[2] in (1.0, 0.6, 0.3, 0.0):
        forces.append(vertical_forces(REST, share, np.zeros(3))[2])
    assert (np.diff(forces) < 0).all()
    assert forces[-1] == 0.0


@given(st.lists(st.floats(0, 1), min_size=6, max_size=6), st.integers(0, 2**32 - 1))
def test_forces_stay_bounded_for_any_load_shares(share: list[float], seed: int) -> None:
    feet = REST + np.random.default_rng(seed).uniform(-0.1, 0.1, (6, 3))
    forces = vertical_forces(feet, np.array(share), np.zeros(3))
    assert np.isfinite(forces).all()
    assert (forces >= 0).all()
    assert forces.max() < 1e3 * WEIGHT


def test_sag_feedforward_lowers_goal_of_loaded_femur() -> None:
    q = body_inverse(PROFILE, REST)
    sag = sag_feed_forward(PROFILE, q, REST, np.ones(6), np.eye(3))
    assert (sag[:, 1] < 0).all()  # down: the ground pushes the foot, and the femur with it, up
    beyond = body_forward(PROFILE, q + sag)
    assert (beyond[:, 2] < REST[:, 2]).all()  # so the commanded feet lie below the ground


def test_unloaded_legs_need_only_link_torques() -> None:
    """Compare with virtual work: the torque lifts the links' midpoints."""
    rng = np.random.default_rng(2)
    q = rng.uniform(PROFILE.joint_limits[..., 0], PROFILE.joint_limits[..., 1])
    torque = PROFILE.servo.stiffness * sag_feed_forward(PROFILE, q, body_forward(PROFILE, q), np.zeros(6), np.eye(3))
    np.testing.assert_allclose(torque, link_torques(PROFILE, q), atol=1e-6)

    def energy(angles: Array) -> Array:
        points = leg_points(PROFILE, angles)[..., 2]
        _, femur, tibia = PROFILE.body.leg_link_masses
        middles = (points[:, 1:-1] + points[:, 2:]) / 2
        return np.asarray(GRAVITY * (femur * middles[:, 0] + tibia * middles[:, 1]))

    for joint in range(3):
        turned = q.copy()
        turned[:, joint] += 1e-6
        np.testing.assert_allclose(torque[:, joint], (energy(turned) - energy(q)) / 1e-6, atol=1e-5)


@given(st.integers(0, 2**32 - 1))
def test_sag_feedforward_balances_spring_and_load(seed: int) -> None:
    """Check that a spring from goal to joint holds exactly the load at rest.

    The equation is stiffness * (goal - q) = -J^T f.
    """
    rng = np.random.default_rng(seed)
    feet = REST + rng.uniform(-0.02, 0.02, (6, 3))
    q = body_inverse(PROFILE, feet)
    torque = PROFILE.servo.stiffness * sag_feed_forward(PROFILE, q, feet, np.ones(6), np.eye(3)) - link_torques(PROFILE, q)
    centre = com(q)
    vertical = vertical_forces(feet, np.ones(6), centre)
    forces = np.column_stack([outward(feet, vertical, centre), vertical])
    for joint in range(3):  # virtual work without the Jacobian: the motor's work equals the work against the ground's force
        turned = q.copy()
        turned[:, joint] += 1e-6
        work = (forces * (body_forward(PROFILE, turned) - body_forward(PROFILE, q))).sum(axis=1) / 1e-6
        np.testing.assert_allclose(torque[:, joint], -work, atol=1e-4)


def test_downhill_legs_carry_more_on_slope() -> None:
    R_level_body = from_xyz_rpy(np.zeros(3), (0.0, np.radians(10.0), 0.0))[:3, :3]  # nose down: the front feet are downhill
    flat, tilted = (vertical_forces(REST @ R.T, np.ones(6), np.zeros(3)) for R in (np.eye(3), R_level_body))
    assert (tilted[:2] > flat[:2]).all()
    assert (tilted[3:5] < flat[3:5]).all()


def test_sag_feedforward_is_limited_to_stall_torque() -> None:
    feet = REST * [2.0, 2.0, 1.0]
    sag = sag_feed_forward(PROFILE, np.zeros((6, 3)), feet, np.array([1.0, 0, 1.0, 0, 0, 0]), np.eye(3))
    assert np.abs(sag).max() <= PROFILE.servo.stall_torque / PROFILE.servo.stiffness + 1e-12


@given(st.floats(0.0, 1.0))
def test_sag_feedforward_scales_with_load_share(share: float) -> None:
    q = body_inverse(PROFILE, REST)
    none, whole, part = (sag_feed_forward(PROFILE, q, REST, np.full(6, s), np.eye(3)) for s in (0.0, 1.0, share))
    np.testing.assert_allclose(part - none, share * (whole - none), atol=1e-3)


def test_link_torques_are_gradient_of_potential_energy() -> None:
    """Compare with virtual work: a small turn of a joint lifts the centre of mass.

    The lift is the work of the joint's torque divided by the weight.
    """
    q = body_inverse(PROFILE, REST + np.random.default_rng(1).uniform(-0.03, 0.03, (6, 3)))
    small = 1e-6
    slopes = np.zeros((6, 3))
    for index in np.ndindex(6, 3):
        ends = []
        for sign in (-1.0, 1.0):
            turned = q.copy()
            turned[index] += sign * small
            ends.append(WEIGHT * com(turned)[2])
        slopes[index] = (ends[1] - ends[0]) / (2 * small)
    np.testing.assert_allclose(link_torques(PROFILE, q), slopes, atol=1e-7)


def test_swinging_tripod_forward_moves_centre_of_mass_forward() -> None:
    at_rest = com(body_inverse(PROFILE, REST))
    np.testing.assert_allclose(at_rest[:2], 0.0, atol=1e-3)  # because rear feet stand further out than front feet
    ahead = REST + np.where(TRIPODS[0][:, None], [0.04, 0.0, 0.02], 0.0)
    moved = com(body_inverse(PROFILE, ahead)) - at_rest
    assert 0.002 < moved[0] < 0.02


def test_centre_of_mass_is_that_of_stability_also_for_an_uneven_trunk() -> None:
    uneven = replace(PROFILE, body=replace(PROFILE.body, centre_of_mass=(0.03, -0.01, 0.02)))
    q = body_inverse(PROFILE, REST + np.random.default_rng(3).uniform(-0.03, 0.03, (6, 3)))
    for profile in (PROFILE, uneven):
        np.testing.assert_allclose(com(q, profile), stability.centre_of_mass(profile, q), atol=1e-12)


def test_lag_feedforward_matches_damping_torque_up_to_stall() -> None:
    rate = np.random.default_rng(0).uniform(-3.0, 3.0, (6, 3))
    torque = PROFILE.servo.stiffness * lag_feed_forward(PROFILE, rate, 0.0)
    np.testing.assert_allclose(torque, PROFILE.servo.damping * rate)
    fastest = lag_feed_forward(PROFILE, np.full((6, 3), 100.0), 0.0)
    np.testing.assert_allclose(PROFILE.servo.stiffness * fastest, PROFILE.servo.stall_torque)
    lead = lag_feed_forward(PROFILE, rate, 0.02) - lag_feed_forward(PROFILE, rate, 0.0)
    np.testing.assert_allclose(lead, 0.01 * rate)
