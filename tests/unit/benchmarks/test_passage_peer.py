"""The NumPy peer and the compiled tests agree for any stance and samples."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.peers.passage_peer import NumpyTests
from benchmarks.peers.passage_strips import GAP, NEAR, heights, random_blocks, thesis_blocks
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.search_tables import ground_of, legs_of, rules_of
from sextant.shared.geometry import Array
from sextant.shared.robot.joint_servos import ServoGroup
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.servo import Servo

PASSAGE = PassageSettings(body_height=0.11)


def weaker(profile: RobotProfile, joint: str, share: float) -> RobotProfile:
    """Return a robot whose servos of a joint have a share of their torque."""
    same = {one.name: getattr(profile.servo, one.name) for one in fields(Servo)}
    group = ServoGroup(joints=(joint,), **{**same, "stall_torque": share * profile.servo.stall_torque})
    return replace(profile, servo_groups=(group,))


PHANTOMX = load_profile("phantomx_mk2")
PROFILES = [PHANTOMX, load_profile("lotriet_rx64"), weaker(PHANTOMX, "tibia", 0.6)]
FIELDS = [
    strip_of(heights(thesis_blocks(3, GAP, 0.17, 0.20, 0.03, 0.28), GAP)),
    strip_of(heights(random_blocks(np.random.default_rng(5), GAP, 0.12, 0.9, 0.10, 0.03), GAP)),
]


def both_verdicts(
    seed: int, leg: int, profile: RobotProfile, ground: int, spread: float
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return verdicts and clearances of both for a stance with random offsets [m]."""
    rng = np.random.default_rng(seed)
    legs, rules, field = legs_of(profile, PASSAGE), rules_of(profile, PASSAGE), ground_of(FIELDS[ground])
    body = np.array([rng.uniform(0.5, NEAR + GAP), rng.uniform(-0.02, 0.02), profile.stance.body_height])
    feet = profile.rest_feet() + body + np.append(rng.uniform(-spread, spread, 2), 0.0)
    feet[:, :2] += rng.uniform(-spread, spread, (6, 2))
    bodies = body + np.column_stack([rng.uniform(0.0, 0.05, 4), rng.uniform(-0.02, 0.02, 4), rng.uniform(-0.01, 0.01, 4)])
    off = np.stack(
        [rng.uniform(-0.1, 0.12, (4, 6)), rng.uniform(-0.05, 0.05, (4, 6)), rng.uniform(-0.01, 0.02, (4, 6))], axis=-1
    )
    goals = profile.rest_feet()[leg] + body + off
    verdict, lifts = np.zeros((4, 6), dtype=np.int64), np.zeros((4, 6))
    roadmap_search.judge(legs, rules, field, feet, leg, body, bodies, goals, verdict, lifts)
    return (verdict, lifts), NumpyTests(legs, rules, field).judge(feet, leg, body, bodies, goals)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.integers(0, 2), st.integers(0, 1), st.floats(0.0, 0.06))
def test_numpy_peer_gives_same_verdicts(seed: int, leg: int, robot: int, ground: int, spread: float) -> None:
    (verdict, lifts), (told, told_lifts) = both_verdicts(seed, leg, PROFILES[robot], ground, spread)
    np.testing.assert_array_equal(verdict, told)
    np.testing.assert_allclose(lifts, told_lifts, atol=1e-12)


@pytest.mark.slow
def test_samples_cover_all_verdicts() -> None:
    seen = {
        int(code)
        for seed in range(120)
        for code in np.unique(both_verdicts(seed, seed % 6, PHANTOMX, seed % 2, 0.02 + 0.02 * (seed % 3))[0][0])
    }
    assert seen >= {
        roadmap_search.OK,
        roadmap_search.REACH,
        roadmap_search.MARGIN,
        roadmap_search.APART,
        roadmap_search.LEVEL,
        roadmap_search.TORQUE,
        roadmap_search.SWING,
    }


@pytest.mark.slow
def test_each_joint_is_tested_by_the_torque_of_its_own_servo() -> None:
    def verdicts(profile: RobotProfile) -> Array:
        return np.array([both_verdicts(seed, seed % 6, profile, 0, 0.03)[0][0] for seed in range(40)])

    strong, coxa, femur, tibia = map(verdicts, (PHANTOMX, *(weaker(PHANTOMX, joint, 0.6) for joint in JOINTS)))
    np.testing.assert_array_equal(coxa, strong)  # coxas bear no weight
    assert not np.array_equal(femur, strong)
    assert not np.array_equal(tibia, femur)
