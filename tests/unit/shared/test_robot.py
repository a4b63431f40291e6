"""Robot profiles: what the file says, what follows from it, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import config
from shared import dynamixel as dxl
from shared.camera import DepthSensor, Intrinsics
from shared.geometry import apply
from shared.kinematics import body_inverse, within_limits
from shared.robot import LEGS, Body, Foot, Leg, LegLinks, RobotProfile, Servo, load_profile, profile_names

PROFILE = load_profile("phantomx_mk2")
TABLE = config.as_table(PROFILE)


def test_legs_go_once_around_the_body_so_that_every_second_makes_a_tripod() -> None:
    assert tuple(leg.name for leg in PROFILE.legs) == LEGS
    mounts = np.array([leg.mount_xyz[:2] for leg in PROFILE.legs])
    headings = np.unwrap(np.arctan2(mounts[:, 1], mounts[:, 0]))
    assert (np.diff(headings) < 0).all()  # clockwise from above
    assert headings[0] - headings[-1] < 2 * np.pi
    for tripod in (mounts[::2], mounts[1::2]):
        a, b, c = tripod
        around = [(b - a)[0] * -a[1] - (b - a)[1] * -a[0], (c - b)[0] * -b[1] - (c - b)[1] * -b[0]]
        assert all(turn < 0 for turn in around)  # the body's centre lies on the inner side of each edge


def test_names_say_where_the_legs_are() -> None:
    for leg in PROFILE.legs:
        side, place = leg.name.split()
        assert (leg.mount_xyz[1] > 0) == (side == "left")
        assert np.sign(leg.mount_xyz[0]) == {"front": 1, "middle": 0, "rear": -1}[place]
        assert all(servo % 2 == (side == "left") for servo in leg.servo_ids)  # the platform numbers its left side odd


@pytest.mark.parametrize("name", profile_names())
def test_profiles_that_come_along_reach_their_stride(name: str) -> None:
    """At rest and half a stride to either side, down on the ground and lifted off it by 2 cm."""
    profile = load_profile(name)
    assert profile.name == name
    half = profile.stance.stride / 2
    for ahead, up in ((0.0, 0.0), (-half, 0.0), (half, 0.0), (0.0, 0.02)):
        q = body_inverse(profile, profile.rest_feet() + np.array([ahead, 0.0, up]))
        assert within_limits(profile, q).all(), (ahead, up)
    stiffest = profile.servo.stall_torque / (profile.servo.compliance_slope * dxl.TICK_RAD)
    assert profile.servo.stiffness == pytest.approx(stiffest, rel=0.01)


def test_coxa_frames_look_along_the_neutral_legs() -> None:
    for T, T_back, leg in zip(PROFILE.T_body_coxa, PROFILE.T_coxa_body, PROFILE.legs, strict=True):
        yaw = np.radians(leg.neutral_yaw_deg)
        np.testing.assert_allclose(T[:3, 0], [np.cos(yaw), np.sin(yaw), 0.0], atol=1e-15)
        np.testing.assert_allclose(T[:3, 2], [0.0, 0.0, 1.0])
        np.testing.assert_allclose(apply(T, [[0.0, 0.0, 0.0]])[0], leg.mount_xyz)
        np.testing.assert_allclose(T_back @ T, np.eye(4), atol=1e-15)


@given(st.lists(st.floats(-3.0, 3.0), min_size=18, max_size=18))
def test_servo_angles_round_trip(values: list[float]) -> None:
    q = np.array(values).reshape(6, 3)
    np.testing.assert_allclose(PROFILE.joint_angles(PROFILE.servo_angles(q)), q, atol=1e-12)


def test_servo_angles_are_batched() -> None:
    q = np.random.default_rng(1).normal(size=(4, 6, 3))
    np.testing.assert_array_equal(PROFILE.servo_angles(q)[2], PROFILE.servo_angles(q[2]))


def test_limits_rise_and_hold_the_leg_straight_out() -> None:
    limits = PROFILE.joint_limits
    assert limits.shape == (6, 3, 2)
    assert (limits[..., 0] < 0.0).all()
    assert (limits[..., 1] > 0.0).all()
    assert (limits[:, 2, 0] < np.radians(-120)).all()  # tibias fold far under the body


@pytest.mark.parametrize("height", [None, 0.08, 0.13])
def test_resting_feet_touch_the_ground(height: float | None) -> None:
    feet = PROFILE.rest_feet(height)
    ground = -(PROFILE.stance.body_height if height is None else height)
    np.testing.assert_allclose(feet[:, 2] - PROFILE.foot.radius, ground)
    mounts = np.array([leg.mount_xyz for leg in PROFILE.legs])
    distance = np.linalg.norm((feet - mounts)[:, :2], axis=1)
    by_leg = dict(zip(("front", "middle", "rear"), PROFILE.stance.foot_radius_from_coxa, strict=True))
    np.testing.assert_allclose(distance, [by_leg[name.split()[1]] for name in LEGS])
    outward = (np.hypot(feet[:, 0], feet[:, 1]) - np.hypot(mounts[:, 0], mounts[:, 1])) > 0
    assert outward.all()


def test_the_camera_looks_ahead_and_down() -> None:
    T = PROFILE.camera.T_body_camera
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    pitch = np.radians(PROFILE.camera.pitch_down_deg)
    np.testing.assert_allclose(T[:3, 2], [np.cos(pitch), 0.0, -np.sin(pitch)], atol=1e-15)  # optical axis
    np.testing.assert_allclose(T[:3, 0], [0.0, -1.0, 0.0], atol=1e-15)  # right of the picture is right of the robot
    assert T[2, 1] < 0.0  # its lower edge is lower


def test_mass_and_damping_follow_from_the_parts() -> None:
    assert 2.2 <= PROFILE.body.total_mass <= 2.6
    servo = PROFILE.servo
    assert servo.stall_torque - servo.damping * servo.no_load_speed == pytest.approx(0.0)


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    sensor, fx = PROFILE.camera.sensor, PROFILE.camera.intrinsics.fx
    near, far = sensor.sigma(np.array([1.0, 2.0]), fx)
    assert far == pytest.approx(4.0 * near)


def test_points_project_back_to_their_pixels() -> None:
    k = Intrinsics(8, 6, 10.0, 11.0, 3.5, 2.5)
    depth = np.random.default_rng(2).uniform(0.5, 2.0, (6, 8))
    points = k.points(depth)
    u, v = np.meshgrid(np.arange(8), np.arange(6))
    np.testing.assert_allclose(k.fx * points[..., 0] / points[..., 2] + k.cx, u, atol=1e-12)
    np.testing.assert_allclose(k.fy * points[..., 1] / points[..., 2] + k.cy, v, atol=1e-12)
    with pytest.raises(ValueError, match=r"\(6, 8\) expected, found \(8, 6\)"):
        k.points(depth.T)


LEG = PROFILE.legs[0]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LegLinks(0.05, 0.0, 0.1), "positive link lengths"),
        (lambda: replace(LEG, name="middle"), "leg name"),
        (lambda: replace(LEG, servo_signs=(1, 0, 1)), "servo signs of 1 or -1"),
        (lambda: replace(LEG, servo_limits_deg=((-80.0, 42.0), (10.0, 10.0), (-55.0, 101.0))), "femur limits"),
        (lambda: replace(LEG, servo_limits_deg=((-80.0, 42.0), (-1.0, 1.0), (-55.0, 151.0))), "tibia limits"),
        (lambda: replace(LEG, servo_ids=(1, 2, 254)), "servo ids from 0 to 253"),
        (lambda: replace(PROFILE, legs=PROFILE.legs[::-1]), "legs in the order"),
        (lambda: replace(PROFILE, legs=(replace(LEG, servo_ids=(1, 2, 5)), *PROFILE.legs[1:])), r"found \[2\] twice"),
        (lambda: replace(PROFILE.stance, body_height=0.2), "body height within"),
        (lambda: replace(PROFILE.stance, max_speed=0.0), "positive heights"),
        (lambda: Foot(0.0), "foot radius"),
        (lambda: Body((0.2, 0.1, 0.0), 1.0, (0.1, 0.1, 0.1)), "positive size and masses"),
        (lambda: replace(PROFILE.servo, no_load_speed=0.0), "positive torque"),
        (lambda: Servo("AX-12A", 1.5, 6.0, 9.0, 0, 0.0, 0.0), "compliance slope"),
        (lambda: Intrinsics(0, 480, 585.0, 585.0, 1.0, 1.0), "at least 1x1"),
        (lambda: Intrinsics(640, 480, 0.0, 585.0, 1.0, 1.0), "positive focal lengths"),
        (lambda: DepthSensor(min_range=2.0, max_range=1.0), "min_range < max_range"),
        (lambda: DepthSensor(baseline=0.0), "positive rate, baseline"),
    ],
)
def test_nonsense_is_refused(make: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_a_profile_is_found_by_name_and_by_path(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match=r"no profile 'phantom'; known: .*phantomx_mk2.*; or give a path"):
        load_profile("phantom")
    with pytest.raises(config.ConfigError, match="no such file"):
        load_profile(str(tmp_path / "my.toml"))
    text = Path(__file__).parents[3].joinpath("shared/profiles/phantomx_mk2.toml").read_text(encoding="utf-8")
    path = tmp_path / "my.toml"
    path.write_text(text.replace('name = "phantomx_mk2"', 'name = "mine"'), encoding="utf-8")
    assert load_profile(str(path)) == replace(PROFILE, name="mine")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("foot_radius_from_coxa = [0.11", "foot_radius_from_coxa = [0.6", "out of the legs' reach for left front"),
        ("pitch_down_deg = 30", "pitch_down_deg = -80", "camera: a pitch_down_deg from -45"),
    ],
)
def test_a_profile_that_cannot_stand_or_see_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = Path(__file__).parents[3].joinpath("shared/profiles/phantomx_mk2.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "my.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(config.ConfigError, match=words):
        load_profile(str(path))


def test_a_profile_with_five_legs_is_refused_in_words() -> None:
    with pytest.raises(config.ConfigError, match="legs: a list of 6 values expected, found 5"):
        config.build(TABLE | {"legs": TABLE["legs"][:5]}, RobotProfile)
    with pytest.raises(config.ConfigError, match=r"legs\[2\].servo_signs: a list of 3"):
        config.build(
            TABLE | {"legs": [*TABLE["legs"][:2], TABLE["legs"][2] | {"servo_signs": [1]}, *TABLE["legs"][3:]]}, RobotProfile
        )


def test_a_leg_is_a_value() -> None:
    assert replace(LEG) == LEG
    assert hash(replace(LEG)) == hash(LEG)
    assert isinstance(LEG, Leg)
