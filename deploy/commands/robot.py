"""`sextant robot`: new robot profiles, their check, and profiles from and for other tools."""

import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from click import UsageError

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, say
from sextant.deploy.terminal.arguments import Choice, Group, Parsed, argument, flag, number, option, options_of
from sextant.shared.files.config import ConfigError

if TYPE_CHECKING:
    from sextant.shared.robot.description.robot_description import RobotDescription

robot = Group("robot", "Make and check a robot profile, or convert it from and to URDF and MJCF.")


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


_SERVO_WORDS = (
    "model of the servos, by its name in docs/servos.md; maestro or pca9685 for hobby servos; a TOML file with [servo]; or a "
    "profile that has these servos"
)


def _point(text: str) -> tuple[float, ...]:
    try:
        point = tuple(map(float, text.split(",")))
    except ValueError:
        point = ()
    if len(point) != 3 or not all(abs(length) <= 10 for length in point):
        raise ValueError(f"three lengths X,Y,Z of at most 10 m expected, found {text!r}")
    return point


@robot.command("import")
@argument("file", "URDF or MJCF", "FILE")
@option("--out", "profile to write, a new file that ends in .toml", "PROFILE", required=True)
@option(
    "--joints",
    "TOML file with the joint names of each leg (default: guessed from their places), feet of each in a table [feet], or both",
    "FILE",
)
@option(
    "--foot",
    "centre of a foot in the frame of its last link [m] (default: as described)",
    "X,Y,Z",
    type=Parsed(_point, "point"),
)
@option("--forward", "direction of the robot's front in the first link", type=Choice(("x", "y", "-x", "-y")), default="x")
@option("--servo", f"{_SERVO_WORDS} (default: the nearest model by torque)", "MODEL")
def import_(file: str, out: str, joints: str | None, foot: tuple[float, ...] | None, forward: str, servo: str | None) -> int:
    """Write a profile from a URDF or MJCF file.

    Meshes are ignored. The robot has six legs of three joints: a vertical coxa axis, and horizontal axes of femur and tibia.
    """
    from sextant.shared.robot.description.profile_import import LegTable, import_profile, read_legs
    from sextant.shared.robot.description.robot_description import DescriptionError
    from sextant.shared.robot.profile_text import write_new_profile

    legs = LegTable({}, {}) if joints is None else read_legs(Path(joints))
    if foot and legs.feet:
        raise InputError(f"--foot: {joints} states the feet already; give one of both")
    try:
        found = import_profile(_described(Path(file)), legs.joints or None, foot or legs.feet or None, forward, servo)
    except DescriptionError as error:
        raise InputError(f"{file}: {error}") from None
    write_new_profile(Path(out), found.profile, [f"Imported from {Path(file).name}.", *found.notes])
    say(f"{out}: {found.profile.name}, whose feet agree with {file} within {1e3 * found.foot_error:.3f} mm")
    for leg, chain in found.joints.items():
        say(f"  {leg:12}  {', '.join(chain)}")
    for note in found.notes:
        say(f"- {note}")
    say(f"`sextant robot check {shlex.quote(out)}` states what the robot can do")
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


_VOLTS = number(3.0, 30.0, "a voltage")
_USUAL_SERVO = "AX-12A"
_LENGTH, _MASS = number(0.005, 0.5, "a length in metres (45 mm are 0.045)"), number(0.1, 30.0, "a mass in kilograms")
_QUESTIONS = {  # what is asked, and its value for a PhantomX
    "coxa": ("from coxa axis to femur axis [m]", _LENGTH, 0.052),
    "femur": ("from femur axis to tibia axis [m]", _LENGTH, 0.066),
    "tibia": ("from tibia axis to the foot's centre [m]", _LENGTH, 0.133),
    "front": ("coxa axes of the front legs ahead of the body's middle [m]", _LENGTH, 0.120),
    "side": ("the same axes to the side of the body's middle [m]", _LENGTH, 0.060),
    "middle": ("coxa axes of the middle legs to the side of the body's middle [m]", _LENGTH, 0.100),
    "mass": ("mass of the whole robot [kg]", _MASS, 2.5),
}


