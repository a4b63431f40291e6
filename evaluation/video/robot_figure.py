"""Robot model for rendering: limbs and rounded boxes sized by the profile.

Parts that the profile does not describe, such as brackets, servo horns and plates, have typical sizes for such links.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, apply, transform
from sextant.shared.robot.kinematics import leg_points
from sextant.shared.robot.profile import RobotProfile

# Numbers of materials; those below `GROUND` belong to the robot.
SKY, SHELL, PLATE, JOINT, LINK, ACCENT, LENS, CARRIES, SWINGS = range(9)
GROUND = 16
COLORS = {  # R, G, B as on a screen, and gloss
    SHELL: ((52, 58, 68), 0.16),
    PLATE: ((78, 86, 99), 0.10),
    JOINT: ((34, 37, 43), 0.14),
    LINK: ((196, 201, 207), 0.12),
    ACCENT: ((240, 132, 38), 0.12),
    LENS: ((14, 18, 30), 0.50),
    CARRIES: ((18, 158, 110), 0.12),
    SWINGS: ((250, 196, 52), 0.12),
}
_SOCK = 0.42  # [1] share of the tibia, from the foot up, whose colour shows load
_FACES = (((0, 1, 2), 1.0), ((0, 1, 2), -1.0), ((1, 2, 0), 1.0), ((1, 2, 0), -1.0), ((2, 0, 1), 1.0), ((2, 0, 1), -1.0))


@dataclass(slots=True)
class Solids:
    """Faces and limbs of the robot, with their materials."""

    faces: list[Array] = field(default_factory=list)  # (4, 3) [m] {world}
    face_materials: list[int] = field(default_factory=list)
    starts: list[Array] = field(default_factory=list)  # (3,) [m] {world}
    ends: list[Array] = field(default_factory=list)
    radii: list[tuple[float, float]] = field(default_factory=list)
    limb_materials: list[int] = field(default_factory=list)

    def limb(self, start: Array, end: Array, radius: float, radius_end: float, material: int) -> None:
        """Add the hull of two balls."""
        self.starts.append(np.asarray(start, dtype=np.float64))
        self.ends.append(np.asarray(end, dtype=np.float64))
        self.radii.append((radius, radius_end))
        self.limb_materials.append(material)

    def rounded_box(self, T: Array, size: tuple[float, float, float], bevel: float, material: int) -> None:
        """Add a box of an outer size [m] centred at a frame (4, 4).

        Its edges are rounded by a bevel [m].
        """
        half = np.asarray(size) / 2
        inner = half - min(bevel, float(half.min()) * 0.999)
        bevel = float((half - inner).max())
        for (k, i, j), sign in _FACES:
            corners = np.zeros((4, 3))
            corners[:, k] = sign * half[k]
            corners[:, i] = inner[i] * np.array([-1.0, 1.0, 1.0, -1.0])
            corners[:, j] = inner[j] * np.array([-1.0, -1.0, 1.0, 1.0])
            self.faces.append(apply(T, corners if sign > 0 else corners[::-1]))
            self.face_materials.append(material)
        for k in range(3):
            for a in (-1.0, 1.0):
                for b in (-1.0, 1.0):
                    edge = np.zeros((2, 3))
                    edge[:, k] = (-inner[k], inner[k])
                    edge[:, (k + 1) % 3], edge[:, (k + 2) % 3] = a * inner[(k + 1) % 3], b * inner[(k + 2) % 3]
                    start, end = apply(T, edge)
                    self.limb(start, end, bevel, bevel, material)

    def arrays(self) -> tuple[Array, NDArray[np.uint16], Array, Array, Array, NDArray[np.uint16]]:
        """Return faces (n, 4, 3) with materials (n,), and limbs.

        Limbs are starts and ends (m, 3), radii (m, 2) and materials (m,).
        """
        return (
            np.array(self.faces).reshape(-1, 4, 3),
            np.array(self.face_materials, dtype=np.uint16),
            np.array(self.starts).reshape(-1, 3),
            np.array(self.ends).reshape(-1, 3),
            np.array(self.radii).reshape(-1, 2),
            np.array(self.limb_materials, dtype=np.uint16),
        )


def robot_solids(profile: RobotProfile, T_world_body: Array, q: Array, carries: NDArray[np.bool_]) -> Solids:
    """Return the robot at a body pose (4, 4) and joint angles (6, 3) [rad].

    The colour of a foot shows whether it carries (6,).
    """
    solids = Solids()
    _body(solids, profile, T_world_body)
    points = leg_points(profile, q)
    scale = _scale(profile)
    for leg in range(6):
        _leg(solids, profile, scale, apply(T_world_body, points[leg]), CARRIES if carries[leg] else SWINGS)
    return solids


def occluders(profile: RobotProfile, T_world_body: Array, q: Array) -> Array:
    """Return balls that approximate the robot for sky occlusion.

    They are (n, 4): x, y, z [m] {world}, radius [m].
    """
    scale = _scale(profile)
    length, width, _ = profile.body.size
    along = np.linspace(-0.5, 0.5, 5) * (length - width / 2)
    body = np.column_stack([apply(T_world_body, np.column_stack([along, 0 * along, 0 * along])), np.full(5, 0.4 * width)])
    points = apply(T_world_body, leg_points(profile, q))
    balls = [body]
    for start, end, radius in ((1, 2, 0.017), (2, 3, 0.012)):
        for s in (0.25, 0.5, 0.75, 1.0):
            centre = points[:, start] + s * (points[:, end] - points[:, start])
            balls.append(np.column_stack([centre, np.full(6, radius * scale)]))
    return np.concatenate(balls)


def _scale(profile: RobotProfile) -> float:
    """Return the scale of undescribed parts, relative to those of a PhantomX."""
    return float(np.clip((profile.links.femur + profile.links.tibia) / 0.199, 0.5, 3.0))


def _body(solids: Solids, profile: RobotProfile, T: Array) -> None:
    length, width, height = profile.body.size
    core = (0.94 * length, 0.80 * width, 0.72 * height)
    plate = (length, width, max(0.16 * height, 0.004))
    solids.rounded_box(T, core, 0.25 * height, SHELL)
    for side in (-1.0, 1.0):
        at = transform(np.eye(3), np.array([0.0, 0.0, side * (height - plate[2]) / 2]))
        solids.rounded_box(T @ at, plate, 0.45 * plate[2], PLATE)
    back = transform(np.eye(3), np.array([-0.10 * length, 0.0, height / 2 + 0.28 * height]))
    solids.rounded_box(T @ back, (0.50 * length, 0.60 * width, 0.60 * height), 0.16 * height, SHELL)
    stripe = transform(np.eye(3), np.array([-0.10 * length, 0.0, height / 2 + 0.58 * height]))
    solids.rounded_box(T @ stripe, (0.40 * length, 0.10 * width, 0.06 * height), 0.02 * height, ACCENT)
    _camera(solids, profile, T)


def _camera(solids: Solids, profile: RobotProfile, T: Array) -> None:
    """Add the depth camera on its mast, in its mounted orientation."""
    camera = profile.camera
    mount = np.asarray(camera.mount_xyz)
    foot = np.array([mount[0] - 0.02, mount[1], profile.body.size[2] / 2])
    low, high = apply(T, np.array([foot, mount - np.array([0.02, 0.0, 0.0])]))
    solids.limb(low, high, 0.007, 0.006, JOINT)
    head = T @ camera.T_body_mount @ transform(np.eye(3), np.array([-0.014, 0.0, 0.0]))
    solids.rounded_box(head, (0.034, 0.125, 0.030), 0.010, SHELL)
    for y, radius in ((-0.034, 0.0085), (0.0, 0.0065), (0.034, 0.0085)):
        lens = apply(head, np.array([[0.011, y, 0.0], [0.0125, y, 0.0]]))
        solids.limb(lens[0], lens[1], radius, radius, LENS)
    light = apply(head, np.array([[0.004, -0.048, 0.0125], [0.004, 0.048, 0.0125]]))
    solids.limb(light[0], light[1], 0.0035, 0.0035, ACCENT)


def _leg(solids: Solids, profile: RobotProfile, scale: float, points: Array, state: int) -> None:
    """Add one leg through coxa axis, femur axis, knee and foot, (4, 3) [m] {world}."""
    coxa, femur, knee, foot = points
    r = scale
    out, up = femur - coxa, None
    hinge = np.cross(femur - coxa, knee - femur)
    if np.linalg.norm(hinge) < 1e-9:
        hinge = np.cross(out, np.array([0.0, 0.0, 1.0]))
    hinge /= max(float(np.linalg.norm(hinge)), 1e-12)
    up = np.cross(hinge, out)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    # The coxa's servo is in the body, with a vertical axis.
    solids.limb(coxa - 0.014 * r * up, coxa + 0.014 * r * up, 0.0175 * r, 0.0175 * r, JOINT)
    solids.limb(coxa, femur, 0.0135 * r, 0.0125 * r, LINK)
    solids.limb(femur - 0.015 * r * hinge, femur + 0.015 * r * hinge, 0.0155 * r, 0.0155 * r, JOINT)
    for side in (-1.0, 1.0):  # a femur is two plates
        off = 0.0115 * r * side * hinge
        solids.limb(femur + off, knee + off, 0.0105 * r, 0.0095 * r, LINK)
    solids.limb(knee - 0.014 * r * hinge, knee + 0.014 * r * hinge, 0.0145 * r, 0.0145 * r, JOINT)
    cuff = foot + _SOCK * (knee - foot)
    tip = profile.foot.radius
    thick = 0.0130 * r
    at_cuff = tip * 0.82 + _SOCK * (thick - tip * 0.82)
    solids.limb(knee, cuff, thick, at_cuff, LINK)
    solids.limb(cuff, foot, at_cuff * 1.04, tip * 0.82, state)
    solids.limb(foot, foot, tip, tip, state)
