"""Where the feet are for given joint angles, and the other way round: closed forms, batched over legs and time.

Sources: Masri 2016, eq. (3.2)-(3.10), and Lotriet 2024, eq. (5.2)-(5.13). docs/kinematics.md maps their angles to ours and
lists every misprint with its correction and the test that proves it. In short, this code reads

- Masri's (3.5) with the horizontal reach d_p, not d_l, under the fraction bar, and its z axis downwards;
- Lotriet's (5.2) with z_t over d - L_1 in the second row, (5.4) with L_2 and L_3, (5.7)-(5.8) with cosines for the horizontal
  reach, and (5.3)'s arcsine as the arctangent that also holds for the blunt angles of a foot near the body.

Angles q are those of `sextant.shared.robot.profile`: coxa about z, femur up from the horizontal, tibia from the straight femur,
up positive. The coxa frame has its origin on the coxa axis, x outward along the neutral leg, z up.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import LegLinks, RobotProfile

SINGULAR = 1e-6  # [m] of horizontal reach, or sine of the knee: nearer to a singularity rates are not given


_REACH_MARGIN = 1e-4  # [m] inside the reach, so that rounding does not lead out of it again


def leg_forward(q: Array, links: LegLinks) -> Array:
    """Foot of a leg with given joint angles.

    Args:
        q: (..., 3) [rad] coxa, femur and tibia angles.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3) [m] {coxa} centre of the foot.

    Raises:
        ValueError: The last axis is not 3.

    Source: Lotriet 2024, eq. (5.7)-(5.8), with cosines where his horizontal reach has sines.
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
    """Joint angles that place the foot at a point, the leg turned towards it and the knee up.

    Args:
        p: (..., 3) [m] {coxa} centre of the foot.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3) [rad] coxa and femur in (-pi, pi], tibia in [-pi, 0]. A row is NaN where the foot is out of reach or not
        finite; nothing is clamped, and joint limits are another question (`within_limits`).

    Raises:
        ValueError: The last axis is not 3.

    Source: Masri 2016, eq. (3.2)-(3.10), with (3.5) read as atan(f_z / d_p). His beta is the femur angle, his gamma the tibia
    angle plus pi; epsilon and delta are taken together in one arctangent, which stays exact near the stretched leg.
    """
    _check(p, "foot", 3)
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    femur, tibia = links.femur, links.tibia
    q = np.empty(p.shape)
    with np.errstate(invalid="ignore", over="ignore"):  # NaN is the answer, not an accident
        d_p = np.sqrt(x * x + y * y) - links.coxa  # (3.3)
        cos_knee = (d_p * d_p + z * z - (femur * femur + tibia * tibia)) / (2.0 * femur * tibia)  # (3.4), (3.9)
        sin_knee = -np.sqrt((1.0 - cos_knee) * (1.0 + cos_knee))  # negative: knee up; NaN out of reach
        along, across = femur + tibia * cos_knee, tibia * sin_knee  # from femur axis to foot, in the femur's own direction
        q[..., 0] = np.arctan2(y, x) + 0.0 * sin_knee  # (3.2); NaN goes to the whole row
        q[..., 1] = np.arctan2(z * along - d_p * across, d_p * along + z * across)  # (3.5)-(3.8)
        q[..., 2] = np.arctan2(sin_knee, cos_knee)  # (3.10)
    return q


def leg_jacobian(q: Array, links: LegLinks) -> Array:
    """Derivative of `leg_forward`: foot velocity per joint rate.

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
    """Joint rates that move the foot at a velocity.

    Args:
        q: (..., 3) [rad] joint angles.
        foot_velocity: (..., 3) [m/s] {coxa}.
        links: Coxa, femur and tibia lengths [m].

    Returns:
        (..., 3) [rad/s]. A row is NaN where no finite rates exist: the leg stretched or folded, the foot on the coxa axis,
        or an input not finite.

    Raises:
        ValueError: The last axes are not 3.

    Source: the derivative of a right eq. (5.2), as Lotriet 2024, eq. (5.9)-(5.13), means it. His second row differentiates the
    product of alpha and an arctangent where (5.2) has their sum.
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
        rates += 0.0 * rates.sum(axis=-1, keepdims=True)  # one rate not finite: none
    return rates


