"""Joint goals that bring loaded feet to their targets. Pure."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.feedforward import lag_feed_forward, sag_feed_forward
from sextant.services.actuator.locomotion.joint_rate_limits import JointRateLimits
from sextant.services.actuator.locomotion.step_executor import Targets
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, nearest_reachable
from sextant.shared.robot.profile import RobotProfile


class JointGoals:
    """Converts foot targets to servo goals, with feed-forward and rate limits.

    `wanted` are the goals without feed-forward: the angles at which the joints should come to rest.
    """

    def __init__(self, profile: RobotProfile, goals: Array):
        """Begin at rest at goals (6, 3) [rad]."""
        self.limits = JointRateLimits(profile)
        self.warning = ""  # which legs cannot reach their targets
        self._profile = profile
        self._q_last: Array | None = None  # targets of the last cycle of the same motion, to compute joint speeds
        self.hold(goals)

    def hold(self, goals: Array) -> None:
        """Take goals (6, 3) [rad] that the servos already have as the wanted angles."""
        self.wanted = goals.copy()
        self._wanted_when_read = goals.copy()

    def adopt(self, legs: NDArray[np.bool_], goals: Array) -> None:
        """Take the goals (6, 3) [rad] of legs (6,) as their wanted angles."""
        self.wanted = np.where(legs[:, None], goals, self.wanted)
        self._wanted_when_read[legs] = goals[legs]

    def begin_motion(self) -> None:
        """Forget the last targets: they belong to another motion, and yield no joint speed."""
        self._q_last = None

    def mark_read(self, leg: int, joint: int) -> None:
        """Note that a joint has just been read."""
        self._wanted_when_read[leg, joint] = self.wanted[leg, joint]

    def mark_all_read(self) -> None:
        """Note that the angles of all joints are those of now."""
        self._wanted_when_read = self.wanted.copy()

    def measured(self, q: Array, without_torque: NDArray[np.bool_]) -> Array:
        """Estimate the present joint angles (6, 3) [rad].

        These are the last readings q (6, 3) [rad], plus the commanded motion since then, except for legs (6,) without torque.
        """
        moved = self.wanted - self._wanted_when_read
        if any(without_torque.tolist()):
            moved[without_torque] = 0.0
        return np.asarray(q + moved)

    def follow(self, targets: Targets, goals: Array, holds: NDArray[np.bool_], dt: float) -> Array:
        """Return the next goals (6, 3) [rad].

        Args:
            targets: Targets of the feet.
            goals: (6, 3) [rad] last goals.
            holds: (6,) legs that keep these.
            dt: [s] since then.
        """
        profile, limits = self._profile, self.limits
        feet = nearest_reachable(profile, targets.feet)
        q = body_inverse(profile, feet)
        before = q if self._q_last is None else self._q_last
        self._q_last = q
        follows = np.isfinite(q)  # joints that follow their targets
        if follows.all():
            sag = sag_feed_forward(profile, q, feet, targets.share, targets.R_level_body)
        else:
            sag = sag_feed_forward(profile, np.where(follows, q, 0.0), feet, targets.share, targets.R_level_body)
        rates = (q - before) / dt
        rates[~np.isfinite(rates)] = 0.0
        lag, limiting = lag_feed_forward(profile, rates, dt), limits.is_limiting
        if limiting:
            lag[limits.gentle] = 0.0  # must not run ahead of them
        goal = q + sag + lag
        if any(holds.tolist()):
            goal[holds], follows[holds] = goals[holds], False
        goal, self.warning = limits.safe(goal, goals, dt)
        rest = np.where(limits.gentle, goal - sag - lag, q) if limiting else q  # not commanded further yet
        self.wanted = np.where(follows, rest, self.wanted)
        return goal
