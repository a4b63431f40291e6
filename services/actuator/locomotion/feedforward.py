"""Load distribution over the legs, and servo feed-forward against sag.

An AX-12A is a spring of about 9 N m/rad around its goal: a femur that carries 1 N m deflects by 6 degrees, 13 mm at the foot.
The load of each leg follows from statics, so the goal exceeds the wanted angle by torque over stiffness. Legs are loaded and
unloaded gradually. Carrying feet push slightly outwards; the friction force there relieves the femora.

The statics are computed in plain numbers, see `sextant.shared.robot.kinematics`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import GRAVITY, RobotProfile

# Keep the forces bounded while a tripod degenerates; 1e-6 of the contribution of a standing leg.
_DAMPING, _DAMPING_M2 = 1e-6, 1e-8
_OUTWARDS = 0.15  # mean outward push as a share of the load; friction of rubber on wood is 0.5 or more

Horizontal = tuple[float, float]  # two horizontal components of a point [m] or of a force [N]


class LegShape(NamedTuple):
    """A leg in the vertical plane through its coxa axis."""

    x_out: float  # {body} horizontal direction of that plane, outwards
    y_out: float
    femur_x: float  # [m] femur axis to knee, outwards
    femur_z: float  # [m] the same, upwards
    tibia_x: float  # [m] knee to foot, outwards
    tibia_z: float  # [m] the same, upwards


def leg_shapes(profile: RobotProfile, q: Array) -> list[LegShape]:
    """Return the shapes of the six legs at joint angles q (6, 3) [rad]."""
    links, shapes = profile.links, []
    for (coxa, femur, tibia), frame in zip(q.tolist(), profile.coxa_frames, strict=True):
        c, s = math.cos(coxa), math.sin(coxa)
        shank = femur + tibia
        shapes.append(
            LegShape(
                frame.cos * c - frame.sin * s,
                frame.sin * c + frame.cos * s,
                links.femur * math.cos(femur),
                links.femur * math.sin(femur),
                links.tibia * math.cos(shank),
                links.tibia * math.sin(shank),
            )
        )
    return shapes


def foot_forces(feet: Sequence[Horizontal], share: Sequence[float], weight: float) -> list[float]:
    """Return vertical ground forces that balance the robot (weighted least squares).

    Args:
        feet: [m] {body, level} horizontal places of the feet relative to the centre of mass.
        share: Share of its load that each leg may carry, 0 to 1.
        weight: [N] of the robot.

    Returns:
        [N] for each foot, zero where the share is zero. With fewer than three carrying legs the balance is only approximate.
    """
    s0, sx, sy, sxx, sxy, syy = _DAMPING, 0.0, 0.0, _DAMPING_M2, 0.0, _DAMPING_M2
    for (x, y), part in zip(feet, share, strict=True):
        s0 += part
        sx += part * x
        sy += part * y
        sxx += part * x * x
        sxy += part * x * y
        syy += part * y * y
    # The forces are share * (a + b x + c y); their sum is the weight, and their moments are zero.
    a, b, c = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
    scale = weight / (s0 * a + sx * b + sy * c)
    return [max(scale * part * (a + b * x + c * y), 0.0) for (x, y), part in zip(feet, share, strict=True)]


def outward_forces(feet: Sequence[Horizontal], vertical: Sequence[float]) -> list[Horizontal]:
    """Return horizontal ground forces on feet that push outwards.

    They relieve the femora and move nothing.

    Each is proportional to the foot's load and to its distance from the centre of mass. If the loads balance about that centre,
    these forces sum to zero, and they have no moment about it.

    Args:
        feet: [m] {body, level} horizontal places of the feet relative to the centre of mass.
        vertical: [N] vertical loads, from `foot_forces`.

    Returns:
        [N] {body, level} for each foot, towards the centre of mass.
    """
    push = -_OUTWARDS * len(feet) / sum(math.hypot(x, y) for x, y in feet)
    return [(push * load * x, push * load * y) for (x, y), load in zip(feet, vertical, strict=True)]


def centre_of_mass(profile: RobotProfile, legs: Sequence[LegShape]) -> tuple[float, float, float]:
    """Return the centre of mass [m] {body} of a robot whose legs have these shapes.

    Each link's mass is in its middle. Legs are two fifths of a robot like the PhantomX, so the centre moves by more than a
    centimetre when a tripod swings.
    """
    body, offset = profile.body, profile.links.coxa
    coxa_mass, femur_mass, tibia_mass = body.leg_link_masses
    beyond, leg_mass = femur_mass / 2 + tibia_mass, coxa_mass + femur_mass + tibia_mass
    at_axis = offset * (coxa_mass / 2 + femur_mass + tibia_mass)
    x, y, z = (body.mass * part for part in body.centre_of_mass)
    for leg, frame in zip(legs, profile.coxa_frames, strict=True):
        out = at_axis + beyond * leg.femur_x + tibia_mass / 2 * leg.tibia_x
        x += leg_mass * frame.x + out * leg.x_out
        y += leg_mass * frame.y + out * leg.y_out
        z += leg_mass * frame.z + beyond * leg.femur_z + tibia_mass / 2 * leg.tibia_z
    return x / body.total_mass, y / body.total_mass, z / body.total_mass


def lag_feed_forward(profile: RobotProfile, q_rate: Array, held_s: float) -> Array:
    """Return the offset of joint goals that compensates the servo lag.

    Without it servos follow a few hundredths of a second late.

    Args:
        profile: The robot.
        q_rate: (6, 3) [rad/s] wanted joint speeds.
        held_s: [s] between two goals; the mean age of a goal is half of it.

    Returns:
        (6, 3) [rad]: half the motion between two goals, plus the position error whose torque maintains the speed.
    """
    servos = profile.servos
    rate = np.minimum(np.maximum(q_rate, -servos.no_load_speed), servos.no_load_speed)
    return np.asarray(rate * (servos.lag_s + held_s / 2))


def sag_feed_forward(profile: RobotProfile, q: Array, feet: Array, share: Array, R_level_body: Array) -> Array:
    """Return the offset of joint goals that compensates the sag of loaded servos.

    Args:
        profile: The robot.
        q: (6, 3) [rad] wanted joint angles.
        feet: (6, 3) [m] {body} wanted feet.
        share: (6,) share of its load that each leg carries, 0 to 1.
        R_level_body: (3, 3) attitude of the body against gravity.

    Returns:
        (6, 3) [rad], at most the deflection at full servo torque.
    """
    legs, shares = leg_shapes(profile, q), share.tolist()
    x_com, y_com, z_com = centre_of_mass(profile, legs)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R_level_body.tolist()
    arms = [(x - x_com, y - y_com, z - z_com) for x, y, z in feet.tolist()]
    level = [(xx * x + xy * y + xz * z, yx * x + yy * y + yz * z) for x, y, z in arms]
    # While no leg may carry its whole load, as in standing up, the belly on the ground carries the rest.
    vertical = foot_forces(level, shares, profile.body.total_mass * GRAVITY * max(shares))
    horizontal = outward_forces(level, vertical)
    servos, offset = profile.servos, profile.links.coxa
    _, femur_mass, tibia_mass = profile.body.leg_link_masses
    sag = []
    for leg, (fx, fy), fz in zip(legs, horizontal, vertical, strict=True):
        x, y, up = xx * fx + yx * fy + zx * fz, xy * fx + yy * fy + zy * fz, xz * fx + yz * fy + zz * fz  # {body}
        out, aside = x * leg.x_out + y * leg.y_out, y * leg.x_out - x * leg.y_out
        # Motor torques -J^T f, and those that hold the links, see `link_torques`.
        coxa = -(offset + leg.femur_x + leg.tibia_x) * aside
        tibia = leg.tibia_z * out - leg.tibia_x * up + GRAVITY * tibia_mass / 2 * leg.tibia_x
        femur = leg.femur_z * out - leg.femur_x * up + GRAVITY * (femur_mass / 2 + tibia_mass) * leg.femur_x + tibia
        sag.append((coxa, femur, tibia))
    return np.minimum(np.maximum(sag, -servos.stall_torque), servos.stall_torque) / servos.stiffness
