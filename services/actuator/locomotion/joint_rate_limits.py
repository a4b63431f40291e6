"""Position, speed and acceleration limits of joint goals. Pure."""

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import LEGS, RobotProfile

# [s] in which a goal may accelerate from rest to the servos' top speed. Stopping is not limited: a goal that braked slowly
# would overshoot the wanted angle. The servo brakes by itself.
_FULL_SPEED_S = 0.04
GENTLE = np.radians(25.0)  # [rad/s] of a joint that resumes its motion
LOWERED = np.radians(35.0)  # [rad/s] of a joint whose foot was left in the air and is lowered
FETCHED = np.radians(95.0)  # [rad/s] of a joint whose leg waited in the air for a silent servo, which has reached its goal
_RESUME_WITHIN_RAD = np.radians(5.0)  # [rad] from the wanted angle, within which the normal motion resumes
_WAIT_BEYOND_RAD = np.radians(3.0)  # [rad] from the wanted angle, beyond which that angle waits for the joint


class JointRateLimits:
    """Keeps goals finite, within joint limits and within servo speed.

    Joints that resume their motion are slower.
    """

    def __init__(self, profile: RobotProfile):
        """Begin at rest."""
        self._profile = profile
        self._rates: Array = np.zeros((6, 3))  # [rad/s] of the last goals
        self.gentle = np.zeros((6, 3), dtype=np.bool_)  # joints with limited speed, until they have caught up
        self._top: Array = np.full((6, 1), GENTLE)  # [rad/s] limit of these joints, per leg
        self.pace = 1.0  # speed factor of a motion that waits for limited joints
        self.behind = np.zeros((6, 3), dtype=np.bool_)  # joints that resume their motion and have not been close yet

    def limit_joint(self, leg: int, joint: int, top: float = GENTLE) -> None:
        """Limit the speed of a joint until its goals have caught up with the wanted angle.

        The whole leg is limited until the joint is close, because its joints change together from hanging to standing.

        Args:
            leg: Leg of the joint.
            joint: Joint of the leg.
            top: [rad/s] limit for that leg's goals.
        """
        self.gentle[leg], self._top[leg] = True, top
        self.behind[leg, joint] = True

    @property
    def is_limiting(self) -> bool:
        """Whether any joint is limited: a step could not lift its foot as planned."""
        return bool(np.count_nonzero(self.gentle))

    def forget(self) -> None:
        """End all limits, because torque is off or all joints stay where they are."""
        self.gentle[:] = self.behind[:] = False
        self.pace = 1.0

    def safe(self, q_goal: Array, q_last: Array, dt: float) -> tuple[Array, str]:
        """Return goals that may be sent, and a warning about legs out of reach.

        Args:
            q_goal: (6, 3) [rad] wanted goals, NaN where a foot is out of reach.
            q_last: (6, 3) [rad] last goals.
            dt: [s] since then.

        Returns:
            (6, 3) [rad], and a warning or an empty string. A leg out of reach keeps its last goals.
        """
        lost = [] if (finite := np.isfinite(q_goal)).all() else np.flatnonzero(~finite.all(axis=1)).tolist()
        wanted = q_goal
        if lost:
            wanted = q_goal.copy()
            wanted[lost] = q_last[lost]
        limits, fastest = self._profile.joint_limits, self._profile.servos.no_load_speed
        wanted = np.minimum(np.maximum(wanted, limits[..., 0]), limits[..., 1])
        gained = fastest / _FULL_SPEED_S * dt
        up = np.minimum(np.maximum(self._rates, 0.0) + gained, fastest)
        down = np.minimum(gained - np.minimum(self._rates, 0.0), fastest)
        limiting = self.is_limiting
        if limiting:
            down, up = (np.where(self.gentle, np.minimum(top, self._top), top) for top in (down, up))
        q = np.minimum(np.maximum(wanted, q_last - down * dt), q_last + up * dt)
        if dt > 0.0:
            self._rates = (q - q_last) / dt
        self.pace = 1.0
        if limiting:
            left = np.abs(wanted - q)
            self.pace -= min(float(left.max(where=self.gentle, initial=0.0)) / _WAIT_BEYOND_RAD, 1.0)
            self.behind &= left > _RESUME_WITHIN_RAD
            self.gentle &= (left > 1e-9) | self.behind.any(axis=1, keepdims=True)
        names = ", ".join(LEGS[leg] for leg in lost)
        return q, f"foot out of reach, leg held in place: {names}" if names else ""
