"""Clearance of swinging feet: how high each foot passes over the ground on its path.

A clearance counts from the higher end of a foot's path. The planner chooses it, and the actuator's swing
(`sextant.services.actuator.locomotion.swing_trajectory`) follows from it. The path here is a lower bound of that swing.
"""

import numpy as np

from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile

# The lowest path of a foot, at shares of the swing's time.
SWING_TIME = np.array([0.0, 0.15, 0.32, 0.42, 0.50, 0.57, 0.68, 0.83, 1.0])
ALONG = np.array([0.0, 0.08, 0.25, 0.40, 0.50, 0.62, 0.75, 0.90, 1.0])  # [1] share of the ground distance
RISEN = np.array([0.0, 0.40, 0.90, 1.0, 1.0, 0.95, 0.85, 0.50, 0.0])  # [1] share of the height over start, then touchdown
LEVEL = 0.8  # [1] share of the clearance, over the higher end, at which the lowest path is level
# The descent in more detail: share of the level's height over the touchdown that is left, at shares of the ground distance.
_DESCENT_ALONG, _DESCENT_LEFT = [0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95], [1.0, 0.97, 0.92, 0.80, 0.69, 0.54, 0.33]
_VERTICAL_DESCENT_M = 0.02  # [m] around a touchdown in which the foot descends vertically next to obstacles


def swing_clearance(
    feet: Array, touchdown: Array, lift: float, profile: RobotProfile, params: StepParams, terrain: Terrain
) -> Array:
    """Return the clearance (6,) [m] that the path of each foot needs.

    It is the largest of three values: the commanded lift, or on rough ground the profile's `rough_lift` if that is larger; the
    height with which the foot passes the highest ground on its path; and that with which it descends next to obstacles.

    Args:
        feet: (6, 3) [m] {world} foot centres at the start.
        touchdown: (6, 3) [m] {world} foot centres at the end.
        lift: [m] commanded clearance.
        profile: The robot.
        params: Margins of the paths, and the relief from which ground is rough.
        terrain: The map.
    """
    start, end = feet[:, 2] - profile.foot.radius, touchdown[:, 2] - profile.foot.radius
    higher, lower = np.maximum(start, end), np.minimum(start, end)
    ground = terrain.ground_along(feet[:, :2], touchdown[:, :2])
    highest = ground.max(axis=0)
    rough = np.maximum(higher, highest) - lower > params.rough_m
    least = np.where(rough, max(lift, profile.stance.rough_lift), lift)
    over_path = np.maximum(least, highest - higher + params.path_margin_m)
    to_sole = np.array([0.0, 0.0, profile.foot.radius])
    descent = descent_clearance(ground, feet - to_sole, touchdown - to_sole, params.sink_margin_m)
    return np.asarray(np.maximum(over_path, descent))


def descent_clearance(ground: Array, start: Array, end: Array, margin: float) -> Array:
    """Return the clearance (n,) [m] with which descending feet pass obstacles.

    Args:
        ground: (m, n) [m] highest ground at even shares of the paths, see `Terrain.ground_along`.
        start: (n, 3) [m] undersides of the feet at the start.
        end: (n, 3) [m] undersides of the feet at the end.
        margin: [m] over that ground.

    Returns:
        (n,) [m] over the higher end, -inf where there is no obstacle.
    """
    share = np.linspace(0.0, 1.0, len(ground))[:, None]
    left = (1.0 - share) * np.linalg.norm((end - start)[:, :2], axis=1)
    obstacle = (share >= _DESCENT_ALONG[0]) & (left >= _VERTICAL_DESCENT_M) & (ground > end[:, 2] + margin)
    rise = np.where(obstacle, ground, -np.inf) + margin - end[:, 2]
    level = end[:, 2] + rise / np.interp(share, _DESCENT_ALONG, _DESCENT_LEFT)
    return np.asarray((level.max(axis=0) - np.maximum(start[:, 2], end[:, 2])) / LEVEL)


def lowest_path(start: Array, end: Array, clearance: Array) -> Array:
    """Return the lowest paths of feet at `SWING_TIME`.

    A foot rises next to its start, passes over both ends at a share of the clearance, and descends.

    Args:
        start: (n, 3) [m] foot centres at the start.
        end: (n, 3) [m] foot centres at the end.
        clearance: (n,) [m] over the higher end.

    Returns:
        (9, n, 3) [m].
    """
    return path_at(start, end, clearance, SWING_TIME, ALONG, RISEN)


def path_at(start: Array, end: Array, clearance: Array, time: Array, along: Array, risen: Array) -> Array:
    """Return foot centres (k, n, 3) [m] of a swing of a given shape.

    Args:
        start: (n, 3) [m] foot centres at the start.
        end: (n, 3) [m] foot centres at the end.
        clearance: (n,) [m] over the higher end.
        time: (k,) [1] shares of the swing's time.
        along: (k,) [1] shares of the ground distance at these times.
        risen: (k,) [1] shares of the height, over the start in the first half of the time, then over the touchdown.
    """
    level = np.maximum(start[:, 2], end[:, 2]) + LEVEL * clearance
    feet = start + along[:, None, None] * (end - start)
    lower = np.where(time[:, None] < 0.5, start[:, 2], end[:, 2])
    feet[..., 2] = lower + risen[:, None] * (level - lower)
    return feet
