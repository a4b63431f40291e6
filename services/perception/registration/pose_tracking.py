"""Tracking of the body pose in {world}.

Leg odometry predicts the pose of the next frame, and registration corrects it.
"""

import numpy as np

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.motion_prior import Motion
from sextant.services.perception.registration.rest_gravity import levelling
from sextant.shared.geometry import Array, inverse, orthonormal, rotation_from_rpy, rpy_from_rotation, transform, yaw_of

_MAX_TILT_RAD, _MAX_LIFT_M = 0.05, 0.03  # of the body against its feet while a pose is doubted
_LOST_NS = 2_000_000_000  # [ns] without a registered frame; then poses are doubted for the same time
_LONGEST_NS = 16_000_000_000  # [ns] longest time for which images are refused
_MAX_SIGMA_M, _MAX_SIGMA_RAD = 10.0, 3.0  # [m] [rad] upper bounds of the predicted standard deviation


class PoseTracker:
    """Pose of the body and of {odom} in {world}; {world} is {odom} of the first frame, made level if gravity is known."""

    def __init__(self, settings: Settings):
        """Start without a pose."""
        self._settings = settings
        self.T_world_body: Array = np.eye(4)
        self.T_world_odom: Array = np.eye(4)
        self.last_registered: Motion | None = None  # motion at the last registered frame, None before the first one
        self._odometry_restarts = 0
        self._tilt: Array = np.zeros(2)  # [rad] roll and pitch of {odom} in {world}, averaged
        self._registered_ns = -1  # stamp of the last registered frame, -1 before the first one
        self._trusted_T: Array | None = None  # T_world_odom before the doubt, None without one
        self._doubted_until_ns = -1  # [ns] end of the doubt
        self._refused_until_ns, self._refuse_ns, self._why = -1, _LOST_NS, ""  # [ns] of images; the next duration; the reason
        self._tilt_ns = -1  # of the newest tilt, -1 before the first one

    def begin(self, T_world_odom: Array, motion: Motion, up: Array | None) -> None:
        """Define {world} before the first frame.

        Args:
            T_world_odom: (4, 4) {odom} in {world} of a robot that has walked before; the identity for a new {world}.
            motion: Motion of the body.
            up: (3,) {body} by an inertial sensor; None without one. A new {world} is then level.
        """
        self.T_world_odom = np.array(T_world_odom)
        if up is not None and np.array_equal(T_world_odom, np.eye(4)):
            self.T_world_odom = transform(levelling(motion.T_odom_body[:3, :3] @ up), np.zeros(3))

    def predict(self, motion: Motion, odometry_restarts: int) -> tuple[Array, Array]:
        """Return the body pose (4, 4) {world} by odometry, and its covariance (6, 6) [m^2, m rad, rad^2].

        The uncertainty grows with the way and the turn since the last registered frame.

        Args:
            motion: Motion of the body at the frame.
            odometry_restarts: Number of times that the odometry has started again.
        """
        settings = self._settings
        if odometry_restarts != self._odometry_restarts:
            # The odometry restarted at zero; the body is assumed unmoved until a frame is registered.
            self._odometry_restarts = odometry_restarts
            if self.last_registered is not None:
                self.T_world_odom = self.T_world_body @ inverse(motion.T_odom_body)
                self.last_registered = motion
                self._trusted_T = None
                self.restart_tilt()  # because {odom} is new
        last = self.last_registered or motion
        way = settings.odometry_drift * max(0.0, motion.travelled - last.travelled) + settings.odometry_floor
        turn = settings.odometry_turn * max(0.0, motion.turned - last.turned) + settings.odometry_floor
        level = settings.odometry_level
        if not motion.reliable:
            way, turn = way + settings.unreliable_way, turn + settings.unreliable_turn
            level += settings.unreliable_level
        way, turn = min(way, _MAX_SIGMA_M), min(turn, _MAX_SIGMA_RAD)  # reported distances may be wrong
        sigma = np.array([way, way, level, level, level, turn])  # [m] x, y, z, then [rad] roll, pitch, yaw
        return self.T_world_odom @ motion.T_odom_body, np.diag(sigma**2)

    def correct(self, stamp_ns: int, T_world_body: Array, motion: Motion, registered: bool) -> None:
        """Set the pose of a frame.

        Args:
            stamp_ns: [ns] of the frame.
            T_world_body: (4, 4) nearly rigid estimate.
            motion: Motion of the body at the frame.
            registered: Whether the frame was registered; after a failed one the prior's covariance keeps growing.
        """
        # The rotation from odometry may not be exactly orthonormal; the error must not accumulate over frames.
        self.T_world_body = orthonormal(T_world_body)
        self.T_world_odom = orthonormal(self.T_world_body @ inverse(motion.T_odom_body))
        self._average_tilt(stamp_ns)
        if registered:
            self.last_registered = motion
            self._registered_ns = stamp_ns

    def contradiction(self, stamp_ns: int, T_world_body: Array, motion: Motion) -> str:
        """Return how a pose (4, 4) contradicts the feet, or an empty string.

        Poses are doubted for a while after a long time without a registered frame: meanwhile, wrong images may have made a
        wrong map. At other times the ground may sink under the feet, which odometry does not feel.
        """
        if 0 <= self._registered_ns < stamp_ns - _LOST_NS and self._trusted_T is None:
            self._trusted_T, self._doubted_until_ns = self.T_world_odom, stamp_ns + _LOST_NS
        if self._trusted_T is None:
            return ""
        if stamp_ns >= self._doubted_until_ns:
            self._trusted_T, self._refuse_ns = None, _LOST_NS
            return ""
        moved = inverse(self._trusted_T @ motion.T_odom_body) @ T_world_body
        tilt = float(np.arccos(np.clip(moved[2, 2], -1.0, 1.0)))
        if tilt > _MAX_TILT_RAD:
            return f"images tilt the body by {np.degrees(tilt):.0f} deg against its feet"
        if abs(moved[2, 3]) > _MAX_LIFT_M:
            return f"images lift the body by {1e2 * moved[2, 3]:+.0f} cm off its feet"
        return ""

    def distrust(self, stamp_ns: int, why: str) -> None:
        """Return to the place before the doubt, and refuse images for a while: longer each time in a row."""
        assert self._trusted_T is not None
        self.T_world_odom, self._trusted_T = self._trusted_T, None
        self._refused_until_ns, self._refuse_ns, self._why = stamp_ns + self._refuse_ns, 2 * self._refuse_ns, why
        self._refuse_ns = min(self._refuse_ns, _LONGEST_NS)
        self._registered_ns = min(self._registered_ns, stamp_ns - 1)
        self.restart_tilt()

    def distrusted(self, stamp_ns: int) -> str:
        """Return why an image is refused, or an empty string."""
        return self._why if stamp_ns < self._refused_until_ns else ""

    def restart_tilt(self) -> None:
        """Start the average of the tilt of {odom} again."""
        self._tilt_ns = -1

    def steady_T_world_odom(self, T_odom_body: Array) -> Array:
        """Return T_world_odom (4, 4) with the averaged tilt, which maps the body's position exactly."""
        R = rotation_from_rpy([*self._tilt, yaw_of(self.T_world_odom)])
        return transform(R, self.T_world_body[:3, 3] - R @ T_odom_body[:3, 3])

    def _average_tilt(self, stamp_ns: int) -> None:
        """Average the tilt of {odom} in {world} over a few steps.

        The two tripods tilt the body differently, by about 1 mm in the map. A correction that was measured on one tripod is
        wrong on the other, and these errors would accumulate. The average keeps only what both have in common.
        """
        tilt = rpy_from_rotation(self.T_world_odom[:3, :3])[:2]
        since_s = max(0, stamp_ns - self._tilt_ns) * 1e-9 if self._tilt_ns >= 0 else np.inf
        self._tilt_ns = stamp_ns
        self._tilt = self._tilt + (1.0 - np.exp(-since_s / self._settings.tilt_s)) * (tilt - self._tilt)
