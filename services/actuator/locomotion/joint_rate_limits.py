"""What the joint goals of a cycle must satisfy before they reach the servos. Pure: time comes in."""

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import LEGS, RobotProfile

# [s] in which a goal may come from rest to the servos' greatest speed. To stop takes no time: a goal that braked slowly would
# run past where the joint is wanted. The servo brakes by itself.
_FULL_SPEED_S = 0.04
GENTLE = np.radians(25.0)  # [rad/s] of a joint that takes up its work again
LOWERED = np.radians(35.0)  # [rad/s] of one whose foot was left in the air, and comes down
FETCHED = np.radians(95.0)  # [rad/s] of one whose leg waited in the air for a servo that was silent, and is where it was sent
_NEAR = np.radians(5.0)  # of what is wanted, within which it has taken it up
_FAR = np.radians(3.0)  # of what is wanted, at which what is wanted waits for it


class GoalLimits:
    """Keeps goals finite, within the joints' limits, and no faster than the servos; gentle where a joint begins anew."""

    def __init__(self, profile: RobotProfile):
        """Begin at rest."""
        self._profile = profile
        self._rates: Array = np.zeros((6, 3))  # [rad/s] of the goals that were sent last
        self.gentle = np.zeros((6, 3), dtype=np.bool_)  # joints that take up their work, until they have caught up
        self._top: Array = np.full((6, 1), GENTLE)  # [rad/s] of the gentle joints of each leg
        self.pace = 1.0  # share of its speed at which a motion has to go on that is not to leave gentle joints behind
        self.behind = np.zeros((6, 3), dtype=np.bool_)  # joints that take up their work, and have not been near it yet

    def ease(self, leg: int, joint: int, top: float = GENTLE) -> None:
        """Let a joint take up its work gently: its goals are slow until they have caught up with what is wanted.

        So are those of its whole leg until it has nearly: they change with it from hanging to standing.

        Args:
            leg: Of the joint.
            joint: Of its leg.
            top: [rad/s] of that leg's goals.
        """
        self.gentle[leg], self._top[leg] = True, top
        self.behind[leg, joint] = True

    @property
    def easing(self) -> bool:
        """Whether a joint takes up its work gently: a foot would not come off the ground as a step wants it."""
        return bool(self.gentle.any())

    def forget(self) -> None:
        """No joint takes up anything: torque is off, or all joints stay where they are."""
        self.gentle[:] = self.behind[:] = False
        self.pace = 1.0

    def safe(self, q_goal: Array, q_last: Array, dt: float) -> tuple[Array, str]:
        """Goals that may be sent, with what had to be withheld.

        Args:
            q_goal: (6, 3) [rad] wanted goals, NaN where a foot is out of reach.
            q_last: (6, 3) [rad] goals sent last.
            dt: [s] since then.

        Returns:
            (6, 3) [rad], and a warning in words or nothing. A leg out of reach keeps its last goals.
        """
        lost = np.asarray(~np.isfinite(q_goal).all(axis=1))
        wanted = np.where(lost[:, None], q_last, q_goal)
        limits, fastest = self._profile.joint_limits, self._profile.servo.no_load_speed
        wanted = np.minimum(np.maximum(wanted, limits[..., 0]), limits[..., 1])
        gained = fastest / _FULL_SPEED_S * dt
        down, up = (np.minimum(np.maximum(way * self._rates, 0.0) + gained, fastest) for way in (-1.0, 1.0))
        down, up = (np.where(self.gentle, np.minimum(top, self._top), top) for top in (down, up))
        q = np.minimum(np.maximum(wanted, q_last - down * dt), q_last + up * dt)
        if dt > 0.0:
            self._rates = (q - q_last) / dt
        left = np.abs(wanted - q)
        self.pace = 1.0 - min(float(left.max(where=self.gentle, initial=0.0)) / _FAR, 1.0)
        self.behind &= left > _NEAR
        self.gentle &= (left > 1e-9) | self.behind.any(axis=1, keepdims=True)
        names = [LEGS[leg] for leg in np.flatnonzero(lost)]
        return q, f"foot out of reach, held: {', '.join(names)}" if names else ""
