"""Import of robot descriptions: the same kinematics for any frames, and an error for what does not fit."""

import contextlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.evaluation.robot_check.gait_cycle import walk_cycle
from sextant.shared.files.config import ConfigError
from sextant.shared.geometry import Array, exp_so3, rotation_z, transform
from sextant.shared.robot.body import Body
from sextant.shared.robot.description.profile_import import import_profile, read_legs
from sextant.shared.robot.description.robot_description import (
    DescribedJoint,
    DescribedLink,
    DescriptionError,
    RobotDescription,
    Shape,
    read_urdf,
)
from sextant.shared.robot.horn_assembly import angles_at_centre
from sextant.shared.robot.kinematics import body_forward, body_inverse
from sextant.shared.robot.links import BASE, LINK_RADII_M, hinges
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.robot.profile_proposal import proposed_stance
from sextant.shared.robot.profile_text import profile_text, write_new_profile
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.reach import joint_room
from sextant.shared.robot.urdf import urdf

PROFILE = load_profile("phantomx_mk2")
TRUNK = Shape("box", np.eye(4), (0.12, 0.06, 0.02))
TRUNK_INERTIA, LINK_INERTIA = np.array([0.003, 0.005, 0.007]), 0.00012


def described(profile: RobotProfile, seed: int | None = None, bend: float = 0.0) -> RobotDescription:
    """Describe a robot with arbitrary frames: each is turned at random, and some axes point the other way.

    With a `bend` [rad], femur and tibia are bent at joint angle zero.
    """
    rng = np.random.default_rng(seed)
    links, joints, turned = (
        {BASE: DescribedLink(BASE, 1.4, inertia=np.diag(TRUNK_INERTIA), shapes=(TRUNK,))},
        [],
        {BASE: np.eye(4)},
    )
    for k, joint in enumerate(hinges(profile)):
        axis = np.array(joint.axis)
        G = np.eye(4) if seed is None else transform(exp_so3(rng.uniform(-2.0, 2.0, 3)), np.zeros(3))
        sign = 1.0 if seed is None else rng.choice([-1.0, 1.0])
        at_zero = bend if k % 3 else 0.0
        T = joint.T_parent_child @ transform(exp_so3(at_zero * axis), np.zeros(3)) @ G
        low, high = np.sort(sign * (profile.joint_limits.reshape(18, 2)[k] - at_zero)).tolist()
        joints.append(
            DescribedJoint(
                joint.name,
                joint.parent,
                joint.child,
                np.linalg.inv(turned[joint.parent]) @ T,
                G[:3, :3].T @ (sign * axis),
                limits=(low, high),
                effort=1.5,
                speed=6.178,
            )
        )
        turned[joint.child] = G
        length = (profile.links.coxa, profile.links.femur, profile.links.tibia)[k % 3]
        tip = np.linalg.inv(G)[:3, :3] @ [length, 0.0, 0.0]
        marks = {"foot": tip} if k % 3 == 2 else {}
        inertia = LINK_INERTIA * (np.eye(3) - 0.9 * np.outer(tip, tip) / (tip @ tip))
        links[joint.child] = DescribedLink(joint.child, 0.06, tip / 2, inertia, marks=marks)
    return RobotDescription("any", links, tuple(joints))


@pytest.mark.parametrize("name", profile_names())
def test_exported_urdf_is_imported_with_the_same_kinematics(name: str, tmp_path: Path) -> None:
    robot = load_profile(name)
    board = robot.servo.pulses.board if robot.servo.pulses else None  # hobby servos are not looked for
    found = import_profile(read_urdf(urdf(robot)), servo=board)
    assert found.foot_error < 1e-9
    q = np.random.default_rng(0).uniform(robot.joint_limits[..., 0], robot.joint_limits[..., 1], (100, 6, 3))
    write_new_profile(tmp_path / "robot.toml", found.profile)
    again = load_profile(str(tmp_path / "robot.toml"))
    np.testing.assert_allclose(body_forward(again, q), body_forward(robot, q), atol=1e-6)
    np.testing.assert_allclose(again.joint_limits, robot.joint_limits, atol=2e-6)
    for part in ("mass", "leg_link_masses", "size", "centre_of_mass"):
        np.testing.assert_allclose(getattr(again.body, part), getattr(robot.body, part), atol=1e-6)
    np.testing.assert_allclose(again.body.trunk_inertia, robot.body.trunk_inertia, rtol=1e-4)
    for joint in range(3):
        across = [body.link_inertia(joint, 0.05, 0.01)[1:] for body in (again.body, export_body(robot))]
        np.testing.assert_allclose(*across, rtol=1e-3)
    assert (again.servo.model, again.servo.stall_torque) == (robot.servo.model, robot.servo.stall_torque)
    assert again.foot == robot.foot
    np.testing.assert_allclose(again.camera.T_body_camera, robot.camera.T_body_camera, atol=1e-5)


