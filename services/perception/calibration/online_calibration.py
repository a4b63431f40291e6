"""Self-correction of the camera while the robot walks, and its report to the operator."""

import math
from dataclasses import dataclass

import numpy as np

from sextant.services.perception.calibration.motion_calibration import HEIGHT, ROTATION, SCALE, MotionCalibration, Registered
from sextant.services.perception.calibration.stamp_delay import StampDelay
from sextant.services.perception.registration.camera_correction import CameraCorrection
from sextant.services.perception.registration.error_twist import covariance_at, error_twist
from sextant.services.perception.registration.motion_prior import Motion
from sextant.services.perception.registration.registration_result import RegistrationResult
from sextant.shared.geometry import Array, inverse
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import CameraErrors

_TOLD = [0, 1, 2, HEIGHT, SCALE]  # values that `CameraErrors` holds, with the delay
_CORRECTED = [0, 1, HEIGHT]  # values that are corrected: roll [rad], pitch [rad], height [m]
_RATE = np.array([*[math.radians(0.3)] * 2, 0.001])  # largest change of a correction after one stretch
_LARGEST = np.array([*[math.radians(6.0)] * 2, 0.02])  # bounds of the corrections
_KNOWN = np.array([*[math.radians(1.4)] * 2, 0.004])  # standard deviation below which a value counts as known
_SURE = 1.0  # [sigma] from which a known value is corrected
# An error is named from this size on, and from this multiple of its standard deviation on.
_NAMED_DEG, _NAMED_M, _NAMED_SCALE, _NAMED_S, _NAMED = 1.5, 0.005, 0.018, 0.03, 2.0
_LEGS_DEG = 0.5  # [deg] by which horns may tilt the body against the feet; an error of the camera looks the same


@dataclass(frozen=True, slots=True)
class _Name:
    """How an error is named: an error below zero means that the camera does what the first of the words says."""

    verb: str
    words: tuple[str, str]
    least: float  # of an error that is named
    per_unit: float  # of the text, in units of the error
    unit: str
    digits: int
    stretches: int  # in a row that must show the error; a slip of feet in one stretch looks like some of the errors


_NAMES = (
    _Name("leans", ("farther right", "farther left"), _NAMED_DEG, 1.0, " deg", 1, 1),
    _Name("looks", ("lower", "higher"), _NAMED_DEG, 1.0, " deg", 1, 3),
    _Name("looks", ("farther left", "farther right"), _NAMED_DEG, 1.0, " deg", 1, 3),
    _Name("sits", ("higher", "lower"), _NAMED_M, 1e3, " mm", 0, 1),
    _Name("measures depths", ("shorter", "longer"), _NAMED_SCALE, 1e2, "%", 1, 3),
    _Name("stamps images", ("later", "earlier"), _NAMED_S, 1e3, " ms", 0, 3),
)


