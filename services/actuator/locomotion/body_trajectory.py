"""Body pose as six coordinates, and interpolation between two poses. Pure."""

import numpy as np

from sextant.shared.geometry import Array, from_xyz_rpy, rpy_from_rotation


def coordinates(T: Array) -> Array:
    """Return position [m] and roll, pitch, yaw [rad] (6,) of a pose (4, 4).

    The body never pitches far enough for a singularity.
    """
    return np.concatenate([T[:3, 3], rpy_from_rotation(T[:3, :3])])


def pose(place: Array) -> Array:
    """Return the pose (4, 4) with coordinates (6,) [m, rad]."""
    return from_xyz_rpy(place[:3], place[3:])


def wrapped(angle: Array) -> Array:
    """Return angles [rad] wrapped to half a turn around zero."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def hermite(p0: Array, v0: Array, p1: Array, v1: Array, duration: float, t: float) -> tuple[Array, Array]:
    """Return position (6,) and speed (6,) [per s] at t [s] of a cubic.

    It goes from p0 with speed v0 to p1 with speed v1.

    It is a straight line if both speeds equal the mean speed.
    """
    s = t / duration
    h00, h10 = 2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s
    h01, h11 = -2 * s**3 + 3 * s**2, s**3 - s**2
    place = h00 * p0 + h10 * duration * v0 + h01 * p1 + h11 * duration * v1
    speed = 6 * s * (1 - s) * (p1 - p0) / duration + (3 * s**2 - 4 * s + 1) * v0 + (3 * s**2 - 2 * s) * v1
    return place, speed