def export_body(robot: RobotProfile) -> Body:
    """Return the body with the inertias of the links that are exported."""
    lengths = (robot.links.coxa, robot.links.femur, robot.links.tibia - robot.foot.radius)
    across = [robot.body.link_inertia(k, lengths[k], LINK_RADII_M[k])[1] for k in range(3)]
    return replace(robot.body, leg_link_inertias=(across[0], across[1], across[2]))


@given(st.integers(0, 2**32 - 1), st.floats(-0.8, 0.8))
@settings(max_examples=25)
def test_frames_signs_and_zero_angles_of_a_description_do_not_matter(seed: int, bend: float) -> None:
    found = import_profile(described(PROFILE, seed, bend))
    assert found.foot_error < 1e-6
    for part in ("coxa", "femur", "tibia"):
        assert getattr(found.profile.links, part) == pytest.approx(getattr(PROFILE.links, part), abs=1e-6)
    q = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 6, 3))
    np.testing.assert_allclose(body_forward(found.profile, q), body_forward(PROFILE, q), atol=1e-6)
    np.testing.assert_allclose(found.profile.joint_limits, PROFILE.joint_limits, atol=5e-6)
    np.testing.assert_allclose(found.profile.body.inertia, TRUNK_INERTIA, atol=1e-9)
    np.testing.assert_allclose(found.profile.body.leg_link_inertias, LINK_INERTIA, atol=1e-9)
    assert found.joints["right rear"] == ("right_rear_coxa", "right_rear_femur", "right_rear_tibia")


def with_trunk(link: DescribedLink, *parts: DescribedJoint, **links: DescribedLink) -> RobotDescription:
    description = described(PROFILE)
    return replace(description, links={**description.links, BASE: link, **links}, joints=(*description.joints, *parts))


def test_inertia_of_a_trunk_of_two_parts_is_about_their_common_centre() -> None:
    """Two plates of 0.7 kg, 0.1 m apart along x: the moments around y and z grow by 2 * 0.7 * 0.05^2."""
    plate = DescribedLink(BASE, 0.7, np.array([0.05, 0.0, 0.0]), np.diag([0.001, 0.001, 0.001]), (TRUNK,))
    turned = transform(rotation_z(np.pi / 2), [-0.05, 0.0, 0.0])
    other = DescribedLink("other", 0.7, np.zeros(3), np.diag([0.001, 0.002, 0.001]))
    found = import_profile(with_trunk(plate, DescribedJoint("mount", BASE, "other", turned), other=other))
    np.testing.assert_allclose(found.profile.body.inertia, (0.003, 0.0055, 0.0055), atol=1e-9)
    np.testing.assert_allclose(found.profile.body.centre_of_mass, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("inertia", "words", "kept"),
    [
        (np.zeros((3, 3)), "states no inertia of the trunk", 0.0),
        (np.diag([0.001, 0.001, 0.01]), "inertia is that of no body", 0.0),
        (np.array([[0.004, 0.001, 0.0], [0.001, 0.004, 0.0], [0.0, 0.0, 0.006]]), "axes of inertia are turned", 0.004),
    ],
)
def test_inertia_that_a_profile_cannot_hold_is_said(inertia: Array, words: str, kept: float) -> None:
    found = import_profile(with_trunk(DescribedLink(BASE, 1.4, inertia=inertia, shapes=(TRUNK,))))
    assert found.profile.body.inertia[0] == kept
    assert any(words in note for note in found.notes)


