"""Robot profiles: values of the file, derived values, and errors."""

import copy
import re
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.files import config
from sextant.shared.geometry import apply
from sextant.shared.robot.body import Body, Foot, LegLinks
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import LEGS, Calibration, Leg, RobotProfile
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.servo import Servo
from sextant.shared.servo.models import MODEL_NAMED

PROFILE = load_profile("phantomx_mk2")
TABLE = config.as_table(PROFILE)


def test_legs_are_in_clockwise_order_and_alternate_in_tripods() -> None:
    assert tuple(leg.name for leg in PROFILE.legs) == LEGS
    mounts = np.array([leg.mount_xyz[:2] for leg in PROFILE.legs])
    headings = np.unwrap(np.arctan2(mounts[:, 1], mounts[:, 0]))
    assert (np.diff(headings) < 0).all()  # clockwise from above
    assert headings[0] - headings[-1] < 2 * np.pi
    for tripod in (mounts[::2], mounts[1::2]):
        a, b, c = tripod
        around = [(b - a)[0] * -a[1] - (b - a)[1] * -a[0], (c - b)[0] * -b[1] - (c - b)[1] * -b[0]]
        assert all(turn < 0 for turn in around)  # the body's centre lies on the inner side of each edge


def test_leg_names_match_mount_positions() -> None:
    for leg in PROFILE.legs:
        side, place = leg.name.split()
        assert (leg.mount_xyz[1] > 0) == (side == "left")
        assert np.sign(leg.mount_xyz[0]) == {"front": 1, "middle": 0, "rear": -1}[place]
        assert all(servo % 2 == (side == "left") for servo in leg.servo_ids)  # the platform numbers its left side odd


@pytest.mark.parametrize("name", profile_names())
def test_packaged_profiles_reach_their_stride(name: str) -> None:
    """Reach the resting place, half a stride ahead and behind, and 2 cm above."""
    profile = load_profile(name)
    assert profile.name == name
    half = profile.stance.stride / 2
    for ahead, up in ((0.0, 0.0), (-half, 0.0), (half, 0.0), (0.0, 0.02)):
        q = body_inverse(profile, profile.rest_feet() + np.array([ahead, 0.0, up]))
        assert within_limits(profile, q).all(), (ahead, up)
    assert profile.servo.stiffness == pytest.approx(profile.servo.nominal_stiffness, rel=0.01)


# Largest error of the depth in the data sheet [1] at a distance [m], horizontal field of view [deg], and baseline [m].
DATA_SHEETS = {
    "d435": (0.02, 2.0, 87.0, 0.050),
    "d405": (0.02, 0.5, 87.0, 0.018),
    "oak": (0.02, 3.0, 73.0, 0.075),
    "gemini2": (0.02, 2.0, 91.0, 0.050),
    "gemini305": (0.01, 0.5, 88.0, 0.018),
}


@pytest.mark.parametrize("name", DATA_SHEETS)
def test_camera_of_packaged_profile_has_noise_and_view_of_its_data_sheet(name: str) -> None:
    share, at_m, view_deg, baseline = DATA_SHEETS[name]
    camera = load_profile(f"phantomx_mk2_{name}").camera
    i, sensor = camera.intrinsics, camera.sensor
    assert float(sensor.sigma(np.array(at_m), i.fx)) / at_m == pytest.approx(share, rel=0.01)
    assert 2 * np.degrees(np.arctan(i.width / 2 / i.fx)) == pytest.approx(view_deg, abs=0.2)
    assert sensor.baseline == baseline


def test_camera_profiles_differ_from_the_plain_one_in_their_camera_alone() -> None:
    for name in ("rgbd", "scanner", *DATA_SHEETS):
        profile = load_profile(f"phantomx_mk2_{name}")
        assert replace(profile, name=PROFILE.name, camera=PROFILE.camera) == PROFILE


