"""Load distribution over the legs, and servo feed-forward against sag.

An AX-12A is a spring of about 9 N m/rad around its goal: a femur that carries 1 N m deflects by 6 degrees, 13 mm at the foot.
The load of each leg follows from statics, so the goal exceeds the wanted angle by torque over stiffness. Legs are loaded and
unloaded gradually. Carrying feet push slightly outwards; the friction force there relieves the femora.
"""

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import joint_torques, leg_points, link_torques
from sextant.shared.robot.profile import GRAVITY, RobotProfile

# Keeps the forces bounded while a tripod degenerates; 1e-6 of the contribution of a standing leg.
_DAMPING = np.diag([1e-6, 1e-8, 1e-8])
_OUTWARDS = 0.15  # mean outward push as a share of the load; friction of rubber on wood is 0.5 or more


def foot_forces(feet: Array, share: Array, weight: float, p_com: Array) -> Array:
    """Return vertical ground forces that balance the robot (weighted least squares).

    Args:
        feet: (6, 3) [m] {body, level} feet.
        share: (6,) share of its load that each leg may carry, 0 to 1.
        weight: [N] of the robot.
        p_com: (3,) [m] {body, level} centre of mass.

    Returns:
        (6,) [N], zero where the share is zero. With fewer than three carrying legs the balance is only approximate.
    """
    A = np.ones((3, 6))
    A[1:] = (feet[:, :2] - p_com[:2]).T
    forces = share * (np.linalg.solve((A * share) @ A.T + _DAMPING, np.array([weight, 0.0, 0.0])) @ A)
    return np.asarray(np.maximum(forces, 0.0))


def outward_forces(feet: Array, vertical: Array, p_com: Array) -> Array:
    """Return horizontal ground forces on feet that push outwards.

    They relieve the femora and move nothing.

    Each is proportional to the foot's load and to its distance from the centre of mass. If the loads balance about that centre,
    these forces sum to zero, and they have no moment about it.

    Args:
        feet: (6, 3) [m] {body, level} feet.
        vertical: (6,) [N] vertical loads, from `foot_forces`.
        p_com: (3,) [m] {body, level} centre of mass.

    Returns:
        (6, 2) [N] {body, level}, towards the centre of mass.
    """
    away = feet[:, :2] - p_com[:2]
    return np.asarray(-_OUTWARDS * vertical[:, None] * away / np.linalg.norm(away, axis=1).mean())


def centre_of_mass(profile: RobotProfile, q: Array) -> Array:
    """Return the centre of mass (3,) [m] {body} at joint angles q (6, 3) [rad].

    Each link's mass is in its middle. Legs are two fifths of a robot like the PhantomX, so the centre moves by more than a
    centimetre when a tripod swings.
    """
    points = leg_points(profile, q)
    middles = (points[:, :-1] + points[:, 1:]) / 2
    masses = np.array([profile.body.leg_link_masses])
    return np.asarray((masses @ middles.sum(axis=0))[0] / profile.body.total_mass)


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
    servo = profile.servo
    rate = np.minimum(np.maximum(q_rate, -servo.no_load_speed), servo.no_load_speed)
    return np.asarray(rate * (servo.damping / servo.stiffness + held_s / 2))


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
    # While no leg may carry its whole load, as in standing up, the belly on the ground carries the rest.
    weight = profile.body.total_mass * GRAVITY * float(share.max())
    forces = np.zeros((6, 3))
    feet, p_com = feet @ R_level_body.T, centre_of_mass(profile, q) @ R_level_body.T
    forces[:, 2] = foot_forces(feet, share, weight, p_com)
    forces[:, :2] = outward_forces(feet, forces[:, 2], p_com)
    torques = joint_torques(profile, q, forces @ R_level_body) + link_torques(profile, q)
    limit = profile.servo.stall_torque
    return np.asarray(np.minimum(np.maximum(torques, -limit), limit) / profile.servo.stiffness)
