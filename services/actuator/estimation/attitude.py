"""Which way is up, by an inertial sensor: the explicit complementary filter with gravity as its one direction.

Source: Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on the special orthogonal group", IEEE Trans. Autom.
Control 53(5), 2008, section V. Of the attitude only that direction is kept, and beside it how far the gyro has turned about it.
"""

import math
from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, exp_so3, rotation_from_rpy
from sextant.shared.robot.profile import GRAVITY

_GAIN = 0.7  # [1/s] at which gravity as it is felt pulls the estimate, the paper's k_P
_BIAS_GAIN = 0.05  # [1/s^2] at which a lasting pull is put down to the gyro, its k_I
_BIAS_FROM = np.radians(5.0)  # larger pulls are a beginning or a push, no bias
_BIAS_LIMIT = 0.05  # [rad/s] of what a calibrated gyro may be off
_PUSH = 0.5  # [m/s^2] by which a specific force may differ from gravity's length and be half believed
_STILL_S, _STILL = 1.0, 0.02  # [s] in which a gyro at rest tells its bias, and [rad/s] up to which it may be at rest
_APART_S = 2.0  # [s] over which force and gyro are watched for whether they tell of one motion
_APART_FROM = 0.1  # [rad] by which they differ on average, from which they do not
_START_DOUBT = 0.2  # [rad] of one reading, taken while the robot may be moving
_FORCE_DOUBT = 5e-3  # [rad] of gravity as it is felt: what an accelerometer is off, 0.05 m/s^2, cannot be told from tilt
_GYRO_DOUBT = 2e-3  # [rad/s] of a gyro whose bias is not found yet


@dataclass(frozen=True, slots=True)
class Attitude:
    """How a body lies against gravity, and how much that is to be trusted."""

    R_level_body: Array  # (3, 3) roll and pitch, no yaw: {level} has its z axis up and its x axis over the body's
    doubt: float  # [rad] one sigma of the direction of up
    turned: float  # [rad] about up since the beginning, by the gyro alone; it drifts with what is left of the bias
    contradictory: bool  # whether gyro and force tell of different motions, as they do in other units

    @property
    def up(self) -> Array:
        """(3,) unit vector {body}"""
        return np.asarray(self.R_level_body[2])


class AttitudeEstimator:
    """Roll and pitch by what gyro and accelerometer say together: the one is right at once, the other in the long run."""

    def __init__(self, bias: Array | None = None):
        """Begin without a reading; the gyro's bias (3,) [rad/s] may be known."""
        self.bias = np.zeros(3) if bias is None else bias.copy()
        self._up: Array | None = None  # (3,) {body}
        self._doubt = _START_DOUBT
        self._turned = 0.0
        self._apart = 0.0  # [rad] between gravity as it is felt and as the gyro has turned it, on average

    def update(self, gyro: Array, specific_force: Array, dt: float, still: bool = False) -> Attitude:
        """Take in a reading.

        Args:
            gyro: (3,) [rad/s] {body}
            specific_force: (3,) [m/s^2] {body}, +g up at rest.
            dt: [s] since the reading before; of the first one nothing follows from it.
            still: Whether the body is known to stand still: only then can a bias about up be told.

        Raises:
            ValueError: dt is not positive.
        """
        if not dt > 0:
            raise ValueError(f"a positive interval expected, found {dt} s")
        length = math.sqrt(float(specific_force @ specific_force))
        if self._up is None:
            # Whatever cannot be gravity says nothing; upright is a guess as good as any.
            self._up = specific_force / length if abs(length - GRAVITY) < 4 * _PUSH else np.array([0.0, 0.0, 1.0])
            return self._attitude(self._up)
        if still and np.abs(gyro - self.bias).max() < _STILL:
            self.bias = self.bias + min(dt / _STILL_S, 1.0) * (gyro - self.bias)
        rate = gyro - self.bias
        belief = math.exp(-math.log(2.0) * ((length - GRAVITY) / _PUSH) ** 2)
        turned = exp_so3(-dt * rate) @ self._up  # as the force is felt at the end of dt
        pull = _cross(specific_force / max(length, 1e-9), turned)
        size = math.sqrt(float(pull @ pull))
        apart = math.atan2(size, float(specific_force @ turned) / max(length, 1e-9))
        self._apart += min(dt / _APART_S, 1.0) * belief * (apart - self._apart)
        if size < _BIAS_FROM:
            bias = self.bias - _BIAS_GAIN * belief * dt * pull
            self.bias = np.minimum(np.maximum(bias, -_BIAS_LIMIT), _BIAS_LIMIT)
        self._turned += dt * float(rate @ turned)
        up = turned - dt * _GAIN * belief * _cross(pull, turned)
        self._up = up / math.sqrt(float(up @ up))
        self._doubt += dt * (_GYRO_DOUBT - _GAIN * belief * (self._doubt - _FORCE_DOUBT))
        return self._attitude(self._up)

    def _attitude(self, up: Array) -> Attitude:
        x, y, z = up.tolist()
        roll, pitch = math.atan2(y, z), -math.asin(min(max(x, -1.0), 1.0))
        contradictory = self._apart > _APART_FROM
        doubt = self._doubt + self._apart * contradictory
        return Attitude(rotation_from_rpy((roll, pitch, 0.0)), doubt, self._turned, contradictory)


def _cross(a: Array, b: Array) -> Array:
    """a x b of two vectors (3,), by plain numbers: for one, the overhead of arrays is most of the time."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