def test_profile_may_extend_a_packaged_one_that_extends_another(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('extends = "phantomx_mk2_d435"\nname = "mine"\n[camera]\npitch_down_deg = 33.0\n')
    profile = load_profile(str(tmp_path / "mine.toml"))
    assert profile.camera == replace(load_profile("phantomx_mk2_d435").camera, pitch_down_deg=33.0)
    assert profile.legs == PROFILE.legs


def test_coxa_frames_point_along_neutral_legs() -> None:
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


def test_servo_angles_accept_batches() -> None:
    q = np.random.default_rng(1).normal(size=(4, 6, 3))
    np.testing.assert_array_equal(PROFILE.servo_angles(q)[2], PROFILE.servo_angles(q[2]))


def test_limits_are_ordered_and_contain_straight_leg() -> None:
    limits = PROFILE.joint_limits
    assert limits.shape == (6, 3, 2)
    assert (limits[..., 0] < 0.0).all()
    assert (limits[..., 1] > 0.0).all()
    assert (limits[:, 2, 0] < np.radians(-120)).all()  # tibias fold far under the body


@pytest.mark.parametrize("height", [None, 0.08, 0.13])
def test_rest_feet_touch_ground(height: float | None) -> None:
    feet = PROFILE.rest_feet(height)
    ground = -(PROFILE.stance.body_height if height is None else height)
    np.testing.assert_allclose(feet[:, 2] - PROFILE.foot.radius, ground)
    mounts = np.array([leg.mount_xyz for leg in PROFILE.legs])
    distance = np.linalg.norm((feet - mounts)[:, :2], axis=1)
    by_leg = dict(zip(("front", "middle", "rear"), PROFILE.stance.foot_radius_from_coxa, strict=True))
    np.testing.assert_allclose(distance, [by_leg[name.split()[1]] for name in LEGS])
    outward = (np.hypot(feet[:, 0], feet[:, 1]) - np.hypot(mounts[:, 0], mounts[:, 1])) > 0
    assert outward.all()


def test_camera_points_ahead_and_down() -> None:
    T = PROFILE.camera.T_body_camera
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    pitch = np.radians(PROFILE.camera.pitch_down_deg)
    np.testing.assert_allclose(T[:3, 2], [np.cos(pitch), 0.0, -np.sin(pitch)], atol=1e-15)  # optical axis
    np.testing.assert_allclose(T[:3, 0], [0.0, -1.0, 0.0], atol=1e-15)  # right of the picture is right of the robot
    assert T[2, 1] < 0.0  # its lower edge is lower


@pytest.mark.parametrize(
    ("turned", "rises", "looks"),
    [({"roll_deg": 3.0}, "left", None), ({"roll_deg": -3.0}, "right", None), ({"yaw_deg": 3.0}, None, "left")],
)
def test_camera_turns_about_line_of_sight_and_to_the_left(turned: dict[str, float], rises: str, looks: str) -> None:
    camera = replace(PROFILE.camera, pitch_down_deg=30.0, **turned)
    right, _, ahead = camera.T_body_camera[:3, :3].T
    assert right[2] == pytest.approx({"left": -1, "right": 1, None: 0}[rises] * np.cos(np.radians(30)) * np.sin(np.radians(3)))
    assert ahead[1] == pytest.approx({"left": 1, None: 0}[looks] * np.cos(np.radians(30)) * np.sin(np.radians(3)))
    np.testing.assert_allclose(ahead[2], -np.sin(np.radians(30)))  # the pitch stays


def test_mass_and_damping_follow_from_parts() -> None:
    assert 2.2 <= PROFILE.body.total_mass <= 2.6
    servo = PROFILE.servo
    assert servo.stall_torque - servo.damping * servo.no_load_speed == pytest.approx(0.0)


def test_depth_noise_grows_with_squared_depth() -> None:
    sensor, fx = PROFILE.camera.sensor, PROFILE.camera.intrinsics.fx
    near, far = sensor.sigma(np.array([1.0, 2.0]), fx)
    assert far == pytest.approx(4.0 * near)


def test_points_project_to_their_pixels() -> None:
    k = Intrinsics(8, 6, 10.0, 11.0, 3.5, 2.5)
    depth = np.random.default_rng(2).uniform(0.5, 2.0, (6, 8))
    points = k.points(depth)
    u, v = np.meshgrid(np.arange(8), np.arange(6))
    np.testing.assert_allclose(k.fx * points[..., 0] / points[..., 2] + k.cx, u, atol=1e-12)
    np.testing.assert_allclose(k.fy * points[..., 1] / points[..., 2] + k.cy, v, atol=1e-12)
    with pytest.raises(ValueError, match=r"\(6, 8\) expected, found \(8, 6\)"):
        k.points(depth.T)


LEG = PROFILE.legs[0]
WIDE = (*LEG.servo_limits_deg[:2], (-55.0, 151.0))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: replace(PROFILE.legs[0], servo_limits_deg=((-1.3, 0.8), (-1.7, 1.7), (-2.5, 0.5))),
            r"servo_limits_deg: limits in degrees expected, found \(-1.3, 0.8\) and others, which look like radians",
        ),
        (lambda: LegLinks(0.05, 0.0, 0.1), "femur: a length of 0.001 to 10 m"),
        (lambda: replace(LEG, name="middle"), "name: one of left front"),
        (lambda: replace(LEG, servo_signs=(1, 0, 1)), r"servo_signs\[1\]: a servo sign of 1 or -1"),
        (
            lambda: replace(LEG, servo_limits_deg=((-80.0, 42.0), (10.0, 10.0), (-55.0, 101.0))),
            r"limits_deg\[1\]: limits",
        ),
        (lambda: replace(LEG, servo_limits_deg=((-80.0, 42.0), (-1.0, 1.0), (-55.0, 181.0))), r"limits_deg\[2\]: limits"),
        (
            lambda: replace(PROFILE, legs=(replace(LEG, servo_limits_deg=WIDE), *PROFILE.legs[1:])),
            r"legs\[0\].servo_limits_deg\[2\]: limits within -150 and 150 deg, the range of AX-12A servos, expected",
        ),
        (lambda: replace(PROFILE.servo, position_gain=32), "no position gain for AX-12A servos, which have a compliance slope"),
        (
            lambda: replace(PROFILE.servo, model="MX-28", compliance_slope=0),
            r"a position gain for MX-28 servos \(32 from the factory\) expected, found none",
        ),
        (lambda: replace(LEG, servo_ids=(1, 2, 254)), r"servo_ids\[2\]: a servo id from 0 to 253 expected, found 254"),
        (
            lambda: replace(PROFILE, legs=PROFILE.legs[::-1]),
            r"legs\[5\].name: 'left middle', the order of the legs",
        ),
        (
            lambda: replace(PROFILE, legs=(replace(LEG, servo_ids=(1, 2, 5)), *PROFILE.legs[1:])),
            "18 different servo ids",
        ),
        (lambda: replace(PROFILE.stance, body_height=0.2), "body_height: a body height within"),
        (lambda: replace(PROFILE.stance, max_speed=0.0), "max_speed: more than 0 and"),
        (lambda: Foot(0.0), "radius: a foot radius of more"),
        (lambda: Body((0.2, 0.1, 0.0), 1.0, (0.1, 0.1, 0.1)), r"size\[2\]: an edge of more than 0 and"),
        (lambda: replace(PROFILE.servo, no_load_speed=0.0), "no_load_speed: more than 0 and"),
        (
            lambda: Servo("AX-12A", 1.5, 6.0, 9.0, 0.0, 0.0),
            r"a compliance slope for AX-12A servos \(32 from the factory\) expected, found none",
        ),
        (lambda: Intrinsics(0, 480, 585.0, 585.0, 1.0, 1.0), "width: 1 to 4096 pixels"),
        (lambda: Intrinsics(640, 480, 0.0, 585.0, 1.0, 1.0), "fx: a focal length of 1 to"),
        (lambda: DepthSensor(min_range=2.0, max_range=1.0), "min_range below max_range"),
        (lambda: DepthSensor(baseline=0.0), "baseline: more than 0 and at most 10 m"),
    ],
)
def test_invalid_values_are_refused(make: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_profile_is_found_by_name_and_path(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match=r"no profile 'phantom'; .*phantomx_mk2.*; or give a path"):
        load_profile("phantom")
    with pytest.raises(config.ConfigError, match="no such file"):
        load_profile(str(tmp_path / "my.toml"))
    text = Path(__file__).parents[4].joinpath("shared/robot/profiles/phantomx_mk2.toml").read_text(encoding="utf-8")
    path = tmp_path / "my.toml"
    path.write_text(text.replace('name = "phantomx_mk2"', 'name = "mine"'), encoding="utf-8")
    assert load_profile(str(path)) == replace(PROFILE, name="mine")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("foot_radius_from_coxa = [0.110", "foot_radius_from_coxa = [0.610", "out of the legs' reach for left front"),
        ("pitch_down_deg = 30", "pitch_down_deg = -80", "camera.pitch_down_deg: an angle from -45"),
        (
            "body_height_range = [0.085, 0.15]",
            "body_height_range = [0.05, 0.15]",
            r"stance.body_height_range\[0\]: a height .* \(0.083 to 0.19\d m\) expected, found 0.05 m, out of the legs'",
        ),
        (
            "body_height_range = [0.085, 0.15]",
            "body_height_range = [0.085, 0.3]",
            r"stance.body_height_range\[1\]: .* found 0.3 m, out of the legs' reach for left front, right front, right middle",
        ),
    ],
)
def test_profile_that_cannot_stand_or_see_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = Path(__file__).parents[4].joinpath("shared/robot/profiles/phantomx_mk2.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "my.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(config.ConfigError, match=words):
        load_profile(str(path))


def _at(table: Any, path: str) -> tuple[Any, Any]:
    """Return the container and the key at a path like legs[0].servo_ids[1]."""
    *way, last = [int(key) if key.isdigit() else key for key in re.findall(r"\w+", path)]
    for key in way:
        table = table[key]
    return table, last


# Each is wrong independently of the others: path in the table, invalid value, error message.
MISTAKES: dict[str, tuple[Any, str]] = {
    "servo.stall_torque": (-1.0, "servo.stall_torque: more than 0 and at most 10000 expected, found -1.0"),
    "servo.model": ("AX-19", f"servo.model: one of {', '.join(MODEL_NAMED)}, or another with its numbers"),
    "servo.compliance_slope": (255, "servo.compliance_slope: a compliance slope from 1 to 254 expected, found 255"),
    "servo.armature": ("little", "servo.armature: a number expected, found 'little'"),
    "links.femur": (0.0, "links.femur: a length of 0.001 to 10 m (45 mm are 0.045) expected, found 0.0"),
    "links.tibia": (None, "links.tibia: missing"),
    "links.shin": (0.1, "links.shin: unknown key"),
    "body.size[2]": (-0.1, r"body.size[2]: an edge of more than 0 and at most 10 m (45 mm are 0.045) expected, found -0.1"),
    "body.leg_link_masses": ([0.1, 0.1], "body.leg_link_masses: a list of 3 values expected, found 2"),
    "body.mass": (float("inf"), "body.mass: a finite number expected, found inf"),
    "foot.radius": (-0.01, "foot.radius: a foot radius of more than 0 and at most 1 m (45 mm are 0.045) expected, found -0.01"),
    "stance.body_height": (0.5, "stance.body_height: a body height within its range expected, found body_height = 0.5"),
    "stance.max_speed": (0.0, "stance.max_speed: more than 0 and at most 100 m/s expected, found 0.0"),
    "camera.pitch_down_deg": (120.0, "camera.pitch_down_deg: an angle from -45 (up) to 90 (straight down) expected"),
    "camera.intrinsics.width": (0, "camera.intrinsics.width: 1 to 4096 pixels expected, found 0"),
    "camera.sensor.min_range": (9.0, "camera.sensor.min_range: min_range below max_range expected"),
    "legs[0].servo_ids[1]": (300, "legs[0].servo_ids[1]: a servo id from 0 to 253 expected, found 300"),
    "legs[1].servo_signs[2]": (0, "legs[1].servo_signs[2]: a servo sign of 1 or -1 expected, found 0"),
    "legs[2].servo_limits_deg[1]": ([50.0, 10.0], "legs[2].servo_limits_deg[1]: limits (coxa, femur, tibia) within"),
    "legs[3].name": ("left front", "legs[3].name: 'right rear', the order of the legs around the body, expected"),
    "legs[4].servo_ids[0]": (
        17,
        "legs[5].servo_ids[2]: 18 different servo ids expected, found 17, which legs[4].servo",
    ),
    "legs[5].mount_xyz": ("here", "legs[5].mount_xyz: a list expected, found 'here'"),
    "name": ("", "name: a name expected, found ''"),
}


@given(st.sets(st.sampled_from(sorted(MISTAKES)), min_size=1))
def test_all_errors_are_reported_with_their_keys(made: set[str]) -> None:
    table = copy.deepcopy(TABLE)
    for path in made:
        holder, key = _at(table, path)
        value = MISTAKES[path][0]
        if value is None:
            del holder[key]
        else:
            holder[key] = value
    with pytest.raises(config.ConfigError) as refusal:
        config.build(table, RobotProfile)
    told = refusal.value.problems
    assert len(told) == len(made), told
    for path in made:
        assert sum(problem.startswith(MISTAKES[path][1]) for problem in told) == 1, (path, told)


def test_invalid_horn_offset_causes_one_error_only(tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text('extends = "phantomx_mk2"\nhorn_offsets_deg = [0.0, "", 0.0]\n')
    with pytest.raises(config.ConfigError, match=r"horn_offsets_deg\[1\]: a number expected, found ''"):
        load_profile(str(tmp_path / "my.toml"))


def test_unreachable_stance_is_reported_among_other_errors(tmp_path: Path) -> None:
    text = Path(__file__).parents[4].joinpath("shared/robot/profiles/phantomx_mk2.toml").read_text(encoding="utf-8")
    for old, new in (
        ("foot_radius_from_coxa = [0.110", "foot_radius_from_coxa = [0.610"),
        ("pitch_down_deg = 30", "pitch_down_deg = -80"),
        ("servo_ids = [2, 4, 6]", "servo_ids = [2, 4]"),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "my.toml").write_text(text, encoding="utf-8")
    with pytest.raises(config.ConfigError) as refusal:
        load_profile(str(tmp_path / "my.toml"))
    places = [problem.split(":")[0] for problem in refusal.value.problems]
    assert sorted(places) == ["camera.pitch_down_deg", "legs[1].servo_ids", "stance"]


def test_profile_with_five_legs_is_refused_with_reason() -> None:
    with pytest.raises(config.ConfigError, match="legs: a list of 6 values expected, found 5"):
        config.build(TABLE | {"legs": TABLE["legs"][:5]}, RobotProfile)
    with pytest.raises(config.ConfigError, match=r"legs\[2\].servo_signs: a list of 3"):
        config.build(
            TABLE | {"legs": [*TABLE["legs"][:2], TABLE["legs"][2] | {"servo_signs": [1]}, *TABLE["legs"][3:]]}, RobotProfile
        )


def test_leg_is_hashable_value() -> None:
    assert replace(LEG) == LEG
    assert hash(replace(LEG)) == hash(LEG)
    assert isinstance(LEG, Leg)


# ------------------------------------------------------------------------------------------------------ a calibrated robot

trims = st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3)


@given(st.sets(st.sampled_from(LEGS)), st.data())
def test_trim_changes_servo_angle_at_same_joint_angle(legs: set[str], data: st.DataObject) -> None:
    entries = [Calibration(leg, date(2026, 7, 30), tuple(data.draw(trims))) for leg in sorted(legs)]
    robot = replace(PROFILE, calibration=tuple(entries))
    q = np.random.default_rng(len(legs)).normal(size=(6, 3))
    np.testing.assert_allclose(robot.joint_angles(robot.servo_angles(q)), q, atol=1e-12)
    turned = robot.servo_signs * (robot.servo_angles(q) - PROFILE.servo_angles(q))
    measured = {entry.leg: entry.trims_deg for entry in entries}
    np.testing.assert_allclose(np.degrees(turned), [measured.get(leg, (0.0, 0.0, 0.0)) for leg in LEGS], atol=1e-9)
    np.testing.assert_allclose(robot.joint_limits, PROFILE.joint_limits, atol=1e-12)  # the brackets have not moved


def test_trim_beyond_servo_range_is_refused() -> None:
    legs = tuple(replace(leg, servo_limits_deg=((-150.0, 150.0),) * 3) for leg in PROFILE.legs)
    robot = replace(PROFILE, legs=legs, calibration=(Calibration("left rear", date(2026, 7, 30), (10.0, -10.0, 5.0)),))
    ends = np.stack([robot.servo_angles(robot.joint_limits[..., k]) for k in (0, 1)])
    assert np.abs(np.degrees(ends)).max() <= 150.0 + 1e-9


OWN = """extends = "phantomx_mk2"
name = "mine"

[stance]
body_height = 0.1

[[calibration]]
leg = "right rear"
date = 2026-07-30
trims_deg = [1, -2.0, 3.0]
"""


def test_profile_may_extend_another(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(OWN)
    robot = load_profile(str(own))
    assert robot == replace(
        PROFILE,
        name="mine",
        stance=replace(PROFILE.stance, body_height=0.1),
        calibration=(Calibration("right rear", date(2026, 7, 30), (1.0, -2.0, 3.0)),),
    )
    (tmp_path / "second.toml").write_text('extends = "mine.toml"\nname = "second"\n')
    assert load_profile(str(tmp_path / "second.toml")) == replace(robot, name="second")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('extends = "own.toml"', "another profile expected, found 'own.toml', which extends this one"),
        ('extends = "unknown"', "no profile 'unknown'; known: "),
        ("extends = 3", "extends: the name or path of a profile expected, found 3"),
        ('extends = "nowhere.toml"', "nowhere.toml: no such file"),
        (OWN.replace("3.0]", "31.0]"), "calibration[0].trims_deg[2]: a trim of at most 20 deg either way"),
        (OWN.replace("2026-07-30", "2026-07-30T10:00:00"), "calibration[0].date: a date without time"),
        (OWN.replace("2026-07-30", '"today"'), "calibration[0].date: a date as in 2026-07-30 expected, found 'today'"),
        (OWN.replace("right rear", "rear"), "calibration[0].leg: one of left front"),
        (OWN + OWN[OWN.index("[[") :], "calibration[1].leg: each leg once expected, found 'right rear'"),
    ],
)
def test_errors_of_extended_profile_are_reported(text: str, words: str, tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text(text)
    with pytest.raises(config.ConfigError, match=re.escape(words)):
        load_profile(str(own))


def test_servo_names_are_joint_names() -> None:
    assert list(PROFILE.servo_names) == PROFILE.servo_ids.ravel().tolist()
    assert PROFILE.servo_names[PROFILE.legs[4].servo_ids[1]] == "left rear femur"


@pytest.mark.parametrize("inertia", [(0.001, 0.001, 0.01), (0.0, 0.001, 0.001), (-0.001, 0.002, 0.002), (1e5, 1e5, 1e5)])
def test_inertia_of_no_body_is_refused(inertia: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="inertia"):
        replace(PROFILE.body, inertia=inertia)


def test_moments_of_a_uniform_trunk_are_those_of_a_box() -> None:
    body = replace(PROFILE.body, size=(0.3, 0.2, 0.1), mass=1.2)
    assert body.trunk_inertia == pytest.approx([0.1 * (0.04 + 0.01), 0.1 * (0.09 + 0.01), 0.1 * (0.09 + 0.04)])
