"""Links and joints of a robot as a tree of frames, with the names that ROS and URDF use.

Frames follow REP 105: {body} is `base_link`. A link's frame has its origin on its joint and x along the link. The camera frame
is the optical frame.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sextant.shared.geometry import Array, exp_so3, transform
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile

BASE, CAMERA = "base_link", "camera_depth_optical_frame"
JOINT_NAMES = tuple(f"{leg.replace(' ', '_')}_{joint}" for leg in LEGS for joint in JOINTS)
LINK_RADII_M = (0.018, 0.014, 0.008)  # coxa, femur, tibia, as capsules
_UP = (0.0, -1.0, 0.0)  # a positive rotation about -y lifts a link that points along x
_AXES = ((0.0, 0.0, 1.0), _UP, _UP)  # coxa, femur, tibia


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint between two links."""

    name: str
    parent: str  # link
    child: str  # link
    T_parent_child: Array  # (4, 4) at joint angle zero
    axis: tuple[float, float, float] | None  # {child} of a hinge; None for a fixed joint


def hinges(profile: RobotProfile) -> tuple[Joint, ...]:
    """Return the 18 hinges, in the order of the joint angles (6, 3)."""
    links = profile.links
    starts = (transform(np.eye(3), (length, 0.0, 0.0)) for length in (links.coxa, links.femur))
    coxa_femur, femur_tibia = starts
    found = []
    for leg, T_body_coxa in zip(LEGS, profile.T_body_coxa, strict=True):
        names = [f"{leg.replace(' ', '_')}_{joint}" for joint in JOINTS]
        chain = pairwise([BASE, *(f"{name}_link" for name in names)])
        for name, (parent, child), T, axis in zip(names, chain, (T_body_coxa, coxa_femur, femur_tibia), _AXES, strict=True):
            found.append(Joint(name, parent, child, T, axis))
    return tuple(found)


def fixed_joints(profile: RobotProfile) -> tuple[Joint, ...]:
    """Return the fixed joints: of the camera on the trunk, and of each foot's centre at the end of its tibia."""
    tip = transform(np.eye(3), (profile.links.tibia, 0.0, 0.0))
    camera = Joint("camera", BASE, CAMERA, profile.camera.T_body_camera, None)
    legs = (leg.replace(" ", "_") for leg in LEGS)
    return camera, *(Joint(f"{leg}_foot", f"{leg}_tibia_link", f"{leg}_foot_link", tip, None) for leg in legs)


def posed(joint: Joint, angle: float) -> Array:
    """Return T_parent_child (4, 4) of a hinge at an angle [rad]."""
    if joint.axis is None:
        return joint.T_parent_child
    turn = exp_so3(angle * np.array(joint.axis))
    return np.asarray(joint.T_parent_child @ transform(turn, np.zeros(3)))
