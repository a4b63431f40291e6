"""Check of a profile: shipped robots pass, and each mistake fails with the value that causes it."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.robot_check.foot_lag import foot_lag
from sextant.evaluation.robot_check.gait_cycle import standing_torques, walk_cycle
from sextant.evaluation.robot_check.ground_limits import find_ground_limits, refusal
from sextant.evaluation.robot_check.limit import MIN_MINUTES
from sextant.evaluation.robot_check.remedies import ground_remedy, room_remedy, speed_remedy
from sextant.evaluation.robot_check.robot_check import RobotCheck, check_robot, describe
from sextant.evaluation.robot_check.walking_pace import slow_down, speed_up
from sextant.services.planner.locomotion.gait import GAITS
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import GRAVITY, RobotProfile
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.reach import joint_room
from sextant.shared.servo.protection import Protection

PROFILE = load_profile("phantomx_mk2")


def failures(check: RobotCheck) -> dict[str, str]:
    return {limit.name: limit.sentence for limit in check.limits if not limit.is_met}


def robots() -> list[str]:
    """Return one profile of those that differ only in name and camera, on which the check does not depend."""
    alike = {repr(replace(one, name="robot", camera=PROFILE.camera)): one.name for one in map(load_profile, profile_names())}
    return sorted(alike.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", robots())
def test_shipped_profiles_pass(name: str) -> None:
    check = check_robot(load_profile(name))
    assert check.passes, failures(check)
    text = describe(check)
    assert text.startswith(f"{name}: passes\n")
    assert all(len(line) <= 120 for line in text.splitlines())
    found = json.loads(check.to_json())
    assert found["passes"] is True
    assert {load["gait"] for load in found["loads"]} == {"stand", *GAITS}
    assert all(limit["sentence"] and "value" in limit for limit in found["limits"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "changes", "limit", "words"),
    [
        ("servo", {"stall_torque": 0.5}, "torque, tripod", r"of the stall torque at a femur"),
        ("servo", {"stall_torque": 0.8}, "heat", r"for \d+ min, then a servo reaches 70 deg C"),
        ("servo", {"stiffness": 18.0}, "stiffness", r"servo.stiffness is 18 N m/rad, the setting of the AX-12A gives 9.16"),
        ("servo", {"no_load_speed": 3.0}, "joint speed", "a lower stance.foot_speed slows swings"),
        (
            "servo",
            {"armature": 0.1},
            "lag at touchdown",
            r"\(\w+ gait, body height [\d.]+ cm\).*; a stance.foot_speed of 0\.\d+",
        ),
        ("stance", {"stride": 0.19}, "stride", r"19.0 cm needed; limited by the \w+ \w+ leg, by its coxa joint"),
        ("body", {"centre_of_mass": (0.11, 0.0, 0.0)}, "support margin", "body.centre_of_mass in the middle adds to it"),
    ],
)
def test_mistake_fails_with_the_value_that_causes_it(table: str, changes: dict[str, object], limit: str, words: str) -> None:
    part = replace(getattr(PROFILE, table), **changes)
    check = check_robot(replace(PROFILE, **{table: part}))
    found = failures(check)
    assert limit in found, found
    assert re.search(words, found[limit]), found[limit]


def heavier(profile: RobotProfile, factor: float) -> RobotProfile:
    body = profile.body
    coxa, femur, tibia = (factor * mass for mass in body.leg_link_masses)
    return replace(profile, body=replace(body, mass=factor * body.mass, leg_link_masses=(coxa, femur, tibia)))


@pytest.mark.parametrize("name", profile_names())
def test_standing_torque_is_proportional_to_mass(name: str) -> None:
    profile = load_profile(name)
    feet = profile.rest_feet()
    q = body_inverse(profile, feet)
    once, twice = (standing_torques(heavier(profile, k), q, feet, np.ones(6)) for k in (1.0, 2.0))
    np.testing.assert_allclose(twice, 2.0 * once, rtol=1e-9, atol=1e-12)


def test_standing_torque_of_a_femur_is_load_times_arm() -> None:
    """Six equal legs of a symmetric robot carry a sixth of its weight each; a femur also holds its own leg."""
    stance = replace(PROFILE.stance, foot_radius_from_coxa=(0.12, 0.12, 0.12))
    legs = tuple(
        replace(leg, mount_xyz=(0.1 * math.cos(yaw), 0.1 * math.sin(yaw), 0.0), neutral_yaw_deg=math.degrees(yaw))
        for leg, yaw in zip(PROFILE.legs, np.radians([30, -30, -90, -150, 150, 90]).tolist(), strict=True)
    )
    robot = replace(PROFILE, stance=stance, legs=legs)
    feet = robot.rest_feet()
    torque = standing_torques(robot, body_inverse(robot, feet), feet, np.ones(6))
    np.testing.assert_allclose(torque, np.tile(torque[0], (6, 1)), atol=1e-9)
    load = robot.body.total_mass * GRAVITY / 6
    outward = 0.15 * load * (robot.stance.body_height - robot.foot.radius)
    arm = 0.12 - robot.links.coxa
    own = abs(torque[0, 1]) - abs(-load * arm + outward)
    assert abs(own) < 0.05  # the links' own weight


@pytest.mark.parametrize("gait", list(GAITS))
def test_cycle_is_that_of_the_gait(gait: str) -> None:
    cycle = walk_cycle(PROFILE, gait)
    stands = cycle.share == 1.0
    np.testing.assert_allclose(stands.mean(axis=0), GAITS[gait].duty, atol=0.06)
    assert np.isfinite(cycle.torque).all()
    assert within_limits(PROFILE, cycle.q[stands.all(axis=1)]).all()
    # Standing feet move backwards with the ground, as far as the body moves.
    ahead = np.diff(cycle.feet[..., 0], axis=0)[stands[1:] & stands[:-1]]
    np.testing.assert_allclose(ahead, -cycle.travel / (len(cycle.feet) / len(GAITS[gait].groups)), atol=1e-9)
    # The vertical forces are those of gravity at every moment: without motion, the body would not accelerate.
    assert cycle.speed <= PROFILE.stance.max_speed + 1e-9


@pytest.mark.parametrize("name", ["phantomx_mk2", "printed_sts3215", "printed_ds3218"])
def test_feet_lag_less_with_more_torque_and_at_lower_speed(name: str) -> None:
    robot = load_profile(name)
    low = robot.stance.body_height_range[0]

    def lag(torque: float, speed: float) -> tuple[float, float]:
        servo, stance = robot.servo, robot.stance
        servo = replace(servo, stall_torque=torque * servo.stall_torque, no_load_speed=torque * servo.no_load_speed)
        changed = replace(robot, servo=servo, stance=replace(stance, foot_speed=speed * stance.foot_speed))
        found = foot_lag(changed, walk_cycle(changed, "tripod", low))
        return found.in_air, found.on_ground

    (weak, _), (usual, usual_at_end), (strong, _), (slow, slow_at_end) = (
        lag(*factors) for factors in ((0.5, 1.0), (1.0, 1.0), (4.0, 1.0), (1.0, 0.5))
    )
    assert weak > usual >= strong > slow
    assert usual_at_end > slow_at_end


def test_torque_beyond_the_stall_torque_is_explained() -> None:
    """The path begins faster than an STS3215 can accelerate; the foot is late for an instant, and in place at touchdown."""
    limits = {limit.name: limit for limit in check_robot(load_profile("printed_sts3215")).limits}
    words = limits["lag in the air"].sentence
    assert re.search(r"exact paths need 1\d\d% of the stall torque at a femur .* for \d+ ms, and a servo gives 100%", words)
    found = re.search(r"a stance.foot_speed of ([\d.]+) m/s avoids that", words)
    assert found is not None
    robot = load_profile("printed_sts3215")
    slower = replace(robot, stance=replace(robot.stance, foot_speed=float(found[1])))
    cycle = walk_cycle(slower, "tripod", robot.stance.body_height_range[0])
    assert (np.abs(cycle.torque) <= slower.servos.stall_torque).all()


def test_hot_servos_get_longer_steps_until_they_last() -> None:
    hasty = replace(PROFILE, stance=replace(PROFILE.stance, step_s=0.5, foot_speed=0.9))
    slower = slow_down(hasty)
    assert hasty.stance.step_s < slower.stance.step_s < 2.0
    assert slower.stance.foot_speed < hasty.stance.foot_speed
    servo, cycle = slower.servo, walk_cycle(slower, "tripod")
    duty = cycle.rms_torque.max() / servo.stall_torque
    assert Protection().time_to_reach(servo.temperature_limit, duty) >= 60.0 * MIN_MINUTES
    assert slow_down(PROFILE) == PROFILE


@pytest.mark.slow
def test_longer_legs_pass_higher_steps() -> None:
    longer = replace(PROFILE, links=replace(PROFILE.links, femur=0.085), stance=replace(PROFILE.stance, body_height=0.12))
    usual, high = find_ground_limits(PROFILE), find_ground_limits(longer)
    assert high.riser.passed > usual.riser.passed
    assert usual.riser.refused is not None
    assert usual.riser.reason
    assert usual.gap.passed >= PROFILE.stance.search_radius


@pytest.mark.slow
def test_obstacle_that_is_refused_is_passed_with_the_named_change() -> None:
    assert refusal(PROFILE, "riser", 0.12)
    words = ground_remedy(PROFILE, "riser", 0.12)
    height = re.fullmatch(r"it passes that with a stance.body_height of ([\d.]+) m", words)
    assert height is not None, words
    assert not refusal(replace(PROFILE, stance=replace(PROFILE.stance, body_height=float(height[1]))), "riser", 0.12)
    assert ground_remedy(PROFILE, "gap", 0.4) == "no other stance passes that, and no legs that are 20% longer"


def test_stance_that_is_named_for_joint_room_has_more() -> None:
    cycle = walk_cycle(PROFILE, "tripod")
    room = float(joint_room(PROFILE, cycle.q, cycle.share).min())
    found = re.search(r"with a stance.stride of ([\d.]+) m it is (\d+) deg", room_remedy(PROFILE, room))
    assert found is not None
    changed = replace(PROFILE, stance=replace(PROFILE.stance, stride=float(found[1])))
    cycle = walk_cycle(changed, "tripod")
    more = math.degrees(float(joint_room(changed, cycle.q, cycle.share).min()))
    assert more > math.degrees(room)
    assert more == pytest.approx(float(found[2]), abs=0.5)
    assert "and with" not in room_remedy(PROFILE, math.pi)


def test_faster_robot_is_as_fast_as_its_servos_bear() -> None:
    faster = speed_up(PROFILE)
    assert faster is not None
    speed = walk_cycle(faster, "tripod").speed
    assert speed > walk_cycle(PROFILE, "tripod").speed
    assert f"bear {100 * speed:.1f} cm/s, with a stance.step_s of {faster.stance.step_s:g} s" in speed_remedy(PROFILE)
    assert speed_up(replace(PROFILE, servo=replace(PROFILE.servo, no_load_speed=1.0))) is None


def test_centre_of_mass_is_printed() -> None:
    body = replace(PROFILE.body, centre_of_mass=(0.03, -0.01, 0.02))
    check = check_robot(replace(PROFILE, body=body))
    x, y, z = (100 * part for part in check.centre_of_mass)
    assert 0.0 < x < 3.0
    assert -1.0 < y < 0.0
    assert f"is at x {x:.1f}, y {y:.1f}, z {z:.1f} cm in the body's frame" in describe(check)


def test_heat_rises_to_its_final_temperature() -> None:
    protection = Protection()
    assert math.isinf(protection.time_to_reach(70.0, 1.0 / 3.0))
    final = protection.final_temperature(0.6)
    times = [protection.time_to_reach(limit, 0.6) for limit in (30.0, 70.0, 0.999 * final)]
    assert times == sorted(times)
    assert times[1] == pytest.approx(150.0, rel=0.02)