def test_turned_robot_is_imported_by_its_front() -> None:
    straight = described(PROFILE)
    turn = transform(rotation_z(np.pi / 2), np.zeros(3))
    joints = tuple(
        replace(joint, T_parent_child=turn @ joint.T_parent_child) if joint.parent == BASE else joint
        for joint in straight.joints
    )
    found = import_profile(replace(straight, joints=joints), forward="y")
    np.testing.assert_allclose(found.profile.T_body_coxa, PROFILE.T_body_coxa, atol=1e-6)
    words = "found 2 and 2; state the robot's front with --forward y or --forward -y$"
    for forward in ("x", "-x"):
        with pytest.raises(DescriptionError, match=words):
            import_profile(replace(straight, joints=joints), forward=forward)


def test_trunk_of_meshes_is_in_the_middle_of_the_coxa_axes() -> None:
    """The first link may be a footprint on the ground."""
    bare = with_trunk(DescribedLink(BASE, 1.4, inertia=np.diag(TRUNK_INERTIA)))
    below_body = DescribedJoint("footprint", "ground", BASE, transform(np.eye(3), [0.02, 0.0, 0.12]))
    on_ground = replace(bare, links={"ground": DescribedLink("ground"), **bare.links}, joints=(below_body, *bare.joints))
    alone, whole = import_profile(bare).profile, import_profile(on_ground)
    np.testing.assert_allclose(whole.profile.T_body_coxa, PROFILE.T_body_coxa, atol=1e-6)
    assert (whole.profile.body, whole.profile.stance) == (alone.body, alone.stance)
    assert any("the middle of the trunk, (0.0200, 0.0000, 0.1200) m" in note for note in whole.notes)


def changed(change: Callable[[DescribedJoint], DescribedJoint | None]) -> RobotDescription:
    description = described(PROFILE)
    kept = [new for joint in description.joints if (new := change(joint)) is not None]
    links = {BASE, *(joint.child for joint in kept)}
    return replace(description, joints=tuple(kept), links={k: v for k, v in description.links.items() if k in links})


def named(name: str, **changes: object) -> Callable[[DescribedJoint], DescribedJoint]:
    return lambda joint: replace(joint, **changes) if joint.name == name else joint  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("description", "words"),
    [
        (
            lambda: changed(lambda joint: None if joint.name.startswith("left_rear") else joint),
            r"six legs of three joints at the trunk expected, found 5 \(left_front_coxa-",
        ),
        (
            lambda: changed(named("left_rear_tibia", axis=None)),
            "six legs of three joints at the trunk expected, found 6 .*name the 18 joints",
        ),
        (
            lambda: changed(named("left_rear_coxa", axis=np.array([1.0, 0.0, 0.0]))),
            r"left rear leg, joint left_rear_coxa: a vertical coxa axis expected, found \(-0.707, 0.707, 0.000\)",
        ),
        (
            lambda: changed(named("left_rear_femur", axis=np.array([0.0, 0.0, 1.0]))),
            "left rear leg, joint left_rear_femur: a horizontal axis expected",
        ),
        (
            lambda: changed(named("left_rear_tibia", axis=np.array([1.0, 0.0, 0.0]))),
            "left rear leg, joint left_rear_tibia: an axis parallel to that of left_rear_femur expected",
        ),
        (
            lambda: changed(named("left_rear_tibia", T_parent_child=transform(np.eye(3), (0.08, 0.0, 0.0)))),
            "six legs of one size expected, found femur lengths of 0.0660 to 0.0800 m",
        ),
        (
            lambda: changed(named("left_rear_tibia", T_parent_child=transform(np.eye(3), (0.066, 0.02, 0.0)))),
            "a foot in the plane of coxa axis and leg expected, found it 20 mm off it",
        ),
        (
            lambda: changed(named("left_middle_coxa", T_parent_child=transform(np.eye(3), (0.0, 0.0, 0.0)))),
            "three legs on the left of the robot and three on the right expected, found 2 and 3; name its legs with --joints",
        ),
        (
            lambda: changed(named("left_rear_coxa", axis=None, other="prismatic")),
            r"found 6 \(.*; of other kinds: left_rear_coxa \(prismatic\)\); name the 18 joints",
        ),
        (
            lambda: changed(named("left_rear_tibia", limits=(-100.0, 30.0))),
            "left rear leg, joint left_rear_tibia: limits in radians expected, found -100 and 30, which look like degrees",
        ),
        (lambda: changed(named("left_rear_coxa", parent="nowhere")), "joint left_rear_coxa: no link 'nowhere'"),
    ],
)
def test_what_does_not_fit_is_an_error(description: Callable[[], RobotDescription], words: str) -> None:
    with pytest.raises(DescriptionError, match=words):
        import_profile(description())


