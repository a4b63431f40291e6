"""Tracking of the body pose in {world}.

Leg odometry predicts the pose of the next frame, and registration corrects it.
"""

import numpy as np

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.motion_prior import Motion
from sextant.shared.geometry import Array, inverse, orthonormal, rotation_from_rpy, rpy_from_rotation, transform, yaw_of

_MAX_SIGMA_M, _MAX_SIGMA_RAD = 10.0, 3.0  # [m] [rad] upper bounds of the predicted standard deviation


class PoseTracker:
    """Pose of the body and of {odom} in {world}; {world} is {odom} of the first frame."""

    def __init__(self, settings: Settings):
        """Start without a pose."""
        self._settings = settings
        self.T_world_body: Array = np.eye(4)
        self.T_world_odom: Array = np.eye(4)
        self.last_registered: Motion | None = None  # motion at the last registered frame, None before the first one
        self._odometry_restarts = 0
        self._tilt: Array = np.zeros(2)  # [rad] roll and pitch of {odom} in {world}, averaged
        self._tilt_ns = -1  # of the newest tilt, -1 before the first one

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
