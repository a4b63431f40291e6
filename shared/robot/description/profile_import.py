"""Robot profile from a description of links and joints; what the description does not state is proposed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sextant.shared.errors import SextantError
from sextant.shared.files import input_file
from sextant.shared.geometry import Array, inverse, rpy_from_rotation
from sextant.shared.robot.body import Body, Foot, LegLinks
from sextant.shared.robot.description.leg_extraction import (
    FORWARD,
    DescribedBodies,
    DescribedLeg,
    chains_of,
    foot_at_zero,
    foot_position,
    leg_of,
    named_chains,
    ordered,
    still_joints,
)
from sextant.shared.robot.description.robot_description import DescribedJoint, DescriptionError, RobotDescription
from sextant.shared.robot.horn_assembly import angles_at_centre
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profile import JOINTS, LEGS, Camera, Leg, RobotProfile
from sextant.shared.robot.profile_proposal import PLACEHOLDER_STANCE, proposed_camera, proposed_stance
from sextant.shared.robot.servo import Battery, Servo
from sextant.shared.robot.servo_proposal import BOARDS, chosen_servo, nearest_servo, proposed_battery, proposed_servo
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.spelling import hint

_LENGTH_TOLERANCE_M = 0.002  # [m] by which legs of one robot may differ
_FOOT_RADIUS_M = 0.01  # [m] if the description shows none
_NO_SERVO_NM, _NO_SERVO_RAD_S = 30.0, 30.0  # torque and speed that stand for "unlimited" in a description
_INERTIA_DIGITS = 9  # of kg m^2
_TURNED = 0.02  # [1] largest product of inertia, as a share of the largest moment, that raises no note
_TRUNK_HEIGHT_M = 0.04  # [m] the same
_POSES, _SEED = 50, 0  # joint angles with which the profile is verified
_OPTICAL = "optical"  # part of the names of cameras' frames with z along the line of sight
_LENGTH_DIGITS, _ANGLE_DIGITS, _OTHER_DIGITS = 7, 4, 4  # decimals [m], [deg], of torques and speeds


@dataclass(frozen=True, slots=True)
class ImportedProfile:
    """A profile and how it came about."""

    profile: RobotProfile
    joints: Mapping[str, tuple[str, str, str]]  # joint names of the description by leg
    notes: tuple[str, ...]  # what was assumed
    foot_error: float  # [m] largest distance between the feet of profile and description


def import_profile(
    description: RobotDescription,
    names: Mapping[str, Sequence[str]] | None = None,
    foot: Sequence[float] | Mapping[str, Sequence[float]] | None = None,
    forward: str = "x",
    servo: str | None = None,
) -> ImportedProfile:
    """Return the profile of a described robot.

    Args:
        description: Links and joints.
        names: Names of coxa, femur and tibia joint by leg; None: guessed from where they are.
        foot: (3,) [m] centre of every foot in the frame of its last link, or one by leg; None: from the description.
        forward: Direction of the robot's front in the frame of the first link, a key of `FORWARD`.
        servo: Model, board, file or profile of the servos, as in `chosen_servo`; None: the nearest model by torque.

    Raises:
        ConfigError: The servos are not known, or their file is invalid.
        DescriptionError: The description is not that of a robot with six legs of three joints, the axes are not standard, or a
            value does not fit a profile.
    """
    try:
        given = foot if isinstance(foot, Mapping) else {} if foot is None else dict.fromkeys(LEGS, foot)
        feet = {leg: np.array(place, dtype=np.float64) for leg, place in given.items()}
        return _import(description, names, feet, forward, servo)
    except SextantError:
        raise
    except ValueError as error:
        raise DescriptionError(f"the robot does not fit a profile: {error}") from None


def _import(
    description: RobotDescription,
    names: Mapping[str, Sequence[str]] | None,
    feet: Mapping[str, Array],
    forward: str,
    servo: str | None,
) -> ImportedProfile:
    movable = None if names is None else frozenset(name for chain in names.values() for name in chain)
    bodies = DescribedBodies(description, FORWARD[forward], movable)
    if names is None:
        legs = chains_of(bodies)
        bodies = DescribedBodies(description, FORWARD[forward], frozenset(joint.name for leg in legs for joint in leg))
        chains = ordered(bodies, legs)
    else:
        chains = named_chains(bodies, names)
    described = [leg_of(bodies, leg, chain, feet.get(leg)) for leg, chain in zip(LEGS, chains, strict=True)]
    notes = [f"joints that are not of a leg are fixed at zero: {still_joints(bodies)}"] if bodies.still else []
    if endless := [joint.name for chain in chains for joint in chain if joint.limits is None]:
        which = "any joint" if len(endless) == len(LEGS) * len(JOINTS) else ", ".join(endless)
        notes.append(f"the description has no limits of {which}: set legs.servo_limits_deg to where the brackets stop it")
    origin, size = _trunk(bodies, described, notes)
    data, battery = _servo([joint for chain in chains for joint in chain], servo, notes)
    most = math.floor(np.degrees(data.servo_model.units.range_rad) * 10 + 1e-6) / 10  # [deg] in both directions
    first = 0 if data.pulses else 1  # servo id, or channel of a board
    horns = _horns(described, most, notes)
    profile = RobotProfile(
        name=description.name[:100].strip() or "imported",
        servo=data,
        horn_offsets_deg=_three(horns, _ANGLE_DIGITS),
        links=_links(described),
        body=_body(bodies, described, origin, size, notes),
        foot=_foot(described, notes),
        stance=PLACEHOLDER_STANCE,
        legs=tuple(_leg(k, leg, horns, most, origin, first) for k, leg in enumerate(described)),  # type: ignore[arg-type]
        camera=_camera(bodies, origin, size, notes),
        battery=battery,
    )
    profile = replace(profile, stance=proposed_stance(profile))
    notes.append(
        f"{'channels' if data.pulses else 'servo ids'} are {first} to {first + 17}, horns and signs those of the description: "
        "`sextant servos calibrate` measures them"
    )
    notes.append(f"screw the horns on with each servo at its centre and its joint at: {angles_at_centre(profile)}")
    error = _foot_error(bodies, chains, described, feet, profile, origin)
    joints = {leg: chain.joints for leg, chain in zip(LEGS, described, strict=True)}
    return ImportedProfile(profile, joints, tuple(notes), error)


class LegTable(NamedTuple):
    """Legs of a description as a user states them."""

    joints: dict[str, list[str]]  # names of coxa, femur and tibia joint by leg; empty if not stated
    feet: dict[str, list[float]]  # (3,) [m] {last link} centres of the feet by leg; empty if not stated


def read_legs(path: Path) -> LegTable:
    """Read a table of legs: their joints, such as `"left front" = ["a", "b", "c"]`, feet in a table `[feet]`, or both.

    Raises:
        DescriptionError: It is not such a table.
        FileError: The file cannot be read.
    """
    table = input_file.read_toml(path)
    feet = table.pop("feet", {})
    if unknown := [key for key in table if key not in LEGS]:
        raise DescriptionError(f"{path}: no leg {unknown[0]!r}; {hint(unknown[0], LEGS)}")
    named = LEGS if table or not feet else ()
    for leg in named:
        found = table.get(leg)
        if not (isinstance(found, list) and len(found) == len(JOINTS) and all(isinstance(name, str) for name in found)):
            raise DescriptionError(f"{path}: {leg}: the names of {', '.join(JOINTS)} joint expected, found {found!r}")
    names = [name for leg in named for name in table[leg]]
    if twice := [name for name in names if names.count(name) > 1]:
        raise DescriptionError(f"{path}: each joint once expected, found {twice[0]!r} twice")
    if not isinstance(feet, dict) or (feet and feet.keys() != set(LEGS)):
        raise DescriptionError(f"{path}: feet: a table with the foot of each leg expected, found {feet!r:.60}")
    for leg, place in feet.items():
        if not (isinstance(place, list) and len(place) == 3 and all(type(p) in (int, float) and abs(p) < 10 for p in place)):
            raise DescriptionError(f"{path}: feet: {leg}: its centre [x, y, z] in metres expected, found {place!r:.60}")
    return LegTable({leg: table[leg] for leg in named}, feet)


def _horns(described: Sequence[DescribedLeg], most: float, notes: list[str]) -> Array:
    """Return horn offsets (3,) [deg] with which servo angles are those of the description, or else the limits fit the servo.

    A servo turns by `most` [deg] in both directions.
    """
    zeros, limits = np.degrees([leg.zeros for leg in described]), np.degrees([leg.limits for leg in described])
    horns = -np.median(zeros, axis=0)
    centred = -np.median(limits.mean(axis=2), axis=0)
    fits = (np.abs(limits + horns[:, None]) <= most + 1e-6).all(axis=(0, 2))
    horns = np.where(fits, horns, centred)
    if (np.abs(limits + horns[:, None]) > most + 1e-6).any():
        notes.append(f"limits are reduced to {most:g} deg in both directions, the range of the servos")
    return np.asarray(np.round(horns, _ANGLE_DIGITS)) + 0.0


def _links(described: Sequence[DescribedLeg]) -> LegLinks:
    lengths = np.array([leg.lengths for leg in described])
    spread = np.ptp(lengths, axis=0)
    if spread.max() > _LENGTH_TOLERANCE_M:
        k = int(np.argmax(spread))
        part, (low, high) = ("coxa", "femur", "tibia")[k], (lengths[:, k].min(), lengths[:, k].max())
        raise DescriptionError(f"six legs of one size expected, found {part} lengths of {low:.4f} to {high:.4f} m")
    coxa, femur, tibia = np.round(np.median(lengths, axis=0), _LENGTH_DIGITS).tolist()
    if min(coxa, femur, tibia) < 0.001:
        found = f"coxa {coxa:.4f}, femur {femur:.4f}, tibia {tibia:.4f} m"
        raise DescriptionError(
            f"links of at least 1 mm expected, found {found}; is the order of the joints coxa, femur, tibia?"
        )
    return LegLinks(coxa, femur, tibia)


def _leg(k: int, leg: DescribedLeg, horns: Array, most: float, origin: Array, first: int) -> Leg:
    """Return a leg of the profile; the servo angle is that of the description, where all legs have the same zero.

    Servo ids begin with `first` at the first leg.
    """
    servo = np.sort(leg.signs[:, None] * (np.degrees(leg.limits) + horns[:, None]), axis=1)
    servo = servo.clip(-most, most).round(_ANGLE_DIGITS)
    if (np.ptp(servo, axis=1) <= 0.0).any():
        joint = leg.joints[int(np.argmin(np.ptp(servo, axis=1)))]
        raise DescriptionError(f"joint {joint}: limits within {most:g} deg of the servo's centre expected")
    signs = leg.signs.astype(int).tolist()
    return Leg(
        name=LEGS[k],
        mount_xyz=_three(leg.mount - origin),
        neutral_yaw_deg=round(float(np.degrees(leg.yaw)), _ANGLE_DIGITS) + 0.0,
        servo_ids=(3 * k + first, 3 * k + first + 1, 3 * k + first + 2),
        servo_signs=(signs[0], signs[1], signs[2]),
        servo_limits_deg=tuple((low, high) for low, high in servo.tolist()),  # type: ignore[arg-type]
    )


def _servo(joints: Sequence[DescribedJoint], word: str | None, notes: list[str]) -> tuple[Servo, Battery]:
    """Return servo and battery.

    A model or a board takes torque, speed, friction and armature of the description where it states them. A file or a profile
    states its own.
    """
    if word is not None and word not in (*MODEL_NAMED, *BOARDS):
        notes.append(f"servos and battery are those of {word}; torque and speed of the description are not used")
        return chosen_servo(word)
    efforts, velocities = [joint.effort for joint in joints], [joint.speed for joint in joints]
    torques, speeds = [t for t in efforts if 0 < t < _NO_SERVO_NM], [v for v in velocities if 0 < v < _NO_SERVO_RAD_S]
    for values, those, unit in ((efforts, torques, "N m"), (velocities, speeds, "rad/s")):
        if not those and max(values, default=0.0) > 0:
            notes.append(f"no servo has {max(values):g} {unit}: the value of the servo model is used")
    torque = round(float(np.median(torques)), _OTHER_DIGITS) if torques else None
    if word is not None and word in BOARDS:
        servo, battery = chosen_servo(word)
        torque = torque or servo.stall_torque
        servo = replace(servo, stall_torque=torque, stiffness=servo.stiffness * torque / servo.stall_torque)
        notes.append(
            "pulses, and what the description does not state of [servo], are those of a DS3218: "
            "correct them for other servos, see docs/hobby_servos.md"
        )
    else:
        name = word or nearest_servo(torque)
        servo, battery = proposed_servo(name, torque), proposed_battery(name)
    if torque is None:
        notes.append(f"the description states no torque: that of {servo.model} at its usual voltage is used")
    elif word is None:
        notes.append(f"servo model {servo.model}, chosen by the torque of {torque:g} N m; give another with --servo")
    frictions = [joint.friction for joint in joints if joint.friction]
    armatures = [joint.armature for joint in joints if joint.armature]
    servo = replace(
        servo,
        no_load_speed=round(float(np.median(speeds)), _OTHER_DIGITS) if speeds else servo.no_load_speed,
        friction=float(np.median(frictions)) if frictions else servo.friction,
        armature=float(np.median(armatures)) if armatures else servo.armature,
    )
    return servo, battery


def _trunk(bodies: DescribedBodies, described: Sequence[DescribedLeg], notes: list[str]) -> tuple[Array, Array]:
    """Return middle (3,) [m] {first link} and size (3,) [m] of the trunk, by its shapes or by the places of the legs."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    boxes = [
        (T @ shape.T_link_shape)[:3, :3] @ (corners * shape.half_size).T + (T @ shape.T_link_shape)[:3, 3:]
        for link, T in bodies.links(bodies.root)
        for shape in link.shapes
    ]
    points = np.concatenate(boxes, axis=1) if boxes else np.array([leg.mount for leg in described]).T
    low, high = points.min(axis=1), points.max(axis=1)
    size, middle = high - low, (low + high) / 2
    if not boxes:
        notes.append("the trunk has no simple shapes: its size is that of the places of the legs; set body.size")
        size = np.array([size[0], size[1] * 0.7, _TRUNK_HEIGHT_M])
    middle = np.where(np.abs(middle) < 1e-9, 0.0, middle)
    if middle.any():
        where = ", ".join(f"{c:.4f}" for c in middle.tolist())
        notes.append(f"the body's origin is the middle of the trunk, ({where}) m from that of the first link")
    return middle, size


