"""Which legs swing, and where they would like to land: gaits as groups of legs that swing together.

Lotriet's tripod gait (2024, section 5.3) with its active sextant and its inversion of the supporting legs, said of any number
of groups: a step swings one group, a cycle is as many steps as there are groups, and between two swings of its own a leg
stands for all the others. A gait may change at every step, since the legs alone say which of them is due.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.wire.messages import GaitName

_EVEN = 0.005  # [m] and less between two tripods is none; the smaller strides of other gaits ask for less
_SLOWEST = 0.1  # [1] of the fastest foot's way; feet that move less than that say little


@dataclass(frozen=True, slots=True)
class Gait:
    """A rhythm of steps."""

    groups: tuple[tuple[int, ...], ...]  # legs that swing together, in the order in which even ones follow each other
    pace: float  # duration of its steps, of the tripod's: the fewer legs swing, the less there is to hand over

    @property
    def stances(self) -> int:
        """Steps of a cycle for which a leg stands."""
        return len(self.groups) - 1

    @property
    def slowness(self) -> float:
        """Time that a way takes by strides of one length, of the tripod's."""
        return self.stances * self.pace

    @property
    def duty(self) -> float:
        """Share of a cycle for which a leg stands."""
        return self.stances / len(self.groups)


# Opposite legs make the pairs of the ripple, so that four are left on all sides; the wave runs from the rear up either side.
GAITS: dict[GaitName, Gait] = {
    "tripod": Gait(((0, 2, 4), (1, 3, 5)), 1.0),
    "ripple": Gait(((1, 4), (0, 3), (2, 5)), 0.8),
    "wave": Gait(((3,), (2,), (1,), (4,), (5,), (0,)), 0.7),
}


def active_sextant(direction: Array, rest_feet: Array) -> int:
    """Index of the leg in whose sextant a direction of motion falls.

    Args:
        direction: (2,) {body} direction of motion.
        rest_feet: (6, 3) [m] {body} resting feet, whose directions are the sextants' middles.

    Source: Lotriet 2024, section 5.3.3.
    """
    middles = rest_feet[:, :2] / np.linalg.norm(rest_feet[:, :2], axis=1, keepdims=True)
    return int(np.argmax(middles @ direction))


def swing_order(gait: Gait, along: Array, feet: Array, rest_feet: Array) -> list[NDArray[np.bool_]]:
    """The groups of a gait as they are due to swing: that which is furthest behind along the motion first.

    The thesis swings the active sextant's tripod and inverts that when the active leg is already stretched beyond its nominal
    length (5.16). One leg is a poor witness once footholds have been moved by the terrain, so here whole groups are compared;
    where they are even the active sextant begins and the gait's own order goes on.

    Args:
        gait: The rhythm.
        along: (6, 2) {body} direction in which the body moves over each foot, at most of length one; a robot that turns has
            six of them.
        feet: (6, 3) [m] {body} standing feet.
        rest_feet: (6, 3) [m] {body} resting feet.

    Returns:
        For each group, (6,) True for its legs.

    Source: Lotriet 2024, eq. (5.15) and (5.16).
    """
    ahead, moved = ((feet - rest_feet)[:, :2] * along).sum(axis=1), np.maximum((along**2).sum(axis=1), _SLOWEST**2)
    active = active_sextant(along.mean(axis=0), rest_feet)
    first = next(k for k, legs in enumerate(gait.groups) if active in legs)
    waiting = [gait.groups[(first + k) % len(gait.groups)] for k in range(len(gait.groups))]
    order = []
    while waiting:
        # Least squares of what the fastest foot has moved: near the centre of a turn a foot has little way to fall behind.
        lead = [float(ahead[list(legs)].sum() / moved[list(legs)].sum()) for legs in waiting]
        due = next(k for k, value in enumerate(lead) if value < min(lead) + _EVEN / gait.stances)
        order.append(np.isin(np.arange(6), waiting.pop(due)))
    return order


def directions(velocity: Array, yaw_rate: float, rest_feet: Array) -> Array:
    """How the body moves over each resting foot (6, 2) {body}, the fastest of length one.

    Args:
        velocity: (2,) [m/s] {body} of the body.
        yaw_rate: [rad/s] of the body.
        rest_feet: (6, 3) [m] {body} resting feet.
    """
    over = velocity + yaw_rate * np.stack([-rest_feet[:, 1], rest_feet[:, 0]], axis=1)
    return np.asarray(over / max(float(np.linalg.norm(over, axis=1).max()), 1e-9))


def carried_on(T_world_body: Array, travel: Array, turn: float, steps: float) -> Array:
    """Where a body (4, 4) is some steps later, each of which travels (2,) [m] {body} and turns [rad] on the way."""
    whole = int(steps)
    for share in [1.0] * whole + [steps - whole]:
        half = share * turn / 2
        c, s = np.cos(half), np.sin(half)
        way = share * (np.array([[c, -s], [s, c]]) @ travel)
        T_world_body = T_world_body @ from_xyz_rpy((*way, 0.0), (0.0, 0.0, 2 * half))
    return T_world_body


def nominal_touchdowns(rest_feet: Array, T_world_body: Array) -> Array:
    """Where swinging feet land on unobstructed ground: at rest under the body as it will be in the middle of their stance.

    Args:
        rest_feet: (6, 3) [m] {body} resting feet.
        T_world_body: (4, 4) that body, level.

    Returns:
        (6, 2) [m] {world}.

    Source: Lotriet 2024, eq. (5.19) and (5.20): rest position plus stride length times direction, a stride of his being
    what a foot moves from rest to either side, half of what the body travels while the foot stands.
    """
    return np.asarray(rest_feet[:, :2] @ T_world_body[:2, :2].T + T_world_body[:2, 3])
