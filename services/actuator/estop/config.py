"""Settings of the stop path."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Robot to watch."""

    port: str = "/dev/ttyUSB0"  # servo port, as in the actuator's settings