def test_description_without_masses_or_feet_is_an_error() -> None:
    whole = described(PROFILE)
    no_mass = {name: replace(link, mass=0.0) for name, link in whole.links.items()}
    with pytest.raises(DescriptionError, match="a mass of the trunk and of each link"):
        import_profile(replace(whole, links=no_mass))
    no_feet = replace(whole, links={name: replace(link, marks={}) for name, link in whole.links.items()})
    with pytest.raises(DescriptionError, match="give the foot's centre in the frame of that link with --foot"):
        import_profile(no_feet)
    found = import_profile(no_feet, foot=(PROFILE.links.tibia, 0.0, 0.0))
    assert found.profile.links == PROFILE.links


def below(link: str, *chain: DescribedJoint) -> RobotDescription:
    """Describe a robot with more joints in a row below a link; each carries a link of 0.1 kg with the joint's name."""
    whole = described(PROFILE)
    parents = [link, *(joint.name for joint in chain)]
    joints = [replace(joint, parent=parent, child=joint.name) for parent, joint in zip(parents, chain, strict=False)]
    more = {joint.name: DescribedLink(joint.name, 0.1) for joint in joints}
    return replace(whole, links={**whole.links, **more}, joints=(*whole.joints, *joints))


def turning(name: str, limits: tuple[float, float] | None = None) -> DescribedJoint:
    return DescribedJoint(name, "", "", np.eye(4), np.array([0.0, 0.0, 1.0]), limits=limits)


def sliding(name: str) -> DescribedJoint:
    return DescribedJoint(name, "", "", np.eye(4), other="prismatic")


@pytest.mark.parametrize(
    ("chain", "listed"),
    [
        ([turning("pan", limits=(-90.0, 90.0))], "pan"),
        ([turning("pan"), turning("tilt")], "pan, tilt"),
        ([sliding("lift")], r"lift \(prismatic\)"),
        ([sliding("lift"), turning("pan")], r"lift \(prismatic\), pan"),
        ([turning(f"arm {k}") for k in range(5)], "arm 0, arm 1, arm 2, arm 3, arm 4"),
    ],
)
def test_joints_of_head_and_arm_are_fixed_and_noted(chain: list[DescribedJoint], listed: str) -> None:
    found = import_profile(below(BASE, *chain))
    assert found.profile.links == PROFILE.links
    assert found.profile.body.mass == pytest.approx(1.4 + 0.1 * len(chain))
    assert [note for note in found.notes if re.fullmatch(f"joints that are not of a leg are fixed at zero: {listed}", note)]


def test_spring_below_a_leg_is_fixed_and_one_in_a_leg_is_an_error(tmp_path: Path) -> None:
    found = import_profile(below("left_rear_tibia_link", sliding("spring")))
    assert "joints that are not of a leg are fixed at zero: spring (prismatic)" in found.notes
    assert import_profile(described(PROFILE)).notes[0] != found.notes[0]
    whole = below("left_rear_femur_link", sliding("spring"))
    sprung = replace(
        whole, joints=tuple(replace(j, parent="spring") if j.name == "left_rear_tibia" else j for j in whole.joints)
    )
    with pytest.raises(
        DescriptionError, match="left rear leg, joint spring: a hinge or a fixed joint expected, found prismatic"
    ):
        import_profile(sprung)


def test_robot_that_floats_in_a_world_is_that_without_the_world() -> None:
    text, place = urdf(PROFILE), '<origin xyz="0.1 0 0.2" rpy="0 0 0.3"/>'
    world = (
        f'<link name="world"/><joint name="free" type="floating">{place}<parent link="world"/><child link="{BASE}"/></joint>'
    )
    alone, floating = (import_profile(read_urdf(t)) for t in (text, text.replace("</robot>", f"{world}</robot>")))
    assert floating.profile == alone.profile
    assert floating.notes == alone.notes
    back = f'<joint name="back" type="floating"><parent link="{BASE}"/><child link="world"/></joint>'
    loop = text.replace("</robot>", f"{world}{back}</robot>")
    with pytest.raises(DescriptionError, match="one link without a parent expected, found none"):
        import_profile(read_urdf(loop))


