"""Parameters of the two foothold layers."""

import math
from dataclasses import dataclass, field

from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class ScoreParams(Params):
    """Weights and limits of Lotriet's walkability score (2024, section 6.2.4).

    The defaults suit a spherical foot of 1 cm radius on a map of 1 cm cells. They refuse a cell within 2 cm of a 1 cm step and
    a slope of 35 degrees. They accept 15 degrees and steps of 5 mm. The slope alone reaches the limit at 31 degrees.
    """

    slope: float = ranged(1.0 / 0.6, 0.0, 1000.0)  # weight per unit gradient
    proximity: float = ranged(100.0, 0.0, 1e5)  # [1/m] weight of the mean height difference around the cell
    roughness: float = ranged(580.0, 0.0, 1e5)  # [1/m] weight of the deviation from the local plane
    limit: float = ranged(1.0, 0.01, 100.0)  # [1] highest weighted sum of a foothold; the published score is relative to it
    proximity_sigma: float = ranged(0.015, 1e-4, 0.5)  # [m] standard deviation of the Gaussian kernel
    flat_radius: float = ranged(0.02, 1e-4, 0.25)  # [m] half width of kernel and plane fit: ground that a foot needs around it
    noise_sigma: float = ranged(0.0015, 0.0, 0.5)  # [m] noise of the map in the plane deviation, subtracted in squares
    unknown_clearance: float = ranged(0.01, 0.0, 0.5)  # [m] cells this close to an unknown one get no score (at least one cell)


@dataclass(frozen=True, slots=True)
class FootholdMapParams(Params):
    """Masri's rules for a foothold (2016, sections 4.5 and 4.6)."""

    depth_limit: float = ranged(0.25, 0.01, 2.0)  # [m] below the body's centre; Masri's
    slope_limit: float = ranged(math.pi / 4, 0.01, 1.57)  # [rad] of a normal from the vertical, eq. 4.4; Masri's
    edge_deviation: float = ranged(1.7e-3, 1e-5, 0.5)  # [m] from the local plane: the effect of a 7 mm step
    unknown_clearance: float = ranged(0.02, 0.0, 0.5)  # [m] cells this close to vacant ground are not accessible
    closing: float = ranged(0.05, 0.0, 0.5)  # [m] edge of the square that bridges vacant cells; Masri's
    bound: float = ranged(0.05, 0.001, 1.0)  # [m] inside accessible ground, beyond which all cells are equal; Masri's
    reach: float = ranged(0.15, 0.001, 1.0)  # [m] outside, beyond which all cells are equal, so that a value fits in one byte


# An unknown cell may be the edge of a block seen from below, so a foot keeps the same distance from it as from an edge.
def _score_of_service() -> ScoreParams:
    return ScoreParams(unknown_clearance=0.02)


@dataclass(frozen=True, slots=True)
class FootholdLayersParams(Params):
    """The foothold layers, and the distance to keep from ground that carries no foot."""

    margin_sigmas: float = ranged(2.0, 0.0, 10.0)  # standard deviations of the position that are kept clear
    max_margin_m: float = ranged(0.05, 0.0, 0.1)  # [m] largest margin beyond the score's own; a cell that needs more is refused
    score: ScoreParams = field(default_factory=_score_of_service)
    foothold_map: FootholdMapParams = field(default_factory=FootholdMapParams)
