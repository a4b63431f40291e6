"""Leg odometry: expected motion of Masri 2016 (section 4), from measured joints."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, align_rigid, apply, yaw_of
from sextant.shared.robot.kinematics import leg_points
from sextant.shared.robot.profile import RobotProfile

_MIN_LEGS = 3


class LegOdometry:
    """Body pose over feet that do not slip.

    Each standing foot is an anchor in {odom}. A foot is a sphere, so it rolls: when the shank turns by a small angle, the
    centre and the anchor move by that angle times the radius. Without this correction a step is several per cent too short.
    """

    def __init__(self, profile: RobotProfile, q: Array, T_odom_body: Array):
        """Start with all feet standing.

        Args:
            profile: The robot.
            q: (6, 3) [rad] measured joint angles.
            T_odom_body: (4, 4) initial body pose.
        """
        self.T_odom_body = T_odom_body.copy()
        self.travelled = 0.0  # [m]
        self.turned = 0.0  # [rad]
        self.reliable = True
        self.slip = np.zeros(6)  # [m] motion of each standing foot over the ground against the others
        self._profile = profile
        self._standing = np.ones(6, dtype=bool)
        self._shanks = self._shanks_in_odom(q)
        self.anchors = apply(T_odom_body, self.feet)

    def update(self, q: Array, standing: NDArray[np.bool_], ground: Array) -> Array:
        """Update the pose with measured joints.

        Args:
            q: (6, 3) [rad] measured joint angles.
            standing: (6,) legs that carry.
            ground: (6,) [m] {odom} heights at which the feet were set down. Anchor heights come from these, because the joint
                measurements of a leg that takes up its load would add up to a drift of millimetres per step.

        Returns:
            (4, 4) T_odom_body. With fewer than three standing legs it stays, and `reliable` is False.
        """
        before = self._shanks
        self._shanks = self._shanks_in_odom(q)
        self.anchors[:, :2] += self._profile.foot.radius * _rolled(before, self._shanks)
        held = standing & self._standing
        self.anchors[:, 2] = ground
        self.reliable = bool(held.sum() >= _MIN_LEGS)
        if self.reliable:
            previous = self.T_odom_body
            self.T_odom_body = align_rigid(self.feet[held], self.anchors[held])
            self.travelled += math.hypot(*(self.T_odom_body[:2, 3] - previous[:2, 3]).tolist())
            off = apply(self.T_odom_body, self.feet)[:, :2] - self.anchors[:, :2]
            self.slip = np.where(held, np.sqrt(np.vecdot(off, off)), 0.0)
            self.turned += abs(math.remainder(yaw_of(self.T_odom_body) - yaw_of(previous), math.tau))
        fresh = standing & ~self._standing
        if fresh.any():
            self.anchors[fresh] = apply(self.T_odom_body, self.feet[fresh])
        self._standing = standing.copy()
        return self.T_odom_body

    def turn(self, T: Array) -> None:
        """Turn {odom} by T (4, 4) about the body, to correct body and feet."""
        self.T_odom_body = T @ self.T_odom_body
        self.anchors = apply(T, self.anchors)
        self._shanks = self._shanks @ T[:3, :3].T

    def _shanks_in_odom(self, q: Array) -> Array:
        """Return unit vectors (6, 3) from the foot centre up the shank.

        Also store the feet (6, 3) [m] {body}.
        """
        points = leg_points(self._profile, q)
        self.feet = points[:, 3]
        shank = points[:, 2] - points[:, 3]
        return np.asarray(shank @ (self.T_odom_body[:3, :3].T / self._profile.links.tibia))


def _rolled(before: Array, after: Array) -> Array:
    """Return how far (6, 2) spheres of radius one roll between two shank directions."""
    # The cross product is the rotation vector of a small turn without spin about the shank; turn x up is the displacement.
    return np.asarray(before[:, 2:] * after[:, :2] - before[:, :2] * after[:, 2:])
