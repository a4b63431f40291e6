"""Settings of the mapper."""

import math
from dataclasses import dataclass, field

from sextant.services.mapper.elevation.params import FusionParams, HeightDriftParams, RayClearingParams
from sextant.services.mapper.footholds.params import FootholdLayersParams
from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params
from sextant.shared.wire import topics


@dataclass(frozen=True, slots=True, kw_only=True)
class MapperParams(Params):
    """Parameters of the mapper."""

    publish_every: int = ranged(1, 1, 1000)  # scans per published map
    # The camera sees nothing within half a metre. The ground there is assumed to be the feet's plane, and marked as assumed.
    assumed_ahead: float = ranged(0.70, 0.0, 3.0)  # [m] assumed ground ahead of the body's centre
    assumed_behind: float = ranged(0.45, 0.0, 3.0)  # [m] assumed ground behind it
    assumed_aside: float = ranged(0.42, 0.0, 3.0)  # [m] assumed ground to either side of it
    # [m] largest difference of the ground's height by a leg and by the camera that the legs follow; 0 turns it off
    leg_difference: float = ranged(0.02, 0.0, 0.05)
    passage_every: int = ranged(8, 1, 1000)  # scans per passage map, while one is requested
    elevation: FusionParams = field(default_factory=FusionParams)
    ray_clearing: RayClearingParams = field(default_factory=RayClearingParams)
    height_drift: HeightDriftParams = field(default_factory=HeightDriftParams)
    footholds: FootholdLayersParams = field(default_factory=FootholdLayersParams)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(MapperParams):
    """Settings of the mapper: its parameters, the size of the map, and limits that follow from messages."""

    cells: int = 256  # along x
    cells_y: int = 0  # along y; 0 for the same as along x
    resolution: float = 0.01  # [m]
    passage_cells: int = 40_000  # maximum per passage
    scan_range: float = 1.5  # [m] horizontally from the camera, equal to the range of perception's scans
    foothold_rule: str = ""  # plug-in that scores the cells; empty for Lotriet's score

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and along y."""
        return self.cells, self.cells_y or self.cells

    def __post_init__(self) -> None:
        config.verify(self)
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
        if self.passage_cells < 1 or not self.scan_range > 0:
            raise ValueError(
                f"positive passage_cells and scan_range expected, found {self.passage_cells} and {self.scan_range}"
            )
