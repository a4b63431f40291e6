"""Reach of the legs around the resting stance, over the range of body heights."""

from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import JOINTS, LEGS, MAX_TRAVEL_M, RobotProfile
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin

_STEP_M = 0.0025  # [m] of a foot between two positions that are tried
_HEIGHT_STEP_M = 0.001  # [m]


@dataclass(frozen=True, slots=True)
class Stride:
    """Longest stride at a body height: the motion of the body while a foot stands, half of it on either side of its rest."""

    body_height: float  # [m]
    length: float  # [m]; 0 if even the resting stance is out of reach
    limited_by: str  # the leg and the joint that would exceed its limit first


def longest_stride(profile: RobotProfile, body_height: float) -> Stride:
    """Return the longest stride straight ahead at a body height [m]."""
    offsets = np.arange(0.0, MAX_TRAVEL_M / 2 + _STEP_M, _STEP_M)
    rest = profile.rest_feet(body_height)
    both = np.array([rest + np.array([sign * offset, 0.0, 0.0]) for offset in offsets for sign in (1.0, -1.0)])
    q = body_inverse(profile, both)
    bad = np.argwhere(~within_limits(profile, q))  # rows of position, leg, joint
    if not len(bad):
        return Stride(body_height, MAX_TRAVEL_M, f"no joint up to {MAX_TRAVEL_M:g} m, the longest that the actuator accepts")
    place, leg, joint = bad[0].tolist()
    side = "ahead of" if place % 2 == 0 else "behind"
    cause = "its length" if np.isnan(q[place, leg]).any() else f"its {JOINTS[joint]} joint"
    length = max(2.0 * float(offsets[place // 2 - 1]), 0.0) if place > 1 else 0.0
    return Stride(body_height, length, f"the {LEGS[leg]} leg, by {cause}, with its foot {side} its rest")


def height_range(profile: RobotProfile) -> tuple[float, float]:
    """Return the lowest and the highest body height [m] around that of the stance at which all feet reach their rest."""
    stance, longest = profile.stance, profile.links.femur + profile.links.tibia + profile.foot.radius
    highest_mount = max(leg.mount_xyz[2] for leg in profile.legs)
    heights = np.arange(_HEIGHT_STEP_M, longest + max(highest_mount, 0.0), _HEIGHT_STEP_M)
    feet = np.array([profile.rest_feet(height) for height in heights.tolist()])
    reached = np.asarray(within_limits(profile, body_inverse(profile, feet)).all(axis=(1, 2)))
    low = high = int(np.argmin(np.abs(heights - stance.body_height)))
    while low > 0 and reached[low - 1]:
        low -= 1
    while high < len(heights) - 1 and reached[high + 1]:
        high += 1
    return float(heights[low]), float(heights[high])


def joint_room(profile: RobotProfile, q: Array, share: Array) -> Array:
    """Return the smallest distance (3,) [rad] of the coxae, femora and tibiae of standing legs from their limits.

    Args:
        profile: The robot.
        q: (n, 6, 3) [rad] joint angles.
        share: (n, 6) share of its load that each leg may carry; a leg stands if that is more than 0.
    """
    limits = profile.joint_limits
    room = np.minimum(q - limits[..., 0], limits[..., 1] - q)
    return np.asarray(np.where((share > 0.0)[..., None], room, np.inf).min(axis=(0, 1)))


def least_support_margin(profile: RobotProfile, feet: Array, share: Array) -> float:
    """Return the smallest distance [m] of the centre of mass from the edges of the support polygon.

    Args:
        profile: The robot.
        feet: (n, 6, 3) [m] {body} foot centres.
        share: (n, 6) share of its load that each leg may carry; a leg stands if that is more than 0.
    """
    centre = resting_centre_of_mass(profile)[:2]
    return min(support_margin(now[stands, :2], centre) for now, stands in zip(feet, share > 0.0, strict=True))


def steady_stride(profile: RobotProfile) -> float:
    """Return the longest stride [m] on three legs that keeps `stance.support_margin`, 0 if none does."""
    rest, share = profile.rest_feet(), np.array([[1.0, 0.0] * 3, [0.0, 1.0] * 3])
    for stride in np.arange(MAX_TRAVEL_M, 0.0, -_STEP_M).tolist():
        ends = [rest + np.array([way / 2, 0.0, 0.0]) for way in (-stride, stride)]
        if all(least_support_margin(profile, np.array([end, end]), share) >= profile.stance.support_margin for end in ends):
            return float(stride)
    return 0.0
