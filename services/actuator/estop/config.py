"""Settings of the stop path."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Which robot it watches over."""

    port: str = "/dev/ttyUSB0"  # of the servos, as the actuator has it
