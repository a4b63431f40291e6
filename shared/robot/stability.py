"""Static stability: centre of mass and its margin inside the support polygon."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import leg_points
from sextant.shared.robot.profile import RobotProfile


def centre_of_mass(profile: RobotProfile, q: Array) -> Array:
    """Compute the centre of mass of the whole robot.

    Args:
        profile: The robot; the mass of each leg link is assumed at its middle.
        q: (..., 6, 3) [rad] joint angles.

    Returns:
        (..., 3) [m] {body}.

    Raises:
        ValueError: The last axes are not (6, 3).
    """
    body = profile.body
    joints = leg_points(profile, q)
    links = 0.5 * (joints[..., :-1, :] + joints[..., 1:, :])  # (..., 6, 3, 3)
    moment = body.mass * np.array(body.centre_of_mass) + np.einsum("k,...lkx->...x", np.array(body.leg_link_masses), links)
    return np.asarray(moment / body.total_mass)


@cache
def resting_centre_of_mass(profile: RobotProfile) -> Array:
    """Return the centre of mass (3,) [m] {body} of a robot with balanced legs.

    The support tests of steps use it. At rest the true centre of mass is less than 1 mm away. Stepping legs move it by a few
    more millimetres, which the support margin covers.
    """
    centre = profile.body.mass / profile.body.total_mass * np.array(profile.body.centre_of_mass)
    centre.flags.writeable = False
    return np.asarray(centre)


def support_margin(feet: Array, centre: Array) -> float:
    """Compute the distance of a point from the edge of the support polygon.

    The polygon is the convex hull of the stance feet.

    Args:
        feet: (n, 2) [m] stance feet, n >= 3.
        centre: (2,) [m] projection of the centre of mass.

    Returns:
        [m]; negative for a point outside: minus its distance beyond the worst edge.

    Raises:
        ValueError: Fewer than three feet.
    """
    if len(feet) < 3:
        raise ValueError(f"at least three standing feet expected, found {len(feet)}")
    middle = feet.mean(axis=0)
    offsets = feet - middle
    # Every edge of the hull is a pair of feet with all feet on one side. Six feet make only fifteen pairs, so all are tried.
    i, j = _pairs(len(feet))
    edges = feet[j] - feet[i]
    length = np.hypot(edges[:, 0], edges[:, 1])
    long = length > 1e-9
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1)[long] / length[long, None]
    start = feet[i][long]
    sides = np.einsum("ek,nk->en", normals, offsets) - np.einsum("ek,ek->e", normals, start - middle)[:, None]
    towards = np.where(sides.max(axis=1) > -sides.min(axis=1), 1.0, -1.0)
    hull = (sides * towards[:, None]).min(axis=1) > -1e-9
    distance = towards * np.einsum("ek,ek->e", normals, centre - start)
    # Feet on one line have no interior.
    distance = np.where(np.abs(sides).max(axis=1) <= 1e-9, -np.abs(distance), distance)
    return float(distance[hull].min()) if hull.any() else -float(np.linalg.norm(centre - middle))


@cache
def _pairs(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the first and second foot of every pair of n feet.

    Both arrays have n (n - 1) / 2 elements.
    """
    i, j = np.triu_indices(n, 1)
    return i, j
