"""Motion of the joints in a swing, as the actuator executes it."""

import numpy as np

from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.kinematics import body_inverse, nearest_reachable
from sextant.shared.robot.profile import RobotProfile

# Paths of the actuator's feet at even shares of the swing's time: one that rises by a ninth of its length, and a steep one.
_LOW, _STEEP = 0.11, 0.28  # [1] clearance over length of these paths
_ALONG = (
    np.array([0, 0, 1, 3, 9, 16, 22, 29, 35, 42, 49, 55, 62, 68, 75, 81, 87, 93, 97, 99, 100]) / 100.0,
    np.array([0, 0, 1, 3, 5, 9, 17, 25, 33, 42, 51, 60, 68, 76, 83, 88, 92, 96, 98, 99, 100]) / 100.0,
)
_RISEN = (
    np.array([0, 8, 37, 66, 79, 85, 91, 95, 98, 100, 101, 99, 96, 91, 84, 73, 60, 43, 25, 11, 0]) / 100.0,
    np.array([0, 5, 21, 38, 55, 70, 80, 87, 92, 96, 97, 95, 89, 81, 70, 57, 43, 28, 15, 6, 0]) / 100.0,
)
SWING_TIME = np.linspace(0.0, 1.0, len(_ALONG[0]))
_FIFTH = (len(_ALONG[0]) - 1) // 5  # samples


def swing_joints(profile: RobotProfile, start: Array, end: Array, clearance: Array, T_start: Array, T_end: Array) -> Array:
    """Return joint angles (n, 6, 3) [rad] at `SWING_TIME` if all legs swing.

    Args:
        profile: The robot.
        start: (6, 3) [m] {world} foot centres at the start.
        end: (6, 3) [m] {world} foot centres at the end.
        clearance: (6,) [m] over the higher end.
        T_start: (4, 4) {world} body pose at the start.
        T_end: (4, 4) {world} body pose at the end.
    """
    share = SWING_TIME[:, None, None]
    length = np.maximum(np.linalg.norm((end - start)[:, :2], axis=1), 1e-3)
    steep = np.clip((clearance / length - _LOW) / (_STEEP - _LOW), 0.0, 1.0)
    along, risen = (low[:, None] + steep * (high - low)[:, None] for low, high in (_ALONG, _RISEN))
    feet = start + along[..., None] * (end - start)
    lower = np.where(share[..., 0] < 0.5, start[:, 2], end[:, 2])
    feet[..., 2] = lower + risen * (np.maximum(start[:, 2], end[:, 2]) + clearance - lower)
    feet = (1.0 - share) * apply(inverse(T_start), feet) + share * apply(inverse(T_end), feet)
    return body_inverse(profile, np.array([nearest_reachable(profile, now) for now in feet]))


def swing_speeds(q: Array) -> Array:
    """Return the highest mean speed (6, 3) [rad per whole swing] of each joint over a fifth of a swing.

    A joint may be faster for a moment, but not for so long: then its servo falls behind, and the foot lands short of its place.

    Args:
        q: (n, 6, 3) [rad] joint angles from `swing_joints`.
    """
    turned = np.concatenate([np.zeros((1, 6, 3)), np.abs(np.diff(q, axis=0)).cumsum(axis=0)])
    return np.asarray((turned[_FIFTH:] - turned[:-_FIFTH]).max(axis=0) / SWING_TIME[_FIFTH])


def shortest_swing_s(
    profile: RobotProfile, start: Array, end: Array, clearance: Array, T_start: Array, T_end: Array, max_speed: float
) -> Array:
    """Return the time (6,) [s] in the air in which no joint exceeds a share `max_speed` of its no-load speed.

    That is its mean speed over a fifth of the swing; the other arguments are those of `swing_joints`.
    """
    speeds = swing_speeds(swing_joints(profile, start, end, clearance, T_start, T_end))
    return np.asarray((speeds / (max_speed * profile.servos.no_load_speed)).max(axis=1))
