"""Parameters of the elevation map: fusion of scans, ray clearing, height drift."""

from dataclasses import dataclass

from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class FusionParams(Params):
    """Error model of a measured height apart from the sensor's noise, and when a cell accepts a different height."""

    floor_sigma: float = ranged(1.0e-3, 1e-9, 0.1)  # [m] error that repeated measurements do not average out
    terrain_slope: float = ranged(0.27, 0.0, 5.0)  # [m/m] steepest ground that is mapped accurately
    independent_pixels: int = ranged(8, 1, 10_000)  # maximum number of a cell's pixels that count: their noise is correlated
    gate: float = ranged(3.0, 0.1, 100.0)  # [sigma] beyond which a measurement votes for the rival height
    edge_step: float = ranged(0.01, 0.0, 1.0)  # [m] apart, points of one scan and cell form an edge; the upper one is used
    patience: int = ranged(5, 1, 200)  # [scans] of disagreement until a well-established height is replaced


@dataclass(frozen=True, slots=True)
class RayClearingParams(Params):
    """Clearing of objects that have gone, by rays that pass through their cells."""

    every: int = ranged(2, 1, 1000)  # every n-th point of a scan has its ray traced, different ones in each scan
    short_cells: int = ranged(3, 1, 100)  # [cells] before its end at which a ray stops: a hit object has a thickness
    well_below_m: float = ranged(0.02, 0.0, 1.0)  # [m] beyond three sigma, by which a ray must pass below a cell's height
    scans_inside: int = ranged(8, 1, 255)  # largest number of scans through a cell inside an object until it is cleared
    scans_per_measurement: int = ranged(4, 1, 255)  # scans through a cell that clear it, per scan that has measured it
    max_sigma_m: float = ranged(0.01, 0.0, 1.0)  # [m] cap of a cell's height sigma: a larger one is the spread of the object
    cleared_neighbours: int = ranged(3, 1, 8)  # cleared neighbours from which a cell at the rim of an object may be cleared

    @property
    def settled_scans(self) -> int:
        """Measuring scans after which a cleared cell counts as normal again."""
        return min(16 * self.scans_inside, 255)  # a layer of bytes counts them


@dataclass(frozen=True, slots=True)
class HeightDriftParams(Params):
    """Compensation of a drift of the poses in height, after elevation_mapping_cupy (Miki et al. 2022, section III-B)."""

    every: int = ranged(8, 1, 1000)  # every n-th cell is used
    max_sigma_m: float = ranged(0.004, 1e-4, 0.1)  # [m] largest sigma of a cell that is used; next to an edge it is larger
    same_ground_m: float = ranged(0.03, 0.001, 0.5)  # [m] largest offset of the same ground
    min_cells: int = ranged(50, 1, 100_000)  # minimum number of cells
    correlated_cells: int = ranged(6, 1, 1000)  # cells that count as one, because neighbours share their errors
    begin_m: float = ranged(0.002, 0.0, 0.1)  # [m] offset that starts the compensation
    end_m: float = ranged(0.0005, 0.0, 0.1)  # [m] offset that ends it
    scans: int = ranged(3, 1, 1000)  # consecutive scans that must show a drift
    rate_m: float = ranged(0.002, 0.0, 0.1)  # [m] largest change of the compensation per scan

    checks = (config.together("end_m begin_m", lambda end, begin: end <= begin, "at most begin_m"),)
