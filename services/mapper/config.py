"""Settings of the mapper."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Settings:
    """Size of the map and of the ground that is assumed at the start."""

    cells: int = 256  # along x
    cells_y: int = 0  # along y, 0 for as many
    resolution: float = 0.01  # [m]
    publish_every: int = 2  # scans per published map
    # The camera sees nothing nearer than half a metre: there the ground is taken for the plane of the feet, and said to be.
    assumed_ahead: float = 0.70  # [m] from the body's centre
    assumed_behind: float = 0.45  # [m]
    assumed_aside: float = 0.42  # [m]

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and along y."""
        return self.cells, self.cells_y or self.cells

    def __post_init__(self) -> None:
        if self.cells < 8 or (self.cells_y != 0 and self.cells_y < 8):
            raise ValueError(f"at least 8 cells along x, and along y or 0, expected, found {self.cells} and {self.cells_y}")
        if not 0.001 <= self.resolution <= 1.0:
            raise ValueError(f"resolution from 0.001 to 1 m expected, found {self.resolution}")
        if self.publish_every < 1:
            raise ValueError(f"publish_every of 1 or more expected, found {self.publish_every}")
