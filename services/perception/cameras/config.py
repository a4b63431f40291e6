"""Settings of the camera."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Which device is read, and how."""

    device: str = ""  # "openni2", "realsense", or the path of a recorded folder; empty for what the robot's profile names
    loop: bool = True  # a recorded folder begins anew when it is over
    color_rate_hz: float = 5.0  # of colour pictures at most, and only where somebody wants them
    delay_s: float = 0.0  # [s] from exposure to arrival at the least; stamps are set back by it

    def __post_init__(self) -> None:
        if self.color_rate_hz <= 0:
            raise ValueError(f"a positive color_rate_hz expected, found {self.color_rate_hz}")
        if not 0 <= self.delay_s < 1:
            raise ValueError(f"a delay_s from 0 to 1 s expected, found {self.delay_s}")