def _body(bodies: DescribedBodies, described: Sequence[DescribedLeg], origin: Array, size: Array, notes: list[str]) -> Body:
    masses = np.median([leg.masses for leg in described], axis=0)
    mass = bodies.mass(bodies.root)
    if mass <= 0.0 or (masses <= 0.0).any():
        raise DescriptionError("a mass of the trunk and of each link of a leg expected (<inertial>), found none")
    centre = bodies.centre_of_mass(bodies.root) - origin
    inside = np.clip(centre, -size / 2, size / 2)
    if np.abs(centre - inside).max() > 1e-9:
        notes.append("the centre of mass is outside of the trunk: it was moved to its edge; set body.centre_of_mass")
    centre = np.where(np.abs(inside) < 1e-12, 0.0, inside)
    body = Body(_three(size), round(mass, _LENGTH_DIGITS), _three(masses), _three(centre))
    of_links = np.median([leg.inertias for leg in described], axis=0)
    of_trunk = _trunk_inertia(bodies.inertia(bodies.root), body, notes)
    return replace(body, inertia=of_trunk, leg_link_inertias=_three(of_links, _INERTIA_DIGITS))


def _trunk_inertia(inertia: Array, body: Body, notes: list[str]) -> tuple[float, float, float]:
    """Return the moments of inertia of a trunk in axes of the body; zeros, those of a uniform box, if they are unusable."""
    if not inertia.any():
        notes.append("the description states no inertia of the trunk: that of a uniform box is used")
        return 0.0, 0.0, 0.0
    around = np.diag(inertia)
    if np.abs(inertia - np.diag(around)).max() > _TURNED * around.max():
        notes.append("the trunk's axes of inertia are turned against the body: only the moments around x, y and z are taken")
    found = _three(around, _INERTIA_DIGITS)
    try:
        replace(body, inertia=found)
    except ValueError:
        notes.append("the trunk's inertia is that of no body: that of a uniform box is used; set body.inertia")
        return 0.0, 0.0, 0.0
    return found


