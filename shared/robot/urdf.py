"""URDF of a robot profile: a description of links and joints that ROS, Pinocchio, PyBullet and MuJoCo read.

Masses, inertias and joint parameters equal those of the simulator's model. Visual and collision shapes are simple: the trunk
is a box, a link of a leg is a cylinder, and a foot is a sphere. Joints are limited to the servos' limits.
"""

from xml.etree import ElementTree as ET

import numpy as np

from sextant.shared.geometry import Array, rpy_from_rotation
from sextant.shared.robot.body import Body
from sextant.shared.robot.links import BASE, LINK_RADII_M, Joint, fixed_joints, hinges
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.robot.servo import Servo

_TIBIA = JOINTS.index("tibia")


def urdf(profile: RobotProfile) -> str:
    """Return the URDF of a robot as XML text."""
    robot = ET.Element("robot", name=profile.name)
    ET.SubElement(ET.SubElement(robot, "material", name="gray"), "color", rgba="0.5 0.5 0.55 1")
    _add_trunk(robot, profile)
    lengths = (profile.links.coxa, profile.links.femur, profile.links.tibia - profile.foot.radius)
    for k, joint in enumerate(hinges(profile)):
        part = k % 3
        link = _add_link(robot, joint.child, profile.body, part, lengths[part])
        if part == _TIBIA:
            _add_shape(link, (profile.links.tibia, 0.0, 0.0), "0 0 0", "sphere", radius=_text(profile.foot.radius))
        _add_hinge(robot, joint, profile.servos.each[k], profile.joint_limits.reshape(18, 2)[k])
    for joint in fixed_joints(profile):
        ET.SubElement(robot, "link", name=joint.child)
        _add_joint(robot, joint, "fixed")
    ET.indent(robot)
    return f'<?xml version="1.0"?>\n{ET.tostring(robot, encoding="unicode")}\n'


def _add_trunk(robot: ET.Element, profile: RobotProfile) -> None:
    body = profile.body
    link = ET.SubElement(robot, "link", name=BASE)
    _add_inertia(link, body.centre_of_mass, body.mass, body.trunk_inertia)
    _add_shape(link, (0.0, 0.0, 0.0), "0 0 0", "box", size=_text(*body.size))


def _add_link(robot: ET.Element, name: str, body: Body, part: int, length: float) -> ET.Element:
    """Add a link of a leg: a cylinder along x, with the inertia of a capsule."""
    radius = LINK_RADII_M[part]
    link = ET.SubElement(robot, "link", name=name)
    middle = (length / 2, 0.0, 0.0)
    _add_inertia(link, middle, body.leg_link_masses[part], body.link_inertia(part, length, radius))
    _add_shape(link, middle, _text(0.0, np.pi / 2, 0.0), "cylinder", length=_text(length), radius=_text(radius))
    return link


def _add_inertia(link: ET.Element, centre: tuple[float, float, float], mass: float, principal: Array) -> None:
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_text(*centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_text(mass))
    xx, yy, zz = map(_text, principal.tolist())
    ET.SubElement(inertial, "inertia", ixx=xx, iyy=yy, izz=zz, ixy="0", ixz="0", iyz="0")


def _add_shape(link: ET.Element, centre: tuple[float, float, float], rpy: str, shape: str, **size: str) -> None:
    """Add the same shape for display and for collisions."""
    for kind in ("visual", "collision"):
        part = ET.SubElement(link, kind)
        ET.SubElement(part, "origin", xyz=_text(*centre), rpy=rpy)
        ET.SubElement(ET.SubElement(part, "geometry"), shape, size)
        if kind == "visual":
            ET.SubElement(part, "material", name="gray")


def _add_hinge(robot: ET.Element, joint: Joint, servo: Servo, limits: Array) -> None:
    hinge = _add_joint(robot, joint, "revolute")
    if joint.axis is not None:
        ET.SubElement(hinge, "axis", xyz=_text(*joint.axis))
    lower, upper = map(_text, limits.tolist())
    ET.SubElement(
        hinge, "limit", lower=lower, upper=upper, effort=_text(servo.stall_torque), velocity=_text(servo.no_load_speed)
    )
    ET.SubElement(hinge, "dynamics", damping=_text(servo.damping), friction=_text(servo.friction))


def _add_joint(robot: ET.Element, joint: Joint, kind: str) -> ET.Element:
    element = ET.SubElement(robot, "joint", name=joint.name, type=kind)
    rpy = rpy_from_rotation(joint.T_parent_child[:3, :3])
    ET.SubElement(element, "origin", xyz=_text(*joint.T_parent_child[:3, 3]), rpy=_text(*rpy))
    ET.SubElement(element, "parent", link=joint.parent)
    ET.SubElement(element, "child", link=joint.child)
    return element


def _text(*numbers: float) -> str:
    return " ".join(f"{float(number) + 0.0:.12g}" for number in numbers)
