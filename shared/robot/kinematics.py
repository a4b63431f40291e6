"""Forward and inverse kinematics of the legs, in closed form.

All functions are batched over legs and time. Those of the control loop compute one robot in plain numbers, because for six legs
an array costs more than its arithmetic.

Sources: Masri 2016, eq. (3.2)-(3.10), and Lotriet 2024, eq. (5.2)-(5.13). docs/kinematics.md maps their angles to ours and
lists every misprint with its correction and the test that proves it. In short, this code uses

- Masri's (3.5) with the horizontal reach d_p, not d_l, in the denominator, and with his z axis downward;
- Lotriet's (5.2) with z_t over d - L_1 in the second row, (5.4) with L_2 and L_3, (5.7)-(5.8) with cosines for the horizontal
  reach, and an arctangent instead of the arcsine in (5.3), which also holds for the obtuse angles of a foot near the body.

The angles q are defined in `sextant.shared.robot.profile`: coxa about z, femur upward from the horizontal, tibia from the
straight continuation of the femur, positive upward. The coxa frame has its origin on the coxa axis, x outward along the neutral
leg, z up.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.body import LegLinks
from sextant.shared.robot.profile import GRAVITY, CoxaFrame, RobotProfile

Point = tuple[float, float, float]  # x, y, z

SINGULAR = 1e-6  # [m] of horizontal reach, or sine of the knee angle; below it joint rates are NaN
_REACH_MARGIN = 1e-4  # [m] inside the reach, so that rounding errors do not exceed it
_OUT_OF_REACH = (math.nan, math.nan, math.nan)


def leg_forward(q: Array, links: LegLinks) -> Array:
    """Compute the foot position of a leg from its joint angles.

    Args:
        q: (..., 3) [rad] coxa, femur and tibia angles.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3) [m] {coxa} centre of the foot.

    Raises:
        ValueError: The last axis is not 3.

    Source: Lotriet 2024, eq. (5.7)-(5.8), with cosines in place of the sines in the horizontal reach.
    """
    _check(q, "joint angles", 3)
    femur, shank = q[..., 1], q[..., 1] + q[..., 2]
    reach = links.coxa + links.femur * np.cos(femur) + links.tibia * np.cos(shank)
    foot = np.empty(q.shape)
    foot[..., 0] = reach * np.cos(q[..., 0])
    foot[..., 1] = reach * np.sin(q[..., 0])
    foot[..., 2] = links.femur * np.sin(femur) + links.tibia * np.sin(shank)
    return foot


def leg_inverse(p: Array, links: LegLinks) -> Array:
    """Compute the joint angles that place the foot at a point.

    The leg faces the point, and the knee is up.

    Args:
        p: (..., 3) [m] {coxa} centre of the foot.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3) [rad] coxa and femur in (-pi, pi], tibia in [-pi, 0]. A row is NaN where the foot is out of reach or not
        finite. Nothing is clamped, and joint limits are not checked (see `within_limits`).

    Raises:
        ValueError: The last axis is not 3.

    Source: Masri 2016, eq. (3.2)-(3.10), with (3.5) read as atan(f_z / d_p). His beta is the femur angle, his gamma the tibia
    angle plus pi. One arctangent replaces the sum of his epsilon and delta, because it stays exact near the stretched leg.
    """
    _check(p, "foot", 3)
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    femur, tibia = links.femur, links.tibia
    q = np.empty(p.shape)
    with np.errstate(invalid="ignore", over="ignore"):  # NaN is the documented result
        d_p = np.sqrt(x * x + y * y) - links.coxa  # (3.3)
        cos_knee = (d_p * d_p + z * z - (femur * femur + tibia * tibia)) / (2.0 * femur * tibia)  # (3.4), (3.9)
        sin_knee = -np.sqrt((1.0 - cos_knee) * (1.0 + cos_knee))  # negative: knee up; NaN out of reach
        along, across = femur + tibia * cos_knee, tibia * sin_knee  # from femur axis to foot, in the femur's frame
        q[..., 0] = np.arctan2(y, x) + 0.0 * sin_knee  # (3.2); 0.0 * NaN makes the whole row NaN
        q[..., 1] = np.arctan2(z * along - d_p * across, d_p * along + z * across)  # (3.5)-(3.8)
        q[..., 2] = np.arctan2(sin_knee, cos_knee)  # (3.10)
    return q


def leg_jacobian(q: Array, links: LegLinks) -> Array:
    """Compute the Jacobian of `leg_forward`: foot velocity per joint rate.

    Args:
        q: (..., 3) [rad] joint angles.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3, 3) [m/rad] {coxa}, rows x, y, z and columns coxa, femur, tibia.

    Raises:
        ValueError: The last axis is not 3.
    """
    _check(q, "joint angles", 3)
    c1, s1, reach, z, shank_x, shank_z = _planar(q, links)
    J = np.empty((*q.shape, 3))
    J[..., 0, 0] = -reach * s1
    J[..., 1, 0] = reach * c1
    J[..., 2, 0] = 0.0
    J[..., 0, 1] = -z * c1
    J[..., 1, 1] = -z * s1
    J[..., 2, 1] = reach - links.coxa
    J[..., 0, 2] = -shank_z * c1
    J[..., 1, 2] = -shank_z * s1
    J[..., 2, 2] = shank_x
    return J


def joint_rates(q: Array, foot_velocity: Array, links: LegLinks) -> Array:
    """Compute the joint rates that move the foot at a velocity.

    Args:
        q: (..., 3) [rad] joint angles.
        foot_velocity: (..., 3) [m/s] {coxa}.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3) [rad/s]. A row is NaN where no finite rates exist: the leg is stretched or folded, the foot is on the coxa
        axis, or an input is not finite.

    Raises:
        ValueError: The last axes are not 3.

    Source: the derivative of the corrected eq. (5.2), as intended by Lotriet 2024, eq. (5.9)-(5.13). The second row there
    differentiates the product of alpha and an arctangent, but (5.2) has their sum.
    """
    _check(q, "joint angles", 3)
    _check(foot_velocity, "foot velocity", 3)
    vx, vy, vz = foot_velocity[..., 0], foot_velocity[..., 1], foot_velocity[..., 2]
    rates = np.empty(np.broadcast_shapes(q.shape, foot_velocity.shape))
    with np.errstate(invalid="ignore", over="ignore"):
        c1, s1, reach, z, shank_x, shank_z = _planar(q, links)
        sin_knee = np.sin(q[..., 2])
        regular = (np.abs(reach) > SINGULAR) & (np.abs(sin_knee) > SINGULAR)
        outward = c1 * vx + s1 * vy
        determinant = np.where(regular, links.femur * links.tibia * sin_knee, np.nan)
        rates[..., 0] = (c1 * vy - s1 * vx) / np.where(regular, reach, np.nan)
        rates[..., 1] = (shank_x * outward + shank_z * vz) / determinant
        rates[..., 2] = -((reach - links.coxa) * outward + z * vz) / determinant
        rates += 0.0 * rates.sum(axis=-1, keepdims=True)  # one rate that is not finite makes the row NaN
    return rates


def body_inverse(profile: RobotProfile, feet_body: Array) -> Array:
    """Compute the joint angles of all legs from the foot positions.

    Args:
        profile: The robot.
        feet_body: (..., 6, 3) [m] {body} foot centres.

    Returns:
        (..., 6, 3) [rad] joint angles; the row of a leg whose foot is out of reach is NaN. Joint limits are not checked.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(feet_body, "feet", 6, 3)
    links = profile.links
    if feet_body.ndim == 2:
        feet = zip(feet_body.tolist(), profile.coxa_frames, strict=True)
        return np.array([_inverse_of_one(x, y, z, frame, links) for (x, y, z), frame in feet])
    R, p = profile.T_body_coxa[:, :3, :3], profile.T_body_coxa[:, :3, 3]
    return leg_inverse(((feet_body - p)[..., None, :] @ R)[..., 0, :], links)


