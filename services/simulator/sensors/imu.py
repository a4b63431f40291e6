"""IMU model: white noise, a random bias per run, and a random walk of the bias."""

from dataclasses import dataclass, replace

import numpy as np

from sextant.shared.geometry import Array


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise parameters of the IMU.

    The densities are from the data sheet of the MPU-6050. The biases are assumed residuals after calibration at rest.
    """

    gyro_density: float = 8.7e-5  # [rad/s/sqrt(Hz)]
    force_density: float = 3.9e-3  # [m/s^2/sqrt(Hz)]
    gyro_bias: float = 2e-3  # [rad/s] standard deviation at the start
    force_bias: float = 5e-2  # [m/s^2] standard deviation at the start
    gyro_walk: float = 2e-5  # [rad/s/sqrt(s)]
    force_walk: float = 5e-4  # [m/s^2/sqrt(s)]

    def times(self, factor: float) -> "ImuNoise":
        """Return this noise with other biases."""
        return replace(self, gyro_bias=self.gyro_bias * factor, force_bias=self.force_bias * factor)


class Imu:
    """IMU that adds noise and bias to the true motion."""

    def __init__(self, noise: ImuNoise, rng: np.random.Generator):
        self._noise, self._rng = noise, rng
        self._gyro_bias = rng.normal(0.0, noise.gyro_bias, 3)
        self.force_bias = rng.normal(0.0, noise.force_bias, 3)  # (3,) [m/s^2]

    def update(self, rate: Array, force: Array, dt: float) -> tuple[Array, Array]:
        """Return the next reading.

        Args:
            rate: True angular rate (3,) [rad/s].
            force: True specific force (3,) [m/s^2].
            dt: Time since the last reading [s].

        Returns:
            Measured angular rate (3,) [rad/s] and specific force (3,) [m/s^2].

        Raises:
            ValueError: dt is not positive.
        """
        if not dt > 0:
            raise ValueError(f"a positive interval expected, found {dt} s")
        n, rng = self._noise, self._rng
        self._gyro_bias = self._gyro_bias + rng.normal(0.0, n.gyro_walk * np.sqrt(dt), 3)
        self.force_bias = self.force_bias + rng.normal(0.0, n.force_walk * np.sqrt(dt), 3)
        gyro = rate + self._gyro_bias + rng.normal(0.0, n.gyro_density / np.sqrt(dt), 3)
        return gyro, force + self.force_bias + rng.normal(0.0, n.force_density / np.sqrt(dt), 3)
