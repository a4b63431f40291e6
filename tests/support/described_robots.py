"""Hexapods as other people describe them in URDF and MJCF, made for the tests of `sextant robot import`.

Each differs from what `sextant robot export` writes: in names, frames, the direction of its front, its angles at zero, how it
shows its feet, and in what it leaves out.
"""

from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path

from sextant.shared.robot.profile import LEGS

# Yaw of the legs of LEGS, from the front: left front, right front, right middle, right rear, left rear, left middle.
_YAWS_DEG = (60.0, -60.0, -90.0, -120.0, 120.0, 90.0)
_ROUND_YAWS_DEG = (30.0, -30.0, -90.0, -150.0, 150.0, 90.0)


@dataclass(frozen=True)
class DescribedRobot:
    """A file, how it is imported, and what must come out."""

    name: str
    text: str
    suffix: str
    options: tuple[str, ...]
    lengths: tuple[float, float, float]  # [m] coxa, femur, tibia
    table: str = ""  # TOML file for --joints

    def write(self, folder: Path) -> list[str]:
        """Write the files, and return the arguments of `sextant robot import` without --out."""
        described = folder / f"{self.name}.{self.suffix}"
        described.write_text(self.text, encoding="utf-8")
        words = [str(described), *self.options]
        if self.table:
            (folder / "legs.toml").write_text(self.table, encoding="utf-8")
            words += ["--joints", str(folder / "legs.toml")]
        return words


