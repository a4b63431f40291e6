"""Standing up and lying down.

To stand up, the feet move to their resting positions while the belly lies on the ground; then the body rises.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.step_executor import Targets
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import RobotProfile

_AT_REST_M = 0.03  # [m] between a foot and its place in the resting stance, up to which the robot is in this stance
_CARRYING_HEIGHT_M = 0.04  # [m] belly height from which the legs carry the body
_STANDING_RANGE_M = 0.08  # [m] from its resting position, up to which a foot stands after an interrupted motion
_WIDER_M = np.arange(0.0, 0.1, 0.005)  # [m] by which feet may stand further out than in the resting stance
_UNEVEN_M = 0.005  # [m] of a foot over the plane of the others, from which the ground is uneven
_BELLY_CLEARANCE_M = 0.005  # [m] of the feet over the ground on which the belly lies


class StandUp:
    """Motion from any folded stance to standing, in a given time.

    A robot on its feet stays on them. On uneven ground the carrying feet keep their heights over the plane through them, so
    none is pressed into the ground or lifted off it.

    Loaded feet cannot be drawn in. If folded legs do not reach the resting stance, the robot rises in a wider stance, and the
    first steps of its walk bring the feet in.
    """

    def __init__(self, profile: RobotProfile, feet: Array, duration_s: float, relief: Array | None = None):
        """Begin.

        Args:
            profile: The robot.
            feet: (6, 3) [m] {body} present feet.
            duration_s: [s] total duration.
            relief: (6,) [m] heights of the ground under a robot on its feet, see `ground_relief`; level by default.
        """
        rest = profile.rest_feet()
        if relief is not None and _is_on_its_feet(profile, feet):
            rest[:, 2] += relief
        if np.abs(feet - rest).max() < _AT_REST_M:
            self._way: tuple[Array, ...] = (feet, rest)
        elif _is_on_its_feet(profile, feet):
            self._way = (feet, np.column_stack([feet[:, :2], rest[:, 2]]))
        else:
            self._way = (feet, *_lying_and_risen(profile))
        self._duration = duration_s
        self._elapsed = 0.0

    @property
    def done(self) -> bool:
        """Whether the robot stands."""
        return self._elapsed >= self._duration

    def update(self, dt: float) -> Targets:
        """Advance by dt [s]."""
        self._elapsed = min(self._elapsed + dt, self._duration)
        legs = len(self._way) - 1
        progress = self._elapsed / self._duration * legs
        leg = min(int(progress), legs - 1)
        s = progress - leg
        s = s * s * (3 - 2 * s)
        feet = (1 - s) * self._way[leg] + s * self._way[leg + 1]
        # Not from goals under load, which include their sag: it must not be added twice.
        carrying = s if leg == legs - 1 else 0.0
        return Targets(feet, np.full(6, carrying), np.eye(3))


class LieDown:
    """Motion from any stance straight down onto the belly, in a given time.

    The feet keep their positions; those out of reach of a folded leg slide outward as far as necessary.
    """

    def __init__(self, profile: RobotProfile, feet: Array, duration_s: float):
        """Begin.

        Args:
            profile: The robot.
            feet: (6, 3) [m] {body} present feet.
            duration_s: [s] total duration.
        """
        lying = feet.copy()
        lying[:, 2] += max(0.0, profile.foot.radius - float(np.median(feet[:, 2])) - profile.body.size[2] / 2)
        self._feet, self._lying = feet, lying + _outward(profile, lying)
        self._duration, self._elapsed = duration_s, 0.0

    @property
    def done(self) -> bool:
        """Whether the robot lies."""
        return self._elapsed >= self._duration

    def update(self, dt: float) -> Targets:
        """Advance by dt [s]."""
        self._elapsed = min(self._elapsed + dt, self._duration)
        s = self._elapsed / self._duration
        s = s * s * (3 - 2 * s)
        return Targets((1 - s) * self._feet + s * self._lying, np.full(6, 1.0 - s), np.eye(3))


def _is_on_its_feet(profile: RobotProfile, feet: Array) -> bool:
    """Return whether feet (6, 3) [m] {body} carry the body as in a walk.

    Drawing such feet in would drop the body.
    """
    height = profile.foot.radius - float(np.median(feet[:, 2]))
    apart = np.linalg.norm((feet - profile.rest_feet())[:, :2], axis=1)
    return height > profile.body.size[2] / 2 + _CARRYING_HEIGHT_M and bool((apart < _STANDING_RANGE_M).all())


def ground_relief(feet: Array, carrying: NDArray[np.bool_], set_down: NDArray[np.bool_]) -> Array:
    """Return heights (6,) [m] of the ground over the plane through the carrying feet; zeros on level ground.

    Args:
        feet: (6, 3) [m] {body} measured feet. Goals would not do: they include the sag of loaded servos.
        carrying: (6,) legs that carry load.
        set_down: (6,) legs that keep the height of their foot, whether they carry load or not; the ground under legs that
            neither carry load nor are set down counts as level.
    """
    over = np.zeros(len(feet))
    if np.count_nonzero(carrying) > 3:
        rows = np.column_stack([feet[:, :2], np.ones(len(feet))])
        above = feet[:, 2] - rows @ np.linalg.lstsq(rows[carrying], feet[carrying, 2])[0]
        over = np.where(carrying | set_down, above, 0.0)
    return over if np.abs(over).max() > _UNEVEN_M else np.zeros(len(feet))


def _lying_and_risen(profile: RobotProfile) -> tuple[Array, Array]:
    """Return feet (6, 3) [m] {body}, lying and risen, at the same footholds.

    Each foothold is the nearest to its resting position at which the leg reaches both.
    """
    lying, risen = profile.rest_feet(profile.body.size[2] / 2 - _BELLY_CLEARANCE_M), profile.rest_feet()
    wider = _outward(profile, lying, risen)
    return lying + wider, risen + wider


def sit_pose(profile: RobotProfile) -> Array:
    """Return the joint angles (6, 3) [rad] of a robot that lies on its belly and is about to stand up."""
    q = body_inverse(profile, _lying_and_risen(profile)[0])
    limits = profile.joint_limits
    return np.asarray(np.clip(np.where(np.isfinite(q), q, 0.0), limits[..., 0], limits[..., 1]))


def _outward(profile: RobotProfile, *stances: Array) -> Array:
    """Return outward offsets (6, 3) [m] {body} that bring all feet within reach.

    They hold for all stances (6, 3).
    """
    outward = np.column_stack([profile.T_body_coxa[:, :2, 0], np.zeros(6)])
    reached = [
        np.all([within_limits(profile, body_inverse(profile, feet + wider * outward)).all(axis=1) for feet in stances], axis=0)
        for wider in _WIDER_M
    ]
    # Without a solution, the servos go as far as they can, and the joint limits are enforced later.
    return np.where(np.any(reached, axis=0), _WIDER_M[np.argmax(reached, axis=0)], 0.0)[:, None] * outward
