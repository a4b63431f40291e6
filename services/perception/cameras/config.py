"""Settings of the camera."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Device and parameters of the camera service."""

    device: str = (
        ""  # "openni2", "realsense", "oak", "orbbec", "external", or a recorded folder; empty for that of the robot's profile
    )
    loop: bool = True  # whether a recorded folder restarts at its end
    color_rate_hz: float = 5.0  # maximum rate of colour images, which are sent only with a subscriber
    gray: bool = True  # whether a camera with colour sends a small grey image with each depth image, for `perception.texture`
    delay_s: float = 0.0  # [s] minimum time from exposure to arrival; subtracted from stamps

    def __post_init__(self) -> None:
        if self.color_rate_hz <= 0:
            raise ValueError(f"a positive color_rate_hz expected, found {self.color_rate_hz}")
        if not 0 <= self.delay_s < 1:
            raise ValueError(f"a delay_s from 0 to 1 s expected, found {self.delay_s}")
