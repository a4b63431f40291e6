"""`sextant robot`: check of robot profiles, and profiles from and for other tools."""

from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, say
from sextant.deploy.terminal.arguments import Choice, Group, Parsed, argument, flag, option

if TYPE_CHECKING:
    from sextant.shared.robot.description.robot_description import RobotDescription

robot = Group("robot", "Check a robot profile, or convert it from and to URDF and MJCF.")


@robot.command("export")
@argument("profile", "profile by name, or path of a TOML file", "PROFILE")
@flag("--urdf", "links, joints, inertias and shapes, for ROS and others")
@flag("--mjcf", "the simulator's model on level ground, for MuJoCo")
@option("--out", "file to write (default: standard output)", "FILE")
def export(profile: str, urdf: bool, mjcf: bool, out: str | None) -> int:
    """Write a robot profile as URDF or MJCF."""
    from sextant.shared.files import whole_files
    from sextant.shared.robot import urdf as ros
    from sextant.shared.robot.profiles import load_profile

    if urdf == mjcf:
        raise InputError(f"one of --urdf and --mjcf expected, found {'both' if urdf else 'none'}")
    found = load_profile(profile)
    if urdf:
        text = ros.urdf(found)
    else:
        try:
            from sextant.services.simulator.physics.model import mjcf as model
        except ModuleNotFoundError as error:
            raise InputError(f"{error.name} is not installed: pip install 'sextant[simulator]'") from None
        text = model(found)
    if out is None:
        say(text.rstrip("\n"))
        return SUCCESS
    whole_files.write_text(Path(out), text)
    say(f"{out}: {'URDF' if urdf else 'MJCF'} of {found.name}, {len(text)} bytes")
    return SUCCESS


@robot.command("check")
@argument("profile", "profile by name, or path of a TOML file", "PROFILE")
@options.as_json
def check(profile: str, as_json: bool) -> int:
    """Compute what a robot can do, and what limits it.

    Reach, torque, heat, speed, stability, and the ground that it can walk over, without a robot. Fails if a limit is not met.
    """
    from sextant.evaluation.robot_check.robot_check import check_robot, describe
    from sextant.shared.robot.profiles import load_profile

    found = check_robot(load_profile(profile))
    say(found.to_json().rstrip("\n") if as_json else describe(found))
    return SUCCESS if found.passes else FAILED


def _point(text: str) -> tuple[float, ...]:
    point = tuple(map(float, text.split(",")))
    if len(point) != 3 or not all(abs(length) <= 10 for length in point):
        raise ValueError(f"three lengths X,Y,Z of at most 10 m expected, found {text!r}")
    return point


@robot.command("import")
@argument("file", "URDF or MJCF", "FILE")
@option("--out", "profile to write, a new file that ends in .toml", "PROFILE", required=True)
@option("--joints", "TOML file with the joint names of each leg (default: guessed from their places)", "FILE")
@option(
    "--foot",
    "centre of a foot in the frame of its last link [m] (default: as described)",
    "X,Y,Z",
    type=Parsed(_point, "point"),
)
@option("--forward", "direction of the robot's front in the first link", type=Choice(("x", "y", "-x", "-y")), default="x")
@option("--servo", "model of the servos (default: the nearest by torque)", "MODEL")
def import_(file: str, out: str, joints: str | None, foot: tuple[float, ...] | None, forward: str, servo: str | None) -> int:
    """Write a profile from a URDF or MJCF file.

    Meshes are ignored. The robot has six legs of three joints: a vertical coxa axis, and horizontal axes of femur and tibia.
    """
    from sextant.shared.robot.description.profile_import import import_profile, joint_names
    from sextant.shared.robot.profile_text import write_new_profile

    names = None if joints is None else joint_names(Path(joints))
    found = import_profile(_described(Path(file)), names, foot, forward, servo)
    write_new_profile(Path(out), found.profile, [f"Imported from {Path(file).name}.", *found.notes])
    say(f"{out}: {found.profile.name}, whose feet agree with {file} within {1e3 * found.foot_error:.3f} mm")
    for leg, chain in found.joints.items():
        say(f"  {leg:12}  {', '.join(chain)}")
    for note in found.notes:
        say(f"- {note}")
    say(f"`sextant robot check {out}` states what the robot can do")
    return SUCCESS


def _described(file: Path) -> "RobotDescription":
    """Read a URDF or MJCF file, told apart by its elements."""
    from sextant.shared.files import input_file
    from sextant.shared.robot.description.robot_description import read_urdf

    text = input_file.read_text(file)
    if "<mujoco" not in text or "<robot" in text:
        return read_urdf(text)
    try:
        from sextant.services.simulator.physics.mjcf_description import read_mjcf
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sextant[simulator]'") from None
    return read_mjcf(file)