def _foot(described: Sequence[DescribedLeg], notes: list[str]) -> Foot:
    radii = [leg.foot_radius for leg in described if leg.foot_radius > 0]
    if not radii:
        notes.append(f"the description shows no round foot: a radius of {_FOOT_RADIUS_M:g} m is assumed; set foot.radius")
    return Foot(float(np.median(radii)) if radii else _FOOT_RADIUS_M)


def _camera(bodies: DescribedBodies, origin: Array, size: Array, notes: list[str]) -> Camera:
    """Return the camera: placed by the trunk's optical frame if there is one, with proposed intrinsics."""
    camera = proposed_camera(size)
    frames = [T for link, T in bodies.links(bodies.root) if _OPTICAL in link.name]
    notes.append("intrinsics and noise of the camera are those of a RealSense D435; set [camera]")
    if not frames:
        notes.append(
            "the description has no optical frame: the camera is placed over the front of the trunk; set camera.mount_xyz"
        )
        return camera
    T_mount_optical = inverse(camera.T_body_mount) @ camera.T_body_camera
    T = frames[0] @ inverse(T_mount_optical)
    roll, pitch, yaw = np.round(np.degrees(rpy_from_rotation(T[:3, :3])), _ANGLE_DIGITS).tolist()
    return replace(
        camera, mount_xyz=_three(T[:3, 3] - origin), roll_deg=roll, pitch_down_deg=float(np.clip(pitch, -45, 90)), yaw_deg=yaw
    )


def _foot_error(
    bodies: DescribedBodies,
    chains: Sequence[Sequence[DescribedJoint]],
    described: Sequence[DescribedLeg],
    feet_given: Mapping[str, Array],
    profile: RobotProfile,
    origin: Array,
) -> float:
    """Return the largest distance [m] of the profile's feet from those of the description, in random poses."""
    rng, worst = np.random.default_rng(_SEED), 0.0
    angles = rng.uniform(profile.joint_limits[..., 0], profile.joint_limits[..., 1], (_POSES, 6, 3))
    feet = body_forward(profile, angles)
    for k, (name, chain, leg) in enumerate(zip(LEGS, chains, described, strict=True)):
        start = foot_at_zero(bodies, name, chain, feet_given.get(name))
        for q, p in zip(angles[:, k], feet[:, k], strict=True):
            there = foot_position(bodies, chain, start, leg.signs * (q - leg.zeros)) - origin
            worst = max(worst, float(np.linalg.norm(there - p)))
    return worst


def _three(values: Array, digits: int = _LENGTH_DIGITS) -> tuple[float, float, float]:
    x, y, z = (round(float(value), digits) + 0.0 for value in values)
    return x, y, z
