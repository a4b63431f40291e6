"""URDF and frames of every bundled profile: a tree of links, whose feet are where the kinematics has them."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest

from sextant.shared.geometry import Array, apply, exp_so3, from_xyz_rpy, transform
from sextant.shared.robot.kinematics import leg_forward
from sextant.shared.robot.links import JOINT_NAMES, fixed_joints, hinges, posed
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.urdf import urdf

PROFILES = [load_profile(name) for name in profile_names()]
by_profile = pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)


def numbers(element: ET.Element | None, key: str) -> list[float]:
    assert element is not None
    return [float(word) for word in element.attrib[key].split()]


def frames(robot: ET.Element, angles: dict[str, float]) -> dict[str, Array]:
    """Return the pose (4, 4) {base_link} of each link, by the rules of URDF alone."""
    poses = {"base_link": np.eye(4)}
    waiting = list(robot.iter("joint"))
    while waiting:
        ready = [joint for joint in waiting if joint.find("parent").attrib["link"] in poses]  # type: ignore[union-attr]
        assert ready, "a joint hangs in the air"
        for joint in ready:
            origin = joint.find("origin")
            T = from_xyz_rpy(numbers(origin, "xyz"), numbers(origin, "rpy"))
            if joint.attrib["type"] == "revolute":
                axis = np.array(numbers(joint.find("axis"), "xyz"))
                T = T @ transform(exp_so3(angles[joint.attrib["name"]] * axis), np.zeros(3))
            poses[joint.find("child").attrib["link"]] = poses[joint.find("parent").attrib["link"]] @ T  # type: ignore[union-attr]
            waiting.remove(joint)
    return poses


def random_angles(profile: RobotProfile, seed: int) -> Array:
    limits = profile.joint_limits
    return np.random.default_rng(seed).uniform(limits[..., 0], limits[..., 1])


def feet(profile: RobotProfile, q: Array) -> Array:
    return np.array([apply(T, foot) for T, foot in zip(profile.T_body_coxa, leg_forward(q, profile.links), strict=True)])


@by_profile
def test_urdf_is_one_tree_of_unique_links(profile: RobotProfile) -> None:
    robot = ET.fromstring(urdf(profile))
    links = [link.attrib["name"] for link in robot.findall("link")]
    children = [joint.find("child").attrib["link"] for joint in robot.findall("joint")]  # type: ignore[union-attr]
    assert len(set(links)) == len(links) == 1 + 18 + 6 + 1
    assert sorted(["base_link", *children]) == sorted(links), "each link but the base has one parent"
    assert set(frames(robot, dict.fromkeys(JOINT_NAMES, 0.0))) == set(links)
    assert [joint.attrib["name"] for joint in robot.findall("joint") if joint.attrib["type"] == "revolute"] == list(JOINT_NAMES)


@by_profile
def test_feet_and_camera_of_urdf_are_where_profile_has_them(profile: RobotProfile) -> None:
    robot = ET.fromstring(urdf(profile))
    for seed in range(5):
        q = random_angles(profile, seed)
        poses = frames(robot, dict(zip(JOINT_NAMES, q.ravel().tolist(), strict=True)))
        found = [poses[f"{leg.replace(' ', '_')}_foot_link"][:3, 3] for leg in LEGS]
        np.testing.assert_allclose(found, feet(profile, q), atol=1e-9)
        np.testing.assert_allclose(poses["camera_depth_optical_frame"], profile.camera.T_body_camera, atol=1e-9)


@by_profile
def test_limits_masses_and_servo_of_urdf_are_those_of_profile(profile: RobotProfile) -> None:
    robot = ET.fromstring(urdf(profile))
    hinge = [joint for joint in robot.findall("joint") if joint.attrib["type"] == "revolute"]
    limits = [[float(joint.find("limit").attrib[key]) for key in ("lower", "upper")] for joint in hinge]  # type: ignore[union-attr]
    np.testing.assert_allclose(limits, profile.joint_limits.reshape(18, 2), atol=1e-9)
    for joint in hinge:
        assert numbers(joint.find("limit"), "effort") == [profile.servo.stall_torque]
        assert numbers(joint.find("limit"), "velocity") == [profile.servo.no_load_speed]
    masses = [numbers(mass, "value")[0] for mass in robot.iter("mass")]
    assert sum(masses) == pytest.approx(profile.body.total_mass)
    for inertia in robot.iter("inertia"):
        xx, yy, zz = (numbers(inertia, key)[0] for key in ("ixx", "iyy", "izz"))
        assert 0 < xx < yy + zz
        assert 0 < yy < xx + zz
        assert 0 < zz < xx + yy


@by_profile
def test_frames_of_hinges_lead_to_the_feet(profile: RobotProfile) -> None:
    q = random_angles(profile, 9)
    poses = {"base_link": np.eye(4)}
    for joint, angle in zip((*hinges(profile), *fixed_joints(profile)), [*q.ravel().tolist(), *[0.0] * 7], strict=True):
        poses[joint.child] = poses[joint.parent] @ posed(joint, angle)
    found = [poses[f"{leg.replace(' ', '_')}_foot_link"][:3, 3] for leg in LEGS]
    np.testing.assert_allclose(found, feet(profile, q), atol=1e-9)
