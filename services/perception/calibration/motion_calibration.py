"""Errors of a walking robot's camera, estimated from its motion.

A camera that looks 3 deg lower than its profile says sees level ground rise by 5 cm in each metre that the legs walk level. An
error of the depth stretches the motion that the images show. A Kalman filter compares this motion with that of the legs, over
stretches of 10 cm. This is the calibration from two motions of Brookshire and Teller (RSS 2012), "Extrinsic calibration from
per-sensor egomotion".

A registered pose lies between that of the images and that of the legs. Its lag behind the images is predicted over each
stretch, so that directions that the scene does not constrain say nothing. New keyframes are placed at the registered pose, so
the lag of earlier stretches is gone.
"""

from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, log_so3, on_twists, skew

# One standard deviation before the first measurement.
_ROTATION_SIGMA = np.radians(2.0)  # [rad] of the mount about each axis of the body
_PLACE_SIGMA = 0.006  # [m] of the mount
_SCALE_SIGMA = 0.02  # [1] relative error of the depth
# Legs are not exact either: legs that walk to the right look like a camera that is turned left.
_LEGS_SIGMA = (np.radians(0.3), np.radians(1.0), 0.009)  # [rad] of their motion's pitch and yaw, [1] of its length
_SIGMA = np.array([*[_ROTATION_SIGMA] * 3, *[_PLACE_SIGMA] * 3, _SCALE_SIGMA, *_LEGS_SIGMA])
ROTATION, HEIGHT, SCALE = slice(0, 3), 5, 6  # places of the numbers in `MotionCalibration.values`
_PLACE, _LEGS = slice(3, 6), slice(7, 10)
_STRETCH_M, _STRETCH_RAD, _STRETCH_NS = 0.10, 0.25, 4_000_000_000  # of the motion that one measurement covers
# Errors of the legs over one stretch: joints bend and feet slip. Position [m], then rotation [rad].
_FLOOR = np.array([0.001, 0.001, 0.0015, 0.004, 0.004, 0.003])
_OF_WAY, _OF_TURN = 0.007, 0.03  # [1] further errors, as a share of the motion
_OF_IMAGES = np.array([0.0007, 0.0007, 0.0007, 0.001, 0.001, 0.001])  # [m] and [rad] errors of the images over one stretch
_LEG_SIGMA_M = 0.0035  # [m] of the ground's height by one leg: its horns and links, and the map below it
_FARTHEST_M = 0.05  # [m] of a plausible difference between the heights of the ground by a leg and by the camera
_GATE = 22.5  # [1] largest squared error of a stretch: 99.9 % of the chi-square distribution with 6 degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """One registered frame. Twists and covariances are those of the body, in world axes, see `error_twist`."""

    T_prior: Array  # (4, 4) body {world} by odometry since the last registered frame
    prior_covariance: Array  # (6, 6)
    twist: Array  # (6,) from the prior to the registered pose
    covariance: Array  # (6, 6) of the registered pose
    T_moved: Array  # (4, 4) motion of the body since the last registered frame, by odometry
    since_ns: int  # [ns] since that frame


