"""Settings of the mapper."""

import math
from dataclasses import dataclass

from sextant.shared.wire import topics


@dataclass(frozen=True, slots=True)
class Settings:
    """Parameters of the map, of the ground assumed at the start, and of passages."""

    cells: int = 256  # along x
    cells_y: int = 0  # along y; 0 for the same as along x
    resolution: float = 0.01  # [m]
    publish_every: int = 2  # scans per published map
    # The camera sees nothing within half a metre. The ground there is assumed to be the feet's plane, and marked as assumed.
    assumed_ahead: float = 0.70  # [m] from the body's centre
    assumed_behind: float = 0.45  # [m]
    assumed_aside: float = 0.42  # [m]
    passage_every: int = 8  # scans per passage map, while one is requested
    passage_cells: int = 40_000  # maximum per passage
    scan_range: float = 1.5  # [m] horizontally from the camera, equal to the range of perception's scans

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and along y."""
        return self.cells, self.cells_y or self.cells

    def __post_init__(self) -> None:
        if self.cells < 8 or (self.cells_y != 0 and self.cells_y < 8):
            raise ValueError(f"at least 8 cells along x, and along y or 0, expected, found {self.cells} and {self.cells_y}")
        for what, cells, topic in (
            ("cells of the map", math.prod(self.shape), topics.TERRAIN),
            ("passage_cells", self.passage_cells, topics.PASSAGE),
        ):
            most = topics.cells_that_fit(topic)
            if cells > most:
                raise ValueError(f"at most {most} {what}, which a message of {topic.key} has room for, expected, found {cells}")
        if not 0.001 <= self.resolution <= 1.0:
            raise ValueError(f"resolution from 0.001 to 1 m expected, found {self.resolution}")
        if self.publish_every < 1 or self.passage_every < 1:
            found = f"{self.publish_every} and {self.passage_every}"
            raise ValueError(f"publish_every and passage_every of 1 or more expected, found {found}")
        if self.passage_cells < 1 or not self.scan_range > 0:
            raise ValueError(
                f"positive passage_cells and scan_range expected, found {self.passage_cells} and {self.scan_range}"
            )
