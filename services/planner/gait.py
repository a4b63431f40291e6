"""Which legs swing, and where they would like to land: the tripod gait of Lotriet 2024, section 5.3."""

import numpy as np
from numpy.typing import NDArray

from shared.geometry import Array

_EVEN: NDArray[np.bool_] = np.arange(6) % 2 == 0


def active_sextant(direction: Array, rest_feet: Array) -> int:
    """Index of the leg in whose sextant a direction of motion falls.

    Args:
        direction: (2,) {body} direction of motion.
        rest_feet: (6, 3) [m] {body} resting feet, whose directions are the sextants' middles.

    Source: Lotriet 2024, section 5.3.3.
    """
    middles = rest_feet[:, :2] / np.linalg.norm(rest_feet[:, :2], axis=1, keepdims=True)
    return int(np.argmax(middles @ direction))


def swinging_tripod(direction: Array, feet: Array, rest_feet: Array) -> NDArray[np.bool_]:
    """The three legs that swing next: every second leg, counted from the active sextant, or the other three.

    The thesis inverts the set when the active leg is already stretched beyond its nominal length (5.16). One leg is a poor
    witness once footholds have been moved by the terrain, so here the whole tripods are compared: the one that is further
    behind along the motion swings; where they are even the thesis' sextant decides.

    Args:
        direction: (6, 2) {body} direction in which the body moves over each foot, at most of length one; a robot that
            turns has six of them.
        feet: (6, 3) [m] {body} standing feet.
        rest_feet: (6, 3) [m] {body} resting feet.

    Returns:
        (6,) True for legs that swing.

    Source: Lotriet 2024, eq. (5.15) and (5.16).
    """
    ahead = ((feet - rest_feet)[:, :2] * direction).sum(axis=1)
    lead = float(ahead[_EVEN].mean() - ahead[~_EVEN].mean())
    if abs(lead) < 0.005:  # [m] even
        even_swings = active_sextant(direction.mean(axis=0), rest_feet) % 2 == 0
    else:
        even_swings = lead < 0
    return _EVEN.copy() if even_swings else np.asarray(~_EVEN)


def directions(velocity: Array, yaw_rate: float, rest_feet: Array) -> Array:
    """How the body moves over each resting foot (6, 2) {body}, the fastest of length one.

    Args:
        velocity: (2,) [m/s] {body} of the body.
        yaw_rate: [rad/s] of the body.
        rest_feet: (6, 3) [m] {body} resting feet.
    """
    over = velocity + yaw_rate * np.stack([-rest_feet[:, 1], rest_feet[:, 0]], axis=1)
    return np.asarray(over / max(float(np.linalg.norm(over, axis=1).max()), 1e-9))


def nominal_touchdowns(rest_feet: Array, T_world_body_end: Array, travel: Array) -> Array:
    """Where swinging feet land on unobstructed ground: half a stride ahead of rest, seen from the body at the step's end.

    Args:
        rest_feet: (6, 3) [m] {body} resting feet.
        T_world_body_end: (4, 4) body at the end of the step.
        travel: (2,) [m] {body at the end} what the body will travel in the step after it.

    Returns:
        (6, 2) [m] {world}.

    Source: Lotriet 2024, eq. (5.19) and (5.20): rest position plus stride length times direction, a stride of his being
    what a foot moves from rest to either side, half of what the body travels while the foot stands.
    """
    feet = rest_feet[:, :2] + 0.5 * travel
    return np.asarray(feet @ T_world_body_end[:2, :2].T + T_world_body_end[:2, 3])