def test_table_of_joints_names_legs_and_leaves_other_hinges_out(tmp_path: Path) -> None:
    with_mast = below(BASE, turning("pan"), turning("tilt"), turning("roll"))
    with pytest.raises(DescriptionError, match=r"found 7 \(.*pan-tilt-roll"):
        import_profile(with_mast)
    parts = ("coxa", "femur", "tibia")
    lines = [f'"{leg}" = {[leg.replace(" ", "_") + "_" + part for part in parts]}' for leg in LEGS]
    path = tmp_path / "joints.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    found = import_profile(with_mast, read_legs(path).joints)
    assert found.profile.body.mass == pytest.approx(1.7)
    assert found.foot_error < 1e-9
    for bad, words in (
        (lines[1:], "left front: the names of coxa, femur, tibia joint expected, found None"),
        ([*lines, "arm = 3"], "no leg 'arm'"),
        ([lines[0].replace("left_front_femur", "left_front_coxa"), *lines[1:]], "each joint once expected"),
    ):
        path.write_text("\n".join(bad), encoding="utf-8")
        with pytest.raises(DescriptionError, match=words):
            read_legs(path)
    path.write_text("\n".join(lines).replace("left_front_femur", "left_front_femurr"), encoding="utf-8")
    with pytest.raises(DescriptionError, match="no hinge 'left_front_femurr'; did you mean 'left_front_femur'"):
        import_profile(with_mast, read_legs(path).joints)


def test_joints_without_limits_are_named() -> None:
    assert not [note for note in import_profile(described(PROFILE)).notes if "no limits" in note]
    one = import_profile(changed(named("left_rear_tibia", limits=None))).notes
    every = import_profile(changed(lambda joint: replace(joint, limits=None))).notes
    for notes, which in ((one, "left_rear_tibia"), (every, "any joint")):
        assert any(note.startswith(f"the description has no limits of {which}: set") for note in notes)


def test_angles_at_which_horns_are_mounted_are_stated_for_servos_on_a_bus() -> None:
    found = import_profile(described(PROFILE), servo="LX-16A")
    angles = angles_at_centre(found.profile)
    assert f"screw the horns on with each servo at its centre and its joint at: {angles}" in found.notes


def test_torque_and_speed_that_no_servo_has_are_those_of_the_model() -> None:
    whole = described(PROFILE)
    unlimited = tuple(replace(joint, effort=100.0, speed=100.0) if joint.axis is not None else joint for joint in whole.joints)
    found = import_profile(replace(whole, joints=unlimited), servo="MX-28")
    assert found.profile.servo.stall_torque == 2.5
    assert found.profile.servo.no_load_speed < 10.0
    notes = [note for note in found.notes if note.startswith("no servo has")]
    assert notes == [f"no servo has 100 {unit}: the value of the servo model is used" for unit in ("N m", "rad/s")]


@pytest.mark.parametrize("board", ["maestro", "pca9685"])
def test_hobby_servos_at_a_board_have_torque_and_speed_of_the_description(board: str) -> None:
    found = import_profile(described(PROFILE), servo=board)
    usual, servo = load_profile("printed_ds3218"), found.profile.servo
    assert servo.pulses is not None
    assert (servo.pulses.board, servo.stall_torque, servo.no_load_speed) == (board, 1.5, 6.178)
    assert servo.stiffness / servo.stall_torque == pytest.approx(usual.servo.stiffness / usual.servo.stall_torque)
    assert found.profile.battery == usual.battery
    assert sorted(found.profile.servo_names) == list(range(18))
    assert np.abs(np.degrees(found.profile.joint_limits) + [[h] * 2 for h in found.profile.horn_offsets_deg]).max() <= 135.0
    for words in ("are those of a DS3218", "channels are 0 to 17", "screw the horns on with each servo at its centre"):
        assert len([note for note in found.notes if words in note]) == 1