def _inverse_of_one(x: float, y: float, z: float, frame: CoxaFrame, links: LegLinks) -> tuple[float, float, float]:
    """Compute `leg_inverse` of a foot [m] {body}."""
    dx, dy, z = x - frame.x, y - frame.y, z - frame.z
    x, y = frame.cos * dx + frame.sin * dy, frame.cos * dy - frame.sin * dx
    femur, tibia = links.femur, links.tibia
    d_p = math.sqrt(x * x + y * y) - links.coxa
    cos_knee = (d_p * d_p + z * z - (femur * femur + tibia * tibia)) / (2.0 * femur * tibia)
    if not -1.0 <= cos_knee <= 1.0:  # also for NaN
        return _OUT_OF_REACH
    sin_knee = -math.sqrt((1.0 - cos_knee) * (1.0 + cos_knee))
    along, across = femur + tibia * cos_knee, tibia * sin_knee
    return (
        math.atan2(y, x),
        math.atan2(z * along - d_p * across, d_p * along + z * across),
        math.atan2(sin_knee, cos_knee),
    )


def nearest_reachable(profile: RobotProfile, feet_body: Array) -> Array:
    """Move feet that are out of reach to the nearest position within the tibia limits.

    A foot within reach stays bit for bit. A foot that is too far moves inward along the line to the femur axis. A foot that is
    too near moves outward at the same height, like a foot that is lifted close to the body.

    Args:
        profile: The robot.
        feet_body: (6, 3) [m] {body} wanted foot centres.

    Returns:
        (6, 3) [m] {body}. A foot straight above or below its femur axis, at more than the length of the leg, stays.

    Source: Masri 2016, section 5.4, which replaces an unreachable point by the nearest reachable one.
    """
    if _all_reachable(profile, feet_body):
        return feet_body
    T = profile.T_coxa_body
    p = (T[:, :3, :3] @ feet_body[:, :, None])[..., 0] + T[:, :3, 3]
    moved = leg_nearest_reachable(p, profile.leg_reach, profile.links)
    return feet_body if moved is p else np.where((moved != p).any(axis=1)[:, None], _to_body(profile, moved), feet_body)


