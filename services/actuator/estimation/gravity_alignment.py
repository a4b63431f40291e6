"""Alignment of {odom} with gravity by an inertial sensor.

Leg odometry alone assumes that the ground under the feet is level.

The legs measure every motion at once, but not the direction of gravity. An inertial sensor measures that direction within its
uncertainty. Therefore {odom} turns slowly about the body, as far as the sensor is certain, so that level in {odom} is level
against gravity. In a walk the heading of {odom} follows the gyro, because slipping feet turn the body unseen by the legs. Both
corrections are limited per step, because legs in the air turn without the sensor.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.attitude import Attitude, AttitudeEstimator
from sextant.shared.geometry import Array, exp_so3, transform, yaw_of
from sextant.shared.wire.messages import Imu

_LIFTED_LEAN_RAD = np.radians(2.0)  # [rad] lean of the body, from which a foot that moves down lifts it ...
_LIFTING_ARM_M = 0.05  # [m] ... if the foot has at least this lever arm
TIPPED = np.radians(20.0)  # [rad] tilt of the body against its commanded pose from which the robot must stop
_MAX_RATE_RAD_S, _MAX_FORCE_M_S2 = 100.0, 2000.0  # [rad/s] and [m/s^2] measuring range of an inertial sensor
_ODD_NS = 1_000_000_000  # [ns] for which an out-of-range reading is reported
_GAP_NS = 100_000_000  # [ns] without a reading after which the rotation meanwhile is unknown
_OTHER_CLOCK_NS = 1_000_000_000  # [ns] by which a reading may be late; an older one is from another clock
_SETTLING_NS = 3_000_000_000  # [ns] that the attitude takes to become certain, at first
_CALM_NS = 1_000_000_000  # [ns] of standing after which the body no longer moves
_PATIENCE_S = 5.0  # [s] of standing for which a walk waits for the gyro's bias
_MAX_UNCERTAINTY_RAD = np.radians(3.0)  # [rad] standard deviation up to which the sensor is used
_TURN_GAIN = 0.5  # [1/s] gain with which {odom} turns, in lean and in heading
_MAX_TURN_RAD_S = np.radians(3.0)  # [rad/s] maximum rate of that turn
_HEADING_GAIN = 2.0  # [1/s] gain at which the heading follows the gyro
_MAX_LEAN_RAD, _MAX_YAW_RAD = np.radians(12.0), np.radians(5.0)  # [rad] limits per step, or per rest


class GravityAlignment:
    """Estimates from an inertial sensor by how much {odom} leans."""

    def __init__(self) -> None:
        """Begin without a reading."""
        self._estimator = AttitudeEstimator()
        self._attitude: Attitude | None = None
        self._first_ns = self._stamp_ns = -1  # of the first and the newest reading
        self._heard_ns = -1  # when it arrived
        self._odd_ns = -_ODD_NS - 1  # when the last out-of-range reading arrived
        self._moved_ns = -1  # stamp of the last reading of a robot that did not stand
        self._stood_s = 0.0  # [s] for which the robot has stood with a sensor, in all
        self.restart()

    def restart(self) -> None:
        """Begin a new {odom}; the attitude estimate stays."""
        self._heading: tuple[float, float] | None = None  # [rad] by the legs and by the gyro, at the last call
        self._behind = 0.0  # [rad] by which the legs' heading is behind that of the gyro
        self._calm: Array | None = None  # (3,) {odom} up before feet came down
        self._begin(None)

    def _begin(self, step: int | None) -> None:
        self._step = step  # number of the running step; None: at rest
        self._R_levelled: Array = np.eye(3)  # rotation of {odom} during this step
        self._made_up = 0.0  # [rad] heading correction during this step
        self._steep = self._astray = False  # whether the error of lean, or of heading, exceeds the correction allowed per step

    def take(self, reading: Imu, now_ns: int, still: bool = False) -> None:
        """Process a reading received at `now_ns`; `still`: the robot is known to stand.

        Out-of-order and out-of-range readings are ignored. After a gap the estimate starts again.
        """
        if np.abs(reading.gyro).max() > _MAX_RATE_RAD_S or np.abs(reading.specific_force).max() > _MAX_FORCE_M_S2:
            self._odd_ns = now_ns
            return
        since_ns = reading.stamp_ns - self._stamp_ns if self._attitude is not None else 1
        if -_OTHER_CLOCK_NS < since_ns <= 0:
            return
        gap = not 0 < since_ns <= _GAP_NS
        if gap:
            self._estimator, self._heading = AttitudeEstimator(self._estimator), None
        if gap or not still or self._attitude is None:
            self._moved_ns = reading.stamp_ns
        self._stood_s += min(max(since_ns, 0), _GAP_NS) * 1e-9 * still
        still = reading.stamp_ns - self._moved_ns > _CALM_NS
        self._first_ns = reading.stamp_ns if self._attitude is None else self._first_ns
        self._stamp_ns, self._heard_ns = reading.stamp_ns, now_ns
        self._attitude = self._estimator.update(reading.gyro, reading.specific_force, max(since_ns, 1) * 1e-9, still)

    def attitude(self, now_ns: int) -> Attitude | None:
        """Return the attitude of the body; None without recent or reliable readings."""
        found = self._attitude
        return None if found is None or found.doubt > _MAX_UNCERTAINTY_RAD or now_ns - self._heard_ns > _GAP_NS else found

    def waiting_reason(self, now_ns: int) -> str:
        """Return why a standing robot should not walk yet, or an empty string."""
        heard = self._attitude is not None and now_ns - self._heard_ns <= _GAP_NS
        waits = heard and not self._estimator.knows_bias and self._stood_s < _PATIENCE_S
        return "the gyroscope measures its bias: the robot must stand still for 2 s" if waits else ""

    def problem(self, now_ns: int) -> str:
        """Return why a sensor that sends readings is not used, or an empty string."""
        if now_ns - self._odd_ns < _ODD_NS:
            return "the IMU readings exceed the range of any sensor (rad/s and m/s^2 expected); they are ignored"
        if self._attitude is None:
            return ""
        if self.attitude(now_ns) is not None:
            return self._unfollowed()
        silence_s = (now_ns - self._heard_ns) * 1e-9
        if silence_s > _GAP_NS * 1e-9:
            return f"no IMU readings for {silence_s:.1f} s; the tilt is estimated from the feet"
        if self._attitude.contradictory:
            return (
                "the IMU's gyroscope and accelerometer contradict each other (rad/s and m/s^2 expected); "
                "the tilt is estimated from the feet"
            )
        if self._stamp_ns - self._first_ns < _SETTLING_NS:
            return ""
        return (
            f"the IMU's tilt is uncertain by {math.degrees(self._attitude.doubt):.0f} deg; the tilt is estimated from the feet"
        )

    def _unfollowed(self) -> str:
        if self._steep:
            return (
                f"the body leans more than the {math.degrees(_MAX_LEAN_RAD):.0f} deg that the legs can compensate, by the IMU"
            )
        if self._astray:
            most = f"{math.degrees(_MAX_YAW_RAD):.0f} deg"
            return f"the headings of gyroscope and legs differ by more than {most} in one step; the legs' heading is used"
        return ""

    def turn(self, T_odom_body: Array, now_ns: int, dt: float, step: int | None = None) -> Array | None:
        """Return the turn (4, 4) of {odom} about the body towards the sensor, or None.

        It makes {odom} more level, and corrects the heading error from feet that slipped in a step.

        Args:
            T_odom_body: (4, 4) body pose by leg odometry.
            now_ns: [ns] the time.
            dt: [s] since the last call.
            step: Number of the running step; None for a standing robot.
        """
        if step != self._step:
            self._begin(step)
        found = self.attitude(now_ns)
        if found is None:
            self._heading = None
            return None
        yaw = self._yaw_to_make_up(yaw_of(T_odom_body), found.turned, dt)
        x, y = self._lean_to_make_up(T_odom_body[:3, :3] @ found.up, found.doubt, dt)
        if x == y == yaw == 0.0:
            return None
        R, place = exp_so3(np.array([x, y, yaw])), T_odom_body[:3, 3]
        self._heading = (yaw_of(R @ T_odom_body[:3, :3]), found.turned)
        self._R_levelled = R @ self._R_levelled
        self._calm = None if self._calm is None else R @ self._calm
        return transform(R, place - R @ place)

    def _lean_to_make_up(self, up: Array, doubt: float, dt: float) -> tuple[float, float]:
        """Return the correction [rad] about x and y now, from up (3,) {odom}."""
        x, y, z = up.tolist()
        sine = math.hypot(x, y)
        beyond = max(math.atan2(sine, z) - doubt, 0.0)
        angle = dt * min(_TURN_GAIN * beyond, _MAX_TURN_RAD_S) / max(sine, 1e-9)
        after = exp_so3(np.array([y * angle, -x * angle, 0.0])) @ self._R_levelled
        self._steep = bool(after[2, 2] < min(self._R_levelled[2, 2], math.cos(_MAX_LEAN_RAD)))
        return (0.0, 0.0) if self._steep else (y * angle, -x * angle)

    def _yaw_to_make_up(self, legs: float, gyro: float, dt: float) -> float:
        """Return the heading correction [rad] from the headings [rad] of legs and gyro."""
        before, self._heading = self._heading, (legs, gyro)
        if before is None or self._step is None:
            self._behind = 0.0
            return 0.0
        self._behind += gyro - before[1] - math.remainder(legs - before[0], math.tau)
        self._astray = self._astray or abs(self._made_up + self._behind) > _MAX_YAW_RAD
        if self._astray:
            self._behind = 0.0
        most = _MAX_TURN_RAD_S * dt
        yaw = float(min(max(min(_HEADING_GAIN * dt, 1.0) * self._behind, -most), most))
        self._behind -= yaw
        self._made_up += yaw
        return yaw

    def lifts_body(self, T_odom_body: Array, feet: Array, coming: NDArray[np.bool_], now_ns: int) -> NDArray[np.bool_]:
        """Flag the foot (6,) that lifts the body.

        A foot whose servo did not detect the ground is lowered further and lifts the body on its side. Leg odometry does not
        show this tilt, the IMU does. The flagged foot is the farthest one on the rising side of those that come down.

        Args:
            T_odom_body: (4, 4) body pose by leg odometry.
            feet: (6, 3) [m] {body}
            coming: (6,) legs that come down; without any, the present attitude becomes the reference.
            now_ns: [ns] the time.
        """
        found, flags = self.attitude(now_ns), np.zeros(6, dtype=np.bool_)
        up = None if found is None else T_odom_body[:3, :3] @ found.up
        if up is None or self._calm is None or not coming.any():
            self._calm = up
            return flags
        rising = (T_odom_body[:3, :3].T @ (up - self._calm))[:2]  # up leans, in the body frame, to the rising side
        size = math.hypot(*rising.tolist())
        if size > _LIFTED_LEAN_RAD:
            arms = np.where(coming, feet[:, :2] @ (rising / size), 0.0)
            flags[arms.argmax()] = arms.max() > _LIFTING_ARM_M
        return flags

    def tipped(self, T_odom_commanded: Array, now_ns: int) -> str:
        """Return a message if the body tips against a commanded pose (4, 4), else ""."""
        found = self.attitude(now_ns)
        if found is None:
            return ""
        off = math.acos(min(max(float(found.up @ T_odom_commanded[2, :3]), -1.0), 1.0))
        if off - found.doubt <= TIPPED:
            return ""
        most = f"at most {math.degrees(TIPPED):.0f} deg allowed"
        return f"the body leaned {math.degrees(off):.0f} deg from the commanded pose, by the IMU; {most}"