def body_inverse(profile: RobotProfile, feet_body: Array) -> Array:
    """Joint angles of the whole robot for given feet.

    Args:
        profile: The robot.
        feet_body: (..., 6, 3) [m] {body} foot centres.

    Returns:
        (..., 6, 3) [rad] joint angles; the row of a leg that cannot reach is NaN. Limits are not looked at.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(feet_body, "feet", 6, 3)
    R, p = profile.T_body_coxa[:, :3, :3], profile.T_body_coxa[:, :3, 3]
    return leg_inverse(((feet_body - p)[..., None, :] @ R)[..., 0, :], profile.links)


def nearest_reachable(profile: RobotProfile, feet_body: Array) -> Array:
    """Feet moved to the nearest place that their legs' tibias allow; where they are within reach they stay, to the bit.

    A foot too far away comes in along the line to the femur's axis; one too near keeps its height and moves outwards, as a
    foot does that is lifted close to the body.

    Args:
        profile: The robot.
        feet_body: (6, 3) [m] {body} wanted foot centres.

    Returns:
        (6, 3) [m] {body}. A foot straight above or below its femur's axis, further than the leg is long, stays.

    Source: Masri 2016, section 5.4: the nearest reachable position in place of a point that is not.
    """
    T = profile.T_coxa_body
    p = (T[:, :3, :3] @ feet_body[:, :, None])[..., 0] + T[:, :3, 3]
    moved = leg_nearest_reachable(p, profile.leg_reach, profile.links)
    return feet_body if moved is p else np.where((moved != p).any(axis=1)[:, None], _to_body(profile, moved), feet_body)


def leg_nearest_reachable(p: Array, reach: Array, links: LegLinks) -> Array:
    """Feet (..., 3) [m] {coxa} as `nearest_reachable` moves them; the same array where all stay.

    Args:
        p: (..., 3) [m] {coxa} wanted foot centres.
        reach: (..., 2) [m] shortest and longest way from the femur's axis to the foot.
        links: Coxa, femur and tibia lengths [m].
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
    """Feet of the whole robot: joint angles (..., 6, 3) [rad] to foot centres (..., 6, 3) [m] {body}.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(q, "joint angles", 6, 3)
    return _to_body(profile, leg_forward(q, profile.links))


def within_limits(profile: RobotProfile, q: Array) -> NDArray[np.bool_]:
    """Whether each joint angle (..., 6, 3) [rad] is one that its servo may take (Masri 2016, eq. 3.14-3.16); NaN is not.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(q, "joint angles", 6, 3)
    limits = profile.joint_limits
    return np.asarray((q >= limits[..., 0]) & (q <= limits[..., 1]))


def joint_torques(profile: RobotProfile, q: Array, forces_body: Array) -> Array:
    """Motor torques that hold the legs still against the ground, the legs' own weight left out.

    Args:
        profile: The robot.
        q: (..., 6, 3) [rad] joint angles.
        forces_body: (..., 6, 3) [N] {body} force that the ground exerts on each foot.

    Returns:
        (..., 6, 3) [N m] = -J^T f, positive when the motor pushes towards growing q. A standing leg, which the ground
        pushes up, has a negative femur torque.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    _check(q, "joint angles", 6, 3)
    _check(forces_body, "forces", 6, 3)
    forces = forces_body[..., None, :] @ profile.T_body_coxa[:, :3, :3]
    return np.asarray(-(forces @ leg_jacobian(q, profile.links))[..., 0, :])


def leg_points(profile: RobotProfile, q: Array) -> Array:
    """Where the joints of each leg are.

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
    """Cosine and sine of the coxa, reach and height of the foot, and the shank's part in both."""
    angles = q.copy()
    angles[..., 2] += q[..., 1]  # of the shank
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
