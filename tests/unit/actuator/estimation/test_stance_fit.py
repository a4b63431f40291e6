"""Offsets of joints from standing feet: small constant ones are learned, a new one is found with its leg and its size."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.estimation.stance_fit import JointOffsets, Stance, largest_change, measure_stance
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profiles import load_profile

# Feet without a radius do not roll, so their centres are fixed to the ground.
PROFILE = replace(load_profile("phantomx_mk2"), foot=replace(load_profile("phantomx_mk2").foot, radius=1e-6))
TRIPODS = ([0, 2, 4], [1, 3, 5])
UNUSUAL, LEG, SURE = 12.0, 10.0, 36.0  # of three pairs of feet, as in `LegMonitor`


def motion(stride: float = 0.09, turn: float = 0.0) -> tuple[Array, Array]:
    """Return the true joint angles at the begin and at the end of a stance."""
    feet = PROFILE.rest_feet()
    poses = [from_xyz_rpy((x, 0.0, 0.0), (0.0, 0.0, yaw)) for x, yaw in ((-stride / 2, -turn / 2), (stride / 2, turn / 2))]
    return body_inverse(PROFILE, apply(inverse(poses[0]), feet)), body_inverse(PROFILE, apply(inverse(poses[1]), feet))


def stance(
    legs: list[int], offset: Array, late: Array | None = None, seed: int = 0, stride: float = 0.09, turn: float = 0.0
) -> Stance:
    """Return a stance as encoders show it that are behind their links by offsets (18,) [rad], and in the end by `late` more."""
    rng = np.random.default_rng(seed)
    readings = [q - offset.reshape(6, 3) + np.radians(0.15) * rng.uniform(-1.0, 1.0, (6, 3)) for q in motion(stride, turn)]
    if late is not None:
        readings[1] -= late.reshape(6, 3)
    return measure_stance(PROFILE, *readings, legs)


def one(joint: int, degrees: float) -> Array:
    offset = np.zeros(18)
    offset[joint] = np.radians(degrees)
    return offset


@given(st.integers(0, 10_000), st.floats(0.03, 0.1), st.floats(-0.3, 0.3))
@settings(max_examples=20, deadline=None)
def test_robot_that_matches_its_profile_is_never_unusual(seed: int, stride: float, turn: float) -> None:
    offsets = JointOffsets()
    for number in range(8):
        seen = stance(TRIPODS[number % 2], np.zeros(18), seed=seed + number, stride=stride, turn=turn)
        assert offsets.surprise([seen]) < UNUSUAL / 3
        offsets.learn(seen)


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_horns_that_are_off_by_up_to_four_degrees_are_learned_and_a_slip_of_another_joint_is_still_seen(seed: int) -> None:
    rng, offsets = np.random.default_rng(seed), JointOffsets()
    horns = np.radians(rng.uniform(-4.0, 4.0, 18))
    for number in range(10):
        seen = stance(TRIPODS[number % 2], horns, seed=seed + number, stride=rng.uniform(0.05, 0.1))
        assert offsets.surprise([seen]) < UNUSUAL
        offsets.learn(seen)
    assert offsets.surprise([stance(TRIPODS[0], horns)]) < UNUSUAL / 3
    coxa = int(rng.choice([0, 6, 12]))
    slipped = stance(TRIPODS[0], horns + one(coxa, 20.0))
    found = offsets.explain([slipped])
    assert offsets.surprise([slipped]) > SURE
    mine = next(one for one in found if one.joint == coxa)
    assert mine.cost < found[0].cost + LEG
    assert np.degrees(mine.size) == pytest.approx(20.0, rel=0.25)


@pytest.mark.parametrize("legs", TRIPODS)
@given(slip=st.sampled_from([-20.0, -15.0, 15.0, 20.0]), which=st.integers(0, 8), late=st.booleans(), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_slip_that_is_seen_is_explained_and_its_leg_is_not_ruled_out(
    legs: list[int], slip: float, which: int, late: bool, seed: int
) -> None:
    joint, offsets = 3 * legs[which // 3] + which % 3, JointOffsets()
    for number in range(6):
        offsets.learn(stance(TRIPODS[number % 2], np.zeros(18), seed=seed + number))
    new = one(joint, slip)
    seen = stance(legs, np.zeros(18), new, seed) if late else stance(legs, new, seed=seed)
    if offsets.surprise([seen]) < UNUSUAL:
        return
    found = offsets.explain([seen])
    mine = min(one.cost for one in found if one.joint // 3 == joint // 3)
    assert mine < found[0].cost + LEG
    assert found[0].left < 12.0


def test_slip_that_grows_does_not_rule_out_its_leg() -> None:
    offsets = JointOffsets()
    for number in range(6):
        offsets.learn(stance(TRIPODS[number % 2], np.zeros(18), seed=number))
    for joint in (7, 8):  # of a middle leg
        grows = [stance(TRIPODS[0], one(joint, 6.0 * k), one(joint, 2.4)) for k in (1, 2)]
        found = offsets.explain(grows)
        assert min(one.cost for one in found if one.joint // 3 == 2) < found[0].cost + LEG


def test_largest_change_is_that_of_the_distances() -> None:
    before, after = motion()
    assert largest_change(PROFILE, before, after, [0, 2, 4]) < 1e-9
    told = after + one(0, 10.0).reshape(6, 3)
    seen = measure_stance(PROFILE, before, told, [0, 2, 4])
    assert largest_change(PROFILE, before, told, [0, 2, 4]) == pytest.approx(abs(seen.moved).max(), abs=1e-6)
    assert seen.constant.shape == seen.late.shape == (3, 18)