def _all_reachable(profile: RobotProfile, feet_body: Array) -> bool:
    """Return whether all feet (6, 3) [m] {body} are within the tibia limits."""
    coxa = profile.links.coxa
    legs = zip(feet_body.tolist(), profile.coxa_frames, profile.leg_reach.tolist(), strict=True)
    for (x, y, z), frame, (shortest, longest) in legs:
        d = math.hypot(math.hypot(x - frame.x, y - frame.y) - coxa, z - frame.z)
        if not shortest + _REACH_MARGIN <= d <= longest - _REACH_MARGIN:
            return False
    return True


def leg_nearest_reachable(p: Array, reach: Array, links: LegLinks) -> Array:
    """Move feet as `nearest_reachable` does, in the coxa frame.

    Args:
        p: (..., 3) [m] {coxa} wanted foot centres.
        reach: (..., 2) [m] shortest and longest distance from the femur axis to the foot.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3) [m] {coxa}; the same array object if all feet are within reach.
    """
    horizontal = np.maximum(np.hypot(p[..., 0], p[..., 1]), 1e-6)
    r, z = horizontal - links.coxa, p[..., 2]
    d = np.hypot(r, z)
    shortest, longest = reach[..., 0], reach[..., 1]
    near, far = d < shortest + _REACH_MARGIN, d > longest - _REACH_MARGIN
    if not (near | far).any():
        return p
    scale = np.where(far, (longest - _REACH_MARGIN) / np.maximum(d, 1e-6), 1.0)
    r_new = np.where(near, np.sqrt(np.maximum((shortest + _REACH_MARGIN) ** 2 - z**2, 0.0)), r * scale)
    outward = ((links.coxa + r_new) / horizontal)[..., None]
    moved = np.concatenate([p[..., :2] * outward, (z * scale)[..., None]], axis=-1)
    return np.where((near | far)[..., None], moved, p)


def body_forward(profile: RobotProfile, q: Array) -> Array:
    """Compute the foot centres [m] {body} of joint angles [rad], both (..., 6, 3).

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(q, "joint angles", 6, 3)
    if q.ndim == 2:
        return np.array(feet_and_shanks(profile, q)[0])
    return _to_body(profile, leg_forward(q, profile.links))


def feet_and_shanks(profile: RobotProfile, q: Array) -> tuple[list[Point], list[Point]]:
    """Compute the foot centres and the directions of the shanks of one robot, in plain numbers.

    Args:
        profile: The robot.
        q: (6, 3) [rad] joint angles.

    Returns:
        Six points [m] {body}, the foot centres, and six unit vectors {body} from them up the shanks.
    """
    links = profile.links
    feet: list[Point] = []
    shanks: list[Point] = []
    for (coxa, femur, tibia), frame in zip(q.tolist(), profile.coxa_frames, strict=True):
        c, s = math.cos(coxa), math.sin(coxa)
        x_out, y_out = frame.cos * c - frame.sin * s, frame.sin * c + frame.cos * s
        along, up = math.cos(femur + tibia), math.sin(femur + tibia)
        reach = links.coxa + links.femur * math.cos(femur) + links.tibia * along
        z = frame.z + links.femur * math.sin(femur) + links.tibia * up
        feet.append((frame.x + reach * x_out, frame.y + reach * y_out, z))
        shanks.append((-along * x_out, -along * y_out, -up))
    return feet, shanks


def within_limits(profile: RobotProfile, q: Array) -> NDArray[np.bool_]:
    """Return whether each joint angle (..., 6, 3) [rad] is within its limits.

    NaN is not.

    Source: Masri 2016, eq. (3.14)-(3.16).

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(q, "joint angles", 6, 3)
    limits = profile.joint_limits
    return np.asarray((q >= limits[..., 0]) & (q <= limits[..., 1]))