def test_servos_of_a_profile_or_a_file_are_taken_as_they_are(tmp_path: Path) -> None:
    for name in ("printed_ds3218", "lotriet_rx64"):
        found, other = import_profile(described(PROFILE), servo=name).profile, load_profile(name)
        assert (found.servo, found.battery) == (other.servo, other.battery)
    path = tmp_path / "servo.toml"
    path.write_text('[servo]\nmodel = "MX-28"\nstall_torque = 2.3\n[battery]\nwarn_voltage = 9.0\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"battery: .*empty_voltage"):
        import_profile(described(PROFILE), servo=str(path))
    path.write_text('[servo]\nmodel = "MX-28"\nstall_torque = 2.3\n', encoding="utf-8")
    found = import_profile(described(PROFILE), servo=str(path)).profile
    assert (found.servo.model, found.servo.stall_torque) == ("MX-28", 2.3)
    assert found.servo_names[1] == "left front coxa"
    with pytest.raises(ConfigError, match="for hobby servos maestro or pca9685"):
        import_profile(described(PROFILE), servo="MG996R")


def test_proposed_stride_leaves_room_for_coxae_that_hardly_turn() -> None:
    legs = tuple(replace(leg, servo_limits_deg=((-25.0, 25.0), *leg.servo_limits_deg[1:])) for leg in PROFILE.legs)
    robot = replace(PROFILE, legs=legs, calibration=())
    robot = replace(robot, stance=proposed_stance(robot))
    cycle = walk_cycle(robot, "tripod", robot.stance.body_height)
    assert joint_room(robot, cycle.q, cycle.share)[0] > 0.0


@pytest.mark.parametrize("most_bend", [1.6, 1.8, 2.4])
def test_knees_are_bent_at_the_greatest_proposed_height(most_bend: float) -> None:
    """Joints of a leg that is nearly straight turn faster than servos can, as soon as its foot swings."""

    def stiff(joint: DescribedJoint) -> DescribedJoint:
        return replace(joint, limits=(-most_bend, 0.5)) if "tibia" in joint.name else joint

    robot = import_profile(changed(stiff)).profile
    low, high = robot.stance.body_height_range
    assert low <= robot.stance.body_height <= high
    assert (np.abs(body_inverse(robot, robot.rest_feet(high))[:, 2]) > 0.69).all()


def test_feet_of_a_table_may_differ_between_legs(tmp_path: Path) -> None:
    """Last links with frames of any yaw, and meshes only: no one point is the foot of all legs."""
    whole = described(PROFILE)
    bare = {name: replace(link, marks={}) for name, link in whole.links.items()}
    joints, feet = [], ["[feet]"]
    turned = list(whole.joints)
    for k, leg in enumerate(LEGS):
        name = leg.replace(" ", "_")
        joints.append(f'"{leg}" = {[f"{name}_{part}" for part in ("coxa", "femur", "tibia")]}')
        at = next(i for i, joint in enumerate(turned) if joint.name == f"{name}_tibia")
        turn = np.eye(4)
        turn[:3, :3] = exp_so3(np.array([0.3 * k, -0.2 * k, 0.5 * k]))
        # The joint's frame turns, and its axis and foot are given in the turned frame.
        axis = turned[at].axis
        assert axis is not None
        turned[at] = replace(turned[at], T_parent_child=turned[at].T_parent_child @ turn, axis=turn[:3, :3].T @ axis)
        feet.append(f'"{leg}" = {(turn[:3, :3].T @ [PROFILE.links.tibia, 0.0, 0.0]).tolist()}')
    path = tmp_path / "legs.toml"
    path.write_text("\n".join([*joints, *feet]), encoding="utf-8")
    legs = read_legs(path)
    found = import_profile(replace(whole, links=bare, joints=tuple(turned)), legs.joints, legs.feet)
    assert found.profile.links == PROFILE.links
    assert found.foot_error < 1e-6
    path.write_text("\n".join(feet), encoding="utf-8")  # joints are guessed
    assert read_legs(path) == ({}, legs.feet)
    guessed = import_profile(replace(whole, links=bare, joints=tuple(turned)), None, read_legs(path).feet)
    assert guessed.profile == found.profile
    with pytest.raises(DescriptionError, match=r"mm off it; .* state each foot in \[feet\] of --joints"):
        import_profile(replace(whole, links=bare, joints=tuple(turned)), foot=(PROFILE.links.tibia, 0.0, 0.0))
    for bad, words in (
        (feet[:-1], "feet: a table with the foot of each leg expected"),
        ([*feet[:-1], f'"{LEGS[-1]}" = [0.1, "a", 0.0]'], r"its centre \[x, y, z\] in metres expected"),
    ):
        path.write_text("\n".join([*joints, *bad]), encoding="utf-8")
        with pytest.raises(DescriptionError, match=words):
            read_legs(path)


EXPAND = "URDF expected, found Xacro; expand it first .*xacro FILE > robot.urdf"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<robot", "XML expected"),
        ("<mujoco/>", "a <robot> of URDF expected, found <mujoco>"),
        ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="leg.xacro"/></robot>', EXPAND),
        ('<robot><xacro:leg name="left_front"/></robot>', EXPAND),
        ('<robot><link name="a"><inertial><mass value="${m / 2}"/></inertial></link></robot>', EXPAND),
        ('<robot><joint name="j" type="revolute"/></robot>', "joint j: <parent> and <child> expected"),
        (
            '<robot><joint name="j" type="hinge"><parent link="a"/><child link="b"/></joint></robot>',
            "joint j: a type of URDF expected, such as revolute or fixed, found 'hinge'",
        ),
        (
            '<robot><joint name="j" type="fixed"><origin xyz="1 2"/><parent link="a"/><child link="b"/></joint></robot>',
            "joint j: three numbers of at most .* expected in xyz, found '1 2'",
        ),
        (
            '<robot><joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
            '<limit lower="1" upper="0"/></joint></robot>',
            "joint j: a lower limit below the upper one expected, found 1 and 0",
        ),
        (
            '<robot><link name="a"><inertial><mass value="heavy"/></inertial></link></robot>',
            "link a: a number of at most .* expected in value",
        ),
        ("<robot/>", "one link without a parent expected, found none"),
    ],
)
def test_invalid_urdf_is_an_error(text: str, words: str) -> None:
    with pytest.raises(DescriptionError, match=words):
        import_profile(read_urdf(text))


