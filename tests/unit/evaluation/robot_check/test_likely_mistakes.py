"""Numbers in other units and legs on wrong sides are found, with what they should be; real robots have none."""

from dataclasses import replace
from typing import Any

import pytest

from sextant.evaluation.robot_check.likely_mistakes import doubtful_numbers, misplaced_legs
from sextant.evaluation.robot_check.robot_check import check_robot, describe
from sextant.shared.robot.new_profile import Measures, new_profile
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.servo_proposal import AT_VOLTS, STALL_TORQUES, chosen_servo

PROFILE, HOBBY = load_profile("phantomx_mk2"), load_profile("printed_ds3218")
SMALL = Measures(coxa=0.045, femur=0.06, tibia=0.11, front=0.085, side=0.045, middle=0.07, mass=1.6)


def with_servo(profile: RobotProfile, **changes: float) -> RobotProfile:
    return replace(profile, servo=replace(profile.servo, **changes))  # type: ignore[arg-type]


def with_leg(name: str, **changes: Any) -> RobotProfile:
    legs = tuple(replace(leg, **changes) if leg.name == name else leg for leg in PROFILE.legs)
    return replace(PROFILE, legs=legs)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", profile_names())
def test_shipped_robots_have_no_likely_mistake(name: str) -> None:
    assert not doubtful_numbers(load_profile(name))
    assert not misplaced_legs(load_profile(name))


@pytest.mark.parametrize("model", sorted(STALL_TORQUES))
def test_proposed_robots_have_no_likely_mistake_at_any_voltage(model: str) -> None:
    for volts in (None, *AT_VOLTS.get(model, {})):
        robot = new_profile("robot", SMALL, chosen_servo(model, volts))
        assert not doubtful_numbers(robot)
        assert not misplaced_legs(robot)


@pytest.mark.parametrize("model", sorted(STALL_TORQUES))
def test_known_servo_in_another_unit_is_compared_with_its_data_sheet(model: str) -> None:
    robot = new_profile("robot", SMALL, chosen_servo(model))
    torque, speed = robot.servo.stall_torque, robot.servo.no_load_speed
    for key, value, unit in (
        ("stall_torque", 10.2 * torque, "kg cm"),
        ("stall_torque", 100.0 * torque, "N cm"),
        ("no_load_speed", 9.55 * speed, "rpm"),
        ("no_load_speed", 57.3 * speed, "deg/s"),
        ("no_load_speed", 1.047 / speed, "seconds per 60 deg"),
    ):
        (doubt,) = doubtful_numbers(with_servo(robot, **{key: value}))
        assert doubt.key == f"servo.{key}"
        assert model in doubt.sentence
        assert doubt.sentence.endswith(f": is it in {unit}?")


@pytest.mark.parametrize(
    ("changes", "key", "unit"),
    [
        ({"stall_torque": 20.0}, "stall_torque", "kg cm"),
        ({"stall_torque": 20.0, "stiffness": 200.0}, "stall_torque", "kg cm"),
        ({"no_load_speed": 70.0}, "no_load_speed", "rpm"),
        ({"no_load_speed": 400.0}, "no_load_speed", "deg/s"),
        ({"no_load_speed": 0.14}, "no_load_speed", "seconds per 60 deg"),
        ({"armature": 30.0}, "armature", "kg cm^2 or g cm^2"),
        ({"friction": 0.5}, "friction", "kg cm"),
    ],
)
def test_hobby_servo_beyond_any_servo_is_doubted(changes: dict[str, float], key: str, unit: str) -> None:
    (doubt,) = doubtful_numbers(with_servo(HOBBY, **changes))
    assert doubt.key == f"servo.{key}"
    assert doubt.sentence.endswith(f"is it in {unit}?")