def _inertial(mass: float, x: float, moment: float) -> str:
    return (
        f'<inertial><origin xyz="{x} 0 0" rpy="0 0 0"/><mass value="{mass}"/>'
        f'<inertia ixx="{moment / 4}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _mesh(name: str) -> str:
    return f'<visual><geometry><mesh filename="package://somewhere/{name}.stl"/></geometry></visual>'


def numbered_with_meshes() -> DescribedRobot:
    """Return a robot that looks along y, with numbered joints, meshes only, torques of 100 N m, and horizontal hinges along x.

    Its last links end nowhere: the foot is given. Its legs are stretched downward by 0.3 rad at joint angles zero.
    """
    coxa, femur, tibia, droop = 0.052, 0.066, 0.132, 0.3
    parts = ['<robot name="numbered">', f'<link name="base_link">{_inertial(1.3, 0.0, 0.004)}{_mesh("base")}</link>']
    table = []
    for number, (leg, yaw_deg) in enumerate(zip(LEGS, _YAWS_DEG, strict=True), 1):
        yaw = yaw_deg * pi / 180 + pi / 2  # the front is along y
        x, y = 0.11 * cos(yaw), 0.11 * sin(yaw)
        names = [f"joint_{number}_{k}" for k in (1, 2, 3)]
        table.append(f'"{leg}" = {names}')
        links = ["base_link", *(f"link_{number}_{k}" for k in (1, 2, 3))]
        places = [
            f'xyz="{x} {y} 0.01" rpy="0 0 {yaw}"',
            f'xyz="{coxa} 0 0" rpy="{pi / 2} {-droop} 0"',  # z of the next link is the axis, x along the leg
            f'xyz="{femur} 0 0" rpy="0 0 0"',
        ]
        axes = ["0 0 1", "0 0 -1", "0 0 1"]
        for k in range(3):
            parts.append(
                f'<joint name="{names[k]}" type="revolute"><origin {places[k]}/><parent link="{links[k]}"/>'
                f'<child link="{links[k + 1]}"/><axis xyz="{axes[k]}"/>'
                '<limit lower="-1.9" upper="1.9" effort="100" velocity="6"/></joint>'
            )
            length = (coxa, femur, tibia)[k]
            parts.append(f'<link name="{links[k + 1]}">{_inertial(0.06, length / 2, 6e-5)}{_mesh("leg")}</link>')
    parts.append("</robot>")
    return DescribedRobot(
        "numbered",
        "\n".join(parts),
        "urdf",
        ("--forward", "y", "--servo", "AX-18A", "--foot", f"{tibia},0,0"),
        (coxa, femur, tibia),
        table="\n".join(table),
    )


def standing_at_zero() -> DescribedRobot:
    """Return a robot that stands at joint angles zero, with a trunk of two links, left and right legs turned the other way."""
    coxa, femur, tibia, radius = 0.045, 0.075, 0.115, 0.009
    up, down = 0.5, 1.9  # [rad] of the femur from the horizontal, and of the tibia from the femur, at joint angles zero
    parts = [
        '<robot name="standing">',
        f'<link name="chassis">{_inertial(0.9, 0.0, 0.003)}<collision><geometry><box size="0.2 0.12 0.04"/></geometry>'
        "</collision></link>",
        f'<link name="battery">{_inertial(0.4, 0.0, 0.0004)}</link>',
        '<joint name="tray" type="fixed"><origin xyz="-0.03 0 0.02" rpy="0 0 1.5708"/><parent link="chassis"/>'
        '<child link="battery"/></joint>',
    ]
    for leg, yaw_deg in zip(LEGS, _YAWS_DEG, strict=True):
        word, yaw = leg.replace(" ", "_"), yaw_deg * pi / 180
        x = {"front": 0.09, "middle": 0.0, "rear": -0.09}[leg.split()[1]]
        y = (0.05 if x else 0.065) * (1.0 if yaw_deg > 0 else -1.0)
        sign = 1 if leg.startswith("left") else -1
        links = ["chassis", f"{word}_hip", f"{word}_thigh", f"{word}_shin"]
        places = [
            f'xyz="{x} {y} 0" rpy="0 0 {yaw}"',
            f'xyz="{coxa} 0 0" rpy="0 {-up} 0"',
            f'xyz="{femur} 0 0" rpy="0 {down} 0"',
        ]
        axes = ["0 0 1", f"0 {-sign} 0", f"0 {sign} 0"]
        ends = [coxa, femur, tibia]
        for k, part in enumerate(("yaw", "pitch", "knee")):
            shape = (
                f'<origin xyz="{ends[k] / 2} 0 0" rpy="0 {pi / 2} 0"/><geometry><cylinder radius="0.012" length="{ends[k]}"/>'
            )
            foot = f'<collision><origin xyz="{tibia} 0 0"/><geometry><sphere radius="{radius}"/></geometry></collision>'
            parts.append(
                f'<joint name="{word}_{part}" type="revolute"><origin {places[k]}/><parent link="{links[k]}"/>'
                f'<child link="{links[k + 1]}"/><axis xyz="{axes[k]}"/>'
                '<limit lower="-1.2" upper="1.2" effort="1.5" velocity="6.2"/>'
                '<dynamics damping="0.01" friction="0.03"/></joint>'
            )
            parts.append(
                f'<link name="{links[k + 1]}">{_inertial(0.05, ends[k] / 2, 5e-5)}<collision>{shape}</geometry></collision>'
                f"{foot if k == 2 else ''}</link>"
            )
    parts.append("</robot>")
    return DescribedRobot("standing", "\n".join(parts), "urdf", (), (coxa, femur, tibia))


def round_in_mjcf() -> DescribedRobot:
    """Return a round robot in MJCF with defaults, angles in degrees, a floor, sites as feet and motors."""
    coxa, femur, tibia = 0.05, 0.08, 0.13
    legs = []
    for leg, yaw_deg in zip(LEGS, _ROUND_YAWS_DEG, strict=True):
        word, yaw = leg.replace(" ", "-"), yaw_deg * pi / 180
        legs.append(
            f'<body name="{word} coxa" pos="{0.12 * cos(yaw)} {0.12 * sin(yaw)} 0" euler="0 0 {yaw_deg}">'
            f'<joint name="{word} coxa" axis="0 0 1" range="-60 60"/><geom fromto="0 0 0 {coxa} 0 0" mass="0.05"/>'
            f'<body name="{word} femur" pos="{coxa} 0 0"><joint name="{word} femur" axis="0 -1 0" range="-90 90"/>'
            f'<geom fromto="0 0 0 {femur} 0 0" mass="0.09"/>'
            f'<body name="{word} tibia" pos="{femur} 0 0" euler="0 90 0">'
            f'<joint name="{word} tibia" axis="0 -1 0" range="-60 80"/>'
            f'<geom fromto="0 0 0 {tibia} 0 0" mass="0.05"/>'
            f'<geom type="sphere" size="0.01" pos="{tibia} 0 0" mass="0"/><site name="{word} foot" pos="{tibia} 0 0"/>'
            "</body></body></body>"
        )
    motors = "".join(
        f'<position joint="{leg.replace(" ", "-")} {part}" kp="40" forcerange="-2.5 2.5"/>'
        for leg in LEGS
        for part in ("coxa", "femur", "tibia")
    )
    text = f"""<mujoco model="round">
<compiler angle="degree"/>
<default><geom type="capsule" size="0.012"/><joint damping="0.4" armature="0.004" frictionloss="0.03" limited="true"/></default>
<worldbody>
<geom name="floor" type="plane" size="5 5 0.1"/>
<body name="hub" pos="0 0 0.15"><freejoint/><geom type="cylinder" size="0.13 0.02" mass="1.4"/>
{"".join(legs)}
</body>
</worldbody>
<actuator>{motors}</actuator>
</mujoco>"""
    return DescribedRobot("round", text, "xml", (), (coxa, femur, tibia))


def floating_with_head() -> DescribedRobot:
    """Return the robot that stands at joint angles zero, floating in a world, with a head, a gripper, and hobby servos."""
    robot = standing_at_zero()
    joints = (("float", "floating", "world", "chassis"), ("pan", "revolute", "chassis", "neck"))
    joints += (("tilt", "revolute", "neck", "head"), ("grip", "prismatic", "chassis", "finger"))
    parts = [
        '<link name="world"/>',
        *(f'<link name="{name}">{_inertial(0.02, 0.0, 2e-6)}</link>' for name in ("neck", "head", "finger")),
    ]
    parts += [
        f'<joint name="{name}" type="{kind}"><origin xyz="0.08 0 0.03"/><parent link="{parent}"/><child link="{child}"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for name, kind, parent, child in joints
    ]
    text = robot.text.replace("</robot>", "\n".join([*parts, "</robot>"]))
    return DescribedRobot("floating", text, "urdf", ("--servo", "maestro"), robot.lengths)


ROBOTS = (numbered_with_meshes, standing_at_zero, round_in_mjcf, floating_with_head)