@dataclass(frozen=True, slots=True)
class _Measured:
    """Measures that options gave, in the order of the questions; None: to be asked for."""

    coxa: float | None
    femur: float | None
    tibia: float | None
    front: float | None
    side: float | None
    middle: float | None
    mass: float | None


@robot.command("new")
@option("--out", "profile to write, a new file that ends in .toml", "PROFILE", required=True)
@options_of(
    _Measured, "measured", *(option(f"--{name}", about, "X", type=kind) for name, (about, kind, _) in _QUESTIONS.items())
)
@option(
    "--servo",
    f"{_SERVO_WORDS} (default: asked for with the measures, else AX-12A)",
    "MODEL",
)
@option("--volts", "voltage of the servos, where their maker states several (default: the usual one)", "V", type=_VOLTS)
def new(out: str, measured: _Measured, servo: str | None, volts: float | None) -> int:
    """Write a profile from a few measures, and check it.

    It asks for servos and measures that no option gives. The robot is symmetric, with straight brackets. Stance, limits and
    camera are proposed.
    """
    from sextant.evaluation.robot_check.robot_check import check_robot
    from sextant.evaluation.robot_check.walking_pace import slow_down
    from sextant.shared.robot.horn_assembly import angles_at_centre
    from sextant.shared.robot.new_profile import Measures, new_profile
    from sextant.shared.robot.profile_text import require_new_file, write_new_profile
    from sextant.shared.robot.servo_proposal import BOARDS, chosen_servo

    require_new_file(Path(out))
    is_asked = servo is None and None in asdict(measured).values()
    word = _asked_servo(volts) if is_asked else servo or _USUAL_SERVO
    drive = chosen_servo(word, volts)
    given = {name: _asked(name) if measure is None else measure for name, measure in asdict(measured).items()}
    made = slow_down(new_profile(Path(out).stem, Measures(**given), drive))  # type: ignore[arg-type]
    words = [f"{name} = {measure:g}: {_QUESTIONS[name][0]}" for name, measure in given.items()]
    note = "Stance, joint limits, masses of the links, camera and servo ids are proposed: see docs/your_robot.md."
    horns = f"Screw the horns on with each servo at its centre and its joint at: {angles_at_centre(made)}."
    write_new_profile(Path(out), made, ["Made by `sextant robot new` from measures:", *words, note, horns])
    found = check_robot(made)
    for limit in found.limits:
        if not limit.is_met:
            say(f"FAIL  {limit.name}: {limit.sentence}")
    assumed = "" if servo or is_asked else ", assumed: --servo NAME for another"
    say(f"{out}: {'passes' if found.passes else 'fails'} the check; its servos are {made.servo.model}{assumed}")
    if word in BOARDS:
        say("The numbers in [servo] are those of a DS3218: correct them for other servos, see docs/hobby_servos.md")
    say(horns)
    say(f"Next: `sextant robot check {shlex.quote(out)}` prints the whole check, and docs/commissioning.md goes on")
    return SUCCESS if found.passes else FAILED


def _asked_servo(volts: float | None) -> str:
    """Ask for the servos until the answer is valid; Enter is the usual model."""
    from sextant.shared.robot.servo_proposal import BOARDS, chosen_servo
    from sextant.shared.servo.models import MODEL_NAMED

    say(f"servos: {', '.join(MODEL_NAMED)}; {' or '.join(BOARDS)} for hobby servos; a TOML file with [servo], or a profile")
    while True:
        word = _answered(f"servos, {_USUAL_SERVO} if you press Enter: ", "--servo") or _USUAL_SERVO
        try:
            chosen_servo(word, volts)
        except ConfigError as error:
            say(str(error))
        else:
            return word


def _asked(name: str) -> float:
    """Ask for a measure until the answer is valid."""
    about, kind, example = _QUESTIONS[name]
    while True:
        answer = _answered(f"{name}: {about}, {example:g} for a PhantomX: ", f"--{name}")
        try:
            return float(kind.convert(answer, None, None))
        except UsageError as error:
            say(error.message)


def _answered(question: str, instead: str) -> str:
    """Return the answer to a question; raise InputError at the end of the input, with the option to give instead."""
    sys.stdout.write(question)
    sys.stdout.flush()
    line = sys.stdin.readline()
    if not line:
        raise InputError(f"an answer expected, found the end of the input; in a script, give {instead}")
    return line.strip()