@pytest.mark.parametrize(
    ("table", "changes", "key", "unit"),
    [
        ("servo", {"stiffness": 0.16}, "servo.stiffness", "N m/deg"),
        ("body", {"mass": 908.0}, "body.mass", "in g"),
        ("body", {"leg_link_masses": (70.0, 70.0, 40.0)}, "body.leg_link_masses[0]", "in g"),
        ("body", {"size": (0.24, 0.12, 3.9)}, "body.size[2]", "in cm"),
        ("links", {"femur": 6.6}, "links.femur", "in cm"),
        ("foot", {"radius": 1.0}, "foot.radius", "in cm"),
        ("stance", {"body_height_range": (8.5, 10.0), "body_height": 9.0}, "stance.body_height_range[0]", "in cm"),
        ("stance", {"search_radius": 6.0}, "stance.search_radius", "in cm"),
        ("stance", {"max_speed": 12.0}, "stance.max_speed", "in cm/s"),
        ("stance", {"foot_speed": 37.0}, "stance.foot_speed", "in cm/s"),
        ("camera", {"mount_xyz": (9.0, 0.0, 0.1)}, "camera.mount_xyz[0]", "in cm"),
        ("camera", {"pitch_down_deg": 0.61}, "camera.pitch_down_deg", "in rad"),
    ],
)
def test_number_in_another_unit_is_doubted(table: str, changes: dict[str, Any], key: str, unit: str) -> None:
    first, *_ = doubtful_numbers(replace(PROFILE, **{table: replace(getattr(PROFILE, table), **changes)}))
    assert first.key == key
    assert unit in first.sentence


def test_angles_of_all_legs_in_radians_are_doubted() -> None:
    legs = tuple(replace(leg, neutral_yaw_deg=round(leg.neutral_yaw_deg / 57.3, 3)) for leg in PROFILE.legs)
    assert [doubt.key for doubt in doubtful_numbers(replace(PROFILE, legs=legs))] == ["legs.neutral_yaw_deg"]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("leg", "changes", "words"),
    [
        ("right front", {"mount_xyz": PROFILE.legs[0].mount_xyz}, "left front and right front have one mount_xyz"),
        ("right front", {"neutral_yaw_deg": 45.0}, "the right front leg points inward: its neutral_yaw_deg is 45; should it"),
        ("left middle", {"neutral_yaw_deg": -90.0}, "the left middle leg points inward"),
        ("left rear", {"neutral_yaw_deg": 45.0}, "the left rear leg points forward"),
        ("left front", {"mount_xyz": (0.12, -0.09, 0.0)}, "the left front leg is mounted on the right"),
        ("right rear", {"mount_xyz": (0.11, -0.06, 0.0)}, "the right rear leg is mounted ahead of the body's middle"),
        ("left middle", {"mount_xyz": (0.35, 0.1, 0.0)}, "the resting feet of left middle and left front are not in"),
    ],
)  # fmt: skip
def test_leg_on_a_wrong_side_is_found(leg: str, changes: dict[str, Any], words: str) -> None:
    assert any(sentence.startswith(words) for sentence in misplaced_legs(with_leg(leg, **changes)))


def test_legs_in_all_directions_around_a_round_body_are_in_order() -> None:
    """Check that legs may point straight ahead, and that turned and moved ones of the same order are fine."""
    for turn in (-14.0, 14.0):
        legs = tuple(replace(leg, neutral_yaw_deg=leg.neutral_yaw_deg + turn) for leg in PROFILE.legs)
        assert not misplaced_legs(replace(PROFILE, legs=legs))  # type: ignore[arg-type]
    straight = tuple(replace(leg, neutral_yaw_deg=90.0 if leg.name.startswith("left") else -90.0) for leg in PROFILE.legs)
    assert not misplaced_legs(replace(PROFILE, legs=straight))  # type: ignore[arg-type]
    assert {leg.name for leg in straight} == set(LEGS)


@pytest.mark.slow
def test_check_fails_and_blames_the_wrong_number_only() -> None:
    check = check_robot(with_servo(PROFILE, stall_torque=15.3))
    failures = {limit.name: limit.sentence for limit in check.limits if not limit.is_met}
    assert failures == {"numbers": "servo.stall_torque is 15.3 N m, an AX-12A has 1.5: is it in kg cm?"}
    assert "is not judged" in describe(check)
