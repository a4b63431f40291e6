"""Attitude from an inertial sensor: explicit complementary filter with gravity.

Source: Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on the special orthogonal group", IEEE Trans. Autom.
Control 53(5), 2008, section V. The state is the direction of up, and separately the angle that the gyro has turned about it.
"""

import math
from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, exp_so3, rotation_from_rpy
from sextant.shared.robot.profile import GRAVITY

_GAIN = 0.7  # [1/s] gain of the measured gravity direction, k_P of the paper
_BIAS_GAIN = 0.05  # [1/s^2] gain of the gyro bias, its k_I
_MAX_BIAS_ERROR_RAD = np.radians(5.0)  # [rad] errors beyond this come from the start or a push, not from the bias
_MAX_BIAS_RAD_S = 0.05  # [rad/s] maximum bias of a calibrated gyro
_PUSH_M_S2 = 0.5  # [m/s^2] deviation of the specific force from g that halves its weight
_STILL = 0.02  # [rad/s] difference from the bias up to which the gyro may be at rest
_KNOWN_S, _STILL_S = 1.0, 10.0  # [s] at rest from which the bias is known, and over which it is averaged
_APART_S = 2.0  # [s] over which force and gyro are compared for consistency
_INCONSISTENT_RAD = 0.1  # [rad] mean difference from which force and gyro are inconsistent
_START_SIGMA_RAD = 0.2  # [rad] sigma of the first reading, taken while the robot may be moving
_GRAVITY_SIGMA_RAD = 5e-3  # [rad] sigma of measured gravity: an accelerometer error of 0.05 m/s^2 looks like tilt
_GYRO_SIGMA_RAD_S = 2e-3  # [rad/s] sigma of a gyro with unknown bias


@dataclass(frozen=True, slots=True)
class Attitude:
    """Roll and pitch of the body, and their uncertainty."""

    R_level_body: Array  # (3, 3) roll and pitch, no yaw: the z axis of {level} is up, its x axis is over that of the body
    doubt: float  # [rad] standard deviation of the direction of up
    turned: float  # [rad] about up since the beginning, by the gyro alone; it drifts with the remaining bias
    contradictory: bool  # whether gyro and force are inconsistent, as with wrong units

    @property
    def up(self) -> Array:
        """(3,) unit vector of up {body}."""
        return np.asarray(self.R_level_body[2])


class AttitudeEstimator:
    """Estimate roll and pitch from gyro (short term) and accelerometer (long term)."""

    def __init__(self, before: "AttitudeEstimator | None" = None):
        """Begin without a reading, with the gyro bias that an earlier estimator has found."""
        self.bias: Array = np.zeros(3) if before is None else before.bias.copy()  # (3,) [rad/s]
        self._still_s: float = 0.0 if before is None else before._still_s  # [s] at rest, at most `_STILL_S`
        self._up: Array | None = None  # (3,) {body}
        self._find_implausibility = _START_SIGMA_RAD
        self._turned = 0.0
        self._apart = 0.0  # [rad] mean angle between measured gravity and that predicted by the gyro

    @property
    def knows_bias(self) -> bool:
        """Whether the gyro was at rest for long enough to know its bias about up."""
        return self._still_s > _KNOWN_S - 1e-9

    def update(self, gyro: Array, specific_force: Array, dt: float, still: bool = False) -> Attitude:
        """Update the estimate with a reading.

        Args:
            gyro: (3,) [rad/s] {body}
            specific_force: (3,) [m/s^2] {body}, +g up at rest.
            dt: [s] since the previous reading; not used for the first one.
            still: Whether the body is known to stand still. Only then is a bias about up observable. Gravity shows the bias
                about the other axes, and a body that has just stood up still levels itself.

        Raises:
            ValueError: dt is not positive.
        """
        if not dt > 0:
            raise ValueError(f"a positive interval expected, found {dt} s")
        length = math.sqrt(float(specific_force @ specific_force))
        if self._up is None:
            # Ignore a first reading that cannot be gravity, and start upright.
            self._up = specific_force / length if abs(length - GRAVITY) < 4 * _PUSH_M_S2 else np.array([0.0, 0.0, 1.0])
            return self._attitude(self._up)
        if still and np.abs(gyro - self.bias).max() < _STILL:
            self._still_s = min(self._still_s + dt, _STILL_S)
            self.bias = self.bias + dt / self._still_s * float((gyro - self.bias) @ self._up) * self._up
        rate = gyro - self.bias
        belief = math.exp(-math.log(2.0) * ((length - GRAVITY) / _PUSH_M_S2) ** 2)
        turned = exp_so3(-dt * rate) @ self._up  # predicted at the end of dt
        pull = _cross(specific_force / max(length, 1e-9), turned)
        size = math.sqrt(float(pull @ pull))
        apart = math.atan2(size, float(specific_force @ turned) / max(length, 1e-9))
        self._apart += min(dt / _APART_S, 1.0) * belief * (apart - self._apart)
        if size < _MAX_BIAS_ERROR_RAD:
            bias = self.bias - _BIAS_GAIN * belief * dt * pull
            self.bias = np.minimum(np.maximum(bias, -_MAX_BIAS_RAD_S), _MAX_BIAS_RAD_S)
        self._turned += dt * float(rate @ turned)
        up = turned - dt * _GAIN * belief * _cross(pull, turned)
        self._up = up / math.sqrt(float(up @ up))
        self._find_implausibility += dt * (
            _GYRO_SIGMA_RAD_S - _GAIN * belief * (self._find_implausibility - _GRAVITY_SIGMA_RAD)
        )
        return self._attitude(self._up)

    def _attitude(self, up: Array) -> Attitude:
        x, y, z = up.tolist()
        roll, pitch = math.atan2(y, z), -math.asin(min(max(x, -1.0), 1.0))
        contradictory = self._apart > _INCONSISTENT_RAD
        doubt = self._find_implausibility + self._apart * contradictory
        return Attitude(rotation_from_rpy((roll, pitch, 0.0)), doubt, self._turned, contradictory)


def _cross(a: Array, b: Array) -> Array:
    """Return a x b of two vectors (3,) with Python floats; faster than NumPy here."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