TOKENS = re.split(r'("[^"]*")', urdf(PROFILE))
WRONG = [
    "",
    "nan",
    "1e308",
    "-1",
    "0",
    "0 0 0",
    "9 9 9",
    "1e9 0 0",
    "left_rear_coxa_link",
    "base_link",
    "fixed",
    "continuous",
    "x",
]


@given(st.dictionaries(st.integers(0, len(TOKENS) // 2 - 1), st.sampled_from(WRONG), min_size=1, max_size=3))
@settings(max_examples=60)
def test_wrong_values_give_a_profile_or_a_reason(changes: dict[int, str]) -> None:
    tokens = list(TOKENS)
    for place, value in changes.items():
        tokens[2 * place + 1] = f'"{value}"'
    with contextlib.suppress(DescriptionError):
        import_profile(read_urdf("".join(tokens)))


def test_expanded_xacro_is_urdf() -> None:
    """The program xacro writes its own name in a comment, and may keep its namespace."""
    text = urdf(PROFILE).replace("<robot ", '<robot xmlns:xacro="http://ros.org/wiki/xacro" ')
    comment = "<!-- This document was autogenerated by xacro from robot.xacro; <xacro:leg/> of ${length} -->"
    assert import_profile(read_urdf(text.replace("</robot>", f"{comment}</robot>"))).profile.links == PROFILE.links


def test_entities_do_not_expand_without_limit() -> None:
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "ten letter"}">' for i in range(10))
    with pytest.raises(DescriptionError, match="XML expected"):
        read_urdf(f"<!DOCTYPE robot [{entities}]><robot>&e9;</robot>")


@pytest.mark.parametrize("name", profile_names())
def test_text_of_a_profile_is_read_as_the_same_profile(name: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    profile = replace(load_profile(name), name='a "robot" \\ of\tthe house')
    path.write_text(profile_text(profile, ["one", "two"]), encoding="utf-8")
    assert load_profile(str(path)) == profile
