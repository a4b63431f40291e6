"""Which leg carries how much, and what the servos need to hold it without sagging.

An AX-12A is a spring of about 9 N m/rad around its goal: a femur that carries 1 N m gives way by 6 degrees, 13 mm at the foot.
The load of each leg is known from statics, so the goal is set beyond the wanted angle by torque over stiffness, and legs take
up and hand over their share gradually. Feet push outwards a little as they carry: what friction then holds is taken off femora.
"""

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import joint_torques, leg_points
from sextant.shared.robot.profile import GRAVITY, RobotProfile

# Keeps the forces bounded while a tripod degenerates; it is 1e-6 of what a standing leg gives.
_DAMPING = np.diag([1e-6, 1e-8, 1e-8])
_OUTWARDS = 0.15  # share of its load by which a foot pushes outwards, in the mean; rubber on wood holds 0.5 and more


def foot_forces(feet: Array, share: Array, weight: float, p_com: Array) -> Array:
    """Vertical forces of the ground on the feet that balance the robot: the least-squares solution, weighted by share.

    Args:
        feet: (6, 3) [m] {body, level} feet.
        share: (6,) how far each leg may carry, 0 to 1.
        weight: [N] of the robot.
        p_com: (3,) [m] {body, level} centre of mass.

    Returns:
        (6,) [N], zero where the share is zero. Where fewer than three legs may carry the balance is only approximate.
    """
    A = np.ones((3, 6))
    A[1:] = (feet[:, :2] - p_com[:2]).T
    forces = share * (np.linalg.solve((A * share) @ A.T + _DAMPING, np.array([weight, 0.0, 0.0])) @ A)
    return np.asarray(np.maximum(forces, 0.0))


def outward_forces(feet: Array, vertical: Array, p_com: Array) -> Array:
    """Horizontal forces of the ground on feet that push outwards, which spare the femora and move nothing.

    Each is proportional to the foot's load and to its way from the centre of mass: where the loads balance about that centre,
    these forces sum to zero, and along those ways they turn nothing.

    Args:
        feet: (6, 3) [m] {body, level} feet.
        vertical: (6,) [N] that they carry, as `foot_forces` gives them.
        p_com: (3,) [m] {body, level} centre of mass.

    Returns:
        (6, 2) [N] {body, level}, towards the centre of mass.
    """
    away = feet[:, :2] - p_com[:2]
    return np.asarray(-_OUTWARDS * vertical[:, None] * away / np.linalg.norm(away, axis=1).mean())


def centre_of_mass(profile: RobotProfile, q: Array) -> Array:
    """Centre of the robot's mass (3,) [m] {body} at joint angles q (6, 3) [rad], each link's taken to sit in its middle.

    Legs are two fifths of a robot like the PhantomX: it moves by more than a centimetre as a tripod swings.
    """
    points = leg_points(profile, q)
    middles = (points[:, :-1] + points[:, 1:]) / 2
    masses = np.array([profile.body.leg_link_masses])
    return np.asarray((masses @ middles.sum(axis=0))[0] / profile.body.total_mass)


def link_torques(profile: RobotProfile, q: Array) -> Array:
    """Motor torques (6, 3) [N m] that hold the legs' own links up, the body level, at joint angles q (6, 3) [rad].

    The links' masses are taken to sit in their middles.
    """
    _, femur_mass, tibia_mass = profile.body.leg_link_masses
    femur, tibia = profile.links.femur * np.cos(q[:, 1]), profile.links.tibia * np.cos(q[:, 1] + q[:, 2])
    torques = np.zeros((6, 3))
    torques[:, 2] = GRAVITY * tibia_mass * tibia / 2
    torques[:, 1] = torques[:, 2] + GRAVITY * (femur_mass / 2 + tibia_mass) * femur
    return torques


def lag_feed_forward(profile: RobotProfile, q_rate: Array, held_s: float) -> Array:
    """What to add to moving joints' angles so that the servos keep up with them, instead of following a few hundredths late.

    Args:
        profile: The robot.
        q_rate: (6, 3) [rad/s] wanted joint speeds.
        held_s: [s] for which a goal stands until the next one comes; in the mean it is half as old.

    Returns:
        (6, 3) [rad]: what a servo moves while a goal stands, and the error from which it draws the torque to move so fast.
    """
    servo = profile.servo
    rate = np.minimum(np.maximum(q_rate, -servo.no_load_speed), servo.no_load_speed)
    return np.asarray(rate * (servo.damping / servo.stiffness + held_s / 2))


def sag_feed_forward(profile: RobotProfile, q: Array, feet: Array, share: Array, R_level_body: Array) -> Array:
    """What to add to joint angles so that the loaded servos come to rest at them.

    Args:
        profile: The robot.
        q: (6, 3) [rad] wanted joint angles.
        feet: (6, 3) [m] {body} wanted feet.
        share: (6,) how far each leg carries, 0 to 1.
        R_level_body: (3, 3) attitude of the body towards gravity.

    Returns:
        (6, 3) [rad], at most what the servo's full torque gives.
    """
    # Where no leg may carry the whole of its load yet, as while it stands up, the belly lies on the ground for the rest.
    weight = profile.body.total_mass * GRAVITY * float(share.max())
    forces = np.zeros((6, 3))
    feet, p_com = feet @ R_level_body.T, centre_of_mass(profile, q) @ R_level_body.T
    forces[:, 2] = foot_forces(feet, share, weight, p_com)
    forces[:, :2] = outward_forces(feet, forces[:, 2], p_com)
    torques = joint_torques(profile, q, forces @ R_level_body) + link_torques(profile, q)
    limit = profile.servo.stall_torque
    return np.asarray(np.minimum(np.maximum(torques, -limit), limit) / profile.servo.stiffness)