class MotionCalibration:
    """Kalman filter of the errors of a camera: `values` (10,) and their `covariance`.

    The first seven are the rotation (3,) [rad] and place (3,) [m] by which the profile's mount differs from the true one, in
    axes of the body, and the relative error of the depth, positive if it is too large. The others belong to the legs.
    """

    def __init__(self, p_body_camera: Array) -> None:
        """Start with the prior; p_body_camera (3,) [m] is the place of the camera."""
        self._p_body_camera = p_body_camera
        self.values: Array = np.zeros(len(_SIGMA))
        self.covariance: Array = np.diag(_SIGMA**2)
        self.way = 0.0  # [m] of all stretches that were used
        self.interrupt()

    @property
    def sigma(self) -> Array:
        """Standard deviations (10,) of the values."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def interrupt(self) -> None:
        """Drop the stretch: a frame was not registered, or the pose jumped."""
        self._R_begin: Array | None = None  # (3, 3) attitude of the body {world} at the beginning of the stretch
        self._lag = np.zeros((6, len(_SIGMA)))  # derivative of the pose's lag by the values
        self._design = np.zeros((6, len(_SIGMA)))  # derivative of the sum of twists by the values
        self._twist, self._gain, self._frames = np.zeros(6), np.zeros((6, 6)), 0
        self._way, self._turn, self._since_ns = 0.0, 0.0, 0
        self._v_begin: Array | None = None  # (3,) [m/s] {world} velocity of the body at the beginning of the stretch

    def add(self, frame: Registered, corrected: Array, delay_s: float = 0.0) -> bool:
        """Add a registered frame, and return whether a stretch ended with it.

        Args:
            frame: The frame.
            corrected: (10,) errors that its registration had corrected.
            delay_s: Time [s] by which images are stamped too late.
        """
        moved = frame.T_moved
        v = frame.T_prior[:3, :3] @ moved[:3, :3].T @ moved[:3, 3] / (frame.since_ns * 1e-9)  # [m/s] {world}
        if self._R_begin is None:
            self._R_begin = frame.T_prior[:3, :3]
        if self._v_begin is None:
            self._v_begin = v
        to_begin = on_twists(self._R_begin.T)  # from {world} to the axes of the stretch
        gain = to_begin @ image_gain(frame) @ to_begin.T
        motion = on_twists(self._R_begin.T @ frame.T_prior[:3, :3]) @ self._motion_design(moved)
        seen = gain @ (motion + self._lag)
        self._lag = self._lag + motion - seen
        self._design = self._design + seen
        self._twist = self._twist + to_begin @ frame.twist
        self._gain, self._frames = self._gain + gain, self._frames + 1
        self._way += float(np.linalg.norm(moved[:3, 3]))
        self._turn += float(np.linalg.norm(log_so3(moved[:3, :3])))
        self._since_ns += frame.since_ns
        ends = self._way >= _STRETCH_M or self._turn >= _STRETCH_RAD
        if ends:
            self._update(corrected, delay_s * self._R_begin.T @ (v - self._v_begin))
        if ends or self._since_ns > _STRETCH_NS:
            self.interrupt()
            self._v_begin = v
        return ends

    def with_leg_heights(self, leg_heights: Array, feet: Array, corrected: Array) -> tuple[Array, Array]:
        """Return values (10,) and covariance (10, 10) that also use the heights of the ground below the feet.

        A camera that is too high shows all of it too high. One that leans shows it too high below the legs of one side.

        Args:
            leg_heights: (6,) [m] height of the ground by each leg, minus that by the camera; NaN if unknown.
            feet: (6, 3) [m] {body} the feet.
            corrected: (10,) errors that the camera's map had corrected.
        """
        known = np.abs(leg_heights) < _FARTHEST_M  # False for NaN
        if not known.any():
            return self.values, self.covariance
        x, y, z = (feet[known] - self._p_body_camera).T
        A = np.zeros((len(x), len(_SIGMA)))
        A[:, 0], A[:, 1] = -y, x
        A[:, _PLACE] = [0.0, 0.0, -1.0]
        A[:, SCALE] = -z
        S = A @ self.covariance @ A.T + _LEG_SIGMA_M**2 * np.eye(len(x))
        K = np.linalg.solve(S, A @ self.covariance).T
        surprise = leg_heights[known] - A @ (self.values - corrected)
        return self.values + K @ surprise, self.covariance - K @ S @ K.T

    def _motion_design(self, moved: Array) -> Array:
        """Return the derivatives (6, 10) of the motion that images show, less that of the legs, in body axes.

        The images show the motion X moved X^-1, where X is the profile's mount times the inverse of the true one.
        """
        d, turned = moved[:3, 3], moved[:3, :3] - np.eye(3)
        M = np.zeros((6, len(_SIGMA)))
        M[:3, ROTATION] = -skew(d) - turned @ skew(self._p_body_camera)
        M[3:, ROTATION] = -skew(log_so3(moved[:3, :3]))
        M[:3, _PLACE] = -turned
        M[:3, SCALE] = d + turned @ self._p_body_camera
        M[:3, _LEGS] = np.array([[-d[2], d[1], -d[0]], [0.0, -d[0], -d[1]], [d[0], 0.0, -d[2]]])
        return M

    def _update(self, corrected: Array, late_m: Array) -> None:
        """Update the values with the stretch, unless it contradicts them: a foot has slipped far.

        Late stamps shorten the way of a stretch by `late_m` (3,) [m].
        """
        sigma = _FLOOR + np.repeat([_OF_WAY * self._way, _OF_TURN * self._turn], 3)
        gain = self._gain / self._frames
        R = gain @ np.diag(sigma**2) @ gain.T + np.diag(_OF_IMAGES**2)
        A = self._design
        surprise = self._twist + gain[:, :3] @ late_m - A @ (self.values - corrected)
        S = A @ self.covariance @ A.T + R
        if float(surprise @ np.linalg.solve(S, surprise)) > _GATE:
            return
        K = np.linalg.solve(S, A @ self.covariance).T
        rest = np.eye(len(_SIGMA)) - K @ A
        self.values = self.values + K @ surprise
        self.covariance = rest @ self.covariance @ rest.T + K @ R @ K.T
        self.way += self._way


def image_gain(frame: Registered) -> Array:
    """Return the gain (6, 6) {world} by which the pose of a frame followed its image: 0 for the prior, 1 for the image."""
    L = np.linalg.cholesky(frame.prior_covariance)
    inverse_L = np.linalg.inv(L)
    kept, axes = np.linalg.eigh(inverse_L @ frame.covariance @ inverse_L.T)
    # The prior of a frame after a slip is wider than the stated one; such a frame says nothing here.
    return np.asarray(L @ (axes * (1.0 - np.clip(kept, 0.0, 1.0))) @ axes.T @ inverse_L)
