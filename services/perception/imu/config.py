"""Settings of the IMU process."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Port of the IMU."""

    port: str = ""  # I2C bus or serial port of the IMU, e.g. /dev/i2c-1; empty for that of the robot's profile
