"""Gaits: groups of legs that swing together, their order and their touchdowns.

This is Lotriet's tripod gait (2024, section 5.3), with its active sextant and its inversion of the supporting legs, generalised
to any number of groups. A step swings one group. A cycle has one step per group. Each leg swings in one step of the cycle and
stands in all others. The gait may change at every step, because the positions of the feet alone decide which group is due.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.wire.messages import GaitName, GaitRequest

_EQUAL_LEAD_M = 0.005  # [m] difference between two leads of a tripod that counts as none; shorter steps use less
_MIN_RELATIVE_MOTION = 0.1  # [1] share of the fastest foot's motion; slower feet count as this fast


@dataclass(frozen=True, slots=True)
class Gait:
    """A cycle of steps."""

    groups: tuple[tuple[int, ...], ...]  # legs that swing together, in their order when all are equally due
    pace: float  # duration of a step relative to the tripod's; fewer swinging legs need less time to hand over load

    @property
    def stances(self) -> int:
        """Return the number of steps of a cycle in which a leg stands."""
        return len(self.groups) - 1

    @property
    def slowness(self) -> float:
        """Return the time to walk a distance with equal steps, relative to the tripod."""
        return self.stances * self.pace

    @property
    def duty(self) -> float:
        """Return the share of a cycle in which a leg stands."""
        return self.stances / len(self.groups)


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast steps are taken."""

    step_s: float  # [s] shortest duration of a tripod's step
    foot_speed: float  # [m/s] of swinging feet, see `Stance`


# Ripple pairs are opposite legs, so four feet stand around the body. The wave goes from rear to front on each side.
GAITS: dict[GaitName, Gait] = {
    "tripod": Gait(((0, 2, 4), (1, 3, 5)), 1.0),
    "ripple": Gait(((1, 4), (0, 3), (2, 5)), 0.8),
    "wave": Gait(((3,), (2,), (1,), (4,), (5,), (0,)), 0.7),
}


def gait_of(request: GaitRequest) -> Gait:
    """Return the requested gait; the tripod where the planner may choose and has not chosen yet."""
    return GAITS["tripod" if request == "auto" else request]


def active_sextant(direction: Array, rest_feet: Array) -> int:
    """Return the index of the leg whose sextant contains a direction of motion.

    Args:
        direction: (2,) {body} direction of motion.
        rest_feet: (6, 3) [m] {body} resting feet, whose directions are the sextants' middles.

    Source: Lotriet 2024, section 5.3.3.
    """
    middles = rest_feet[:, :2] / np.linalg.norm(rest_feet[:, :2], axis=1, keepdims=True)
    return int(np.argmax(middles @ direction))


def swing_order(gait: Gait, along: Array, feet: Array, rest_feet: Array) -> list[NDArray[np.bool_]]:
    """Return the groups of a gait, the one furthest behind along the motion first.

    The thesis swings the active sextant's tripod. It inverts it when the active leg is already stretched beyond its nominal
    length (5.16). On rough terrain a single leg is unreliable, because its foothold may be far from the nominal place. So whole
    groups are compared here. Between equal groups the active sextant's group comes first, then the order of the gait.

    Args:
        gait: The gait.
        along: (6, 2) {body} direction in which the body moves over each foot, at most of length one. Under rotation the six
            directions differ.
        feet: (6, 3) [m] {body} standing feet.
        rest_feet: (6, 3) [m] {body} resting feet.

    Returns:
        For each group, (6,) flags, True for its legs.

    Source: Lotriet 2024, eq. (5.15) and (5.16).
    """
    ahead, moved = ((feet - rest_feet)[:, :2] * along).sum(axis=1), np.maximum((along**2).sum(axis=1), _MIN_RELATIVE_MOTION**2)
    active = active_sextant(along.mean(axis=0), rest_feet)
    first = next(k for k, legs in enumerate(gait.groups) if active in legs)
    waiting = [gait.groups[(first + k) % len(gait.groups)] for k in range(len(gait.groups))]
    order = []
    while waiting:
        # Least squares relative to the fastest foot: near the centre of a turn a foot can hardly fall behind.
        lead = [float(ahead[list(legs)].sum() / moved[list(legs)].sum()) for legs in waiting]
        due = next(k for k, value in enumerate(lead) if value < min(lead) + _EQUAL_LEAD_M / gait.stances)
        legs = waiting.pop(due)
        order.append(np.array([leg in legs for leg in range(6)]))
    return order


def directions(velocity: Array, yaw_rate: float, rest_feet: Array) -> Array:
    """Return the motion of the body over each resting foot (6, 2) {body}.

    It is relative to the fastest foot, whose motion has length one.

    Args:
        velocity: (2,) [m/s] {body} of the body.
        yaw_rate: [rad/s] of the body.
        rest_feet: (6, 3) [m] {body} resting feet.
    """
    over = velocity + yaw_rate * np.stack([-rest_feet[:, 1], rest_feet[:, 0]], axis=1)
    return np.asarray(over / max(float(np.linalg.norm(over, axis=1).max()), 1e-9))


def extrapolate_pose(T_world_body: Array, travel: Array, turn: float, steps: float) -> Array:
    """Return the body pose (4, 4) after a number of steps.

    Each step travels by (2,) [m] {body} and turns by [rad] at the same time.
    """
    whole = int(steps)
    for share in [1.0] * whole + [steps - whole]:
        half = share * turn / 2
        c, s = np.cos(half), np.sin(half)
        way = share * (np.array([[c, -s], [s, c]]) @ travel)
        T_world_body = T_world_body @ from_xyz_rpy((*way, 0.0), (0.0, 0.0, 2 * half))
    return T_world_body


def nominal_touchdowns(rest_feet: Array, T_world_body: Array) -> Array:
    """Return where swinging feet land on unobstructed ground.

    A foot is at its resting place when the body is in the middle of the foot's stance.

    Args:
        rest_feet: (6, 3) [m] {body} resting feet.
        T_world_body: (4, 4) body pose in the middle of the stance, level.

    Returns:
        (6, 2) [m] {world}.

    Source: Lotriet 2024, eq. (5.19) and (5.20): rest position plus stride length times direction. His stride is the motion of a
    foot from rest to either side, which is half of the body's travel during the stance.
    """
    return np.asarray(rest_feet[:, :2] @ T_world_body[:2, :2].T + T_world_body[:2, 3])
