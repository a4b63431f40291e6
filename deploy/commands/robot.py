"""`sextant robot`: check of robot profiles, and profiles for other tools."""

from pathlib import Path

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, say
from sextant.deploy.terminal.arguments import Group, argument, flag, option

robot = Group("robot", "Check a robot profile, or convert it to URDF or MJCF.")


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
