"""Standing up: feet to their resting places while the belly lies on the ground, then the body rises."""

import numpy as np

from services.actuator.walker import Targets
from shared.geometry import Array
from shared.robot import RobotProfile

_BELLY_CLEARANCE = 0.005  # [m] of the feet over the ground on which the belly lies


class StandUp:
    """From any folded stance to the resting stance in a given time."""

    def __init__(self, profile: RobotProfile, feet: Array, duration_s: float):
        """Begin.

        Args:
            profile: The robot.
            feet: (6, 3) [m] {body} where the feet are.
            duration_s: [s] for the whole.
        """
        rest = profile.rest_feet()
        lying = profile.rest_feet(profile.body.size[2] / 2 - _BELLY_CLEARANCE)
        standing = np.abs(feet - rest).max() < 0.03
        self._way = (feet, rest) if standing else (feet, lying, rest)
        self._duration = duration_s
        self._elapsed = 0.0

    @property
    def done(self) -> bool:
        """Whether the robot stands."""
        return self._elapsed >= self._duration

    def update(self, dt: float) -> Targets:
        """Move on by dt [s]."""
        self._elapsed = min(self._elapsed + dt, self._duration)
        legs = len(self._way) - 1
        progress = self._elapsed / self._duration * legs
        leg = min(int(progress), legs - 1)
        s = progress - leg
        s = s * s * (3 - 2 * s)
        feet = (1 - s) * self._way[leg] + s * self._way[leg + 1]
        # From goals that hold a load already, too: those include its sag, which must not be added twice.
        carrying = s if leg == legs - 1 else 0.0
        return Targets(feet, np.full(6, carrying), np.eye(3))