class OnlineCalibration:
    """Estimates errors of a camera, and corrects its tilt and height.

    Yaw and depth error are only named: to correct them would move the mapped ground sideways, by the width of a foot at 1 m.
    The delay of its stamps is only named, too.
    """

    def __init__(self, profile: RobotProfile, corrects: bool) -> None:
        """Start with the camera of the profile.

        Args:
            profile: The robot.
            corrects: Whether tilt and height are corrected; otherwise they, too, are only named.
        """
        self.correction = CameraCorrection(profile.camera)
        self._motion = MotionCalibration(profile.camera.T_body_camera[:3, 3])
        self._delay = StampDelay()
        self._feet = profile.rest_feet() - [0.0, 0.0, profile.foot.radius]
        self._leg_heights: Array = np.full(6, np.nan)
        self.values, self.covariance = self._motion.values, self._motion.covariance
        self.finding, self._has_news = "", False
        self._shown = [0] * len(_NAMES)  # stretches in a row that have shown each error
        self._corrects = corrects
        self._last: tuple[int, Motion] | None = None  # stamp [ns] and motion of the last registered frame
        self._odometry_restarts = 0

    def add(
        self,
        found: RegistrationResult,
        T_prior: Array,
        prior_covariance: Array,
        T_body: Array,
        motion: Motion,
        odometry_restarts: int,
    ) -> None:
        """Add a frame.

        Args:
            found: The frame's result {world}.
            T_prior: (4, 4) body {world} by odometry.
            prior_covariance: (6, 6) of its error twist.
            T_body: (4, 4) body {world} by registration.
            motion: Motion of the body at the frame.
            odometry_restarts: Number of times that the odometry has started again.
        """
        if odometry_restarts != self._odometry_restarts:
            self._odometry_restarts = odometry_restarts
            self.restart()
        last, usable = self._last, found.ok and motion.reliable
        self._last = (found.stamp_ns, motion) if usable else None
        if not usable or last is None or found.stamp_ns <= last[0]:
            self._interrupt()
            return
        frame = Registered(
            T_prior,
            prior_covariance,
            error_twist(T_body, T_prior),
            covariance_at(found.covariance, T_body[:3, 3] - found.T_world_camera[:3, 3]),
            inverse(last[1].T_odom_body) @ motion.T_odom_body,
            found.stamp_ns - last[0],
        )
        self._delay.add(frame)
        if not self._motion.add(frame, self.corrected, self._delay.value):
            return
        self.values, self.covariance = self._motion.with_leg_heights(self._leg_heights, self._feet, self.corrected)
        self.finding, self._has_news = self._name_errors(), True
        if self._corrects:
            self._follow(T_body)

    def compare(self, leg_heights: Array) -> None:
        """Set the heights (6,) [m] of the ground by each leg, minus that of the map; NaN if unknown."""
        self._leg_heights = leg_heights

    def restart(self) -> None:
        """Go on after a jump of the pose or of the odometry."""
        self._last = None
        self._interrupt()

    @property
    def sigma(self) -> Array:
        """Standard deviations (10,) of the values."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def corrected(self) -> Array:
        """Errors (10,) that are corrected, in the order of `MotionCalibration.values`."""
        values = np.zeros(len(self.values))
        correction = self.correction
        values[_CORRECTED] = [*correction.tilt, correction.height]
        return values

    def _interrupt(self) -> None:
        self._motion.interrupt()
        self._delay.interrupt()

    def _follow(self, T_body: Array) -> None:
        """Correct the errors that are known, slowly."""
        now, values, sigma = (of[_CORRECTED] for of in (self.corrected, self.values, self.sigma))
        goal = np.where((sigma < _KNOWN) & (np.abs(values) > _SURE * sigma), values, now)
        new = np.clip(now + np.clip(goal - now, -_RATE, _RATE), -_LARGEST, _LARGEST)
        if (new != now).any():
            self.correction.change(new[:2], float(new[2]), T_body)

    def news(self, stamp_ns: int) -> CameraErrors | None:
        """Return the estimate if it has changed since the last call."""
        if not self._has_news:
            return None
        self._has_news = False
        estimate, sigma = self._told()
        return CameraErrors(stamp_ns, estimate, sigma, np.append(self.corrected[_TOLD], 0.0), self.finding)

    def _told(self) -> tuple[Array, Array]:
        """Return estimate (6,) and standard deviations (6,) as in `CameraErrors`."""
        return np.append(self.values[_TOLD], -self._delay.value), np.append(self.sigma[_TOLD], self._delay.sigma)

    def _name_errors(self) -> str:
        """Return the errors that enough stretches have shown, as a sentence; empty if there are none."""
        values, sigmas = self._told()
        values[ROTATION], sigmas[ROTATION] = np.degrees(values[ROTATION]), np.degrees(sigmas[ROTATION])
        sigmas[:2] = np.hypot(sigmas[:2], _LEGS_DEG)
        found = []
        for at, (name, value, sigma) in enumerate(zip(_NAMES, values.tolist(), sigmas.tolist(), strict=True)):
            size = abs(value)
            self._shown[at] = self._shown[at] + 1 if size > max(name.least, _NAMED * sigma) else 0
            if self._shown[at] >= name.stretches:
                low, best, high = (f"{name.per_unit * of:.{name.digits}f}" for of in (size - 2 * sigma, size, size + 2 * sigma))
                found.append(f"{name.verb} {best}{name.unit} ({low} to {high}) {name.words[value > 0.0]}")
        if not found:
            return ""
        return f"the camera {' and '.join(found)} than its profile says: run `sextant camera calibrate`"
