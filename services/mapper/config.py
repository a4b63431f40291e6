"""Settings of the mapper."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Size of the map and of the ground that is assumed at the start."""

    cells: int = 256  # along an edge
    resolution: float = 0.01  # [m]
    publish_every: int = 2  # scans per published map
    # The camera sees nothing nearer than half a metre: there the ground is taken for the plane of the feet, and said to be.
    assumed_ahead: float = 0.70  # [m] from the body's centre
    assumed_behind: float = 0.45  # [m]
    assumed_aside: float = 0.42  # [m]

    def __post_init__(self) -> None:
        if self.publish_every < 1:
            raise ValueError(f"publish_every of 1 or more expected, found {self.publish_every}")