def reaches(profile: RobotProfile, feet_body: Array) -> NDArray[np.bool_]:
    """Return which legs (..., 6) reach feet (..., 6, 3) [m] {body} within joint limits.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    return np.asarray(within_limits(profile, body_inverse(profile, feet_body)).all(axis=-1))


def joint_torques(profile: RobotProfile, q: Array, forces_body: Array) -> Array:
    """Compute the static motor torques from ground forces.

    The weight of the legs is neglected.

    Args:
        profile: The robot.
        q: (..., 6, 3) [rad] joint angles.
        forces_body: (..., 6, 3) [N] {body} force that the ground exerts on each foot.

    Returns:
        (..., 6, 3) [N m] = -J^T f, positive when the motor pushes towards increasing q. The femur torque of a stance leg is
        negative, because the ground pushes the foot up.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(q, "joint angles", 6, 3)
    _check(forces_body, "forces", 6, 3)
    forces = forces_body[..., None, :] @ profile.T_body_coxa[:, :3, :3]
    return np.asarray(-(forces @ leg_jacobian(q, profile.links))[..., 0, :])


def link_torques(profile: RobotProfile, q: Array) -> Array:
    """Return motor torques (6, 3) [N m] that hold the leg links at q (6, 3) [rad].

    The body is level, and each link's mass is in its middle.
    """
    _, femur_mass, tibia_mass = profile.body.leg_link_masses
    at_tibia = GRAVITY * profile.links.tibia * tibia_mass / 2
    at_femur = GRAVITY * profile.links.femur * (femur_mass / 2 + tibia_mass)
    torques = []
    for _, femur, tibia in q.tolist():
        torque = at_tibia * math.cos(femur + tibia)
        torques.append((0.0, torque + at_femur * math.cos(femur), torque))
    return np.array(torques)


def leg_points(profile: RobotProfile, q: Array) -> Array:
    """Compute the positions of the joints of each leg.

    Args:
        profile: The robot.
        q: (..., 6, 3) [rad] joint angles.

    Returns:
        (..., 6, 4, 3) [m] {body} coxa axis, femur axis, tibia axis (the knee) and centre of the foot.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(q, "joint angles", 6, 3)
    links = profile.links
    c1, s1, reach, z, shank_x, shank_z = _planar(q, links)
    outward = np.empty(q.shape)  # horizontal distance of femur axis, knee and foot from the coxa axis
    outward[..., 0], outward[..., 1], outward[..., 2] = links.coxa, reach - shank_x, reach
    points = np.zeros((*q.shape[:-1], 4, 3))
    points[..., 1:, 0], points[..., 1:, 1] = outward * c1[..., None], outward * s1[..., None]
    points[..., 2, 2], points[..., 3, 2] = z - shank_z, z
    R, p = profile.T_body_coxa[:, :3, :3], profile.T_body_coxa[:, :3, 3]
    return np.asarray(points @ R.mT + p[:, None, :])


def _planar(q: Array, links: LegLinks) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return cosine and sine of the coxa angle, and reach and height of the foot.

    The last two values are the tibia's parts of reach and height.
    """
    angles = q.copy()
    angles[..., 2] += q[..., 1]  # angle of the tibia from the horizontal
    c, s = np.cos(angles), np.sin(angles)
    shank_x, shank_z = links.tibia * c[..., 2], links.tibia * s[..., 2]
    reach = links.coxa + links.femur * c[..., 1] + shank_x
    z = links.femur * s[..., 1] + shank_z
    return c[..., 0], s[..., 0], reach, z, shank_x, shank_z


def _to_body(profile: RobotProfile, p_coxa: Array) -> Array:
    T = profile.T_body_coxa
    return np.asarray((T[:, :3, :3] @ p_coxa[..., None])[..., 0] + T[:, :3, 3])


def _check(values: Array, what: str, *last: int) -> None:
    if values.shape[-len(last) :] != last:
        raise ValueError(f"{what} of shape (..., {', '.join(map(str, last))}) expected, found {values.shape}")
