"""Leg odometry: expected motion of Masri 2016 (section 4), from measured joints."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, align_rigid, apply, yaw_of
from sextant.shared.robot.kinematics import Point, feet_and_shanks
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
        self._standing = [True] * 6
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
        before, self._shanks = self._shanks, self._shanks_in_odom(q)
        stands, radius = standing.tolist(), self._profile.foot.radius
        rolling = zip(self.anchors.tolist(), before, self._shanks, ground.tolist(), strict=True)
        # The cross product of the shanks is the rotation vector of a small turn without spin; turn x up is the displacement.
        anchors = [
            (x + radius * (bz * sx - bx * sz), y + radius * (bz * sy - by * sz), z)
            for (x, y, _), (bx, by, bz), (sx, sy, sz), z in rolling
        ]
        held = [leg for leg in range(6) if stands[leg] and self._standing[leg]]
        self.reliable = len(held) >= _MIN_LEGS
        feet = self._feet
        if self.reliable:
            previous = self.T_odom_body
            self.T_odom_body = align_rigid(np.array([feet[leg] for leg in held]), np.array([anchors[leg] for leg in held]))
            (xx, xy, xz, x), (yx, yy, yz, y), *_ = self.T_odom_body.tolist()
            self.travelled += math.hypot(x - previous[0, 3], y - previous[1, 3])
            self.turned += abs(math.remainder(math.atan2(yx, xx) - yaw_of(previous), math.tau))
            self.slip = np.zeros(6)
            for leg in held:
                fx, fy, fz = feet[leg]
                x_off, y_off = xx * fx + xy * fy + xz * fz + x, yx * fx + yy * fy + yz * fz + y
                self.slip[leg] = math.hypot(x_off - anchors[leg][0], y_off - anchors[leg][1])
        self.anchors = np.array(anchors)
        fresh = [leg for leg in range(6) if stands[leg] and not self._standing[leg]]
        if fresh:
            self.anchors[fresh] = apply(self.T_odom_body, self.feet[fresh])
        self._standing = stands
        return self.T_odom_body

    def turn(self, T: Array) -> None:
        """Turn {odom} by T (4, 4) about the body, to correct body and feet."""
        self.T_odom_body = T @ self.T_odom_body
        self.anchors = apply(T, self.anchors)
        self._shanks = [tuple(row) for row in (np.array(self._shanks) @ T[:3, :3].T).tolist()]

    def _shanks_in_odom(self, q: Array) -> list[Point]:
        """Return unit vectors {odom} from the foot centres up the shanks.

        Also store the joint angles, and the feet (6, 3) [m] {body}.
        """
        self.q = q
        self._feet, shanks = feet_and_shanks(self._profile, q)
        self.feet = np.array(self._feet)
        (xx, xy, xz, _), (yx, yy, yz, _), (zx, zy, zz, _), _ = self.T_odom_body.tolist()
        return [(xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z) for x, y, z in shanks]
